"""How well a motion stands on its ground: penetration, sliding, pops, jerk.

NumPy; lengths in metres, y up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from fitting.datasets.clips import contacts
from fitting.datasets.clips.clip import Clip
from jaxik.maths import quat, vec
from jaxik.world.frame import UP

from .playback import Motion

STRAIGHT_KNEE = np.radians(175.0)  # rad; a larger knee angle counts as straight
TICK = 1.0 / 60.0  # s, the time over which a pop is measured
POP = 0.02  # m in a tick; a correction that changes faster is a pop


@dataclass(frozen=True)
class Measures:
    """Measures of one motion; NaN where there is nothing to measure.

    `fitting.report.labels.MEASURES` defines each of them.
    """

    penetration_mean: float
    """Metres."""
    penetration_max: float
    """Metres."""
    clearance: float
    """Metres."""
    slide: float
    """m per stance."""
    pop_max: float
    """m in a 60th of a second."""
    pops: float
    """Count."""
    knee_jerk: float
    """Rad/s³."""
    pelvis_jerk: float
    """m/s³."""
    reached: float
    """Fraction of targets."""
    straight: float
    """Fraction of frames and legs."""


@dataclass(frozen=True)
class FootStates:
    """What is known of each foot in each frame, beside its joints."""

    gap: Float64[np.ndarray, "frames legs"]
    """m, see `gaps`; NaN where there is no ground."""
    stance: Bool[np.ndarray, "frames legs"]
    """Where the animation says that the foot stands."""
    reached: Float64[np.ndarray, "frames legs"]
    """1 or 0; NaN where there is no target."""


def measure(
    motion: Motion, animated: Motion, feet: FootStates, fps: float, cuts: Sequence[int] = ()
) -> Measures:
    """All measures of a motion.

    Args:
        motion: after foot IK.
        animated: before it.
        feet: of the motion.
        fps: frames per second.
        cuts: frames at which the motion starts anew, as in a teleport; see `Clip.cuts`.
    """
    depth = np.maximum(-feet.gap, 0.0)
    correction = np.asarray(motion.ankle) - np.asarray(animated.ankle)
    speed = correction_speed(correction, fps, cuts)
    return Measures(
        penetration_mean=_mean(depth),
        penetration_max=_largest(depth),
        clearance=_mean(np.maximum(feet.gap, 0.0)[feet.stance]),
        slide=slide_per_stance(np.asarray(motion.toe), feet.stance, cuts),
        pop_max=_largest(speed),
        pops=float(sum(len(contacts.runs(leg_speed > POP)) for leg_speed in speed.T)),
        knee_jerk=jerk(motion.knee_angle, fps, cuts),
        pelvis_jerk=jerk(np.asarray(motion.pelvis)[:, 1], fps, cuts),
        reached=_mean(feet.reached),
        straight=_mean((motion.knee_angle > STRAIGHT_KNEE).astype(float)),
    )


def soles(clip: Clip) -> Float64[np.ndarray, "frames legs 2 3"]:
    """Points of the soles below ankles and balls, along each foot's up axis, m, world space.

    They are as far below as the clip's rig says.
    """
    rig = clip.rig
    depths = np.stack([rig.ankle_height, rig.ball_height], axis=-1)
    feet = quat.multiply(clip.leg_pose_ws().ankle.rot, rig.ankle_from_foot)
    up = np.asarray(quat.rotate(feet, vec.constant(UP, feet)))
    joints = np.stack([clip.joints_ws(2), clip.joints_ws(3)], axis=2)
    return joints - depths[..., None] * up[:, :, None]


def gaps(
    soles_ws: Float64[np.ndarray, "*b 2 3"], ground: Float64[np.ndarray, "*b 2"]
) -> Float64[np.ndarray, "*b"]:
    """Height of a foot's lowest point above the ground under it, m; negative in the ground.

    A foot with ground under one of its points is measured there; a foot without ground is NaN.

    Args:
        soles_ws: the points of each foot's sole, world space, m.
        ground: height of the ground under each point, m; NaN where there is none.
    """
    return np.fmin.reduce(soles_ws[..., 1] - ground, axis=-1)


def slide_per_stance(
    ball_ws: Float[np.ndarray, "frames legs 3"],
    stance: Bool[np.ndarray, "frames legs"],
    cuts: Sequence[int] = (),
) -> float:
    """Length of the ball's horizontal path in a stance, m; median over the stances of all feet.

    Stances of a single frame are left out; NaN where there are no others.
    """
    steps = horizontal_steps(ball_ws, cuts)
    travelled = np.concatenate([np.zeros((1, ball_ws.shape[1])), np.cumsum(steps, axis=0)])
    slides = [
        travelled[last, leg] - travelled[first, leg]
        for leg in range(ball_ws.shape[1])
        for first, last in contacts.runs(stance[:, leg])
        if last > first
    ]
    return float(np.median(slides)) if slides else float("nan")


def horizontal_steps(
    points_ws: Float[np.ndarray, "frames legs 3"], cuts: Sequence[int] = ()
) -> Float[np.ndarray, "steps legs"]:
    """How far points move from frame to frame over the ground, m; not at all where a cut is."""
    steps = np.linalg.norm(np.diff(points_ws[..., [0, 2]], axis=0), axis=-1)
    steps[[cut - 1 for cut in cuts]] = 0.0
    return steps


def correction_speed(
    correction_ws: Float[np.ndarray, "frames legs 3"], fps: float, cuts: Sequence[int] = ()
) -> Float[np.ndarray, "changes legs"]:
    """How fast corrections change, m in a `TICK`; NaN where a cut lies between.

    The change is taken over a tick, or over a frame where frames are longer. A steady change gives
    the same number at every frame rate. A jump gives its size at 60 Hz and its multiples, and half
    of it at 30 Hz, where it cannot be distinguished from a steady change within the frame.
    """
    frames = max(1, round(fps * TICK))
    change = np.linalg.norm(correction_ws[frames:] - correction_ws[:-frames], axis=-1)
    for cut in cuts:
        change[max(cut - frames, 0) : cut] = np.nan
    return change * (fps * TICK / frames)


def jerk(series: Float[np.ndarray, "*b"], fps: float, cuts: Sequence[int] = ()) -> float:
    """Root mean square of the third derivative, per s³, of a series with frames on its first axis.

    Taken by differences of four consecutive frames, none of which starts anew (`cuts`); NaN for
    shorter series.
    """
    third = np.diff(series, n=3, axis=0) * fps**3
    across = [first for cut in cuts for first in range(max(cut - 3, 0), min(cut, len(third)))]
    third = np.delete(third, across, axis=0)
    return float(np.sqrt(np.mean(third**2))) if third.size else float("nan")


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _largest(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else float("nan")
