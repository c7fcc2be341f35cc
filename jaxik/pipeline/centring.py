"""Memory and results whose places are those of coordinates about the character.

See `jaxik.world.places` for what the coordinates are good for.
"""

import dataclasses
from typing import Protocol, TypeVar, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxik.stages.inputs import Inputs
from jaxik.world import places
from jaxik.world.terrain import LegTerrains, Terrain

from .faults import Faults


@runtime_checkable
class Centred(Protocol):
    """A struct of memory."""

    @property
    def started(self) -> Bool[Array, ""]:
        """False before the first frame."""
        ...

    @property
    def centre_ws(self) -> Float[Array, "3"]:
        """m, the origin of its places."""
        ...


Memory = TypeVar("Memory", bound=Centred)
Tree = TypeVar("Tree")


def recentred(
    memory: Memory,
    centre_ws: Float[Array, "3"] | None,
    terrain: Terrain | LegTerrains,
    faults: Faults | None,
) -> Memory:
    """Memory with its places about the centre of a frame, m; None leaves it as it is.

    A frame that is of no use has no place either: the memory stays where it is.
    """
    if centre_ws is None:
        return memory
    if faults is not None:
        centre_ws = jnp.where(faults.frame, memory.centre_ws, centre_ws)
    # Before the first frame memory is 0, which is better near the goals that it then jumps to.
    by_ws = jnp.where(memory.started, memory.centre_ws - centre_ws, 0.0)
    memory = places.moved(memory, by_ws, terrain.up_ws, terrain.leg_up_ws)
    return dataclasses.replace(memory, centre_ws=centre_ws)  # type: ignore[type-var]


def in_world(inputs: Inputs, tree: Tree) -> Tree:
    """What was computed about the centre of a frame, in world space as the caller knows it."""
    if inputs.centre_ws is None:
        return tree
    terrain = inputs.terrain
    return places.moved(tree, inputs.centre_ws, terrain.up_ws, terrain.leg_up_ws)
