"""`read_c3d`: a `Recording` of joints, or, where no joints are recognised, of the bare markers."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from fitting.datasets.clips.joint_roles import find_roles
from fitting.datasets.clips.joints import map_files
from fitting.datasets.clips.joints.dialects import LEG_ROLES
from fitting.datasets.clips.kinematics import local_from_world
from fitting.datasets.clips.recording import Recording
from fitting.runtime.validation import error_context

from . import plug_in_gait
from .marker_sets import JointMotion, bridge, from_map, from_plug_in_gait, guess_map
from .markers import AXES, Markers, listed, read_markers

UNEVEN = 0.1  # of a bone's length, by which it changes in a capture that is in order
UNRECOGNISED = (
    "no set of markers recognised: known is Plug-in Gait, lower body (LASI, RASI, LPSI and RPSI or "
    "SACR, and of each leg THI, KNE, TIB, ANK, TOE, at best HEE)"
)
UPRIGHT = 0.5  # of the way from the ankles to the pelvis, at least, goes up


def read_c3d(
    path: Path, joints: Mapping[str, str] | None = None, scale: float | None = None
) -> Recording:
    """The joints of a C3D file, in its own unit, from its markers.

    Frames in which a marker that is needed was not seen are masked: joints move there on straight
    lines between the frames before and after. Without a map, the joints are those of Plug-in Gait,
    or points that are named as joints are in other formats. Of any other file, the markers
    themselves are the joints, none of which is a leg's.

    Args:
        path: the file.
        joints: role, as in a joint map, to a marker, or to several with " + " between: their mean.
        scale: metres per unit; None takes the unit that the file states.

    Raises:
        ValueError: with the file's name, where it is no whole C3D file of markers, lacks those that
            are named, or no frame has them all.
    """
    with error_context(path):
        markers = _turned(read_markers(path))
        if joints is not None:
            checked = map_files.check_joint_map(dict(joints), "the joint map")
            return _recording(markers, from_map(markers, checked))
        if (subject := _subject(markers)) is not None:
            return _recording(markers, from_plug_in_gait(markers, subject, scale))
        if (known := _as_joints(markers.names)) is not None:
            return _recording(markers, from_map(markers, known))
        return _bare(markers)


def _subject(markers: Markers) -> plug_in_gait.Subject | None:
    """Who wears Plug-in Gait, at best without the markers that were never seen."""
    names = tuple(name for n, name in enumerate(markers.names) if markers.seen[:, n].any())
    return plug_in_gait.find_subject(names) or plug_in_gait.find_subject(markers.names)


def draft_marker_map(path: Path) -> str:
    """A joint map of a file's markers, to be edited: the best guess, and all names.

    Raises:
        ValueError: with the file's name, as of `read_c3d`.
    """
    with error_context(path):
        names = read_markers(path).names
        known = _as_joints(names)
    roles = guess_map(names) if known is None else known
    return map_files.marker_template(names, roles, path.name)


def _as_joints(names: tuple[str, ...]) -> dict[str, str] | None:
    """The map of points that are named as joints are in other formats; None for others."""
    try:
        roles = find_roles(names, (-1,) * len(names))
    except ValueError:
        return None
    if any(leg.ends_at_ankle for leg in roles.legs):  # a map of markers needs all joints
        return None
    joints = {"pelvis": names[roles.pelvis]}
    for leg in roles.legs:
        for role, joint in zip(LEG_ROLES, leg.joints, strict=True):
            joints[f"{role}_{leg.name}"] = names[joint]
    return joints


def _turned(markers: Markers) -> Markers:
    """The markers with y up, where the file has an axis up that a recording cannot state."""
    if markers.up in ("", "Y", "Z", "+Y", "+Z") or not markers.right:
        return markers
    right, up = AXES[markers.right], AXES[markers.up]
    if right @ up != 0.0:
        return markers
    turned = markers.positions @ np.stack([right, up, np.cross(right, up)]).T
    return replace(markers, positions=turned, right="+X", up="+Y")


def _up_axis(markers: Markers) -> str | None:
    return {"Y": "y", "Z": "z"}.get(markers.up.lstrip("+"))


def _recording(markers: Markers, motion: JointMotion) -> Recording:
    """Joints in all frames, from those in which they are known."""
    names, parents, known_ws, _ = motion.skeleton
    positions_ls, rotations_ls = local_from_world(parents, *motion.in_all_frames())
    offsets_ls = np.median(positions_ls[motion.known], axis=0)
    up = _up_axis(markers)
    remarks = (
        *markers.remarks,
        *motion.remarks,
        *_gaps(markers, motion.used, motion.known),
        *_uneven_bones(motion),
        *_lying(names, known_ws, up),
    )
    return Recording(
        names, parents, offsets_ls, positions_ls, rotations_ls, markers.frame_time,
        metres_per_unit=markers.metres_per_unit or motion.guessed_unit, up_axis=up,
        mask=None if motion.known.all() else motion.known, remarks=remarks,
    )  # fmt: skip


def _gaps(
    markers: Markers, used: tuple[int, ...], known: Bool[np.ndarray, " frames"]
) -> tuple[str, ...]:
    """A remark that says what is missing, of which markers."""
    lost = (~markers.seen[:, used]).sum(axis=0)
    order = [index for index in np.argsort(-lost, kind="stable") if lost[index]]
    if not order:
        return ()
    names = [f"{markers.names[used[index]]} in {lost[index]}" for index in order]
    return (
        f"{(~known).sum()} of {len(known)} frames are masked, as markers were not seen "
        f"({listed(names)}): no fit looks at them, and joints move there on straight lines",
    )


def _uneven_bones(motion: JointMotion) -> tuple[str, ...]:
    """A remark for each bone of a leg whose length changes as no bone's does.

    From one frame to the next it jumps where markers are swapped. Skin that moves over the bone,
    and markers beside the joint after which they are named, change it as fast as the leg moves.
    """
    names, parents, positions_ws, _ = motion.skeleton
    follows = np.diff(np.flatnonzero(motion.known)) == 1
    remarks = []
    for joint, parent in enumerate(parents):
        if parent < 0:
            continue
        bone = np.linalg.norm(positions_ws[:, joint] - positions_ws[:, parent], axis=-1)
        low, middle, high = np.quantile(bone, [0.05, 0.5, 0.95])
        place = f"from {names[parent]} to {names[joint]}"
        if jumps := int((np.abs(np.diff(bone))[follows] > UNEVEN * middle).sum()):
            remarks.append(
                f"{place} the distance jumps in {jumps} frames, by more than {UNEVEN:.0%}: markers "
                "have been swapped or have slipped"
            )
        elif high - low > UNEVEN * middle:
            remarks.append(
                f"{place} it is {low:.4g} to {high:.4g} units: markers move over the bone there, "
                "or are not those of these joints"
            )
    return tuple(remarks)


def _lying(
    names: tuple[str, ...], positions_ws: Float64[np.ndarray, "known joints 3"], up: str | None
) -> tuple[str, ...]:
    """A remark where the file's axis up does not lead from the feet to the pelvis."""
    ankles = [j for j, name in enumerate(names) if name.endswith("_ankle")]
    rise = np.median(positions_ws[:, 0] - positions_ws[:, ankles].mean(axis=1), axis=0)
    if up is None or rise["xyz".index(up)] >= UPRIGHT * np.linalg.norm(rise):
        return ()
    return (
        f"{up} is up in the file (POINT:Y_SCREEN), but the pelvis is not above the feet along it; "
        "give --up (up=... in Python) if you know better",
    )


