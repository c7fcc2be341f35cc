"""Edits of clips: pure functions, each returning a new clip."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from jaxik.world.skeleton import Rig

from . import contacts
from .clip import Clip
from .joint_roles import partners
from .recording import local_from_world, place

POP = 0.02  # m: second difference of a joint at 120 Hz that no body makes
POP_RATE = 120.0  # Hz
REST = np.radians(1.0)  # a joint turned less is at rest
REST_SHARE = 0.5  # share of the joints at rest in a T-pose
JUMP = 4.0  # times the median step: how far it is from a T-pose to the motion
RAMP_SECONDS = 0.1  # within which a filter's ramp out of a T-pose dies away
RAMP = 2.0  # times the median step
GAP = 0.02  # s: a ramp that overshoots slows down for as long
MIRROR = np.array([-1.0, 1.0, 1.0])  # of vectors
MIRROR_TURN = np.array([1.0, 1.0, -1.0, -1.0])  # of rotations, wxyz


def resample(clip: Clip, fps: float) -> Clip:
    """The clip at another rate; the same clip at the same rate.

    Between two frames local rotations go the shorter arc and local positions a straight line, so
    bones keep their lengths. Stance labels and slide are those of the nearer frame; a frame between
    a good and a masked one is masked. Ends with the last whole frame of the new rate.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps is {fps}; wanted a number above 0")
    if fps == clip.fps:
        return clip
    count = int(np.floor(clip.seconds * fps + 1e-9)) + 1
    at = np.minimum(np.arange(count) * (clip.fps / fps), clip.frame_count - 1)
    at = np.where(np.abs(at - np.round(at)) < 1e-9, np.round(at), at)
    before = np.minimum(at.astype(int), max(clip.frame_count - 2, 0))
    after = np.minimum(before + 1, clip.frame_count - 1)
    share = (at - before)[:, None, None]
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    first = _rotation(rotations_ls[before])
    step = (first.inv() * _rotation(rotations_ls[after])).as_rotvec()
    step = step.reshape(count, len(clip.parents), 3) * share
    turned = first * Rotation.from_rotvec(step.reshape(-1, 3))
    rotations_ls = turned.as_quat(scalar_first=True).reshape(count, len(clip.parents), 4)
    positions_ls = positions_ls[before] + share * (positions_ls[after] - positions_ls[before])
    positions_ws, rotations_ws = place(clip.parents, positions_ls, rotations_ls)
    near = np.round(at).astype(int)
    whole = at == before
    return replace(
        clip, fps=float(fps), positions_ws=positions_ws, rotations_ws=rotations_ws,
        stance=None if clip.stance is None else clip.stance[near],
        mask=None if clip.mask is None else clip.mask[before] & (whole | clip.mask[after]),
        slide=None if clip.slide is None else clip.slide[near],
    )  # fmt: skip


def trim(clip: Clip, start: float = 0.0, end: float | None = None) -> Clip:
    """The frames from `start` to `end`, s, both included; None is the end of the clip."""
    last = clip.seconds if end is None else end
    if not 0 <= start <= last <= clip.seconds + 0.5 / clip.fps:
        raise ValueError(
            f"trim from {start} s to {last} s; wanted 0 <= start <= end <= {clip.seconds:.4f} s"
        )
    return clip.at(slice(round(start * clip.fps), round(last * clip.fps) + 1))


def drop_t_pose(clip: Clip) -> Clip:
    """The clip without a T-pose at its start, the ramp out of it, and repeats of its last frame."""
    first, last = motion_span(clip)
    return clip if (first, last) == (0, clip.frame_count - 1) else clip.at(slice(first, last + 1))


