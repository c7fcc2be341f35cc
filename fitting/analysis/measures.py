"""What a motion does over its ground, in numbers. NumPy; lengths in metres, y up."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from fitting.datasets.clips import contacts
from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.rigs import flat_frames
from jaxik.maths import quat, vec
from jaxik.world.frame import UP

from .playback import Motion

STRAIGHT = np.radians(175.0)  # rad, angle above which a knee counts as straight
TICK = 1.0 / 60.0  # s, over which a pop is measured
POP = 0.02  # m in a tick; a correction that moves faster pops


@dataclass(frozen=True)
class Measures:
    """One motion in numbers, as `COLUMNS` explains them; NaN where there is nothing to measure."""

    penetration_mean: float  # m
    penetration_max: float  # m
    clearance: float  # m
    slide: float  # m a stance
    pop_max: float  # m in a 60th of a second
    pops: float  # how many
    knee_jerk: float  # rad/s³
    pelvis_jerk: float  # m/s³
    reached: float  # share of 1
    straight: float  # share of 1


class Column(NamedTuple):
    """How a measure is shown: its value times `factor` in `unit`."""

    head: str
    unit: str
    factor: float
    digits: int
    meaning: str


COLUMNS = {
    "penetration_mean": Column(
        "penetration, mean", "cm", 100.0, 2,
        "How deep a foot is in the ground, mean over all frames and feet; 0 for a foot that is not "
        "in it. The deeper of two points of its sole counts, one below the ankle and one below the "
        "ball (the toe joint). Each is as far below its joint, along the foot's up, as the joint "
        "is over the floor when the animated foot stands flat.",
    ),
    "penetration_max": Column(
        "penetration, max", "cm", 100.0, 1, "The deepest that any foot is in the ground."
    ),
    "clearance": Column(
        "sole clearance", "cm", 100.0, 2,
        "Air under a standing foot, mean over its frames: height over the ground of the lower of "
        "the same two points, 0 where one of them touches the ground or is in it.",
    ),
    "slide": Column(
        "slide per stance", "cm", 100.0, 2,
        "Length of the way that the ball of the foot (the toe joint) makes in a stance, seen from "
        "above; median over the stances of all feet.",
    ),
    "pop_max": Column(
        "largest pop", "cm in 1/60 s", 100.0, 1,
        "The fastest change of an ankle's correction, that is of where foot IK puts it less where "
        "the animation has it. It is the change over 1/60 s, or over a frame as its share of "
        "1/60 s where frames are longer, so that clips of different rates compare.",
    ),
    "pops": Column(
        "pops", "count", 1.0, 0,
        "How often an ankle's correction changes by more than 2 cm in 1/60 s. Frames in a row over "
        "that speed are one pop.",
    ),
    "knee_jerk": Column(
        "knee jerk", "rad/s³", 1.0, 0,
        "Third derivative of the knee angle, from four frames in a row; root mean square over "
        "all knees. It grows with the rate of a clip: compare it with that of the animation.",
    ),
    "pelvis_jerk": Column(
        "pelvis jerk", "m/s³", 1.0, 1,
        "The same of the height of the pelvis.",
    ),
    "reached": Column(
        "targets reached", "%", 100.0, 1,
        "Share of the ankle targets, over all frames and feet with ground under them, at which the "
        "system says that the ankle has arrived.",
    ),
    "straight": Column(
        "straight knees", "%", 100.0, 1,
        "Share of all frames and legs in which the knee is opened by more than 175°.",
    ),
}  # fmt: skip


def worded(key: str, value: float) -> str:
    """A measure in the unit of its column; a dash where there is none."""
    column = COLUMNS[key]
    return "–" if np.isnan(value) else f"{column.factor * value:.{column.digits}f}"


def measure(
    motion: Motion,
    animated: Motion,
    gap: Float64[np.ndarray, "frames legs"],
    stance: Bool[np.ndarray, "frames legs"],
    reached: Float64[np.ndarray, "frames legs"],
    fps: float,
) -> Measures:
    """All measures of a motion.

    Args:
        motion: after foot IK.
        animated: before.
        gap: see `gaps`; NaN where there is no ground.
        stance: where the animation says that a foot stands.
        reached: 1 or 0; NaN where there is no target.
        fps: frames per second.
    """
    depth = np.maximum(-gap, 0.0)
    correction = np.asarray(motion.ankle) - np.asarray(animated.ankle)
    speed = correction_speed(correction, fps)
    return Measures(
        penetration_mean=_mean(depth),
        penetration_max=_largest(depth),
        clearance=_mean(np.maximum(gap, 0.0)[stance]),
        slide=slide_per_stance(np.asarray(motion.toe), stance),
        pop_max=_largest(speed),
        pops=float(sum(len(contacts.runs(of_leg > POP)) for of_leg in speed.T)),
        knee_jerk=jerk(motion.knee_angle, fps),
        pelvis_jerk=jerk(np.asarray(motion.pelvis)[:, 1], fps),
        reached=_mean(reached),
        straight=_mean((motion.knee_angle > STRAIGHT).astype(float)),
    )


def sole_depths(clip: Clip, floor: float = 0.0) -> Float64[np.ndarray, "legs 2"]:
    """How far the sole is below each ankle and each ball, m.

    It is their height over the floor, the median over the frames in which the foot stands flat.

    Args:
        clip: the animation on its flat floor.
        floor: its height, m.
    """
    stance, joints = clip.stance_labels(), np.stack([clip.joints_ws(2), clip.joints_ws(3)], axis=2)
    depths = []
    for leg in range(stance.shape[1]):
        flat = flat_frames(joints[:, leg, 0], joints[:, leg, 1], stance[:, leg])
        depths.append(np.median(joints[flat, leg, :, 1], axis=0) - floor)
    return np.array(depths)


def soles(
    clip: Clip, depths: Float64[np.ndarray, "legs 2"]
) -> Float64[np.ndarray, "frames legs 2 3"]:
    """Points of the soles below ankles and balls along the feet's up, m, world space.

    Args:
        clip: a motion of the rig from which the depths are.
        depths: see `sole_depths`.
    """
    feet = quat.multiply(clip.leg_pose_ws().ankle.rot, clip.rig.ankle_from_foot)
    up = np.asarray(quat.rotate(feet, vec.constant(UP, feet)))
    joints = np.stack([clip.joints_ws(2), clip.joints_ws(3)], axis=2)
    return joints - depths[..., None] * up[:, :, None]


def gaps(
    soles_ws: Float64[np.ndarray, "*b 2 3"], ground: Float64[np.ndarray, "*b 2"]
) -> Float64[np.ndarray, "*b"]:
    """Height of a foot's lowest point over the ground under it, m; below 0 in the ground.

    Args:
        soles_ws: the points of each foot's sole, world space, m.
        ground: height of the ground under each, m; NaN without. A foot with ground under one of its
            points is measured there, one without ground is NaN.
    """
    return np.fmin.reduce(soles_ws[..., 1] - ground, axis=-1)


def slide_per_stance(
    ball_ws: Float[np.ndarray, "frames legs 3"], stance: Bool[np.ndarray, "frames legs"]
) -> float:
    """Way of a ball over the ground plan in a stance, m; median over the stances of all feet.

    A stance of a single frame has no way and is left out; NaN where there is no other.
    """
    steps = np.linalg.norm(np.diff(ball_ws[..., [0, 2]], axis=0), axis=-1)
    way = np.concatenate([np.zeros((1, ball_ws.shape[1])), np.cumsum(steps, axis=0)])
    ways = [
        way[last, leg] - way[first, leg]
        for leg in range(ball_ws.shape[1])
        for first, last in contacts.runs(stance[:, leg])
        if last > first
    ]
    return float(np.median(ways)) if ways else float("nan")


def correction_speed(
    correction_ws: Float[np.ndarray, "frames legs 3"], fps: float
) -> Float[np.ndarray, "changes legs"]:
    """How fast corrections change, m in a `TICK`.

    Taken over a tick, or over a frame where frames are longer. A steady change gives the same
    number at every rate. A jump gives its size at 60 Hz and its multiples, and half of it at 30 Hz,
    where it cannot be told from a steady change within the frame.
    """
    apart = max(1, round(fps * TICK))
    change = np.linalg.norm(correction_ws[apart:] - correction_ws[:-apart], axis=-1)
    return change * (fps * TICK / apart)


def jerk(series: Float[np.ndarray, "*b"], fps: float) -> float:
    """Root mean square of the third derivative, per s³, of series whose first axis is of frames.

    Taken by differences of four frames in a row; NaN for fewer.
    """
    third = np.diff(series, n=3, axis=0) * fps**3
    return float(np.sqrt(np.mean(third**2))) if third.size else float("nan")


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _largest(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else float("nan")
