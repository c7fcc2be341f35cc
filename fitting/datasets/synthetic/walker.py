"""A synthetic walk: feet placed exactly, swings and pelvis as an average adult's.

Played directly, the measured curves of `gait` leave feet sliding by centimetres; `footsteps` places
them instead. The pelvis follows its curve as far as both legs reach their feet (`body`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fitting.datasets.clips.clip import Clip

from . import gait
from .body import Body
from .footsteps import SIDES, sample_footsteps
from .speed_profile import Event, Slide, speed_profile
from .trajectories import GroundPath, heading_vectors, smoothstep

BREATH, BREATH_HZ = 0.003, 0.3  # m and Hz: the pelvis of a standing body rises and falls


@dataclass(frozen=True)
class WalkStyle:
    """How straight and how regular a walk is."""

    bend: float = 0.09
    """rad, about how far the path turns away from +z to either side."""
    variation: float = 1.0
    """Of strides, 1 as measured; 0 makes all alike."""
    knees: float = -1.0
    """1 bends the knees forward. The shipped clips, whose fits are published, have -1: backward."""


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
    left, right = (
        sample_footsteps(leg, strides, path, style.variation, rng).motion(phase, still)
        for leg in range(len(SIDES))
    )
    body = Body(pelvis, yaw, (left, right), fps, style.knees)
    breath = BREATH * 0.5 * (1.0 - np.cos(2.0 * np.pi * BREATH_HZ * time))
    clip = body.clip(f"walker seed {seed}", body.sinking() + still * breath, drifted)
    has_slide = any(isinstance(event, Slide) for event in events)
    return replace(clip, slide=slide if has_slide else None)


def _smooth_noise(phase: np.ndarray, strides: int, rng: np.random.Generator) -> np.ndarray:
    """A smooth curve through one standard normal value per stride."""
    values = rng.normal(size=strides + 1)
    stride = np.floor(phase).astype(int)
    return values[stride] + smoothstep(phase - stride) * (values[stride + 1] - values[stride])
