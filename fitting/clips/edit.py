"""Edits of clips: pure functions that return a new clip."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from . import contacts, rigs
from .clip import Clip, local_from_world, world_from_local
from .rigs import rotation, with_sole, with_soles

MARKER_JUMP = 0.02  # m: a second difference at `MARKER_RATE` that no body produces
MARKER_RATE = 120.0  # Hz
REST_ANGLE = np.radians(1.0)  # a joint rotated less is at rest
REST_FRACTION = 0.5  # of the joints that turn, at rest in a T-pose
JUMP = 4.0  # times the median step: the step from a T-pose into the motion
RAMP_SECONDS = 0.1  # duration of a filter's ramp out of a T-pose
RAMP_SPEED = 2.0  # times the median step
RAMP_GAP = 0.02  # s: a ramp that overshoots slows down for as long


def resample(clip: Clip, fps: float) -> Clip:
    """The clip at another frame rate; the same object if the rate is the same.

    Between two frames local rotations are interpolated along the shorter arc and local positions
    linearly, so bones keep their lengths. Contact labels and other tracks are those of the nearer
    frame. A frame between an unmasked and a masked one is masked. The new clip ends with the last
    whole frame at the new rate.

    Raises:
        ValueError: `fps` is not a finite number above 0.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps is {fps}; wanted a number above 0")
    if fps == clip.fps:
        return clip
    count = int(np.floor(clip.seconds * fps + 1e-9)) + 1
    time = np.minimum(np.arange(count) * (clip.fps / fps), clip.frame_count - 1)  # in old frames
    time = np.where(np.abs(time - np.round(time)) < 1e-9, np.round(time), time)
    before = np.minimum(time.astype(int), max(clip.frame_count - 2, 0))
    after = np.minimum(before + 1, clip.frame_count - 1)
    fraction = (time - before)[:, None, None]
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    start = rotation(rotations_ls[before])
    step = (start.inv() * rotation(rotations_ls[after])).as_rotvec()
    step = step.reshape(count, len(clip.parents), 3) * fraction
    between = start * Rotation.from_rotvec(step.reshape(-1, 3))
    rotations_ls = between.as_quat(scalar_first=True).reshape(count, len(clip.parents), 4)
    positions_ls = positions_ls[before] + fraction * (positions_ls[after] - positions_ls[before])
    positions_ws, rotations_ws = world_from_local(clip.parents, positions_ls, rotations_ls)
    nearest = np.round(time).astype(int)
    on_frame = time == before
    return replace(
        clip, fps=float(fps), positions_ws=positions_ws, rotations_ws=rotations_ws,
        **{name: track[nearest] for name, track in clip.tracks.items() if name != "mask"},
        mask=None if clip.mask is None else clip.mask[before] & (on_frame | clip.mask[after]),
    )  # fmt: skip


def at_speed(clip: Clip, factor: float) -> Clip:
    """The clip over a root that travels `factor` times as far in the same time.

    The pose of each frame is the same, so that standing feet skate; strides that are scaled by the
    same factor bring them to rest (`frames_from_clip`). Contact labels stay those of the clip.

    Raises:
        ValueError: `factor` is not a finite number above 0, or the clip has no legs.
    """
    if not (np.isfinite(factor) and factor > 0):
        raise ValueError(f"the speed is {factor} times the clip's; wanted a finite number above 0")
    root = clip.positions_ws[:, clip.rig.pelvis]
    further = (factor - 1.0) * (root - root[0]) * [1.0, 0.0, 1.0]
    faster = clip.with_motion(clip.positions_ws + further[:, None], clip.rotations_ws)
    return replace(faster, stance=clip.stance_labels())


def in_direction(clip: Clip, angle: float) -> Clip:
    """The clip over a root that travels in another direction, but faces where it did.

    The pose of each frame is the same, so that standing feet skate; feet that are turned by the
    same angle bring them to rest (`frames_from_clip`). Contact labels stay those of the clip.

    Args:
        clip: with legs.
        angle: rad, by which the way of the root turns to the left, up to a right angle.

    Raises:
        ValueError: `angle` is beyond a right angle, or the clip has no legs.
    """
    if not abs(angle) <= 0.5 * np.pi + 1e-9:
        raise ValueError(
            f"the direction is {np.degrees(angle):g} degrees to the clip's; wanted -90 to 90: "
            "beyond, play an animation that goes the other way"
        )
    root = clip.positions_ws[:, clip.rig.pelvis]
    way = (root - root[0]) * [1.0, 0.0, 1.0]
    aside = Rotation.from_rotvec([0.0, angle, 0.0]).apply(way) - way
    turned = clip.with_motion(clip.positions_ws + aside[:, None], clip.rotations_ws)
    return replace(turned, stance=clip.stance_labels())


def trim(clip: Clip, start: float = 0.0, end: float | None = None) -> Clip:
    """The frames from `start` to `end`, s, both included.

    Args:
        clip: any clip.
        start: s.
        end: s; None is the end of the clip.

    Raises:
        ValueError: the times are not in order or not within the clip.
    """
    last = clip.seconds if end is None else end
    if not 0 <= start <= last <= clip.seconds + 0.5 / clip.fps:
        raise ValueError(
            f"trim from {start} s to {last} s; wanted 0 <= start <= end <= {clip.seconds:.4f} s"
        )
    first = round(start * clip.fps)
    part = clip.select(slice(first, round(last * clip.fps) + 1))
    return replace(part, start=clip.start + first / clip.fps)


