"""The lean of the spine: forward uphill, backward downhill, with a head that turns back."""

import math
from dataclasses import dataclass

import numpy as np

from reference import maths
from reference.characters import Parameters
from reference.maths import Array, cross, lerp
from reference.stages.ground import forward


@dataclass
class State:
    """Memory between frames."""

    ahead: float
    """Slope ahead, rad."""
    aside: float
    """Slope to the right, rad."""
    slide: float
    """Weight of sliding, 0..1."""


def lean(
    parameters: Parameters,
    root_rot: Array,
    points: Array,
    normals: Array,
    weights: Array,
    slide: float,
    dt: float,
    state: State | None,
    up: Array = maths.Y,
) -> tuple[State, Array, Array]:
    """Memory after a frame, and the rotations of spine and head, world axes.

    Args:
        parameters: of the rule, under `lean.`.
        root_rot: rotation of the character (4).
        points: of the ground under each foot (legs, 3), m.
        normals: of the ground under each foot (legs, 3).
        weights: how much each foot stands (legs).
        slide: how much the character slides, 0..1.
        dt: s since the frame before.
        state: memory after the frame before.
        up: unit.
    """
    ahead_ws = forward(root_rot, up)
    right_ws = cross(ahead_ws, up)
    normal = up if weights.sum() == 0 else (weights[:, None] * normals).sum(axis=0)
    under_soles = math.atan2(-float(normal @ ahead_ws), float(normal @ up))
    ahead = between_feet(parameters["lean.spacing"], points @ ahead_ws, points @ up, under_soles)
    aside = math.atan2(-float(normal @ right_ws), float(normal @ up))
    if state is not None:
        half_life = parameters["lean.half_life"]
        fraction = maths.fraction_of_half_life(half_life, dt)
        slide = lerp(state.slide, slide, fraction)
        ahead, aside = lerp(state.ahead, ahead, fraction), lerp(state.aside, aside, fraction)
    rate = parameters["lean.uphill_rate" if ahead >= 0 else "lean.downhill_rate"]
    pitch = ahead * lerp(rate, parameters["lean.forward_rate_slide"], slide)
    roll = aside * lerp(parameters["lean.side_rate"], parameters["lean.side_rate_slide"], slide)
    bend = right_ws * pitch - ahead_ws * roll
    back = -parameters["lean.head_share"] * bend
    rotations = maths.from_rotvec(np.asarray(bend)), maths.from_rotvec(np.asarray(back))
    return State(ahead, aside, slide), *rotations


def between_feet(spacing: float, places: Array, heights: Array, under_soles: float) -> float:
    """Slope, rad, of the line through the feet that is pulled to the slope under their soles.

    It is the ridge regression of heights by places with a prior `spacing / 2`, found here as
    ordinary least squares with one more row, that pulls to the tangent under the soles.
    """
    places, heights = places - places.mean(), heights - heights.mean()
    pull = spacing / 2 * math.sqrt(len(places))
    rows = np.append(places, pull)
    goals = np.append(heights, pull * math.tan(under_soles))
    (tangent,), *_ = np.linalg.lstsq(rows[:, None], goals, rcond=None)
    return math.atan(tangent)
