"""The lean of the trunk: forward uphill, backward downhill, over a pelvis that tilts less."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from reference import maths
from reference.characters import Parameters, forward, named
from reference.maths import Array, cross, lerp
from reference.stages import ground

DEFAULTS = (
    named("lean", uphill_rate=-0.65, downhill_rate=-0.25, side_rate=0.0, head_share=0.5)
    | named("lean", forward_rate_slide=0.0, side_rate_slide=0.0)
    | named("lean", pelvis_rate=-0.25, pelvis_side_rate=0.0, spacing=0.3, half_life=0.2)
)
LITTLE = 0.1  # of a foot's ground, from which its slope is taken in full


@dataclass
class State:
    """Memory between frames."""

    ahead: float  # slope, rad
    aside: float  # slope to the right, rad
    slide: float  # weight of sliding, 0..1


def lean(
    parameters: Parameters,
    root_rot: Array,
    points: Array,
    normals: Array,
    stands: Array,
    slide: float,
    dt: float,
    state: State | None,
    up: Array = maths.Y,
    found: Array | float = 1.0,
    weights: Array | None = None,
) -> tuple[State, Array, Array, Array]:
    """Memory after a frame, and the rotations of trunk, head and pelvis, world axes.

    The head's comes after the trunk's, the trunk's and the pelvis's are both from the animation.

    Args:
        parameters: of the rule, under `lean.`.
        root_rot: rotation of the character (4).
        points: of the ground under each foot (legs, 3), m.
        normals: of the ground under each foot (legs, 3).
        stands: how much each foot stands (legs).
        slide: how much the character slides, 0..1.
        dt: s since the frame before.
        state: memory after the frame before.
        up: unit.
        found: whether there is ground under each foot (legs).
        weights: of the legs; None is 1.
    """
    ahead_ws = forward(root_rot, up)
    right_ws = cross(ahead_ws, up)
    weights = np.ones(len(points)) if weights is None else weights
    normal = ground.standing_normal(stands, weights, normals, up)
    ahead, aside = (
        between_feet(
            parameters["lean.spacing"],
            points @ along_ws,
            points @ up,
            min(stands.sum() / LITTLE, 1.0)
            * math.atan2(-float(normal @ along_ws), float(normal @ up)),
            found * weights,
            weights,
        )
        for along_ws in (ahead_ws, right_ws)
    )
    if state is not None:
        fraction = maths.fraction_of_half_life(parameters["lean.half_life"], dt)
        slide = lerp(state.slide, slide, fraction)
        ahead, aside = lerp(state.ahead, ahead, fraction), lerp(state.aside, aside, fraction)
    rate = parameters["lean.uphill_rate" if ahead >= 0 else "lean.downhill_rate"]
    pitch = ahead * lerp(rate, parameters["lean.forward_rate_slide"], slide)
    roll = aside * lerp(parameters["lean.side_rate"], parameters["lean.side_rate_slide"], slide)
    bend = right_ws * pitch - ahead_ws * roll
    pelvis_pitch = (1.0 - slide) * parameters["lean.pelvis_rate"] * ahead
    pelvis_roll = (1.0 - slide) * parameters["lean.pelvis_side_rate"] * aside
    tilt = right_ws * pelvis_pitch - ahead_ws * pelvis_roll
    back = -parameters["lean.head_share"] * bend
    trunk, head, pelvis = (maths.from_rotvec(turn) for turn in (bend, back, tilt))
    return State(ahead, aside, slide), trunk, head, pelvis


def between_feet(
    spacing: float,
    places: Array,
    heights: Array,
    under_soles: float,
    legs: Array,
    weights: Array,
) -> float:
    """Slope, rad, of the line through the feet that is pulled to the slope under their soles.

    It is the ridge regression of heights by places with a prior `spacing / 2`, found here as
    weighted least squares with one more row, that pulls to the tangent under the soles. With
    partial weights the line counts as much as pairs of legs do.
    """
    if legs.sum() == 0.0:
        return under_soles
    shares = legs / legs.sum()
    places, heights = places - shares @ places, heights - shares @ heights
    pairs = sum(a * b for a, b in itertools.combinations(weights, 2))
    counted = np.sqrt(min(pairs, 1.0) * shares)
    rows = np.append(counted * places, spacing / 2)
    goals = np.append(counted * heights, spacing / 2 * math.tan(under_soles))
    (tangent,), *_ = np.linalg.lstsq(rows[:, None], goals, rcond=None)
    return math.atan(tangent)
