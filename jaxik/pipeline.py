"""The pipeline: one frame with `step`, a joined clip with `run`, part of a clip with `resume`.

Each frame goes through three phases. `sense` and `pose` have no memory and are computed for all
frames of a clip at once; only `advance`, a few numbers per leg, runs in a scan over the frames.
Everything here is for one character: batch with `lanes` or `jax.vmap`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxik.maths import quat, vec
from jaxik.maths.gate import HARD, AbstractGate
from jaxik.maths.parameter_tree import Rule
from jaxik.maths.struct import struct
from jaxik.stages.contact import AbstractContact
from jaxik.stages.effector import AbstractEffector, Effector
from jaxik.stages.foot import AbstractFoot
from jaxik.stages.inputs import Inputs, Moment, SensedMoment
from jaxik.stages.lean import AbstractLean, Lean
from jaxik.stages.leg import AbstractLeg, LegGoal
from jaxik.stages.lock import AbstractLock, Hold
from jaxik.stages.pelvis import AbstractPelvis, PelvisMoment, PelvisState
from jaxik.stages.probe import AbstractProbe, foot_heading
from jaxik.stages.root import AbstractRoot
from jaxik.stages.target import AbstractTarget
from jaxik.world.frame import Contact, Frame, Sensed, animated_ankles
from jaxik.world.skeleton import LegPose, Rig, Transform, bone_lengths
from jaxik.world.terrain import LegTerrains, Terrain

Function = TypeVar("Function", bound=Callable[..., object])


class FootIK(Rule):
    """A foot-IK system: one rule for each of ten stages, in the order in which they run.

    Make one from a preset of `jaxik.presets`, then exchange rules with `dataclasses.replace` and
    numbers with `jaxik.maths.parameter_tree.replace`:

        ik = dataclasses.replace(jaxik.presets.stride(), pelvis=SupportPelvis(lowest_share=0.5))
        ik = parameter_tree.replace(ik, {"pelvis.rise_half_life": 0.2})

    Printing a system lists its rules and parameters with their units. It is a pytree whose float
    leaves are the parameters, so that `jax.grad` with respect to it works. A parameter is one
    number for all legs or an array with one number a leg.
    """

    contact: AbstractContact
    root: AbstractRoot
    probe: AbstractProbe
    target: AbstractTarget
    lean: AbstractLean
    lock: AbstractLock
    pelvis: AbstractPelvis
    effector: AbstractEffector
    leg: AbstractLeg
    foot: AbstractFoot


@struct
class State:
    """The pipeline's memory between frames; each stage's part belongs to its rule."""

    started: Bool[Array, "*b"]  # False before the first frame, where memory jumps to its goals
    contact: PyTree
    target: PyTree
    lean: PyTree
    lock: PyTree
    pelvis: PelvisState
    effector: PyTree


@struct
class Advanced:
    """Output of the stages with memory, in one frame."""

    foothold_ws: Float[Array, "legs 3"]  # m, smoothed and limited, not yet locked
    hold: Hold
    lean: Lean
    effector: Effector
    state: State  # after this frame


@struct
class Corrections:
    """Local rotations from the animated pose to the solved one: `solved = animated * correction`."""

    hip: Float[Array, "*b legs 4"]
    knee: Float[Array, "*b legs 4"]
    ankle: Float[Array, "*b legs 4"]


@struct
class Trace:
    """Output of every stage."""

    sensed: Sensed
    advanced: Advanced


@struct
class Result:
    """One frame after foot IK."""

    pose: LegPose  # solved legs, model space
    body: Transform  # moves the animated body to its solved place, model space
    corrections: Corrections
    reached: Float[Array, "*b legs"]  # 1 where the ankle is at its target, else 0
    aimed: Float[Array, "*b legs"]  # 1 where the foot has the rotation its rule wants, else 0
    trace: Trace | None  # None from a `step` without `trace=True`


def init(ik: FootIK, rig: Rig) -> State:
    """Memory before the first frame, which then starts settled, with nothing to catch up on."""
    return State(
        jnp.zeros((), bool),
        ik.contact.init(rig),
        ik.target.init(rig),
        ik.lean.init(rig),
        ik.lock.init(rig),
        ik.pelvis.init(rig),
        ik.effector.init(rig),
    )


def sense(ik: FootIK, inputs: Inputs, contact: Contact) -> Sensed:
    """Outputs of the stages that need no memory, given which feet stand."""
    rig, terrain, frame = inputs.rig, inputs.terrain, inputs.frame
    up = terrain.leg_up_ws
    weight = jnp.where(rig.present, frame.weight * ik.leg.weight, 0.0)
    with jax.named_scope("root"):
        root_ws = vec.scale(terrain.up_ws, ik.root.sense(inputs))
        frame = frame.translated(root_ws)
        inputs = dataclasses.replace(inputs, frame=frame)
    with jax.named_scope("probe"):
        ground = ik.probe.sense(inputs, contact, ik.target.foot_height)
    with jax.named_scope("target"):
        foothold = ik.target.sense(inputs, ground, contact)
    with jax.named_scope("lean"):
        slope = ik.lean.sense(inputs, ground, contact, weight)
    with jax.named_scope("foot"):
        rot_ws = ik.foot.sense(inputs, ground)
    thigh, shin = bone_lengths(frame.pose)
    ankle = animated_ankles(frame)
    return Sensed(
        up_ws=terrain.up_ws,
        leg_up_ws=up,
        dt=frame.dt,
        slide=frame.slide,
        platform=frame.platform,
        present=rig.present,
        weight=weight,
        root_ws=root_ws,
        hip_ws=frame.world_from_model.apply(frame.pose.hip.pos),
        ankle_ws=ankle.pos,
        ankle_rot_ws=ankle.rot,
        ball_ws=frame.world_from_model.apply(frame.pose.toe.pos),
        ahead_ws=foot_heading(inputs, up)[0],
        rot_ws=rot_ws,
        thigh=thigh,
        shin=shin,
        ground=ground,
        contact=contact,
        foothold=foothold,
        slope=slope,
    )


def advance(ik: FootIK, now: SensedMoment, state: State, contact: PyTree) -> Advanced:
    """Memory after this frame, and the outputs of the stages that have some.

    Args:
        ik: the system.
        now: the sensed frame.
        state: memory after the frame before.
        contact: the contact stage's memory after this frame: it advances before `sense`.
    """
    sensed, up = now.sensed, now.sensed.leg_up_ws
    with jax.named_scope("target"):
        target_state, rise = ik.target.advance(now, state.target)
        foothold_ws = sensed.foothold.point_ws + vec.scale(up, rise)
    with jax.named_scope("lean"):
        lean_state, lean = ik.lean.advance(now, state.lean)
    with jax.named_scope("lock"):
        # With the last frame's pelvis: this frame's offset follows from the locks.
        hip_ws = sensed.hip_ws + state.pelvis.offset_ws
        lock_state, hold = ik.lock.advance(now, foothold_ws, hip_ws, state.lock)
        target_ws = foothold_ws + hold.offset_ws + vec.scale(up, sensed.foothold.lift)
        ankle = Transform(target_ws, hold.rot_ws)
    with jax.named_scope("pelvis"):
        awake = ik.effector.awake(now, state.effector)
        pelvis_now = PelvisMoment(now.dt, now.started, now.gate, sensed, now.terrain, lean, awake)
        pelvis = ik.pelvis.advance(pelvis_now, ankle, state.pelvis)
    with jax.named_scope("effector"):
        effector_state, effector = ik.effector.advance(now, ankle, pelvis, state.effector)
    after = State(
        started=jnp.ones_like(now.started),
        contact=contact,
        target=target_state,
        lean=lean_state,
        lock=lock_state,
        pelvis=pelvis,
        effector=effector_state,
    )
    return Advanced(foothold_ws, hold, lean, effector, after)


def pose(ik: FootIK, inputs: Inputs, sensed: Sensed, advanced: Advanced) -> Result:
    """The solved legs."""
    rig, frame, effector = inputs.rig, inputs.frame, advanced.effector
    offset_ws = sensed.root_ws + advanced.state.pelvis.offset_ws
    body = body_transform(inputs, advanced.lean.turn_ws, offset_ws)
    target_ms = frame.world_from_model.inverse().apply(effector.target_ws)
    with jax.named_scope("leg"):
        moved = frame.pose.transformed(body.repeat(rig.side.size))
        leg = ik.leg.pose(inputs, sensed, LegGoal(moved, target_ms, effector.weight))
    with jax.named_scope("foot"):
        foot = ik.foot.pose(inputs, sensed, effector, leg)
    corrections = Corrections(leg.hip, leg.knee, foot.ankle)
    trace = Trace(sensed, advanced)
    return Result(foot.pose, body, corrections, leg.reached, foot.reached, trace)


def sense_contacts(rule: AbstractContact, inputs: Inputs, state: State) -> tuple[PyTree, Contact]:
    """The contact stage for a joined clip: memory after each frame, and the contacts.

    It runs in a scan of its own before everything else, or without one if the rule has no memory.
    The leaves of `inputs.frame` have a leading axis of frames.
    """
    frames, gate = inputs.frame, inputs.gate
    with jax.named_scope("contact"):
        sensed = jax.vmap(lambda frame: rule.sense(dataclasses.replace(inputs, frame=frame)))(
            frames
        )
        if not jax.tree.leaves(state.contact):
            return state.contact, sensed

        def scanned(
            carry: tuple[PyTree, Array], frame: tuple[Contact, Array]
        ) -> tuple[tuple[PyTree, Array], tuple[PyTree, Contact]]:
            (memory, started), (contact, dt) = carry, frame
            after, contact = rule.advance(Moment(dt, started, gate), contact, memory)
            return (after, jnp.ones_like(started)), (after, contact)

        return jax.lax.scan(scanned, (state.contact, state.started), (sensed, frames.dt))[1]


def body_transform(inputs: Inputs, rot_ws: Array, offset_ws: Array) -> Transform:
    """The body's motion in model space: a rotation about the mean of its hips, then an offset.

    Args:
        inputs: the frame and its rig; legs that are not present do not count.
        rot_ws: rotation, world axes.
        offset_ws: offset, m, world space.
    """
    model_from_world = quat.conjugate(inputs.frame.world_from_model.rot)
    present = inputs.rig.present.astype(offset_ws.dtype)
    weight = present / jnp.maximum(vec.sum_last(present), 1.0)
    pivot = vec.barrier(vec.sum_vectors(vec.scale(inputs.frame.pose.hip.pos, weight)))
    rot = quat.multiply(model_from_world, quat.multiply(rot_ws, quat.conjugate(model_from_world)))
    offset = quat.rotate(model_from_world, offset_ws)
    return Transform(pivot + offset - quat.rotate(rot, pivot), rot)


def _jit(**options: str) -> Callable[[Function], Function]:
    """`jax.jit`, but editors and type checkers still see the function's own signature."""
    return cast(Callable[[Function], Function], functools.partial(jax.jit, **options))


