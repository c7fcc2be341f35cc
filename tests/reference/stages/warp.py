"""Strides of a character that is faster or slower than its animation."""

from reference import maths
from reference.characters import Frame, Parameters
from reference.maths import Array, across, apply, clip
from reference.stages.ground import forward


def moved(
    parameters: Parameters, frame: Frame, leg: int, velocity_ws: Array, scale: float, up: Array
) -> Array:
    """How far one foot moves (3), m, world space.

    Args:
        parameters: of the rule, under `warp.`.
        frame: the animation.
        leg: index.
        velocity_ws: of the character (3), m/s.
        scale: its speed over that of the animation.
        up: unit, of this leg.
    """
    lowest = parameters.of_leg("warp.min_scale", leg)
    highest = parameters.of_leg("warp.max_scale", leg)
    root = frame.world_from_model
    offset = across(apply(root, frame.toe.pos[leg]) - root.pos, up)
    way = maths.unit(across(velocity_ws, up), forward(root.rot, up))
    along = way * float(offset @ way)
    aside = (offset - along) * parameters.of_leg("warp.width", leg)
    return (clip(scale, lowest, highest) - 1.0) * (along + aside)
