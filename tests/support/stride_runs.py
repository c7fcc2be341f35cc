"""The preset `stride` with a terrain for each leg: one program for all clips of `FRAMES` frames."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

import jaxik
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import slots
from reference import characters, maths
from reference.terrain import LegTerrains
from reference.terrain import Terrain as PlainTerrain

from .cases import QUICK
from .clips import to_frames, to_ik, to_leg_terrains, to_rig
from .probing import quad
from .strides import blocks

FRAMES = 100
TRIANGLES = 120  # of each ground
compiled = jax.jit(jaxik.run, compiler_options=QUICK)


def on_platform(triangles: Any) -> PlainTerrain:
    """Ground of triangles (count 3 3), some of them repeated."""
    repeated = np.resize(triangles, (TRIANGLES, 3, 3))
    return PlainTerrain(maths.Y, triangles=repeated, platform=0)


UNEVEN = on_platform(blocks(np.random.default_rng(3)).triangles)
EDGES = np.linspace(-9.0, 9.0, TRIANGLES // 2 + 1)  # of strips, so that both have a grid alike
STRIPS = [
    quad((-9.0, 0.0, back), (-9.0, 0.0, front), (9.0, 0.0, front), (9.0, 0.0, back))
    for back, front in itertools.pairwise(EDGES)
]
FLAT = on_platform(np.concatenate(STRIPS))


def of_legs(ground: PlainTerrain, *tilts: np.ndarray) -> LegTerrains:
    """The ground, and for each of two legs with an up that is turned like this, or not at all."""
    ups = [maths.rotate(tilt, maths.Y) for tilt in tilts or [maths.IDENTITY] * 2]
    return LegTerrains(ground, [dataclasses.replace(ground, up=up) for up in ups])


def solved(
    values: dict[str, Any],
    rig: characters.Rig,
    ground: LegTerrains,
    frames: Sequence[characters.Frame],
) -> jaxik.Result:
    """What the preset with these values makes of a clip; each leg has its numbers.

    The frames have all ways of strides, and a platform, on which the ground is.
    """
    ik = to_ik(values, "stride")
    shared = {x.name: x.value for x in slots(ik) if x.per_leg and x.value.shape == x.shape}
    ik = parameter_tree.replace(ik, {name: [value] * 2 for name, value in shared.items()})
    return compiled(ik, to_rig(rig), to_leg_terrains(ground), to_frames(frames))