@_jit(static_argnames="trace")
def step(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    state: State,
    frame: Frame,
    gate: AbstractGate = HARD,
    *,
    trace: bool = False,
) -> tuple[State, Result]:
    """One frame of one character, for use in a game loop.

    Args:
        ik: the system; its float leaves are its parameters.
        rig: the legs.
        terrain: the terrain, world space; `LegTerrains` where legs differ in their up.
        state: memory, from `init` or from the previous step.
        frame: the animation.
        gate: `Hard` decides as a game does; `Smooth` lets gradients through decisions.
        trace: whether the result contains every stage's output. Handing these out, one buffer per
            leaf, takes a third of a call's time.

    Returns:
        Memory after the frame, for the next step, and the result.
    """
    inputs = Inputs(rig, terrain, frame, gate)
    with jax.named_scope("contact"):
        now = Moment(frame.dt, state.started, gate)
        memory, contact = ik.contact.advance(now, ik.contact.sense(inputs), state.contact)
    sensed = sense(ik, inputs, contact)
    sensed_now = SensedMoment(frame.dt, state.started, gate, sensed, terrain)
    advanced = advance(ik, sensed_now, state, memory)
    result = pose(ik, inputs, sensed, advanced)
    return advanced.state, result if trace else dataclasses.replace(result, trace=None)