def motion_span(clip: Clip) -> tuple[int, int]:
    """First and last frame of the motion proper, as `drop_t_pose` keeps it.

    A T-pose is a first frame whose joints are mostly at rest, left by a jump of some joint, about
    the root, many times its usual step. Frames right after it that still move faster than the
    clip does are its ramp.
    """
    steps = np.linalg.norm(np.diff(clip.positions_ws, axis=0), axis=-1).max(axis=1, initial=0.0)
    if not steps.any():
        return 0, clip.frame_count - 1
    last = int(np.flatnonzero(steps > 1e-9)[-1]) + 1
    about_root = clip.positions_ws - clip.positions_ws[:, :1]
    steps = np.linalg.norm(np.diff(about_root, axis=0), axis=-1).max(axis=1)
    leap = int(np.flatnonzero(np.append(steps, 1.0) > 1e-9)[0])  # a T-pose may be held
    rotations_ls = local_from_world(clip.parents, clip.positions_ws[:1], clip.rotations_ws[:1])[1][
        0, 1:
    ]
    at_rest = 2 * np.arccos(np.clip(np.abs(rotations_ls[:, 0]), 0.0, 1.0)) < REST
    usual = np.median(steps)
    if leap >= len(steps) or at_rest.mean() < REST_SHARE or steps[leap] <= JUMP * usual:
        return 0, last
    ramp = leap + 1 + round(RAMP_SECONDS * clip.fps)
    fast = contacts.merge_runs(
        contacts.runs(steps[leap:ramp] > RAMP * usual), round(GAP * clip.fps)
    )
    return leap + fast[0][1] + 1, last


def pops(clip: Clip) -> Bool[np.ndarray, " frames"]:
    """True where the pelvis, a knee, an ankle or a toe jumps as a slipped marker makes it.

    That is a second difference above 2 cm at 120 Hz, the same acceleration at other rates.
    """
    rig = clip.rig
    joints = [rig.pelvis, *(joint for leg in rig.joints for joint in leg[1:])]
    jerk = np.linalg.norm(np.diff(clip.positions_ws[:, joints], n=2, axis=0), axis=-1)
    popped = np.zeros(clip.frame_count, bool)
    if clip.frame_count > 2:
        popped[1:-1] = (jerk > POP * (POP_RATE / clip.fps) ** 2).any(axis=1)
    return popped


def mask_pops(clip: Clip) -> Clip:
    """The clip with its marker pops masked, besides what was masked before."""
    good = ~pops(clip)
    return replace(clip, mask=good if clip.mask is None else clip.mask & good)


def mirror(clip: Clip) -> Clip:
    """The clip in a mirror: x negated, left and right swapped.

    Errors: ValueError where the two sides are not built alike.
    """
    other = partners(clip.joint_names)
    if any(
        (other[parent] if parent >= 0 else -1) != clip.parents[other[joint]]
        for joint, parent in enumerate(clip.parents)
    ) or any(other[other[joint]] != joint for joint in range(len(other))):
        raise ValueError(
            f"{clip.source}: no mirror, as left and right are not built alike among the joints "
            f"{list(clip.joint_names)}"
        )
    swap = list(other)
    rig = clip.measured
    legs = partners(rig.names) if rig else ()
    return replace(
        clip,
        offsets_ls=clip.offsets_ls[swap] * MIRROR,
        positions_ws=clip.positions_ws[:, swap] * MIRROR,
        rotations_ws=clip.rotations_ws[:, swap] * MIRROR_TURN,
        measured=_mirror_rig(rig, list(legs)) if rig else None,
        stance=None if clip.stance is None else clip.stance[:, list(legs)],
    )


def _mirror_rig(rig: Rig, legs: list[int]) -> Rig:
    """The rig whose legs are the mirrored other ones; names, joints and sides stay."""
    with jax.enable_x64(True):
        swapped = {
            name: np.asarray(getattr(rig, name))[legs]
            for name in ("knee_axis_ls", "ankle_from_foot", "thigh", "shin", "foot", "present")
        }
        # A turn about an axis becomes, in a mirror, the opposite turn about the mirrored axis.
        swapped["knee_axis_ls"] = swapped["knee_axis_ls"] * MIRROR_TURN[1:]
        swapped["ankle_from_foot"] = swapped["ankle_from_foot"] * MIRROR_TURN
        return replace(rig, **{name: jnp.asarray(value) for name, value in swapped.items()})


def _rotation(rotations: np.ndarray) -> Rotation:
    return Rotation.from_quat(rotations.reshape(-1, 4), scalar_first=True)
