"""The algorithm of foot IK: `solve`, and its three phases `sense`, `advance` and `pose`.

`sense` and `pose` have no memory, so that a clip's frames are computed all at once; only `advance`
has to run frame by frame. Contact and root are sensed and advanced before everything else, and so
is what the probe remembers. How frames are fed in is no part of the algorithm: see `frames`.
"""

import dataclasses
import functools
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, vec
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.stages.leg import LegGoal
from jaxik.stages.pelvis import PelvisMoment
from jaxik.stages.probe import foot_heading
from jaxik.stages.warp import about_up, with_turned_feet, with_turned_pelvis
from jaxik.world import places
from jaxik.world.frame import Contact, Sensed, Stride, Turn, animated_ankles
from jaxik.world.skeleton import Transform, bone_lengths, mean_position
from jaxik.world.terrain import Hit

from .faults import Faults
from .frames import AbstractFrames
from .system import Advanced, Corrections, FootIK, Result, State, Trace

Tree = TypeVar("Tree")


def solve(frames: AbstractFrames) -> tuple[State, Result]:
    """Memory after the last frame, and the result of each."""
    contact = frames.ahead("contact", lambda ik, inputs: ik.contact.sense(inputs))
    root = frames.ahead("root", lambda ik, inputs: ik.root.sense(inputs))
    warp = frames.ahead("warp", lambda ik, inputs: ik.warp.sense(inputs))
    probe = frames.ahead("probe", watch, contact.output, warp.output)
    sensed = frames.each(sense, contact.output, root.output, warp.output, probe.output)
    ahead = contact.state, root.state, warp.state, probe.state
    after, advanced = frames.advance(advance, sensed, ahead)
    return after, frames.each(pose, sensed, advanced, frames.faults)


def watch(ik: FootIK, inputs: Inputs, contact: Contact, turn: Turn | None) -> PyTree:
    """What the memory of the probe advances with; None if it has none."""
    if not jax.tree.leaves(ik.probe.init(inputs.rig)):
        return None  # and no stride is scaled in vain
    return ik.probe.watch(_warped(ik, inputs, turn)[0], contact, ik.target.foot_height)


def _warped(
    ik: FootIK, inputs: Inputs, turn: Turn | None
) -> tuple[Inputs, Float[Array, "legs 3"] | None]:
    """The frame with its feet moved for the character's velocity, and by how much, m.

    Feet that are turned move from where the turned pelvis carries them.
    """
    before_ws = None
    if turn is not None:
        carried = with_turned_pelvis(inputs.frame, turn)
        before_ws = animated_ankles(carried).pos
        turned = with_turned_feet(carried, inputs.bearing, turn)
        inputs = dataclasses.replace(inputs, frame=turned)
    warp_ws = ik.warp.offset(inputs)
    if warp_ws is not None:
        inputs = dataclasses.replace(inputs, frame=inputs.frame.with_moved_feet(warp_ws))
    if before_ws is not None:
        warp_ws = animated_ankles(inputs.frame).pos - before_ws
    return inputs, warp_ws


def sense(
    ik: FootIK,
    inputs: Inputs,
    contact: Contact,
    rise: Float[Array, ""],
    turn: Turn | None,
    stride: Stride | None,
) -> Sensed:
    """Outputs of the stages that need no memory.

    Args:
        ik: the system.
        inputs: the frame.
        contact: which feet stand.
        rise: of the root, m.
        turn: of pelvis and feet; None for none.
        stride: where the feet stood and will stand; None leaves what the animation says.
    """
    rig, terrain, frame = inputs.rig, inputs.terrain, inputs.frame
    if stride is not None:
        frame = dataclasses.replace(frame, stride=stride)
    up = terrain.leg_up_ws
    weight = jnp.where(rig.present, frame.grounded * frame.weight * ik.leg.weight, 0.0)
    root_ws = vec.scale(terrain.up_ws, rise)
    frame = frame.translated(root_ws)
    inputs = dataclasses.replace(inputs, frame=frame)
    thigh, shin = bone_lengths(frame.pose)
    with jax.named_scope("warp"):
        inputs, warp_ws = _warped(ik, inputs, turn)
        frame = inputs.frame
    inputs = dataclasses.replace(inputs, foot_heading_ws=foot_heading(inputs))
    with jax.named_scope("probe"):
        ground = ik.probe.ground(inputs, contact, ik.target.foot_height)
    with jax.named_scope("target"):
        foothold = ik.target.sense(inputs, ground, contact)
    with jax.named_scope("lean"):
        slope = ik.lean.sense(inputs, ground, contact, weight)
    with jax.named_scope("foot"):
        rot_ws = ik.foot.sense(inputs, ground)
    ankle = animated_ankles(frame)
    return Sensed(
        up_ws=terrain.up_ws,
        leg_up_ws=up,
        slide=frame.slide,
        carry=frame.carry(_shared_platform(ground.ankle, rig.present)),
        present=rig.present,
        side=rig.side,
        weight=weight,
        grounded=frame.grounded,
        root_ws=root_ws,
        hip_ws=frame.world_from_model.apply(frame.pose.hip.pos),
        ankle_ws=ankle.pos,
        ankle_rot_ws=ankle.rot,
        foot_speed=frame.foot_speed,
        ball_ws=frame.world_from_model.apply(frame.pose.toe.pos),
        ahead_ws=foot_heading(inputs)[0],
        rot_ws=rot_ws,
        thigh=thigh,
        shin=shin,
        ground=ground,
        contact=contact,
        foothold=foothold,
        slope=slope,
        warp_ws=warp_ws,
        turn=turn,
    )


