"""What a foot-IK system is, what it remembers, and what it returns."""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxik.maths.parameter_tree import Rule
from jaxik.maths.struct import place, struct
from jaxik.stages.contact import AbstractContact
from jaxik.stages.effector import AbstractEffector, Effector
from jaxik.stages.fade import AbstractFade, NoFade
from jaxik.stages.foot import AbstractFoot
from jaxik.stages.lean import AbstractLean, Lean
from jaxik.stages.leg import AbstractLeg
from jaxik.stages.lock import AbstractLock, Hold
from jaxik.stages.pelvis import AbstractPelvis, PelvisState
from jaxik.stages.probe import AbstractProbe
from jaxik.stages.root import AbstractRoot
from jaxik.stages.separation import AbstractSeparation
from jaxik.stages.target import AbstractTarget
from jaxik.stages.warp import StrideWarp
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import LegPose, Rig, Transform

from .shapes import check_system

Tree = TypeVar("Tree")


class FootIK(Rule):
    """A foot-IK system: one rule for each of thirteen stages.

    Make one from a preset of `jaxik.presets`, then exchange rules with `dataclasses.replace` and
    numbers with `jaxik.maths.parameter_tree.replace`:

        ik = dataclasses.replace(jaxik.presets.stride(), pelvis=SupportPelvis(lowest_share=0.5))
        ik = parameter_tree.replace(ik, {"pelvis.rise_half_life": 0.2})

    Printing a system lists its rules and parameters with their units. It is a pytree whose float
    leaves are the parameters (`equinox.filter_grad` differentiates by them). A parameter is one
    number for all legs or an array with one number a leg; those of root, lean and pelvis, which
    move the whole body, are mostly one number only, and another shape is refused by name.
    """

    contact: AbstractContact
    root: AbstractRoot
    warp: StrideWarp
    probe: AbstractProbe
    target: AbstractTarget
    lean: AbstractLean
    lock: AbstractLock
    separation: AbstractSeparation
    pelvis: AbstractPelvis
    effector: AbstractEffector
    leg: AbstractLeg
    foot: AbstractFoot
    fade: AbstractFade = eqx.field(default_factory=NoFade)


@struct
class State:
    """The pipeline's memory between frames; each stage's part belongs to its rule."""

    started: Bool[Array, "*b"]
    """False before the first frame, where memory jumps to its goals."""
    centre_ws: Float[Array, "*b 3"]
    """m, the origin of all places in this memory; 0 with 64 bits."""
    contact: PyTree
    root: PyTree
    warp: PyTree
    probe: PyTree
    target: PyTree
    lean: PyTree
    lock: PyTree
    separation: PyTree
    pelvis: PelvisState
    effector: PyTree
    fade: PyTree


@struct
class Advanced:
    """Output of the stages with memory, in one frame."""

    foothold_ws: Float[Array, "legs 3"] = place("point")
    """m, smoothed and limited, not yet locked."""
    hold: Hold
    lean: Lean
    effector: Effector
    state: State
    """After this frame."""


@struct
class Corrections:
    """Rotations from animation to solution.

    Those of the legs are local: `solved = animated * correction`. Spine and head are in model
    space, since a frame does not tell how these joints are turned: first the spine's base turns
    about itself, with all joints above it, then the head about itself, both after the body has
    moved. For a joint that then has the rotation q in model space, `conj(q) * correction * q` is
    the local correction, multiplied as those of the legs.
    """

    hip: Float[Array, "*b legs 4"]
    knee: Float[Array, "*b legs 4"]
    ankle: Float[Array, "*b legs 4"]
    spine: Float[Array, "*b 4"] | None = None
    """None if the lean rule does not bend the spine."""
    head: Float[Array, "*b 4"] | None = None
    """None likewise."""
    stretch: Float[Array, "*b legs"] | None = None
    """Not a rotation: the length of thigh and shin as a multiple of the animated one. None if the
    leg rule stretches none."""
    toe: Float[Array, "*b legs 4"] | None = None
    """Of the toe joints, local as those of the legs. None if the foot rule does not bend them."""
    twist: Float[Array, "*b 4"] | None = None
    """In model space, before that of the spine: the joints of the spine share it evenly, each
    turning about itself with all joints above it. None where `Frame.orientation` is."""


@struct
class Trace:
    """Output of every stage."""

    sensed: Sensed
    advanced: Advanced


@struct
class Result:
    """One frame after foot IK."""

    pose: LegPose
    """Solved legs, model space."""
    body: Transform
    """Moves the animated body to its solved place, model space."""
    corrections: Corrections
    reached: Float[Array, "*b legs"]
    """1 where the ankle is at its target, else 0."""
    aimed: Float[Array, "*b legs"]
    """1 where the foot has the rotation its rule wants, else 0."""
    faulty: Bool[Array, "*b legs"]
    """Where the animation has numbers that are not finite: the leg stays as animated, on the body,
    which stays too where that goes for the whole frame. Joints that are not finite are at the
    model's origin. Memory is as it was, so that the next frame goes on from there."""
    trace: Trace | None
    """None from a `step` without `trace=True`."""


def init(ik: FootIK, rig: Rig) -> State:
    """Memory before the first frame, which then starts settled, with nothing to catch up on.

    Raises:
        ValueError: if a parameter is neither one for all legs nor, where it may be, one per leg of
            the rig, or the rig is not that of one character.
    """
    check_system(ik, rig)
    return fresh_memory(ik, rig)


def fresh_memory(ik: FootIK, rig: Rig) -> State:
    """What `init` returns, without its checks."""
    started, centre_ws = jnp.zeros((), bool), jnp.zeros(3, rig.side.dtype)
    stages = [field.name for field in dataclasses.fields(State)][2:]
    return State(started, centre_ws, *(getattr(ik, stage).init(rig) for stage in stages))


def restarted(memory: Tree, fresh: Tree, restart: Bool[Array, ""] | None) -> Tree:
    """What a frame starts with: the memory of the frame before or, where it restarts, a fresh one.

    Args:
        memory: all of a system, or a part of it.
        fresh: the same before the first frame.
        restart: see `Frame.restart`.
    """
    if restart is None:
        return memory
    return jax.tree.map(lambda kept, new: jnp.where(restart, new, kept), memory, fresh)
