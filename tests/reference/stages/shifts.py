"""Feet beside their animated places: strides of another length, and a distance between feet."""

from dataclasses import dataclass

import numpy as np

from reference import maths
from reference.characters import Frame, Parameters, forward
from reference.maths import Array, across, apply, clip, lerp

GENTLEST = 0.5  # cosine of the steepest ground along which a foot moves


def warp(
    parameters: Parameters, frame: Frame, leg: int, velocity_ws: Array, scale: float, up: Array
) -> Array:
    """How far one foot moves (3), m, of a character that is not as fast as its animation.

    Args:
        parameters: of the rule, under `warp.`.
        frame: the animation.
        leg: index.
        velocity_ws: of the character (3), m/s.
        scale: its speed over that of the animation.
        up: unit, of this leg.
    """
    lowest, highest, width = (
        parameters.of_leg(f"warp.{name}", leg) for name in ("min_scale", "max_scale", "width")
    )
    root = frame.world_from_model
    offset = across(apply(root, frame.toe.pos[leg]) - root.pos, up)
    way = maths.unit(across(velocity_ws, up), forward(root.rot, up))
    along = way * float(offset @ way)
    return (clip(scale, lowest, highest) - 1.0) * (along + (offset - along) * width)


@dataclass
class Feet:
    """One frame, what `separate` reads: side (legs), points (legs 3) m, weights 0..1 (legs)."""

    side: Array
    animated_ws: Array
    placed_ws: Array
    standing: Array
    weight: Array
    normals: Array
    found: Array
    left_ws: Array
    dt: float


def separate(
    parameters: Parameters, feet: Feet, before: Array | None, up: Array = maths.Y
) -> tuple[Array, Array]:
    """Horizontal offsets (legs 3) after a frame, and how far feet move with the ground's slope.

    Feet of opposite sides keep a distance across the heading of the character.

    Args:
        parameters: of the rule, under `separation.`.
        feet: in this frame.
        before: offsets after the frame before; None before the first.
        up: unit.
    """
    legs = range(len(feet.side))
    offsets = np.zeros((len(feet.side), 3)) if before is None else before
    after, moved = np.zeros_like(offsets), np.zeros_like(offsets)
    for leg in legs:
        largest = 0.0
        for other in legs:
            if feet.side[leg] * feet.side[other] >= 0 or feet.weight[other] == 0:
                continue
            outward = feet.side[leg] * feet.left_ws
            animated = float(outward @ (feet.animated_ws[leg] - feet.animated_ws[other]))
            place_of_other = feet.placed_ws[other] + feet.standing[other] * offsets[other]
            apart = float(outward @ (feet.placed_ws[leg] - place_of_other))
            missing = min(parameters["separation.distance"], animated) - apart
            mine = (1.0 - feet.standing[leg]) * (feet.weight[leg] > 0)
            theirs = 1.0 - feet.standing[other]
            if missing > 0 and mine > 0:
                largest = max(largest, missing * mine / (mine + theirs))
        half_life = parameters.of_leg("separation.half_life", leg)
        fraction = 1.0 if before is None else maths.fraction_of_half_life(half_life, feet.dt)
        goal = feet.side[leg] * largest * feet.left_ws
        after[leg] = lerp(offsets[leg], goal, (1.0 - feet.standing[leg]) * fraction)
        facing = max(float(feet.normals[leg] @ up), GENTLEST)
        climb = -float(after[leg] @ feet.normals[leg]) / facing
        moved[leg] = after[leg] + up * climb * feet.found[leg]
    return after, moved