def advance(
    ik: FootIK, now: SensedMoment, state: State, ahead: tuple[PyTree, PyTree, PyTree, PyTree]
) -> Advanced:
    """Memory after this frame, and the outputs of the stages that have some.

    Args:
        ik: the system.
        now: the sensed frame.
        state: memory after the frame before.
        ahead: memory of contact, root, warp and probe after this frame.
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
        lasting = ik.fade.lasting(sensed.weight, state.fade)
        lock_now = dataclasses.replace(now, sensed=dataclasses.replace(sensed, weight=lasting))
        lock_state, hold = ik.lock.advance(lock_now, foothold_ws, hip_ws, state.lock)
        target_ws = foothold_ws + hold.offset_ws + vec.scale(up, sensed.foothold.lift)
    with jax.named_scope("separation"):
        separation_state, apart_ws = ik.separation.advance(now, foothold_ws, hold, state.separation)
        target_ws = target_ws if apart_ws is None else target_ws + apart_ws
        ankle = Transform(target_ws, hold.rot_ws)
    with jax.named_scope("pelvis"):
        awake = ik.effector.awake(now, state.effector)
        pelvis_now = PelvisMoment(now.dt, now.started, now.gate, sensed, now.terrain, lean, awake)
        pelvis = ik.pelvis.advance(pelvis_now, ankle, state.pelvis)
    with jax.named_scope("fade"):
        offset_ws = vec.scale(pelvis.offset_ws, sensed.grounded)
        body = Transform(offset_ws, _part_of(lean.rot_ws, sensed.grounded))
        fade_state, body = ik.fade.body(now, body, sensed.weight, state.fade)
        pelvis = dataclasses.replace(pelvis, offset_ws=body.pos)
        lean = dataclasses.replace(lean, rot_ws=body.rot)
    with jax.named_scope("effector"):
        effector_state, effector = ik.effector.advance(now, ankle, pelvis, state.effector)
    with jax.named_scope("fade"):
        # All that a leg's weight consists of: frame and leg (`Sensed.weight`), its contact, how far
        # these have faded in, and the effector's own part. A faulty leg has none (`pose`).
        standing = jnp.where(ik.effector.by_contact, sensed.contact.weight, 1.0)
        fade_state, faded = ik.fade.legs(now, effector, body, sensed.weight * standing, fade_state)
        effector = dataclasses.replace(effector, weight=faded * effector.weight)
    after = State(
        started=jnp.ones_like(now.started),
        centre_ws=state.centre_ws,
        contact=ahead[0],
        root=ahead[1],
        warp=ahead[2],
        probe=ahead[3],
        target=target_state,
        lean=lean_state,
        lock=lock_state,
        separation=separation_state,
        pelvis=pelvis,
        effector=effector_state,
        fade=fade_state,
    )
    return Advanced(foothold_ws, hold, lean, effector, after)


def pose(
    ik: FootIK, inputs: Inputs, sensed: Sensed, advanced: Advanced, faults: Faults | None
) -> Result:
    """The solved legs; faulty ones as animated, on a body that stays if all are."""
    rig, frame = inputs.rig, inputs.frame
    effector, lean = advanced.effector, advanced.lean
    offset_ws = sensed.root_ws + advanced.state.pelvis.offset_ws
    rot_ws, spine_ws, head_ws = lean.rot_ws, lean.spine_ws, lean.head_ws
    faulty, turn = jnp.zeros_like(rig.present), sensed.turn
    if faults is not None:
        faulty = faults.legs
        effector = dataclasses.replace(effector, weight=jnp.where(faulty, 0.0, effector.weight))
        offset_ws = jnp.where(faults.frame, 0.0, offset_ws)
        level = functools.partial(jnp.where, faults.frame, quat.identity(offset_ws.dtype))
        rot_ws = level(rot_ws)
        spine_ws, head_ws = (None if rot is None else level(rot) for rot in (spine_ws, head_ws))
        turn = jax.tree.map(functools.partial(jnp.where, faults.frame, 0.0), turn)
    if turn is not None:
        frame = with_turned_pelvis(frame, turn)
        inputs = dataclasses.replace(inputs, frame=frame)
    body = body_transform(inputs, rot_ws, offset_ws)
    target_ms = frame.world_from_model.inverse().apply(effector.target_ws)
    with jax.named_scope("leg"):
        moved = frame.pose.transformed(body.repeat(rig.side.size))
        leg = ik.leg.pose(inputs, sensed, LegGoal(moved, target_ms, effector.weight))
    with jax.named_scope("foot"):
        foot = ik.foot.pose(inputs, sensed, effector, leg)
        if ik.foot.bend_toes:
            foot = ik.foot.with_toes(inputs, sensed, effector.weight, foot)
    spine, head = (
        None if rot is None else in_model_space(inputs, rot) for rot in (spine_ws, head_ws)
    )
    twist = None
    if turn is not None:
        pelvis = about_up(turn.pelvis)
        twist = body.turn_rot(quat.conjugate(pelvis.rot))  # about the up of the body as it leans
        body = body @ pelvis
    corrections = Corrections(
        leg.hip, leg.knee, foot.ankle, spine, head, leg.stretch, foot.toe, twist
    )
    advanced_ws = dataclasses.replace(_in_world(inputs, advanced), state=advanced.state)
    trace = Trace(_in_world(inputs, sensed), advanced_ws)
    return Result(foot.pose, body, corrections, leg.reached, foot.reached, faulty, trace)


def _in_world(inputs: Inputs, tree: Tree) -> Tree:
    """What was computed about the centre of a frame, in world space as the caller knows it."""
    if inputs.centre_ws is None:
        return tree
    terrain = inputs.terrain
    return places.moved(tree, inputs.centre_ws, terrain.up_ws, terrain.leg_up_ws)


def _shared_platform(hit: Hit, present: Array) -> Hit:
    """The hits, with feet that found no ground on the platform of another foot, if there is one."""
    if hit.platform is None:
        return hit
    others = jnp.max(jnp.where(present, hit.platform, -1))
    platform = jnp.where(hit.found > 0, hit.platform, others)
    return dataclasses.replace(hit, platform=platform)


def _part_of(rot: Array, weight: Array) -> Array:
    """A rotation by a part of the way, 0..1; exactly `rot` at weight 1."""
    return jnp.where(weight < 1, quat.nlerp_identity(rot, weight), rot)


def body_transform(inputs: Inputs, rot_ws: Array, offset_ws: Array) -> Transform:
    """The body's motion in model space: a rotation about the mean of its hips, then an offset.

    Args:
        inputs: the frame and its rig; legs that are not present do not count.
        rot_ws: rotation, world axes.
        offset_ws: offset, m, world space.
    """
    pivot = vec.barrier(mean_position(inputs.frame.pose.hip.pos, inputs.rig.present))
    rot = in_model_space(inputs, rot_ws)
    offset = quat.unrotate(inputs.frame.world_from_model.rot, offset_ws)
    return Transform(pivot + offset - quat.rotate(rot, pivot), rot)


def in_model_space(inputs: Inputs, rot_ws: Array) -> Array:
    """The rotation about model axes that `rot_ws` is about world axes."""
    world_from_model = inputs.frame.world_from_model.rot
    model_from_world = quat.conjugate(world_from_model)
    return quat.multiply(model_from_world, quat.multiply(rot_ws, world_from_model))
