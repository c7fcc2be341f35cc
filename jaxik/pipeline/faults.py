"""Frames that cannot be used, since numbers are not finite, and frames in which no time passes.

Neither changes what a system remembers. All is computed anyway and what counts is chosen at the
end, so that a member of a batch neither spoils its neighbours nor keeps them waiting.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxik.maths import quat, vec
from jaxik.maths.struct import struct
from jaxik.stages.inputs import Moment
from jaxik.world.frame import Frame
from jaxik.world.skeleton import LegPose, Rig

Tree = TypeVar("Tree")

LARGEST = 1e7  # of a joint's numbers together, so that their fourth power is finite in 32 bits
LONGEST = 60.0  # s; in a longer frame, too, everything reaches its goal


@struct
class Faults:
    """What of a frame cannot be used."""

    legs: Bool[Array, "*b legs"]
    """Where a number of the leg is not finite, or one of the whole frame."""
    frame: Bool[Array, "*b"]
    """Where a number of the whole frame is not finite, or one of each leg that is there."""


def clean(frame: Frame, present: Bool[Array, "*#b legs"]) -> tuple[Frame, Faults]:
    """The frame with finite numbers only, and where it had others.

    A joint that is not finite goes to the model's origin, unturned; the rest of its leg stays as
    animated. A negative `dt` becomes 0, and one beyond `LONGEST` becomes that.

    Args:
        frame: the leaves may have a leading axis of frames.
        present: the legs that are there, of the rig; what others hold is not a fault.
    """
    present = present if frame.rig is None else frame.rig.present
    rank, pose = frame.dt.ndim, frame.pose
    joints = (pose.hip, pose.knee, pose.ankle, pose.toe)
    of_legs = (frame.weight, frame.foot_speed, frame.toe_speed, frame.stride)
    whole = (frame.world_from_model, frame.grounded, frame.slide, frame.velocity_ws)
    whole = (*whole, frame.stride_scale, frame.orientation, frame.dt)
    platforms = (frame.platforms, frame.platforms_before)

    joints_sound = [_is_sound(joint, rank + 1) for joint in joints]
    sound = functools.reduce(jnp.logical_and, joints_sound, _is_sound(of_legs, rank + 1))
    faulty, usable = present & ~sound, present & sound
    frame_sound = _is_sound(whole, rank) & jnp.all(_is_sound(platforms, rank + 1), axis=-1)
    frame_sound &= _any(usable) | ~_any(faulty)
    faulty |= ~frame_sound[..., None]
    # Legs that are not there count for nothing, but what they hold takes part in sums all the same.
    sound &= frame_sound[..., None]
    # Otherwise each reader of a number would look through the whole frame.
    flags = (*joints_sound, sound, faulty, frame_sound[..., None])
    *joints_sound, sound, faulty, frame_sound = _materialised(flags, rank)
    frame_sound = frame_sound[..., 0]

    joints = tuple(map(_chosen, joints_sound, joints))
    joints, of_legs = _materialised((joints, _chosen(sound, of_legs)), rank + 1)
    whole = _materialised(_chosen(frame_sound, whole), rank)
    weight, foot_speed, toe_speed, stride = of_legs
    world_from_model, grounded, slide, velocity_ws, stride_scale, orientation, dt = whole
    platforms, platforms_before = _chosen(frame_sound[..., None], platforms)
    cleaned = dataclasses.replace(
        frame,
        world_from_model=world_from_model,
        pose=LegPose(*joints),
        weight=weight,
        grounded=grounded,
        slide=slide,
        velocity_ws=velocity_ws,
        foot_speed=foot_speed,
        toe_speed=toe_speed,
        stride=stride,
        dt=jnp.clip(dt, 0.0, LONGEST),
        platforms=platforms,
        platforms_before=platforms_before,
        stride_scale=stride_scale,
        orientation=orientation,
    )
    return cleaned, Faults(faulty, ~frame_sound)


def per_leg(init: Callable[[Rig], Tree], rig: Rig) -> Tree:
    """Which leaves of the memory that `init` returns belong to single legs: they grow with them."""
    larger = jax.tree.map(lambda x: jnp.concatenate([x, x[:1]]), rig)
    few, many = jax.eval_shape(init, rig), jax.eval_shape(init, larger)
    return jax.tree.map(lambda few, many: few.shape != many.shape, few, many)


def remembered(
    now: Moment, before: Tree, after: Tree, of_legs: PyTree, faults: Faults | None
) -> Tree:
    """Memory after a frame: as before it where the frame is of no use, and in a pause.

    Before the first frame nothing is remembered: a `dt` of 0 is then no pause, and a faulty leg
    begins where the clean frame has it.

    Args:
        now: the frame.
        before: memory, all of a system or a part of it.
        after: what the frame would make of it.
        of_legs: which leaves belong to single legs.
        faults: of the frame; None takes all of it.
    """
    if faults is None:
        return after
    whole = faults.frame | (now.started & (now.dt <= 0))
    legs = whole | (now.started & faults.legs)

    def choose(before: Array, after: Array, of_legs: bool) -> Array:
        keep = jnp.expand_dims(legs, range(1, after.ndim)) if of_legs else whole
        return jnp.where(keep, before, after)

    return jax.tree.map(choose, before, after, of_legs)


def _is_sound(tree: PyTree, rank: int) -> Bool[Array, "*b"]:
    """Whether all numbers are finite and not too large; of vectors, `rank` axes are left."""
    sizes = (
        jnp.abs(leaf) if leaf.ndim == rank else vec.sum_last(jnp.abs(leaf))
        for leaf in jax.tree.leaves(tree)
    )
    return functools.reduce(jnp.add, sizes) <= LARGEST


def _chosen(sound: Bool[Array, "*b"], tree: Tree) -> Tree:
    """The numbers where they are sound, else 0, or no rotation."""

    def choose(leaf: Array) -> Array:
        if leaf.ndim == sound.ndim:
            return jnp.where(sound, leaf, 0.0)
        neutral = quat.identity(leaf.dtype) if leaf.shape[-1] == 4 else 0.0
        return jnp.where(sound[..., None], leaf, neutral)

    return jax.tree.map(choose, tree)


def _any(flags: Bool[Array, "*b n"]) -> Bool[Array, "*b"]:
    return functools.reduce(jnp.logical_or, vec.unstack(flags))


def _materialised(tree: Tree, rank: int) -> Tree:
    """The same numbers, computed once: stacked, which costs a single loop, behind a barrier."""
    leaves, structure = jax.tree.flatten(tree)
    flat = [leaf.reshape(*leaf.shape[:rank], -1) for leaf in leaves]
    stacked = vec.barrier(jnp.concatenate(flat, axis=-1))
    parts = jax.lax.split(stacked, [part.shape[-1] for part in flat], axis=rank)
    pairs = zip(parts, leaves, strict=True)
    return jax.tree.unflatten(structure, [part.reshape(leaf.shape) for part, leaf in pairs])
