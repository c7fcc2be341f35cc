"""The decision which ground a foot may stand on, of a character whose root is at the origin.

Heights are above the root along up, m; everything is in world space.
"""

import math
from typing import NamedTuple

import numpy as np

from reference.characters import Footing
from reference.maths import Array, across, clip, smooth01, unit
from reference.terrain import Hit

FADE = 0.10  # m or rad beyond a limit over which a reading fades out


class Reading(NamedTuple):
    """Ground that may be accepted in part: `found` is from 0 to 1."""

    found: float
    point: Array
    normal: Array


def read(footing: Footing, start: Array, reach: float, ahead: Array | None) -> Reading:
    """The ground below a point, or that below the highest step where the first is refused.

    With the heading of a foot, ground narrower than its sole is refused too.
    """
    up = footing.up
    first = footing.terrain.cast(start, reach)
    above = float(start @ up) - footing["probe.max_step_up"]
    below = first._replace(found=False)
    if 0.0 < above <= reach:
        below = footing.terrain.cast(start - up * above, reach - above)
    if float((first.point - below.point) @ up) < 1e-3:  # the same ground again
        below = below._replace(found=False)
    sure, rest = accepted(footing, first), accepted(footing, below)
    if ahead is not None:
        over = max(above, 0.0)
        sure *= wide_enough(footing, first, start, reach, ahead)
        rest *= wide_enough(footing, below, start - up * over, reach - over, ahead)
    rest *= 1.0 - sure
    if sure + rest == 0.0:
        return Reading(0.0, first.point, first.normal)
    share = rest / (sure + rest)
    point = first.point + share * (below.point - first.point)
    normal = unit(first.normal + share * (below.normal - first.normal), up)
    return Reading(sure + rest, point, normal)


def accepted(footing: Footing, hit: Hit) -> float:
    """From 0 to 1, how far a hit counts as ground."""
    if not hit.found:
        return 0.0
    step = float(hit.point @ footing.up)
    # A plane through the root is not a step, however high it is at the foot.
    sloped = -float(across(hit.point, footing.up) @ hit.normal) / float(hit.normal @ footing.up)
    if step * sloped > 0.0:
        step = math.copysign(max(abs(step) - abs(sloped), 0.0), step)
    return low_enough(footing, step) * gentle(footing, hit.normal)


def low_enough(footing: Footing, step: float) -> float:
    """From 0 to 1, how far a step of that height, m, negative if down, is small enough."""
    limit = footing["probe.max_step_up" if step > 0.0 else "probe.max_step_down"]
    return 1.0 - smooth01((abs(step) - limit) / FADE)


def gentle(footing: Footing, normal: Array) -> float:
    """1 for a slope that counts, 0 for one that is too steep."""
    steepness = math.acos(clip(float(normal @ footing.up), -1.0, 1.0))
    return 1.0 - smooth01((steepness - footing["probe.max_slope"]) / FADE)


def wide_enough(footing: Footing, hit: Hit, start: Array, reach: float, ahead: Array) -> float:
    """From 0 to 1: less if the plane of a hit does not go on around it."""
    if not hit.found:
        return 0.0
    up, radius = footing.up, footing["probe.support_radius"]
    right = np.cross(ahead, up)
    support = 0.0
    for turn in np.radians(range(0, 360, 45)):
        way = radius * (math.cos(turn) * ahead + math.sin(turn) * right)
        around = footing.terrain.cast(start + way, reach + radius)
        if around.found:
            expected = hit.point @ up - (way @ hit.normal) / (hit.normal @ up)
            gap = abs(float(around.point @ up - expected))
            support += 1.0 - smooth01(gap / radius - 0.5)
    return 1.0 - smooth01((footing["probe.min_support"] - support / 8.0) / 0.25)
