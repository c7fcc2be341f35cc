"""The crowd of the benchmarks by C over vector lanes, which JAX's programs are compared with."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

import jaxik
from fitting.codegen.crowd import Axes, kernel_of, run_crowd
from jaxik.maths import parameter_tree
from jaxik.world.terrain import Terrain

from .measurement import Call
from .workloads import Crowd


def taken_over(result: jaxik.Result) -> tuple:
    """What a game takes over of a result: corrections, the body's motion, what was reached."""
    return result.corrections, result.body, result.reached


def by_kernel(crowd: Crowd, ground: Terrain, size: int) -> tuple[Call, str]:
    """A call that computes a crowd in parts of a size, on all cores, and what by.

    Raises:
        NoKernelError: there is no compiled code for it.
    """
    count = len(crowd.members.first)
    firsts = (min(first, count - size) for first in range(0, count, size))
    parts = [_arguments(crowd, ground, slice(first, first + size)) for first in firsts]
    kernel = kernel_of(*parts[0][0], keep=taken_over)

    def call() -> list[PyTree]:
        return [
            run_crowd(*trees, -1, starts=starts, count=crowd.frame_count, keep=taken_over)
            for trees, starts in parts
        ]

    return call, f"C, {kernel.lanes} lanes"


def _arguments(
    crowd: Crowd, ground: Terrain, part: slice
) -> tuple[tuple[jaxik.FootIK, jaxik.Rig, Terrain, jaxik.Frame, Axes], np.ndarray]:
    """Those of `run_crowd` for some of a crowd, and the frames with which they start."""
    members = jax.tree.map(lambda leaf: np.asarray(leaf)[part], crowd.members)
    world_ws = np.asarray(crowd.motion.world_from_model.pos)
    to_place = (members.place_ws - world_ws[members.first]) * np.array([1, 0, 1], np.float32)
    frames = eqx.tree_at(
        lambda frame: frame.world_from_model.pos, crowd.motion, world_ws + to_place[:, None]
    )
    ik = parameter_tree.replace(crowd.ik, members.drawn)
    trees, shared = (ik, frames), (crowd.ik, crowd.motion)
    of_ik, of_frames = (
        jax.tree.map(lambda many, one: 0 if np.ndim(many) > np.ndim(one) else None, *pair)
        for pair in zip(trees, shared, strict=True)
    )
    return (ik, crowd.rig, ground, frames, (of_ik, None, None, of_frames)), members.first
