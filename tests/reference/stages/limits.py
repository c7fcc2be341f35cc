"""The decision which ground a foot may stand on, of a character whose root is at `root_ws`.

Heights are above the root along up, m; everything is in world space.
"""

import math
from typing import NamedTuple

import numpy as np

from reference.characters import Ground, Parameters
from reference.maths import Array, across, clip, smooth01, unit
from reference.terrain import ALL_LAYERS, Hit

FADE = 0.10  # m or rad beyond a limit over which a reading fades out


class Reading(NamedTuple):
    """Ground that may be accepted in part: `found` is from 0 to 1."""

    found: float
    point: Array
    normal: Array


def read(
    parameters: Parameters,
    terrain: Ground,
    leg: int,
    root_ws: Array,
    start: Array,
    reach: float,
    mask: int = ALL_LAYERS,
    ahead: Array | None = None,
) -> Reading:
    """The ground below a point, or that below the highest step where the first is refused.

    With the heading of a foot, ground narrower than its sole is refused too.
    """
    up = terrain.up
    first = terrain.cast(start, reach, mask)
    above = float((start - root_ws) @ up) - parameters.of_leg("probe.max_step_up", leg)
    below = first._replace(found=False)
    if 0.0 < above <= reach:
        below = terrain.cast(start - up * above, reach - above, mask)
    if float((first.point - below.point) @ up) < 1e-3:  # the same ground again
        below = below._replace(found=False)
    sure = accepted(parameters, leg, up, root_ws, first)
    rest = accepted(parameters, leg, up, root_ws, below)
    if ahead is not None:
        sure *= wide_enough(parameters, terrain, leg, first, start, reach, mask, ahead)
        over = max(above, 0.0)
        under = start - up * over
        rest *= wide_enough(parameters, terrain, leg, below, under, reach - over, mask, ahead)
    rest *= 1.0 - sure
    if sure + rest == 0.0:
        return Reading(0.0, first.point, first.normal)
    share = rest / (sure + rest)
    point = first.point + share * (below.point - first.point)
    normal = unit(first.normal + share * (below.normal - first.normal), up)
    return Reading(sure + rest, point, normal)


def accepted(parameters: Parameters, leg: int, up: Array, root_ws: Array, hit: Hit) -> float:
    """From 0 to 1, how far a hit counts as ground."""
    if not hit.found:
        return 0.0
    away = hit.point - root_ws
    rise = float(away @ up)
    # A plane through the root is no step, however high it is at the foot.
    sloped = -float(across(away, up) @ hit.normal) / float(hit.normal @ up)
    if rise * sloped <= 0.0:
        step = rise
    else:
        step = math.copysign(abs(rise) - min(abs(rise), abs(sloped)), rise)
    return low_enough(parameters, leg, step) * gentle(parameters, leg, up, hit.normal)


def low_enough(parameters: Parameters, leg: int, step: float) -> float:
    """From 0 to 1, how far a step of that height, m, negative if down, is small enough."""
    limit = parameters.of_leg("probe.max_step_up" if step > 0.0 else "probe.max_step_down", leg)
    return 1.0 - smooth01((abs(step) - limit) / FADE)


def gentle(parameters: Parameters, leg: int, up: Array, normal: Array) -> float:
    """1 for a slope that counts, 0 for one that is too steep."""
    steepness = math.acos(clip(float(normal @ up), -1.0, 1.0))
    return 1.0 - smooth01((steepness - parameters.of_leg("probe.max_slope", leg)) / FADE)


def wide_enough(
    parameters: Parameters,
    terrain: Ground,
    leg: int,
    hit: Hit,
    start: Array,
    reach: float,
    mask: int,
    ahead: Array,
) -> float:
    """From 0 to 1: less if the plane of a hit does not go on around it."""
    if not hit.found:
        return 0.0
    up, radius = terrain.up, parameters.of_leg("probe.support_radius", leg)
    right = np.cross(ahead, up)
    support = 0.0
    for turn in np.radians(range(0, 360, 45)):
        way = radius * (math.cos(turn) * ahead + math.sin(turn) * right)
        around = terrain.cast(start + way, reach + radius, mask)
        if around.found:
            expected = hit.point @ up - (way @ hit.normal) / (hit.normal @ up)
            gap = abs(float(around.point @ up - expected))
            support += 1.0 - smooth01(gap / radius - 0.5)
    lacking = parameters.of_leg("probe.min_support", leg) - support / 8.0
    return 1.0 - smooth01(lacking / 0.25)