@_jit()
def resume(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    state: State,
    frames: Frame,
    gate: AbstractGate = HARD,
) -> tuple[State, Result]:
    """A clip, or a part of one, that starts with the memory of what came before.

    Gives what `step` gives for each frame in turn. For the arguments see `step`; the leaves of
    `frames` and of the result have a leading axis of frames.

    Returns:
        Memory after the last frame, so that the remainder can follow, and the result.
    """
    inputs = Inputs(rig, terrain, frames, gate)

    def at(frame: Frame) -> Inputs:
        return dataclasses.replace(inputs, frame=frame)

    memories, contacts = sense_contacts(ik.contact, inputs, state)
    sensed = jax.vmap(lambda frame, contact: sense(ik, at(frame), contact))(frames, contacts)

    def scanned(state: State, frame: tuple[Sensed, PyTree]) -> tuple[State, Advanced]:
        sensed, memory = frame
        now = SensedMoment(sensed.dt, state.started, gate, sensed, terrain)
        advanced = advance(ik, now, state, memory)
        return advanced.state, advanced

    after, advanced = jax.lax.scan(scanned, state, (sensed, memories))
    result = jax.vmap(lambda frame, s, a: pose(ik, at(frame), s, a))(frames, sensed, advanced)
    return after, result


@_jit(static_argnames="block")
def run(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    frames: Frame,
    gate: AbstractGate = HARD,
    *,
    block: int | None = None,
) -> Result:
    """A clip of one character, from a fresh start.

    It can be jitted, vmapped and differentiated with respect to any argument. For the arguments see
    `step`; the leaves of `frames` and of the result have a leading axis of frames.

    Args:
        block: how many frames to compute at a time, for long clips; None computes all at once. The
            result is the same, but besides arguments and results only one block has to be in
            memory, in reverse mode one block and the state before each.

    Raises:
        ValueError: if `block` is less than 1.
    """
    if block is not None and block < 1:
        raise ValueError(
            f"block must be at least 1 frame, or None for all frames at once; got {block}"
        )
    start, count = init(ik, rig), frames.dt.shape[0]
    if block is None or block >= count:
        return resume(ik, rig, terrain, start, frames, gate)[1]
    blocks = count // block

    def resume_block(state: State, frames: Frame) -> tuple[State, Result]:
        return resume(ik, rig, terrain, state, frames, gate)

    split = jax.tree.map(lambda x: x[: blocks * block].reshape(blocks, block, *x.shape[1:]), frames)
    state, results = jax.lax.scan(jax.checkpoint(resume_block), start, split)
    joined = jax.tree.map(lambda x: x.reshape(blocks * block, *x.shape[2:]), results)
    if blocks * block == count:
        return joined
    remainder = resume_block(state, jax.tree.map(lambda x: x[blocks * block :], frames))[1]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), joined, remainder)
