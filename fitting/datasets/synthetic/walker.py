"""A walk made from measured curves: feet placed exactly, swings and pelvis as an average adult's.

Put straight through forward kinematics, the curves of `gait` leave feet sliding by centimetres, so
`steps` places them. The pelvis follows its curve as far as both legs reach their feet; legs are
closed by the cosine law, so that bones keep their lengths exactly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.formats.npz import clip_from_joints, leg_rotations
from fitting.datasets.clips.rigs import unit

from . import gait
from .footsteps import Path, Steps, forward_ws
from .speed_profile import Slide, Slip, Stop, pace
from .trajectories import smoothstep

REACH = 0.992  # share of a leg's length to which it stretches: its knee keeps 15 degrees
SETTLE = 0.1  # s, before and after the pelvis gives way to a leg
BREATH, BREATH_HZ = 0.003, 0.3  # m, by which the pelvis of a standing body rises and falls
JOINTS = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
          "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7)


def walk(
    seconds: float = 12.0,
    fps: float = 60.0,
    seed: int = 0,
    *,
    turn: float = 0.09,
    variation: float = 1.0,
    slips: Sequence[Slip] = (),
    slides: Sequence[Slide] = (),
    stops: Sequence[Stop] = (),
) -> Clip:
    """A walk over the floor y = 0, from the origin along +z, with its contact labels.

    A foot is labelled as standing while its ball is placed. It then does not move, but for slips
    and slides: they carry the whole body along, standing feet included. In a stop both feet lie
    flat and nothing moves but the pelvis, which breathes up and down.

    Args:
        seconds: length of the clip.
        fps: frames per second.
        seed: of the differences between strides.
        turn: rad, how far the path turns away from +z to either side, about.
        variation: of strides, as a share of the measured one; 0 makes all alike.
        slips: spells in which the root runs ahead of the feet or lags behind.
        slides: spells of sliding, apart by 2 s or more; `Clip.slide` is 1 in them.
        stops: spells of standing, apart from each other and from slides by 2 s or more.

    Raises:
        ValueError: for a length or a rate that is not above 0, a spell that does not lie in the
            clip.
    """
    if not (seconds > 0 and fps > 0):
        raise ValueError(f"wanted seconds and fps above 0, got {seconds} s at {fps} fps")
    for spell in (*slips, *slides, *stops):
        if not 0 <= spell.start < spell.end <= seconds:
            raise ValueError(f"{spell} does not lie in the clip's {seconds} s")
    frames = round(seconds * fps)
    time = np.arange(frames) / fps
    cadence, drift, slide, still = pace(time, fps, slips, slides, stops)
    phase = np.concatenate([[0.0], np.cumsum(cadence[:-1])]) / (fps * gait.PERIOD)
    strides = int(phase[-1]) + 3
    rng = np.random.default_rng(seed)
    path = Path(turn, rng.uniform(0.0, 2.0 * np.pi))

    along = gait.STRIDE * phase
    yaw = path.yaw(along)
    travel = drift[:, None] * forward_ws(yaw)
    carried = np.concatenate([np.zeros((1, 3)), np.cumsum(travel[:-1], axis=0)]) / fps
    bob = _smooth_noise(phase, strides, rng) * gait.HEIGHT_SD * variation
    pelvis = path.at(along, 0.0, gait.curve(gait.HEIGHT, phase) + bob)
    left_ws = forward_ws(yaw + np.pi / 2)
    heading = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    sides = np.array([1.0, -1.0])
    hips = [
        pelvis + heading.apply([side * gait.HALF_PELVIS, -gait.HIP_DROP, 0.0]) for side in sides
    ]
    feet = [
        Steps.draw(strides, side, late, path, variation, rng).foot(phase, still)
        for side, late in zip(sides, gait.LATE, strict=True)
    ]
    sunk = _sunk(hips, [foot.ankle for foot in feet], round(SETTLE * fps))
    breath = BREATH * 0.5 * (1.0 - np.cos(2.0 * np.pi * BREATH_HZ * time))
    sunk = (sunk + still * breath)[:, None] * [0.0, 1.0, 0.0]

    positions, turns = [pelvis - sunk], [heading.as_quat(scalar_first=True)]
    for hip, foot in zip(hips, feet, strict=True):
        hip = hip - sunk
        knee = bent_knee(hip, foot.ankle, left_ws, gait.THIGH, gait.SHIN)
        positions += [hip, knee, foot.ankle, foot.ball]
        turns += [*leg_rotations(hip, knee, foot.ankle, left_ws), foot.rot, foot.rot]
    clip = clip_from_joints(
        JOINTS,
        PARENTS,
        np.stack(positions, axis=1) + carried[:, None],
        np.stack(turns, axis=1),
        float(fps),
        f"walker seed {seed}",
        np.stack([foot.stands for foot in feet], axis=-1),
    )
    return replace(clip, slide=slide if len(slides) else None)


def bent_knee(
    hip: np.ndarray, ankle: np.ndarray, hinge_ws: np.ndarray, thigh: float, shin: float
) -> np.ndarray:
    """Knees, m, (frames, 3), that bend forward where `hinge_ws` is left; a leg reaches its ankle.

    `hinge_ws`, (frames, 3), is the axis about which a knee flexes, as far as the leg lets it.
    """
    leg = ankle - hip
    distance = np.linalg.norm(leg, axis=-1, keepdims=True)
    along = leg / distance
    forth = (thigh**2 - shin**2 + distance**2) / (2.0 * distance)
    return hip + along * forth - unit(np.cross(along, hinge_ws)) * np.sqrt(thigh**2 - forth**2)


def _sunk(hips: list[np.ndarray], ankles: list[np.ndarray], around: int) -> np.ndarray:
    """How far the body sinks, m, (frames,), smoothly, so that both legs reach."""
    short = np.zeros(len(hips[0]))
    for hip, ankle in zip(hips, ankles, strict=True):
        leg = hip - ankle
        highest = np.sqrt((REACH * (gait.THIGH + gait.SHIN)) ** 2 - leg[:, 0] ** 2 - leg[:, 2] ** 2)
        short = np.maximum(short, leg[:, 1] - highest)
    # A mean of maxima over the same window is nowhere below what is needed.
    window = np.hanning(2 * around + 3)[1:-1]
    widest = maximum_filter1d(short, len(window), mode="nearest")
    return convolve1d(widest, window / window.sum(), mode="nearest")


def _smooth_noise(phase: np.ndarray, strides: int, rng: np.random.Generator) -> np.ndarray:
    """A curve through a normal draw a stride."""
    knots = rng.normal(size=strides + 1)
    stride = np.floor(phase).astype(int)
    return knots[stride] + smoothstep(phase - stride) * (knots[stride + 1] - knots[stride])
