"""Other bodies with the motion of a clip: larger, smaller, with other legs."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from fitting.clips import edit
from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import Clip
from fitting.motion.flat_animation import with_rigid_legs


def scaled(clip: Clip, size: float, *, froude: bool = False) -> Clip:
    """The clip by a body `size` times as large; with equal Froude numbers, slower if it is."""
    fps = clip.fps / size**0.5 if froude else clip.fps
    stance = clip.stance_labels()
    return _measured(replace(clip, positions_ws=size * clip.positions_ws, fps=fps, stance=stance))


def with_shins(clip: Clip, *lengths: float) -> Clip:
    """The clip by a body whose shins have other lengths, as fractions, left and right.

    Its feet go the same way; its pelvis is as much lower as its legs need to reach them.
    """
    rig = clip.rig
    shins = rig.shin * jnp.asarray(lengths)
    way = clip.joints_ws(0) - clip.joints_ws(2)
    reach = 0.998 * np.asarray(rig.thigh + shins)
    height = np.sqrt(reach**2 - way[..., 0] ** 2 - way[..., 2] ** 2)
    positions = clip.positions_ws.copy()
    feet = np.array(rig.joints)[:, 1:].ravel()
    rest = np.setdiff1d(np.arange(positions.shape[1]), feet)
    positions[:, rest, 1] -= np.max(way[..., 1] - height)
    moved = replace(clip, positions_ws=positions, measured_rig=replace(rig, shin=shins))
    return _measured(replace(with_rigid_legs(moved), stance=clip.stance_labels()))


def _measured(clip: Clip) -> Clip:
    """The clip with its rig measured again, and the labels that it had."""
    joints = {"pelvis": clip.joint_names[clip.rig.pelvis]}
    for name, leg in zip(clip.rig.names, clip.rig.joints, strict=True):
        roles = zip(("hip", "knee", "ankle", "toe"), leg, strict=True)
        joints |= {f"{role}_{name}": clip.joint_names[joint] for role, joint in roles}
    motion = JointMotion(
        clip.joint_names, clip.parents, clip.positions_ws, clip.rotations_ws,
        clip.stance_labels(), clip.fps,
    )  # fmt: skip
    return clip_from_joints(motion, clip.source, joints)


def without_t_pose(clip: Clip) -> Clip:
    """The part of a clip in which something moves."""
    first, last = edit.motion_span(clip)
    return clip.select(slice(first, last + 1))
