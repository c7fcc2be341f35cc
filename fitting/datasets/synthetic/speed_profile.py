"""How fast a synthetic walk goes, with events in which it slips, slides or stops."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from . import gait
from .trajectories import smoothstep

FREEZE_PHASE = 0.43  # of the rear foot; the heel of the front one is just down
EASE = 0.4  # s, shortest transition between walking and freezing, and of a slip
SETTLING = 0.25  # fraction of the normal cadence below which feet settle flat; both are down then


@dataclass(frozen=True)
class Slip:
    """Seconds in which the root moves faster or slower than the feet step, as game roots do."""

    start: float
    """Seconds."""
    end: float
    """Seconds."""
    speed_change: float
    """Fraction of the walking speed, added; negative if the root lags behind."""


@dataclass(frozen=True)
class Slide:
    """Seconds in which the walk freezes and the whole body glides on at walking speed."""

    start: float
    """Seconds."""
    end: float
    """Seconds."""


@dataclass(frozen=True)
class Stop:
    """Seconds in which the walk slows down, stands on both feet, and walks on.

    It slows down from `start` for 0.4 to 1.5 s, until the next step is complete, and then stands
    exactly still until `end`.
    """

    start: float
    """Seconds."""
    end: float
    """Seconds."""


Event = Slip | Slide | Stop


class SpeedProfile(NamedTuple):
    """How fast a walk goes in each frame."""

    cadence: Float64[np.ndarray, " frames"]
    """Fraction of the normal cadence."""
    drift: Float64[np.ndarray, " frames"]
    """m/s, speed of the whole body beyond what the feet step."""
    slide: Float64[np.ndarray, " frames"]
    """1 in a slide, else 0."""
    still: Float64[np.ndarray, " frames"]
    """0..1, 1 while the character stands."""


def speed_profile(
    time: Float64[np.ndarray, " frames"], fps: float, events: Sequence[Event]
) -> SpeedProfile:
    """The speed at these times, s; slides and stops begin once both feet are down.

    Args:
        time: s, from 0.
        fps: frames per second.
        events: slides and stops must not overlap.
    """
    speed = gait.STRIDE / gait.PERIOD
    cadence, gliding, standing = np.ones_like(time), np.ones_like(time), np.ones_like(time)
    slide = np.zeros_like(time)
    freezes = [event for event in events if not isinstance(event, Slip)]
    for event in sorted(freezes, key=lambda event: event.start):
        phase = cadence[time < event.start].sum() / (fps * gait.PERIOD)
        remaining = (FREEZE_PHASE - phase - 0.2) % 0.5 + 0.2  # of a stride, until the walk freezes
        down = smoothstep((time - event.start) / (2.0 * gait.PERIOD * remaining))
        up = smoothstep((time - event.end) / EASE)
        walking = 1.0 - np.minimum(down, 1.0 - up)
        cadence *= walking
        if isinstance(event, Stop):
            standing *= walking
        else:
            gliding *= walking
            slide[(time >= event.start) & (time < event.end)] = 1.0
    drift = speed * (1.0 - gliding)
    for event in events:
        if isinstance(event, Slip):
            fade_in = smoothstep((time - event.start) / EASE)
            fade_out = smoothstep((event.end - time) / EASE)
            drift = drift + event.speed_change * speed * (fade_in * fade_out) * cadence
    return SpeedProfile(cadence, drift, slide, smoothstep(1.0 - standing / SETTLING))
