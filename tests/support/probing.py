"""What probes find under the feet of a clip, and ground made of level blocks for them."""

from typing import Any

import jax
import numpy as np

import jaxik
from fitting.runtime.precision import with_floats
from jaxik import HARD
from jaxik.maths.gate import AbstractGate
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import GroundHits
from reference import maths
from reference.terrain import Terrain as PlainTerrain

from .cases import RIG
from .clips import to_rig

BLOCKS = 6  # of all grounds: equal shapes share a program


@jax.jit
def ground_under(
    ik: jaxik.FootIK, ground: Any, frames: jaxik.Frame, gate: AbstractGate = HARD
) -> GroundHits:
    """What the probe of a system finds in each frame."""
    rig = with_floats(to_rig(RIG), frames.dt.dtype)

    def sense(frame: jaxik.Frame) -> GroundHits:
        inputs = Inputs(rig, ground, frame, gate)
        return ik.probe.sense(inputs, ik.contact.sense(inputs), ik.target.foot_height)

    return jax.vmap(sense)(frames)


def quad(*corners: tuple[float, float, float]) -> list[list[list[float]]]:
    """Two triangles over four corners in turn."""
    a, b, c, d = ([*corner] for corner in corners)
    return [[a, b, c], [a, c, d]]


def level_blocks(*tops: tuple[float, ...]) -> PlainTerrain:
    """Level blocks, each given by where it starts and ends forward, and its height, m.

    Then may follow where it starts and ends to the left, -2 and 2 m otherwise. Missing blocks
    repeat the last one.
    """
    triangles = []
    for top in (*tops, *(tops[-1:] * BLOCKS))[:BLOCKS]:
        near, far, height, right, left = (*top, -2.0, 2.0)[:5]
        corners = ((right, near), (right, far), (left, far), (left, near))
        triangles += quad(*((x, height, z) for x, z in corners))
    return PlainTerrain(maths.Y, triangles=np.array(triangles))
