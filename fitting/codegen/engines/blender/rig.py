"""An armature: how its bones move in the scene, and a new action that moves them otherwise."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import bpy
import numpy as np
from mathutils import Matrix

from .exchange import Motion, Refusal, Solution, relative, rigid

END = "_end"  # after the name of a bone that has none below it: its tail
MOVED = 2e-5  # m, and in the numbers of rotations; less is rounding
CONTACT, PELVIS = "jaxik_contact_{}", "jaxik_pelvis"
SOURCE, MUTED = "jaxik_source", "jaxik_muted"
"""Of a baked action: the action below it, and the constraints that were muted for it."""
CHAINS = ("IK", "SPLINE_IK")
LINEAR = 1  # interpolation of keys
PATHS = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}


class Sample(NamedTuple):
    """An armature over the frames of its action."""

    frames: list[int]
    names: list[str]
    parents: list[int]
    """-1 at roots; parents come first."""
    tails: list[str]
    """Names that have been given to the tails of the bones without children."""
    world: np.ndarray
    """(frames, 4, 4), of the object."""
    pose: np.ndarray
    """(frames, bones, 4, 4), in the object's space, with constraints."""
    basis: np.ndarray
    """(frames, bones, 4, 4), as the channels of the bones have it."""
    motion: Motion
    """Of the bones, and then the tails, in the scene."""
    rest: Motion
    """Of the same, in one frame."""

    def is_of(self, armature: bpy.types.Object) -> bool:
        """Whether an armature still has these bones."""
        return list(armature.data.bones.keys()) == self.names


class Channel(NamedTuple):
    """A property of a bone, or of the armature, over the frames."""

    path: str
    group: str
    values: np.ndarray
    """(frames, numbers)."""


class Bake(NamedTuple):
    """All that is to be changed."""

    channels: list[Channel]
    muted: list[tuple[str, str]]
    """Bone and constraint."""
    heads: np.ndarray
    """(frames, bones, 3), where the heads of the bones shall be in the scene."""


def source_of(armature: bpy.types.Object) -> bpy.types.Action:
    """The active action or, if that has been baked here, the one below it.

    Raises:
        Refusal: there is none, or it does not play.
    """
    animation = armature.animation_data
    action = animation.action if animation else None
    if action is None:
        raise Refusal(f"{armature.name} has no active action; choose one in the Action Editor")
    if animation.use_tweak_mode:
        raise Refusal(f"a strip of {armature.name} is being tweaked; leave that with Tab")
    if armature.data.pose_position == "REST":
        raise Refusal(f"{armature.name} shows its rest position; set it to Pose Position")
    action = action.get(SOURCE) or action
    first, last = action.frame_range
    if round(first) == round(last):
        raise Refusal(f"{action.name} has a single frame; wanted a motion")
    return action


@contextmanager
def playing(armature: bpy.types.Object, action: bpy.types.Action) -> Iterator[None]:
    """In this context an armature plays an action, as if none had been baked."""
    shown = armature.animation_data.action
    _mute(armature, _muted_for(shown), muted=False)
    _activate(armature, action)
    try:
        yield
    finally:
        _activate(armature, shown)
        _mute(armature, _muted_for(shown), muted=True)


def _activate(armature: bpy.types.Object, action: bpy.types.Action) -> None:
    """Has an armature play an action, in the slot that it plays now."""
    animation = armature.animation_data
    slot = getattr(animation, "action_slot", None)  # of Blender 4.4 and newer
    identifier = slot.identifier if slot else None
    animation.action = action
    if identifier is not None:
        animation.action_slot = action.slots[identifier]


def heads(context: bpy.types.Context, armature: bpy.types.Object, names: list[str]) -> np.ndarray:
    """Where the heads of bones are in the scene, (bones, 3)."""
    posed = armature.evaluated_get(context.evaluated_depsgraph_get())
    return np.array([posed.matrix_world @ posed.pose.bones[name].head for name in names])


def sample(
    context: bpy.types.Context, armature: bpy.types.Object, frames: list[int]
) -> Iterator[float]:
    """Plays an armature, a frame a step; yields how much is done, and returns a `Sample`.

    Raises:
        Refusal: a bone or the armature is mirrored.
    """
    bones = list(armature.data.bones)
    names = [bone.name for bone in bones]
    parents = [names.index(bone.parent.name) if bone.parent else -1 for bone in bones]
    world, pose, basis = [], [], []
    for number, frame in enumerate(frames):
        context.scene.frame_set(frame)
        posed = armature.evaluated_get(context.evaluated_depsgraph_get())
        world.append(np.array(posed.matrix_world))
        of_frame = [posed.pose.bones[name] for name in names]
        pose.append(np.array([bone.matrix for bone in of_frame]))  # now, as these change
        basis.append(np.array([bone.matrix_basis for bone in of_frame]))
        yield number / len(frames)
    at_rest = np.array([bone.matrix_local for bone in bones])[None]
    ends = np.array([[0.0, bone.length, 0.0, 1.0] for bone in bones])
    leaves = [number for number in range(len(bones)) if number not in parents]
    tails = []
    for leaf in leaves:
        name = names[leaf] + END
        while name in names:
            name += END
        tails.append(name)
    world, pose = np.array(world), np.array(pose)
    motion, rest = (
        _motion(names + tails, parents + leaves, placed, ends)
        for placed in (world[:, None] @ pose, world[:1, None] @ at_rest)
    )
    return Sample(frames, names, parents, tails, world, pose, np.array(basis), motion, rest)


