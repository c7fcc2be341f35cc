"""A problem of many clips whose residuals are computed on all devices, each with its clips.

The clips lie on the devices and stay there; the parameters go to all of them, and one number comes
back for each point, the sum over all devices. It is that of one device up to rounding.
"""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, PyTree

import jaxik
from fitting.problem import shared_world
from fitting.problem.capture_system import CapturedSystem
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scene, residuals_of_scenes
from fitting.problem.scene import Scene

from .noise import with_unknown_sigmas

Tree = TypeVar("Tree", bound=PyTree)

CLIPS = "clips"  # the axis of the devices
EVERYWHERE, SPLIT = PartitionSpec(), PartitionSpec(CLIPS)


class ShardedScenes(eqx.Module):
    """The clips of a problem, on several devices."""

    stacks: tuple[Scene, ...]
    """Each with clips on the first axis of its arrays, as many for each device."""
    stacked: tuple[tuple[bool, ...], ...] = eqx.field(static=True)
    """Of each stack, which of its arrays have that axis."""
    mesh: Mesh = eqx.field(static=True)
    """The devices."""


def over_devices(problem: Problem[jaxik.FootIK]) -> Problem[jaxik.FootIK]:
    """The problem with its clips shared out among the process's devices; the same up to rounding.

    Its residuals come in another order, with zeros where clips were made longer or devices have
    less to do. With one device or one clip, a capture that is fitted, or residuals of another
    kind, it stays as it is.
    """
    devices = jax.local_devices()
    if (
        len(devices) < 2
        or problem.residual_function is not residuals_of_scenes
        or len(problem.data) < 2
        or isinstance(problem.space.system, CapturedSystem)
    ):
        return problem
    mesh = Mesh(np.array(devices), (CLIPS,))
    stacks = [_filled(stack, len(devices)) for stack in shared_world.stack(problem.data)]
    each = [stack.one(i) for stack in stacks for i in range(len(stack.members))]
    sharded = dataclasses.replace(
        _on_all(dataclasses.replace(problem, data=(), unknown_sigmas=None), mesh),
        data=ShardedScenes(
            tuple(_placed(stack, mesh) for stack in stacks),
            tuple(stack.stacked for stack in stacks),
            mesh,
        ),
        residual_function=residuals_of_sharded,
    )
    if problem.unknown_sigmas is None:
        return sharded
    # Which residual has which sigma, in their new order.
    unsharded = dataclasses.replace(problem, data=tuple(each), unknown_sigmas=None)
    unknown = with_unknown_sigmas(unsharded).unknown_sigmas
    return dataclasses.replace(sharded, unknown_sigmas=_on_all(unknown, mesh))


def residuals_of_sharded(ik: jaxik.FootIK, data: ShardedScenes) -> Float[Array, " residuals"]:
    """Residuals of clips on several devices, one clip after another."""
    parts = []
    for scenes, stacked in zip(data.stacks, data.stacked, strict=True):
        of_clips = jax.vmap(
            residuals_of_scene, in_axes=(None, shared_world.labelled(scenes, stacked, 0))
        )
        spread = shared_world.labelled(scenes, stacked, SPLIT, EVERYWHERE)
        # Unchecked: loops of the pipeline begin with constants, which are the same everywhere.
        of_devices = jax.shard_map(
            of_clips,
            mesh=data.mesh,
            in_specs=(EVERYWHERE, spread),
            out_specs=SPLIT,
            check_vma=False,
        )
        parts.append(of_devices(ik, scenes).ravel())
    return jnp.concatenate(parts)


def _filled(stack: shared_world.Stack, devices: int) -> shared_world.Stack:
    """The stack with clips that nobody observed, until each device has as many."""
    count = len(stack.members)
    whole = -(-count // devices) * devices
    scenes = stack.part(0, whole)
    observed = np.array(scenes.reference.observed)
    observed[count:] = False
    scenes = dataclasses.replace(
        scenes, reference=dataclasses.replace(scenes.reference, observed=observed)
    )
    return stack._replace(scenes=scenes, members=(*stack.members, *[-1] * (whole - count)))


def _on_all(tree: Tree, mesh: Mesh) -> Tree:
    """The tree with a copy of each array on every device, wherever it was before."""
    everywhere = NamedSharding(mesh, EVERYWHERE)
    return jax.tree.map(
        lambda leaf: jax.device_put(leaf, everywhere) if eqx.is_array(leaf) else leaf, tree
    )


def _placed(stack: shared_world.Stack, mesh: Mesh) -> Scene:
    """The stack's arrays on their devices."""
    split, everywhere = NamedSharding(mesh, SPLIT), NamedSharding(mesh, EVERYWHERE)
    shardings = shared_world.labelled(stack.scenes, stack.stacked, split, everywhere)
    return jax.device_put(stack.scenes, shardings)
