"""Foot IK as sense, advance, pose: one frame with `step`, a clip with `run`.

What has no memory is computed for all frames at once (`sense`, `pose`); only a few numbers per leg
go through the scan (`advance`). Everything is for one character: batch with `lanes` or `jax.vmap`.
"""

import dataclasses
import functools

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


class FootIK(Rule):
    """A foot-IK system: one rule a stage, in the order in which they run."""

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
    """All that the pipeline remembers between frames."""

    started: Bool[Array, "*b"]  # False before the first frame, on which memory jumps to its goals
    contact: PyTree
    target: PyTree
    lean: PyTree
    lock: PyTree
    pelvis: PelvisState
    effector: PyTree


@struct
class Advanced:
    """What memory makes of a frame."""

    foothold_ws: Float[Array, "legs 3"]  # m, smoothed and limited, before the lock
    hold: Hold
    lean: Lean
    effector: Effector
    state: State  # after the frame


@struct
class Corrections:
    """Local rotations that turn the animated pose into the solved one, right-multiplied."""

    hip: Float[Array, "*b legs 4"]
    knee: Float[Array, "*b legs 4"]
    ankle: Float[Array, "*b legs 4"]


@struct
class Trace:
    """Every stage's output."""

    sensed: Sensed
    advanced: Advanced


@struct
class Result:
    """The frame after foot IK."""

    pose: LegPose  # legs, model space
    body: Transform  # carries the animated body to where it belongs, model space
    corrections: Corrections
    reached: Float[Array, "*b legs"]  # 1 where the ankle is at its target, else 0
    aimed: Float[Array, "*b legs"]  # 1 where the foot is turned as its rule wants, else 0
    trace: Trace | None  # None from a `step` that was not asked for it


def init(ik: FootIK, rig: Rig) -> State:
    """The memory of a character that has not been seen yet: its first frame starts settled."""
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
    """All that the frame shows by itself, once it is known which feet stand."""
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
    """Memory: footholds, locks, lean, pelvis and effectors after this frame.

    That of the contact has advanced already, to `contact`: the senses need it.
    """
    sensed, up = now.sensed, now.sensed.leg_up_ws
    with jax.named_scope("target"):
        target, rise = ik.target.advance(now, state.target)
        foothold_ws = sensed.foothold.point_ws + vec.scale(up, rise)
    with jax.named_scope("lean"):
        leaning, lean = ik.lean.advance(now, state.lean)
    with jax.named_scope("lock"):
        # The hip as the frame before left it: this frame's offset follows from the locks.
        hip_ws = sensed.hip_ws + state.pelvis.offset_ws
        lock, held = ik.lock.advance(now, foothold_ws, hip_ws, state.lock)
        target_ws = foothold_ws + held.offset_ws + vec.scale(up, sensed.foothold.lift)
        ankle = Transform(target_ws, held.rot_ws)
    with jax.named_scope("pelvis"):
        awake = ik.effector.awake(now, state.effector)
        pelvis_now = PelvisMoment(now.dt, now.started, now.gate, sensed, now.terrain, lean, awake)
        pelvis = ik.pelvis.advance(pelvis_now, ankle, state.pelvis)
    with jax.named_scope("effector"):
        following, effector = ik.effector.advance(now, ankle, pelvis, state.effector)
    after = State(jnp.ones_like(now.started), contact, target, leaning, lock, pelvis, following)
    return Advanced(foothold_ws, held, lean, effector, after)


def pose(ik: FootIK, inputs: Inputs, sensed: Sensed, advanced: Advanced) -> Result:
    """The solved legs."""
    rig, frame = inputs.rig, inputs.frame
    offset_ws = sensed.root_ws + advanced.state.pelvis.offset_ws
    body = carry(rig, frame, advanced.lean.turn_ws, offset_ws)
    effector = advanced.effector
    target_ms = frame.world_from_model.inverse().apply(effector.target_ws)
    with jax.named_scope("leg"):
        carried = frame.pose.transformed(body.repeat(rig.side.size))
        bend = ik.leg.pose(inputs, sensed, LegGoal(carried, target_ms, effector.weight))
    with jax.named_scope("foot"):
        planted = ik.foot.pose(inputs, sensed, effector, bend)
    corrections = Corrections(bend.hip, bend.knee, planted.ankle)
    trace = Trace(sensed, advanced)
    return Result(planted.pose, body, corrections, bend.reached, planted.reached, trace)


def sense_contacts(rule: AbstractContact, inputs: Inputs, state: State) -> tuple[PyTree, Contact]:
    """Memory after each frame and the contacts, in a scan of their own.

    A rule without memory needs none. The leaves of `inputs.frame` have a leading axis of frames.
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


def carry(rig: Rig, frame: Frame, turn_ws: Array, offset_ws: Array) -> Transform:
    """The body's move in model space: a turn about the middle of the hips, then an offset."""
    into_model = quat.conjugate(frame.world_from_model.rot)
    present = rig.present.astype(offset_ws.dtype)
    share = present / jnp.maximum(vec.sum_last(present), 1.0)
    pivot = vec.barrier(vec.sum_vectors(vec.scale(frame.pose.hip.pos, share)))
    turn = quat.multiply(into_model, quat.multiply(turn_ws, quat.conjugate(into_model)))
    offset = quat.rotate(into_model, offset_ws)
    return Transform(pivot + offset - quat.rotate(turn, pivot), turn)


@functools.partial(jax.jit, static_argnames="trace")
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
    """One frame of one character, live.

    Args:
        ik: the system; its float leaves are its parameters.
        rig: the legs.
        terrain: the ground, world space; `LegTerrains` where legs differ in their up.
        state: memory, from `init` or from the step before.
        frame: the animation.
        gate: `Hard` decides as a game does; `Smooth` has slopes through decisions.
        trace: whether the result tells every stage's output. A call spends a third of its time on
            handing these out, one buffer a leaf.
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


@jax.jit
def resume(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    state: State,
    frames: Frame,
    gate: AbstractGate = HARD,
) -> tuple[State, Result]:
    """A clip from a given memory; the leaves of `frames` have a leading axis of frames.

    Equal to `step` for each frame in turn. Returns the memory after the last frame, so that a clip
    may be cut anywhere.
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


@functools.partial(jax.jit, static_argnames="block")
def run(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    frames: Frame,
    gate: AbstractGate = HARD,
    *,
    block: int | None = None,
) -> Result:
    """A clip of one character; the leaves of `frames` and of the result lead with frames.

    Jit, vmap and differentiate over any argument. `block` cuts a long clip: so many frames are
    computed at a time, so that besides arguments and results one block is all that memory holds,
    and in reverse mode one block and the state before each of them. The result is the same.

    Raises:
        ValueError: a block of no frames.
    """
    if block is not None and block < 1:
        raise ValueError(f"block is {block}, wanted 1 frame or more, or None for all at once")
    start, count = init(ik, rig), frames.dt.shape[0]
    if block is None or block >= count:
        return resume(ik, rig, terrain, start, frames, gate)[1]
    blocks = count // block

    def resumed(state: State, frames: Frame) -> tuple[State, Result]:
        return resume(ik, rig, terrain, state, frames, gate)

    cut = jax.tree.map(lambda x: x[: blocks * block].reshape(blocks, block, *x.shape[1:]), frames)
    state, results = jax.lax.scan(jax.checkpoint(resumed), start, cut)
    whole = jax.tree.map(lambda x: x.reshape(blocks * block, *x.shape[2:]), results)
    if blocks * block == count:
        return whole
    rest = resumed(state, jax.tree.map(lambda x: x[blocks * block :], frames))[1]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), whole, rest)
