"""Builds a `Clip` from the contents of a file: finds legs, scale, up axis and frame rate.

There are two ways in: `clip_from_recording` for motion files, whose units and axes must be guessed,
and `clip_from_joints` for joint transforms that are in metres with y up already.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from fitting.runtime.validation import error_context
from jaxik.world.skeleton import Rig

from . import guesses, rigs, skating
from .clip import (
    FASTEST,
    FURTHEST,
    LONGEST,
    SHORTEST,
    SLOWEST,
    Y_UP_FROM_Z_UP,
    Clip,
    Recording,
    continuous,
    local_from_world,
    world_from_local,
)
from .guesses import with_balls
from .joint_maps import ADVICE, Leg, Roles, find_roles
from .rigs import left_directions, measure_rig, relative_size
from .skating import Skating

NO_LEGS = "no legs are recognised"
UP_ADVICE = "give --up (up=... in Python) if you know better"
UPRIGHT = 0.5, 0.8  # of the way from feet to pelvis: how far it goes up at least, and surely
HUGE = 1e12  # units of a file, whatever they are
RATES = (24, 25, 30, 48, 50, 60, 72, 75, 90, 100, 120, 144, 150, 180, 200, 240, 250, 300, 360, 480)
RATE_TOLERANCE = 0.005  # relative: 23.976 becomes 24; `Clip.raw_frame_time` stays


def clip_from_recording(
    recording: Recording,
    source: str,
    *,
    scale: float | None = None,
    fps: float | None = None,
    up: str | None = None,
    joints: Mapping[str, str] | None = None,
    travel: str | None = None,
) -> Clip:
    """The recording in metres with y up, with its legs recognised and measured.

    Every guess is noted in the clip's `remarks`. Without recognised legs the clip has no rig.

    Args:
        recording: the contents of a motion file.
        source: the file's name, for messages.
        scale: metres per unit of the file; None takes the file's, or guesses it.
        fps: frames per second; None takes the common rate nearest to the file's.
        up: "y" or "z"; None takes the file's, or guesses it.
        joints: role to joint name, see `joint_maps.find_roles`; None recognises the names.
        travel: whether the root travels as standing feet show: one of `TRAVELS`; None is "auto".

    Raises:
        ValueError: `joints` names joints that do not exist, or a joint, a leg or the
            frame rate is beyond what a body can be.
    """
    _check_places(recording, source, HUGE, "units of the file")
    remarks = list(recording.remarks)
    roles: Roles | None = None
    try:
        roles = find_roles(recording.names, recording.parents, joints)
    except ValueError as error:
        if joints is not None:
            raise ValueError(f"{source}: {error}") from None
        remarks.append(f"{_first_clause(error)}; {ADVICE}")
    if scale is None:
        scale = _find_scale(recording, roles, remarks)
    recording = recording.scaled(scale)
    _check_places(recording, source, FURTHEST, f"m, at {scale:g} m per unit (scale=...)")
    if roles is not None:
        roles = _with_bones(recording, source, roles, scale, remarks)
    up = up or recording.up_axis or _guess_up(recording, roles, remarks)
    if up == "z":
        recording = recording.rotated(Y_UP_FROM_Z_UP)
    rate = fps or common_rate(recording.frame_time, remarks)
    if not SLOWEST <= rate <= FASTEST:
        raise ValueError(
            f"{source}: {rate:.4g} frames per second; wanted {SLOWEST:g} to {FASTEST:g}; "
            "give fps=... if you know better"
        )
    if roles is not None:
        recording, roles, guessed = with_balls(recording, roles, rate)
        remarks += guessed
    positions_ws, rotations_ws = world_from_local(
        recording.parents, recording.positions_ls, recording.rotations_ls
    )
    rig = None
    if roles is not None:
        feet = _skating(roles, positions_ws, rotations_ws, rate)
        with error_context(source):
            if feet.moves_root(travel):
                positions_ws = positions_ws + feet.travel_ws[:, None]
        remarks += feet.remarks(travel)
        seen = slice(None) if recording.mask is None else recording.mask  # the rest is a guess
        stance = feet.stance[seen]
        if not stance.any():
            remarks.append(
                "no foot ever stands, neither still nor at one velocity with others; the axes of "
                "the feet are guesses"
            )
        for leg, stands in zip(roles.legs, stance.T, strict=True):
            if stance.any() and not stands.any():
                remarks.append(f"the {leg.name} foot never stands; its axes are a guess")
        rig, guessed = _measure(roles, positions_ws[seen], rotations_ws[seen], stance)
        remarks += guessed
    return Clip(
        recording.names, recording.parents, recording.offsets_ls, positions_ws, rotations_ws,
        float(rate), recording.frame_time, source, float(scale), up,
        roles.dialect if roles else None, rig, mask=recording.mask, remarks=tuple(remarks),
        rest_rotations_ls=recording.rest_rotations_ls, channels=recording.channels,
        model=recording.model,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Joints in world space, metres, y up, with contact labels."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """-1 at the root; parents before children."""
    positions_ws: Float64[np.ndarray, "frames joints 3"]
    """Metres."""
    rotations_ws: Float64[np.ndarray, "frames joints 4"]
    """Unit quaternions, wxyz."""
    stance: Bool[np.ndarray, "frames legs"]
    """When each foot stands."""
    fps: float


def clip_from_joints(
    motion: JointMotion, source: str, joints: Mapping[str, str] | None = None
) -> Clip:
    """A clip from joint transforms that need no conversion.

    Args:
        motion: joints and contact labels.
        source: name of the clip.
        joints: role to joint name, see `joint_maps.find_roles`; None recognises the names.
    """
    rotations_ws = continuous(motion.rotations_ws)
    positions_ls, _ = local_from_world(motion.parents, motion.positions_ws, rotations_ws)
    roles = find_roles(motion.names, motion.parents, joints)
    rig, remarks = _measure(roles, motion.positions_ws, rotations_ws, motion.stance)
    return Clip(
        motion.names, motion.parents, np.median(positions_ls, axis=0), motion.positions_ws,
        rotations_ws, motion.fps, 1.0 / motion.fps, source, 1.0, "y", roles.dialect, rig,
        stance=motion.stance, remarks=remarks,
    )  # fmt: skip


def _measure(
    roles: Roles, positions_ws: np.ndarray, rotations_ws: np.ndarray, stance: np.ndarray
) -> tuple[Rig, tuple[str, ...]]:
    """The rig, and remarks on what is a guess about it."""
    rig = measure_rig(roles, positions_ws, rotations_ws, stance)
    guessed = rigs.knee_remarks(roles, positions_ws, rotations_ws)
    return rig, guessed + rigs.remarks(rig, positions_ws, rotations_ws, stance)


def _skating(
    roles: Roles, positions_ws: np.ndarray, rotations_ws: np.ndarray, fps: float
) -> Skating:
    joints = np.array([leg.joints for leg in roles.legs])
    side = np.array([leg.side for leg in roles.legs])
    left_ws = left_directions(positions_ws[:, joints[:, 0]], side, rotations_ws[:, roles.pelvis])
    return skating.measure(
        positions_ws[:, joints[:, 3]], positions_ws[:, roles.pelvis], left_ws, fps,
        relative_size(positions_ws, [leg.joints for leg in roles.legs]),
    )  # fmt: skip


def _check_places(recording: Recording, source: str, furthest: float, unit: str) -> None:
    """ValueError where a joint is further from its parent, or the root from the origin."""
    far = ~(np.abs(recording.positions_ls) <= furthest).all(axis=-1)
    if far.any():
        frame, joint = np.argwhere(far)[0]
        place = ", ".join(f"{value:.4g}" for value in recording.positions_ls[frame, joint])
        raise ValueError(
            f"{source}: {recording.names[joint]} is at ({place}) in frame {frame}; "
            f"wanted at most {furthest:g} {unit}"
        )


def _with_bones(
    recording: Recording, source: str, roles: Roles, scale: float, remarks: list[str]
) -> Roles | None:
    """The roles, unless a leg has no thigh or no shin: then none, and a remark.

    Raises:
        ValueError: a bone of a leg is longer than a body's can be.
    """
    for leg in roles.legs:
        lengths = _bone_lengths(recording, leg)
        for bone, length in zip(("thigh", "shin"), lengths, strict=True):
            if length > LONGEST:
                raise ValueError(
                    f"{source}: the {leg.name} {bone} is {length:.4g} m long; wanted at most "
                    f"{LONGEST:g}; {guesses.remedy(sum(lengths) / scale, scale)}"
                )
            if length < SHORTEST:
                remarks.append(
                    f"the {leg.name} {bone} has no length, so there are no legs; "
                    f"name other joints: {ADVICE}"
                )
                return None
    return roles


def _bone_lengths(recording: Recording, leg: Leg) -> tuple[float, float]:
    """Thigh and shin in file units; joints between their ends, such as twists, lie along them."""
    lengths = np.median(np.linalg.norm(recording.positions_ls, axis=-1), axis=0)

    def length(upper: int, lower: int) -> float:
        chain, above = [lower], recording.parents[lower]
        while above not in (upper, -1):
            chain.append(above)
            above = recording.parents[above]
        return float(lengths[chain if above == upper else [lower]].sum())

    hip, knee, ankle, _ = leg.joints
    return length(hip, knee), length(knee, ankle)


def _first_clause(error: ValueError) -> str:
    """What is wrong with the names, without the list of what would be right."""
    text = str(error)
    return "no legs recognised" if text.startswith("no pair") else text.partition(f"; {ADVICE}")[0]


def common_rate(frame_time: float, remarks: list[str]) -> float:
    """The common frame rate nearest to a frame time, or the exact rate if none is near."""
    rate = 1.0 / frame_time
    common = min(RATES, key=lambda candidate: abs(candidate - rate))
    if abs(common - rate) > RATE_TOLERANCE * common:
        remarks.append(f"the rate {rate:.6g} Hz is unusual, and stays as it is")
        return rate
    if abs(common - rate) > 0.0005 * common:
        remarks.append(f"the frame time {frame_time:g} s is {rate:.6g} Hz; taken as {common} Hz")
    return float(common)


def _leg_length(recording: Recording, roles: Roles | None) -> float:
    """Thigh plus shin in file units; without legs, the longest chain from the root to a leaf."""
    if roles is not None:
        return float(np.mean([sum(_bone_lengths(recording, leg)) for leg in roles.legs]))
    lengths = np.median(np.linalg.norm(recording.positions_ls, axis=-1), axis=0)
    reach = np.zeros(len(lengths))
    for joint, parent in enumerate(recording.parents):
        reach[joint] = 0.0 if parent < 0 else reach[parent] + lengths[joint]
    return float(reach.max())


def _find_scale(recording: Recording, roles: Roles | None, remarks: list[str]) -> float:
    """Metres per unit that the file states, or else those of the most likely unit."""
    leg = _leg_length(recording, roles)
    if (stated := recording.metres_per_unit) is not None:
        if roles is not None and leg > 0.0 and (text := guesses.doubt(leg, stated)):
            remarks.append(text)
        return stated
    if leg == 0.0:
        remarks.append("scale not recognised, as no bone has a length; taken as metres")
        return 1.0
    guessed, text = guesses.guess(leg)
    if roles is None:
        text = f"scale guessed: {guessed:.4g} m per unit; doubtful, as {NO_LEGS}; {guesses.ADVICE}"
    remarks.append(text)
    return guessed


def _guess_up(recording: Recording, roles: Roles | None, remarks: list[str]) -> str:
    """The axis, y or z, along which the pelvis is above the ankles.

    Without legs it is z if the skeleton is more than twice as long along z as along y.
    """
    positions, _ = world_from_local(
        recording.parents, recording.positions_ls, recording.rotations_ls
    )
    if roles is None:
        extent = np.median(np.ptp(positions, axis=1), axis=0)
        up = "z" if extent[2] > 2 * extent[1] else "y"
        remarks.append(f"up axis guessed: {up}; doubtful, as {NO_LEGS}; {UP_ADVICE}")
        return up
    ankles = positions[:, [leg.joints[2] for leg in roles.legs]].mean(axis=1)
    rise = np.median(positions[:, roles.pelvis] - ankles, axis=0)
    up, height = ("z", rise[2]) if rise[2] > rise[1] else ("y", rise[1])
    distance = float(np.linalg.norm(rise))
    if height < UPRIGHT[0] * distance:
        sureness = f"doubtful, as the pelvis is not above the feet along y or z; {UP_ADVICE}"
    elif height < UPRIGHT[1] * distance:
        sureness = f"not sure, as the pelvis is ahead of the feet rather than above; {UP_ADVICE}"
    else:
        sureness = f"sure, as the pelvis is {height:.2f} m above the feet along it"
    remarks.append(f"up axis guessed: {up}; {sureness}")
    return up
