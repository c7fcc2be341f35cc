"""A synthetic walk: feet placed exactly, swings and pelvis as an average adult's.

Played directly, the measured curves of `gait` leave feet sliding by centimetres; `footsteps` places
them instead. The pelvis follows its curve as far as both legs reach their feet, and knees follow
from the law of cosines, so bones keep their lengths exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.assemble import JointMotion, clip_from_joints
from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.leg_geometry import knee_positions, leg_rotations, unit

from . import gait
from .footsteps import SIDES, sample_footsteps
from .speed_profile import Event, Slide, speed_profile
from .trajectories import GroundPath, heading_vectors, smoothstep

MAX_REACH = 0.992  # of a leg's length, to which it extends: the knee keeps 15 degrees
SETTLE = 0.1  # s, before and after the pelvis gives way to a leg
BREATH, BREATH_HZ = 0.003, 0.3  # m and Hz: the pelvis of a standing body rises and falls
JOINTS = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
          "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7)


@dataclass(frozen=True)
class WalkStyle:
    """How straight and how regular a walk is."""

    bend: float = 0.09
    """rad, about how far the path turns away from +z to either side."""
    variation: float = 1.0
    """Of strides, 1 as measured; 0 makes all alike."""


def walk(
    seconds: float = 12.0,
    fps: float = 60.0,
    seed: int = 0,
    events: Sequence[Event] = (),
    style: WalkStyle = WalkStyle(),
) -> Clip:
    """A walk over the floor y = 0, from the origin along +z, with its contact labels.

    A foot is labelled as standing while its ball is placed. It then does not move, except in slips
    and slides, which carry the whole body along, standing feet included. In a stop both feet lie
    flat and nothing moves but the pelvis, which breathes up and down.

    Args:
        seconds: length of the clip.
        fps: frames per second.
        seed: of the differences between strides.
        events: slips, slides and stops. Slides and stops must be 2 s or more apart. `Clip.slide` is
            1 in slides, and None without any.
        style: how straight and how regular the walk is.

    Raises:
        ValueError: a length or rate that is not above 0, or an event outside the clip.
    """
    if not (seconds > 0 and fps > 0):
        raise ValueError(f"wanted seconds and fps above 0, got {seconds} s at {fps} fps")
    for event in events:
        if not 0 <= event.start < event.end <= seconds:
            raise ValueError(f"{event} does not lie in the clip's {seconds} s")
    time = np.arange(round(seconds * fps)) / fps
    cadence, drift, slide, still = speed_profile(time, fps, events)
    phase = np.concatenate([[0.0], np.cumsum(cadence[:-1])]) / (fps * gait.PERIOD)
    strides = int(phase[-1]) + 3
    rng = np.random.default_rng(seed)
    path = GroundPath(style.bend, rng.uniform(0.0, 2.0 * np.pi))

    along = gait.STRIDE * phase
    yaw = path.yaw(along)
    drift_ws = drift[:, None] * heading_vectors(yaw)
    drifted = np.concatenate([np.zeros((1, 3)), np.cumsum(drift_ws[:-1], axis=0)]) / fps
    bob = _smooth_noise(phase, strides, rng) * gait.HEIGHT_SD * style.variation
    pelvis = path.points(along, 0.0, gait.curve(gait.HEIGHT, phase) + bob)
    left_ws = heading_vectors(yaw + np.pi / 2)
    heading = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    hips = [
        pelvis + heading.apply([side * gait.HALF_PELVIS, -gait.HIP_DROP, 0.0]) for side in SIDES
    ]
    feet = [
        sample_footsteps(leg, strides, path, style.variation, rng).motion(phase, still)
        for leg in range(len(SIDES))
    ]
    sinking = _sinking(hips, [foot.ankle for foot in feet], round(SETTLE * fps))
    breath = BREATH * 0.5 * (1.0 - np.cos(2.0 * np.pi * BREATH_HZ * time))
    sinking = (sinking + still * breath)[:, None] * [0.0, 1.0, 0.0]

    positions, rotations = [pelvis - sinking], [heading.as_quat(scalar_first=True)]
    for hip, foot in zip(hips, feet, strict=True):
        hip = hip - sinking
        forward = -unit(np.cross(unit(foot.ankle - hip), left_ws))
        knee = knee_positions(hip, foot.ankle, forward, (gait.THIGH, gait.SHIN))
        positions += [hip, knee, foot.ankle, foot.ball]
        rotations += [*leg_rotations(hip, knee, foot.ankle, left_ws), foot.rot, foot.rot]
    motion = JointMotion(
        JOINTS, PARENTS, np.stack(positions, axis=1) + drifted[:, None],
        np.stack(rotations, axis=1), np.stack([foot.stance for foot in feet], axis=-1), float(fps),
    )  # fmt: skip
    clip = clip_from_joints(motion, f"walker seed {seed}")
    has_slide = any(isinstance(event, Slide) for event in events)
    return replace(clip, slide=slide if has_slide else None)


def _sinking(hips: list[np.ndarray], ankles: list[np.ndarray], window: int) -> np.ndarray:
    """How far the body sinks, m, (frames,), smoothly, so that both legs reach their feet."""
    missing = np.zeros(len(hips[0]))
    max_length = MAX_REACH * (gait.THIGH + gait.SHIN)
    for hip, ankle in zip(hips, ankles, strict=True):
        leg = hip - ankle
        highest = np.sqrt(max_length**2 - leg[:, 0] ** 2 - leg[:, 2] ** 2)
        missing = np.maximum(missing, leg[:, 1] - highest)
    # A mean of maxima over the same window is nowhere below what is needed.
    kernel = np.hanning(2 * window + 3)[1:-1]
    upper = maximum_filter1d(missing, len(kernel), mode="nearest")
    return convolve1d(upper, kernel / kernel.sum(), mode="nearest")


def _smooth_noise(phase: np.ndarray, strides: int, rng: np.random.Generator) -> np.ndarray:
    """A smooth curve through one standard normal value per stride."""
    values = rng.normal(size=strides + 1)
    stride = np.floor(phase).astype(int)
    return values[stride] + smoothstep(phase - stride) * (values[stride + 1] - values[stride])
