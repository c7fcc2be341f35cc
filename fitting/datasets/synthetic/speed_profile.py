"""How fast the made walk goes: spells in which its root slips, in which it slides or stands."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from . import gait
from .trajectories import smoothstep

GLIDE = 0.43  # phase of the rear foot, the heel of the front one just down, in which a walk freezes
EASE = 0.4  # s, shortest change between walking and freezing, and of a slip
SETTLING = 0.25  # share of the cadence below which feet settle flat; both are down by then


@dataclass(frozen=True)
class Slip:
    """Seconds in which the root travels at another speed than the feet step, as game roots do."""

    start: float  # s
    end: float
    share: float  # of the walking speed, added; below 0 the root lags


@dataclass(frozen=True)
class Slide:
    """Seconds in which the walk freezes and the whole body glides on at walking speed."""

    start: float  # s
    end: float


@dataclass(frozen=True)
class Stop:
    """Seconds in which the walk slows down, stands on both feet, and walks on.

    It slows down from `start` over 0.4 to 1.5 s, until the next step is done, and then stands
    exactly still until `end`.
    """

    start: float  # s
    end: float


class Pace(NamedTuple):
    """How fast a walk goes in each frame."""

    cadence: Float64[np.ndarray, " frames"]  # share of the measured one
    drift: Float64[np.ndarray, " frames"]  # m/s, speed of the whole body beyond what the feet step
    slide: Float64[np.ndarray, " frames"]  # 1 in a slide, else 0
    still: Float64[np.ndarray, " frames"]  # 0..1, 1 while the character stands


def pace(
    time: Float64[np.ndarray, " frames"],
    fps: float,
    slips: Sequence[Slip] = (),
    slides: Sequence[Slide] = (),
    stops: Sequence[Stop] = (),
) -> Pace:
    """The pace at these times, s; a walk slows down so that it freezes with both feet down."""
    speed = gait.STRIDE / gait.PERIOD
    cadence, gliding, standing = np.ones_like(time), np.ones_like(time), np.ones_like(time)
    slide = np.zeros_like(time)
    for one in sorted((*slides, *stops), key=lambda one: one.start):
        begun = cadence[time < one.start].sum() / (fps * gait.PERIOD)
        left = (GLIDE - begun - 0.2) % 0.5 + 0.2  # of a stride, until the walk freezes
        down = smoothstep((time - one.start) / (2.0 * gait.PERIOD * left))
        up = smoothstep((time - one.end) / EASE)
        walking = 1.0 - np.minimum(down, 1.0 - up)
        cadence *= walking
        if isinstance(one, Stop):
            standing *= walking
        else:
            gliding *= walking
            slide[(time >= one.start) & (time < one.end)] = 1.0
    drift = speed * (1.0 - gliding)
    for one in slips:
        edges = smoothstep((time - one.start) / EASE) * smoothstep((one.end - time) / EASE)
        drift = drift + one.share * speed * edges * cadence
    return Pace(cadence, drift, slide, smoothstep(1.0 - standing / SETTLING))