def observed_span(clip: Clip) -> tuple[int, int]:
    """First and last frame that is not masked; those of the clip if all are."""
    observed = np.flatnonzero(clip.observed)
    return (int(observed[0]), int(observed[-1])) if len(observed) else (0, clip.frame_count - 1)


def motion_span(clip: Clip) -> tuple[int, int]:
    """First and last frame without a leading T-pose and the ramp out of it, and repeated ones.

    Masked frames at both ends are left out as well. A clip starts with a T-pose if most of the
    joints that turn are at rest in its first frame and some joint then jumps, relative to the root,
    by several times its usual step. The frames after the jump are a ramp as long as they move
    faster than the clip usually does.
    """
    start, end = observed_span(clip)
    clip = clip.select(slice(start, end + 1))
    steps = np.linalg.norm(np.diff(clip.positions_ws, axis=0), axis=-1).max(axis=1, initial=0.0)
    if not steps.any():
        return start, end
    end = start + int(np.flatnonzero(steps > 1e-9)[-1]) + 1
    about_root = clip.positions_ws - clip.positions_ws[:, :1]
    steps = np.linalg.norm(np.diff(about_root, axis=0), axis=-1).max(axis=1)
    jump = int(np.flatnonzero(np.append(steps, 1.0) > 1e-9)[0])  # a T-pose may be held
    usual = np.median(steps)
    if jump >= len(steps) or steps[jump] <= JUMP * usual or not _starts_at_rest(clip):
        return start, end
    ramp_end = jump + 1 + round(RAMP_SECONDS * clip.fps)
    fast = contacts.runs(steps[jump:ramp_end] > RAMP_SPEED * usual)
    ramp = contacts.merge_runs(fast, round(RAMP_GAP * clip.fps))[0]
    return start + jump + ramp[1] + 1, end


def _starts_at_rest(clip: Clip) -> bool:
    """Whether most of the joints that ever turn are at rest in the first frame."""
    _, rotations_ls = local_from_world(clip.parents, clip.positions_ws, clip.rotations_ws)
    angles = 2 * np.arccos(np.clip(np.abs(rotations_ls[:, 1:, 0]), 0.0, 1.0))
    turning = np.ptp(angles, axis=0) >= REST_ANGLE
    return bool(turning.any() and (angles[0, turning] < REST_ANGLE).mean() >= REST_FRACTION)


def on_floor(clip: Clip, floor: float, sole: float | None = None) -> Clip:
    """The clip with its rig's heights over the sole measured over a floor, or set.

    Args:
        clip: any clip with legs.
        floor: height of the floor, m.
        sole: m, of the balls of flat feet over their soles; None measures it.

    Raises:
        ValueError: `sole` is not a finite number of 0 or more, or the clip has no legs.
    """
    if floor == 0.0 and sole is None:  # over which they were measured
        return clip
    if sole is not None and not (np.isfinite(sole) and sole >= 0):
        raise ValueError(f"sole is {sole}; wanted a number of metres from 0 on")
    rig = clip.rig if clip.measured_rig is None else clip.measured_rig  # `clip.rig` explains
    seen = clip.observed
    motion = clip.positions_ws[seen], clip.rotations_ws[seen], clip.stance_labels()[seen]
    rig = with_soles(rig, *motion, floor) if sole is None else with_sole(rig, sole)
    others = tuple(text for text in clip.remarks if rigs.TOPIC not in text)
    remarks = (*others, *rigs.remarks(rig, *motion, floor))
    return replace(clip, measured_rig=rig, remarks=remarks)


def marker_jumps(clip: Clip) -> Bool[np.ndarray, " frames"]:
    """True where the pelvis, a knee, an ankle or a toe jumps as if a marker had slipped."""
    rig = clip.rig
    joints = [rig.pelvis, *(joint for leg in rig.joints for joint in leg[1:])]
    return jumps(clip.positions_ws[:, joints], clip.fps)


def jumps(
    positions_ws: Float64[np.ndarray, "frames joints 3"], fps: float
) -> Bool[np.ndarray, " frames"]:
    """True where a joint jumps as no body does.

    The criterion is a second difference above 2 cm at 120 Hz, the same acceleration at other rates.

    Args:
        positions_ws: m.
        fps: Hz.
    """
    second_difference = np.diff(positions_ws, n=2, axis=0)
    jumped = np.zeros(len(positions_ws), bool)
    if len(positions_ws) > 2:
        limit = MARKER_JUMP * (MARKER_RATE / fps) ** 2
        jumped[1:-1] = (np.linalg.norm(second_difference, axis=-1) > limit).any(axis=1)
    return jumped


def mask_marker_jumps(clip: Clip) -> Clip:
    """The clip with frames in which a marker jumps masked, in addition to those masked already."""
    good = ~marker_jumps(clip)
    return replace(clip, mask=clip.observed & good)