def _motion(names: list[str], parents: list[int], placed: np.ndarray, ends: np.ndarray) -> Motion:
    """A motion of bones with matrices (frames, bones, 4, 4), and of tails below some of them."""
    leaves = parents[placed.shape[1] :]
    tails = (placed[:, leaves] @ ends[leaves, :, None])[..., :3, 0]
    turns = rigid(placed[..., :3, :3])
    positions = np.concatenate([placed[..., :3, 3], tails], axis=1)
    return Motion(names, parents, positions, np.concatenate([turns, turns[:, leaves]], axis=1))


def plan(armature: bpy.types.Object, sampled: Sample, solved: Solution) -> Iterator[float]:
    """Works out a bake, a bone a step; yields how much is done, and returns a `Bake`.

    Scales and shears of the armature and its bones stay. Only those bones are baked that jaxik has
    moved against their parents, or that do not follow these by themselves.

    Args:
        armature: the object.
        sampled: as it was.
        solved: as it shall be, in the scene.

    Raises:
        Refusal: a bone would have to leave the tail of its parent, to which it is connected.
    """
    count = len(sampled.names)
    turns, heads = solved.motion.rotations[:, :count], solved.motion.positions[:, :count]
    placed = sampled.world[:, None] @ sampled.pose
    linear = placed[..., :3, :3]
    wanted = placed.copy()
    wanted[..., :3, :3] = turns @ sampled.motion.rotations[:, :count].swapaxes(-1, -2) @ linear
    wanted[..., :3, 3] = heads
    wanted = np.linalg.inv(sampled.world)[:, None] @ wanted
    yield 0.0
    moving, muted = _moving(armature, sampled, solved.motion)
    yield 0.0
    channels = []
    for number, bone in enumerate(moving):
        channels += _channels(armature.pose.bones[sampled.names[bone]], bone, sampled, wanted)
        yield number / len(moving)
    for leg, weights in solved.contacts.items():
        name = bpy.utils.escape_identifier(CONTACT.format(leg))
        channels.append(Channel(f'["{name}"]', "jaxik", weights[:, None]))
    moved = solved.motion.positions - sampled.motion.positions
    channels.append(Channel(f'["{PELVIS}"]', "jaxik", moved[:, solved.pelvis]))
    return Bake(channels, muted, heads)


def _moving(
    armature: bpy.types.Object, sampled: Sample, solved: Motion
) -> tuple[list[int], list[tuple[str, str]]]:
    """The bones that a motion moves against what they follow, and their constraints."""
    off = _changes(relative(sampled.motion), relative(solved))
    off_in_world = _changes(sampled.motion[2:], solved[2:])
    moving = {
        name
        for number, name in enumerate(sampled.names)
        if (off if _follows_all(armature.pose.bones[name]) else off_in_world)[number] > MOVED
    }
    muted: dict[tuple[str, str], None] = {}
    again = _muted_for(armature.animation_data.action)
    before = -1
    while len(moving) > before:  # a chain may hold bones of which another constraint has others
        before = len(moving)
        for bone in armature.pose.bones:
            for constraint in bone.constraints:
                pair, chain = (bone.name, constraint.name), _chain(bone, constraint)
                acts = not constraint.mute or pair in again
                if acts and constraint.influence > 0 and chain & moving:
                    moving |= chain
                    muted[pair] = None
    return [number for number, name in enumerate(sampled.names) if name in moving], list(muted)


def _changes(before: tuple, after: tuple) -> np.ndarray:
    """The largest change of each bone's numbers, of positions and rotations."""
    shifts, turns = (np.abs(now - then) for then, now in zip(before, after, strict=True))
    return np.maximum(shifts.max(axis=(0, 2)), turns.max(axis=(0, 2, 3)))


def _follows_all(posed: bpy.types.PoseBone) -> bool:
    """Whether a bone moves with its parent in every way."""
    bone = posed.bone
    inherits = bone.use_inherit_rotation and bone.use_local_location
    return inherits and bone.inherit_scale == "FULL" and not posed.constraints


def _chain(bone: bpy.types.PoseBone, constraint: bpy.types.Constraint) -> set[str]:
    """The bones that a constraint moves."""
    above = [bone.name, *(parent.name for parent in bone.parent_recursive)]
    if constraint.type not in CHAINS:
        return set(above[:1])
    return set(above[: constraint.chain_count or len(above)])


