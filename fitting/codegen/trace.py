"""Golden traces: frames of a clip with what the rays hit, and the results of a system in JAX."""

# pyright: reportArgumentType=false

import dataclasses
from collections.abc import Callable, Iterator
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import jaxik
from fitting.runtime.precision import with_floats
from jaxik.pipeline import step_and_rays
from jaxik.world.terrain import LegTerrains, Terrain

from .memory import doubles, rows
from .program import Program

Pack: TypeAlias = Callable[[PyTree], np.ndarray]
"""Makes structs, a row each, of a tree whose leaves have one more axis in front."""


def with_restart(frames: jaxik.Frame) -> jaxik.Frame:
    """The frames with a `restart`, which a program made for them then has."""
    if frames.restart is not None:
        return frames
    return dataclasses.replace(frames, restart=jnp.zeros(frames.dt.shape, bool))


def record(
    program: Program,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frames: jaxik.Frame,
    *,
    wide: bool = False,
) -> bytes:
    """The trace of a clip: parameters and rig, then of each frame all that a check compares.

    Those are the frame, its rays, their hits and the result, as the structs of the program are in
    memory.

    Args:
        program: of the system.
        rig: the legs of the clip.
        terrain: onto which the rays are cast.
        frames: the clip, with the fields of the program's frames.
        wide: whether JAX computes in 64 bits, and each number is one of them; else in 32.
    """
    with jax.enable_x64(wide):
        setup = with_floats((program.ik, rig), jnp.float32)  # as they are in the program
        trees = setup, with_floats((terrain, frames), jnp.float32)
        (ik, rig), (terrain, frames) = with_floats(trees, jnp.float64) if wide else trees
        pack = doubles if wide else rows
        return _struct(pack, (ik, rig)) + b"".join(_frames(program, pack, ik, rig, terrain, frames))


def _frames(
    program: Program,
    pack: Pack,
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frames: jaxik.Frame,
) -> Iterator[bytes]:
    state = jaxik.init(ik, rig)
    for number in range(len(frames.dt)):
        frame = jax.tree.map(lambda leaf, i=number: leaf[i], frames)
        state, result, rays, hits = step_and_rays(ik, rig, terrain, state, frame)
        yield _struct(pack, frame)
        for parts in (
            (rays.origins_ws, -rays.up_ws, rays.length, rays.layers),
            (hits.point, hits.normal, hits.found, hits.platform),
        ):
            yield pack(jax.tree.map(lambda leaf: np.asarray(leaf)[program.order], parts)).tobytes()
        yield _struct(pack, result)


def _struct(pack: Pack, tree: PyTree) -> bytes:
    return pack(jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)).tobytes()
