"""What the pipeline takes: shapes, checked as it is traced, at no cost at run time, and floats."""

import dataclasses
import typing
from collections.abc import Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Rule
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import Frame
from jaxik.world.skeleton import LegPose, Rig
from jaxik.world.terrain import LegTerrains, Terrain

Tree = TypeVar("Tree")
Shape = tuple[int, ...]
BATCHES = "many characters at once need jax.vmap or jaxik.lanes"


def with_floats_of(rig: Rig, tree: Tree) -> Tree:
    """The tree with all its floats as wide as those of the rig, which memory has too."""
    floats = rig.side.dtype

    def convert(leaf: Array) -> Array:
        return jnp.asarray(leaf, floats) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(convert, tree)


def check_system(ik: Rule, rig: Rig) -> None:
    """Refuses a rig of more than one character, and parameters that do not fit its legs.

    Raises:
        ValueError: naming the array, its shape and the shapes that it may have.
    """
    if np.ndim(rig.side) != 1:
        raise ValueError(f"rig.side has shape {rig.side.shape}, wanted (legs,); {BATCHES}")
    legs = rig.side.shape[0]
    _check_arrays("rig", rig, (), legs)
    try:
        parameter_tree.check_shapes(ik, legs)
    except ValueError as error:
        raise ValueError(f"{error}; {BATCHES}") from None


def check_inputs(ik: Rule, inputs: Inputs, *, clip: bool) -> None:
    """Refuses what does not belong to one character, or has another number of legs than its rig.

    Args:
        ik: the system.
        inputs: what a stage reads; for a clip the leaves of `frame` have a leading axis of frames.
        clip: whether `frame` is a clip.

    Raises:
        ValueError: naming the array, its shape and the shapes that it may have.
    """
    check_system(ik, inputs.rig)
    legs = inputs.rig.side.shape[0]
    _check_terrain(inputs.terrain, legs)
    _check_frame(inputs.frame, legs, clip=clip)
    _check_platforms(inputs.frame, inputs.terrain)


def check_state(state: PyTree, fresh: PyTree) -> None:
    """Refuses memory of another system or rig.

    Args:
        state: the memory, a struct with one part for each stage.
        fresh: what `init` returns for this system and rig, or its shapes.

    Raises:
        ValueError: naming the part of the memory that differs.
    """
    for field in dataclasses.fields(fresh):
        part, expected = getattr(state, field.name), getattr(fresh, field.name)
        if jax.tree.structure(part) != jax.tree.structure(expected) or _shapes(part) != _shapes(
            expected
        ):
            raise ValueError(
                f"state.{field.name} is the memory of another system, rig or batch; start with "
                f"jaxik.init(ik, rig) of this system and rig; {BATCHES}"
            )


def _check_terrain(terrain: Terrain | LegTerrains, legs: int) -> None:
    if isinstance(terrain, LegTerrains):
        if len(terrain.legs) != legs:
            raise ValueError(f"terrain.legs has {len(terrain.legs)} terrains, the rig {legs} legs")
        grounds = {"terrain.body": terrain.body}
        grounds |= {f"terrain.legs[{leg}]": ground for leg, ground in enumerate(terrain.legs)}
    else:
        grounds = {"terrain": terrain}
    for name, ground in grounds.items():
        if (shape := ground.up_ws.shape) != (3,):
            raise ValueError(f"{name}.up_ws has shape {shape}, wanted (3,); {BATCHES}")


def _check_frame(frame: Frame, legs: int, *, clip: bool) -> None:
    shape = np.shape(frame.dt)
    if clip and len(shape) != 1:
        way = BATCHES if shape else "a single frame needs step"
        raise ValueError(f"frames.dt has shape {shape}, wanted (frames,); {way}")
    if not clip and shape:
        way = f"a clip needs run or resume, {BATCHES}"
        raise ValueError(f"frame.dt has shape {shape}, wanted (); {way}")
    _check_arrays("frames" if clip else "frame", frame, shape, legs)


def _check_platforms(frame: Frame, terrain: Terrain | LegTerrains) -> None:
    if terrain.platform_count > (count := _platform_count(frame)):
        raise ValueError(
            f"the terrain moves with platform {terrain.platform_count - 1}, but platforms has "
            f"{count} platforms, numbered from 0; Frame.with_platforms gives a clip its platforms"
        )


def _check_arrays(name: str, struct: object, batch: Shape, legs: int) -> None:
    for path, array, shape in _declared_shapes(struct, batch, legs):
        if np.shape(array) != shape:
            counts = f"{legs} legs in rig.side"
            counts += "".join(f", {frames} frames in frames.dt" for frames in batch)
            if path.startswith("platforms"):
                counts += f", as many platforms in platforms_before as in {name}.platforms"
            raise ValueError(
                f"{name}.{path} has shape {np.shape(array)}, wanted {shape}: {counts}; {BATCHES}"
            )


def _declared_shapes(struct: object, batch: Shape, legs: int) -> Iterator[tuple[str, Array, Shape]]:
    """Every array of a struct by dotted name, with the shape that its annotation declares."""
    axes = {"*b": batch, "legs": (legs,)}
    for field in dataclasses.fields(struct):  # type: ignore[arg-type]
        value = getattr(struct, field.name)
        if dataclasses.is_dataclass(value):
            inner = batch
            if isinstance(struct, LegPose):
                inner = (*batch, legs)
            elif isinstance(struct, Frame) and field.name.startswith("platforms"):
                inner = (*batch, _platform_count(struct))
            for path, array, shape in _declared_shapes(value, inner, legs):
                yield f"{field.name}.{path}", array, shape
        elif value is not None and not field.metadata.get("static", False):
            annotation, *_ = typing.get_args(field.type) or (field.type,)  # of an optional field
            names = getattr(annotation, "dim_str").split()  # noqa: B009
            sizes = [axes[name] if name in axes else (int(name),) for name in names]
            yield field.name, value, sum(sizes, ())


def _platform_count(frame: Frame) -> int:
    """How many platforms a frame has, as far as its shape says."""
    return sum(np.shape(frame.platforms.pos)[-2:-1])


def _shapes(tree: PyTree) -> list[Shape]:
    return [np.shape(leaf) for leaf in jax.tree.leaves(tree)]