def _channels(
    bone: bpy.types.PoseBone, number: int, sampled: Sample, wanted: np.ndarray
) -> list[Channel]:
    """What a bone needs to get matrices (frames, bones, 4, 4) in the armature's space."""
    rest, above = bone.bone, sampled.parents[number]
    parts, own = [], []
    for frame, matrices in enumerate(wanted):
        parent = {}
        if above >= 0:
            parent["parent_matrix"] = Matrix(matrices[above])
            parent["parent_matrix_local"] = rest.parent.matrix_local
        basis = rest.convert_local_to_pose(
            Matrix(matrices[number]), rest.matrix_local, invert=True, **parent
        )
        parts.append(basis.decompose())
        own.append(Matrix(sampled.basis[frame, number]).decompose())
    locations, quats, scales = zip(*parts, strict=True)
    own_locations, own_quats, own_scales = map(np.array, zip(*own, strict=True))
    channels = []
    size = np.linalg.norm(sampled.world[0, :3, :3], axis=0).max()  # of the armature's unit
    shift = np.abs(np.array(locations) - own_locations).max() * size
    if shift > MOVED and rest.use_connect:
        raise Refusal(
            f"{bone.name} would have to leave {rest.parent.name}, to which it is connected, by "
            f"{shift:.2g} units; clear Connected in Edit Mode, or let no bone stretch"
        )
    if shift > MOVED:
        channels.append(("location", np.array(locations)))
    signs = np.sign(np.sum(np.array(quats) * own_quats, axis=-1, keepdims=True))
    if np.abs(np.array(quats) * signs - own_quats).max() > MOVED:
        mode = bone.rotation_mode
        channels.append((PATHS.get(mode, "rotation_euler"), _rotations(quats, mode)))
    if np.abs(np.array(scales) - own_scales).max() > MOVED:
        channels.append(("scale", np.array(scales)))
    return [Channel(bone.path_from_id(path), bone.name, values) for path, values in channels]


def _rotations(quats, mode: str) -> np.ndarray:
    """Quaternions as a bone with this rotation mode has them, without jumps."""
    for before, quat in zip(quats[:-1], quats[1:], strict=True):
        quat.make_compatible(before)
    if mode == "QUATERNION":
        return np.array(quats)
    if mode == "AXIS_ANGLE":
        turns = [quat.to_axis_angle() for quat in quats]
        return np.array([[angle, *axis] for axis, angle in turns])
    angles = [quats[0].to_euler(mode)]
    for quat in quats[1:]:
        angles.append(quat.to_euler(mode, angles[-1]))
    return np.array(angles)


def apply(armature: bpy.types.Object, bake: Bake, frames: list[int]) -> bpy.types.Action:
    """Gives an armature a new action: a bake over a copy of the one below it, which is kept."""
    source = source_of(armature)
    _mute(armature, _muted_for(armature.animation_data.action), muted=False)
    action = source.copy()
    action.name = f"{source.name} on ground"
    action[SOURCE], action[MUTED] = source, json.dumps(bake.muted)
    source.use_fake_user = True  # or it would not be saved
    _activate(armature, action)
    for channel in bake.channels:
        if channel.group == "jaxik":
            _declare(armature, channel.path[2:-2], channel.values)
    bag = _channelbag(armature, action)
    for path, name, values in bake.channels:
        group = bag.groups.get(name) or bag.groups.new(name)
        for index, numbers in enumerate(values.T):
            if (old := bag.fcurves.find(path, index=index)) is not None:
                bag.fcurves.remove(old)
            curve = bag.fcurves.new(path, index=index)
            curve.group = group
            curve.keyframe_points.add(len(frames))
            keys = np.stack([np.array(frames, np.float64), numbers], axis=-1)
            curve.keyframe_points.foreach_set("co", keys.ravel())
            curve.keyframe_points.foreach_set("interpolation", [LINEAR] * len(frames))
            curve.update()
    _mute(armature, bake.muted, muted=True)
    return action


def _declare(armature: bpy.types.Object, name: str, values: np.ndarray) -> None:
    """Makes a custom property of the armature."""
    if values.shape[1] == 1:
        armature[name] = 0.0
        words = {"min": 0.0, "max": 1.0, "description": "1 where the foot stands, 0 in its swing"}
    else:
        armature[name] = [0.0] * values.shape[1]
        words = {"description": "How far the pelvis has moved from the animation, in the world"}
    armature.id_properties_ui(name).update(**words)


def _channelbag(armature: bpy.types.Object, action: bpy.types.Action):
    """What holds the curves of an armature in an action: before Blender 4.4 the action itself."""
    if not hasattr(action, "layers"):
        return action
    slot = armature.animation_data.action_slot
    return action.layers[0].strips[0].channelbag(slot, ensure=True)


def _mute(armature: bpy.types.Object, constraints: list, *, muted: bool) -> None:
    """Mutes constraints, or lets them act again; those that are gone are left out."""
    for bone, name in constraints:
        posed = armature.pose.bones.get(bone)
        if posed is not None and name in posed.constraints:
            posed.constraints[name].mute = muted


def _muted_for(action: bpy.types.Action) -> list[tuple[str, str]]:
    """The constraints that were muted for a baked action."""
    return [tuple(pair) for pair in json.loads(action.get(MUTED, "[]"))]
