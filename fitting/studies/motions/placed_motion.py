"""A motion as a whole skeleton on its ground, and how its feet are placed there."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from fitting.analysis import measures
from fitting.analysis.placement import Placement, Soles
from fitting.datasets.clips import Clip

SOLES = ("ankle_height", "ball_height", "ankle_from_foot")  # of a rig: where the soles are


@dataclass(frozen=True)
class PlacedMotion:
    """A motion, and how its feet are placed on the ground."""

    clip: Clip
    soles_ws: Float64[np.ndarray, "frames legs 2 3"]
    """m, below ankles and balls."""
    in_ground: Bool[np.ndarray, "frames legs"]
    """Where a sole is visibly in the ground, as `placement` counts it."""
    placement: Placement


def place(clip: Clip, feet: Soles, placement: Placement) -> PlacedMotion:
    """A motion with what was measured of its soles."""
    return PlacedMotion(clip, measures.soles(clip), feet.gap < -placement.visible, placement)


def with_soles_of(captured: Clip, flat: Clip) -> Clip:
    """The captured clip with the soles of its flat animation.

    Its own are measured as if it stood on a floor; on uneven ground they are not where they seem.
    """
    rig, flat_rig = captured.measured_rig, flat.measured_rig
    if rig is None or flat_rig is None:
        return captured
    soles = {name: getattr(flat_rig, name) for name in SOLES}
    return replace(captured, measured_rig=replace(rig, **soles))
