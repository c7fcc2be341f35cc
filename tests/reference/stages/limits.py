"""The decision which ground a foot may stand on, of a character whose root is at `root_ws`.

Heights are above the root along up, m; everything is in world space.
"""

import math
from typing import NamedTuple

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
) -> Reading:
    """The ground below a point, or that below the highest step where the first is refused."""
    up = terrain.up
    first = terrain.cast(start, reach, mask)
    above = float((start - root_ws) @ up) - parameters.of_leg("probe.max_step_up", leg)
    below = first._replace(found=False)
    if 0.0 < above <= reach:
        below = terrain.cast(start - up * above, reach - above, mask)
    if float((first.point - below.point) @ up) < 1e-3:  # the same ground again
        below = below._replace(found=False)
    sure = accepted(parameters, leg, up, root_ws, first)
    rest = (1.0 - sure) * accepted(parameters, leg, up, root_ws, below)
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
