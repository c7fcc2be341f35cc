"""Legs that are not there: they only pad a batch of characters with different numbers of legs."""

import dataclasses

import jax
import jax.numpy as jnp

import jaxik
from support.clips import make_rig, to_rig


def padded_leg(tree, legs: int, axis: int):
    """The tree with a padding leg: no position, no bones."""

    def widen(leaf):
        missing = legs - leaf.shape[axis]
        return jnp.pad(leaf, [(0, missing if a == axis else 0) for a in range(leaf.ndim)])

    return jax.tree.map(widen, tree)


def three_legged(rig: jaxik.Rig, frames: jaxik.Frame) -> tuple[jaxik.Rig, jaxik.Frame]:
    """A rig and its clip with one padding leg, whose weight is 1 all the same."""
    wide = padded_leg(rig, 3, axis=0)
    names, joints = to_rig(make_rig(legs=3)).names, to_rig(make_rig(legs=3)).joints
    wide = dataclasses.replace(wide, names=names, joints=joints, pelvis=12)
    pose = padded_leg(frames.pose, 3, axis=1)
    weight = jnp.concatenate([frames.weight, jnp.ones((len(frames.weight), 1))], axis=1)
    stride_and_speeds = {
        name: padded_leg(getattr(frames, name), 3, axis=1)
        for name in ("foot_speed", "toe_speed", "stride")
    }
    return wide, dataclasses.replace(frames, pose=pose, weight=weight, **stride_and_speeds)