def _bare(markers: Markers) -> Recording:
    """The markers as joints without parents; those that were never seen are left out."""
    seen = [index for index in range(len(markers.names)) if markers.seen[:, index].any()]
    if not seen:
        raise ValueError(f"none of its {len(markers.names)} markers was ever seen")
    frames = np.arange(len(markers.positions))
    mask = np.asarray(markers.seen.any(axis=1))
    remarks = [*markers.remarks, UNRECOGNISED]
    if lost := int((~mask).sum()):
        remarks.append(f"{lost} of {len(mask)} frames are masked, as no marker was seen")
    known = [np.flatnonzero(markers.seen[:, index]) for index in seen]
    places = [markers.positions[at, index] for at, index in zip(known, seen, strict=True)]
    bridged = [bridge(frames, *pair) for pair in zip(known, places, strict=True)]
    positions = np.stack(bridged, axis=1)
    rotations = np.zeros((*positions.shape[:2], 4))
    rotations[..., 0] = 1.0
    return Recording(
        tuple(markers.names[index] for index in seen), (-1,) * len(seen),
        np.median(positions, axis=0), positions, rotations, markers.frame_time,
        metres_per_unit=markers.metres_per_unit, up_axis=_up_axis(markers),
        mask=mask if lost else None, remarks=tuple(remarks),
    )  # fmt: skip
