"""Feet of the `stride` reference slide along themselves to ground that supports more of a sole.

One leg, one foothold at a time. World space, m.
"""

import math
from typing import NamedTuple

import numpy as np

from reference import maths
from reference.characters import Frame, Ground, Parameters, Rig
from reference.maths import across, smooth01
from reference.stages import ground
from reference.terrain import Hit

HEEL, TIP = -4, 1  # fifths of a sole from its ball
FURTHEST = 2  # fifths of a sole, of a slide
SUPPORTS, DOES_NOT = 0.3, 0.7  # fifths of a sole from its plane
FADE = 0.10  # of the sole
INDIFFERENCE = 0.01  # of the sole
ASIDE_COSTS, HEIGHT_COSTS = 0.03, 0.1  # of the sole, for each fifth of it


class Slide(NamedTuple):
    """How far forward a foot slides, m, and the share of its sole that is supported there."""

    forward: float
    support: float


def fifth_of_sole(parameters: Parameters, rig: Rig, leg: int) -> float:
    """The sole reaches from behind the ankle to beyond the ball, m."""
    height = parameters.of_leg("target.foot_height", leg)
    height -= parameters.of_leg("probe.ball_height", leg)
    between = math.sqrt(max(rig.foot**2 - height**2, 0.0))
    ends = (parameters.of_leg(f"probe.{end}_length", leg) for end in ("heel", "toe"))
    return (between + sum(ends)) / 5.0


def slide(
    parameters: Parameters,
    rig: Rig,
    terrain: Ground,
    frame: Frame,
    leg: int,
    foothold: Hit,
    known: bool,
) -> Slide:
    """Where the foot that would stand with its ball on this foothold, if known, stands instead."""
    if not foothold.found:
        return Slide(0.0, 0.0)
    up, heading = terrain.up, ground.heading(rig, frame, leg, terrain.up)
    fifth = fifth_of_sole(parameters, rig, leg)
    highest = parameters.of_leg("probe.max_step_up", leg)
    deepest = parameters.of_leg("probe.max_step_down", leg)
    mask = int(parameters.of_leg("probe.layers", leg))
    hits = {
        place: terrain.cast(
            foothold.point + place * fifth * heading + highest * up, highest + deepest, mask
        )
        for place in range(HEEL - FURTHEST, TIP + FURTHEST + 1)
    }

    def fit(ball: int) -> tuple[float, float]:
        """Shares of the sole that are supported and that stick in the ground."""
        on, stuck = [], []
        normal = hits[ball].normal
        slope = -float(across(heading, up) @ normal) / float(normal @ up)
        for place in range(ball + HEEL, ball + TIP + 1):
            over = float((hits[place].point - hits[ball].point) @ up)
            over -= slope * fifth * (place - ball)
            off = smooth01((abs(over) / fifth - SUPPORTS) / (DOES_NOT - SUPPORTS))
            found = hits[place].found
            on.append(1.0 - off if found else 0.0)
            stuck.append(off if found and over > 0.0 else 0.0)
        return float(np.mean(on)), float(np.mean(stuck))

    enough, furthest = (
        parameters.of_leg(f"probe.{name}", leg) for name in ("min_sole", "max_slide")
    )
    places = range(-FURTHEST, FURTHEST + 1)
    supported = {place: fit(place) for place in places}
    gains = []
    for place in places:
        share, stuck = supported[place]
        climbed = abs(float((hits[place].point - hits[0].point) @ up))
        gain = (
            min(share - stuck, enough) - ASIDE_COSTS * abs(place) - HEIGHT_COSTS * climbed / fifth
        )
        gains.append(gain - 2.0 * smooth01((abs(place) * fifth - furthest) / fifth))
    chance = np.exp((np.array(gains) - max(gains)) / INDIFFERENCE)
    chance /= chance.sum()
    here, stuck_here = supported[0]
    if not known:
        return Slide(0.0, here)
    need = smooth01((enough - (here - stuck_here)) / FADE)
    there = float(sum(c * supported[place][0] for c, place in zip(chance, places, strict=True)))
    return Slide(need * fifth * float(chance @ places), maths.lerp(here, there, need))
