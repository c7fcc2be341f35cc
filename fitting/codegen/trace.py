"""Golden traces: frames of a clip with what the rays hit, and the results of a system in JAX."""

# pyright: reportArgumentType=false

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import jaxik
from fitting.runtime.precision import with_floats
from jaxik.pipeline import step_and_rays
from jaxik.pipeline.requests import Request
from jaxik.world.terrain import Hit, LegTerrains, Terrain

from .memory import rows, words
from .program import Program


def with_restart(frames: jaxik.Frame) -> jaxik.Frame:
    """The frames with a `restart`, which a program made for them then has."""
    if frames.restart is not None:
        return frames
    return dataclasses.replace(frames, restart=jnp.zeros(frames.dt.shape, bool))


def record(
    program: Program, rig: jaxik.Rig, terrain: Terrain | LegTerrains, frames: jaxik.Frame
) -> bytes:
    """The trace of a clip: parameters and rig, then of each frame all that `check.c` compares.

    Those are the frame, its rays, their hits and the result, as the structs of the program are in
    memory, with four bytes for each number.

    Args:
        program: of the system.
        rig: the legs of the clip.
        terrain: onto which the rays are cast.
        frames: the clip, with the fields of the program's frames.
    """
    with jax.enable_x64(False):
        setup = with_floats((program.ik, rig), jnp.float32)
        trees = with_floats((*setup, terrain, frames), jnp.float32)
        return words(setup) + b"".join(_frames(program, *trees))


def _frames(
    program: Program,
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frames: jaxik.Frame,
) -> Iterator[bytes]:
    state = jaxik.init(ik, rig)
    for number in range(len(frames.dt)):
        frame = jax.tree.map(lambda leaf, i=number: leaf[i], frames)
        state, result, rays, hits = step_and_rays(ik, rig, terrain, state, frame)
        yield words(frame) + rays_in_order(program, rays) + hits_in_order(program, hits)
        yield words(result)


def rays_in_order(program: Program, rays: Request) -> bytes:
    """Rays as `jaxik.step` casts them, as an array of the program's."""
    parts = (rays.origins_ws, -rays.up_ws, rays.length, rays.layers)
    return _in_order(program, parts)


def hits_in_order(program: Program, hits: Hit) -> bytes:
    """Hits of these rays, as an array of the program's."""
    parts = (hits.point, hits.normal, hits.found, hits.platform)
    return _in_order(program, parts)


def _in_order(program: Program, parts: PyTree) -> bytes:
    return rows(jax.tree.map(lambda leaf: np.asarray(leaf)[program.order], parts)).tobytes()
