"""Joints with their rotations, from markers that a joint map or Plug-in Gait names.

Positions are joint centres. Rotations are what positions and further markers show: the pelvis'
from three of its markers, or else from hips and thighs; thigh and shin as in `leg_geometry`; the
foot's from ankle, heel and toe, or else from the foot and the hinge of the knee.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation, Slerp

from fitting.datasets.clips.joint_roles import Leg, find_roles
from fitting.datasets.clips.joints.dialects import LEG_NAMES, LEG_ROLES
from fitting.datasets.clips.leg_geometry import Vectors, leg_rotations, reject, unit

from . import plug_in_gait
from .markers import UNITS, Markers

AND = " + "  # between the markers of which a joint is the mean
ORDER = ("pelvis", *LEG_ROLES)
# How names begin after the letter of the side: first those of joint centres, which need no others.
GUESSES = {
    "hip": (("hjc",), ("fep",), ("hip", "tro")),
    "knee": (("kjc",), ("feo",), ("kne",)),
    "ankle": (("ajc",), ("tio",), ("ank", "mal")),
    "toe": (("toe", "mt2", "met"),),
}
PELVIS_MARKERS = ("lasi", "rasi", "lpsi", "rpsi", "sacr")
Places = Mapping[str, Vectors]
Rotations = Float64[np.ndarray, "known 4"]


class Skeleton(NamedTuple):
    """Joints over frames, in the file's unit and axes."""

    names: tuple[str, ...]
    """As `joint_name` has them, the pelvis first."""
    parents: tuple[int, ...]
    positions_ws: Float64[np.ndarray, "frames joints 3"]
    rotations_ws: Float64[np.ndarray, "frames joints 4"]
    """wxyz."""


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Joints in the frames in which they are known."""

    skeleton: Skeleton
    """In those frames alone."""
    known: Bool[np.ndarray, " frames"]
    """Where all markers were seen that are needed."""
    used: tuple[int, ...]
    """The markers that are needed."""
    guessed_unit: float | None = None
    """Metres; None where it was not needed."""
    remarks: tuple[str, ...] = ()

    def in_all_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and rotations in all frames: interpolated between, held before and after."""
        _, _, positions, rotations = self.skeleton
        known, frames = np.flatnonzero(self.known), np.arange(len(self.known))
        bridged = [bridge(frames, known, place) for place in positions.swapaxes(0, 1)]
        if len(known) == 1:
            return np.stack(bridged, axis=1), np.tile(rotations, (len(frames), 1, 1))
        within = np.clip(frames, known[0], known[-1])
        turns = [
            Slerp(known, Rotation.from_quat(turn, scalar_first=True))(within)
            for turn in rotations.swapaxes(0, 1)
        ]
        quaternions = [turn.as_quat(scalar_first=True) for turn in turns]
        return np.stack(bridged, axis=1), np.stack(quaternions, axis=1)


def joint_name(role: str) -> str:
    """The name of a joint by its role in a joint map: `left_hip` of `hip_left`."""
    kind, _, leg = role.partition("_")
    return f"{leg}_{kind}" if leg else kind


def bridge(
    frames: Int64[np.ndarray, " frames"],
    known: Int64[np.ndarray, " known"],
    places: Float64[np.ndarray, "known 3"],
) -> Float64[np.ndarray, "frames 3"]:
    """Places in all frames, on straight lines between the known ones; held before and after.

    Args:
        frames: their numbers.
        known: those of the places.
        places: in any unit.
    """
    return np.stack([np.interp(frames, known, column) for column in places.T], axis=-1)


def from_plug_in_gait(
    markers: Markers, subject: plug_in_gait.Subject, scale: float | None
) -> JointMotion:
    """The joints of a subject that wears the markers of Plug-in Gait.

    Args:
        markers: in the file's unit.
        subject: which markers are its own.
        scale: metres per unit; None takes the file's, or guesses it from the pelvis.
    """
    used = tuple(markers.names.index(subject.names[name]) for name in subject.used)
    known = _known(markers, used)
    remarks: list[str] = []
    raw = dict(zip(subject.used, markers.positions[known][:, used].swapaxes(0, 1), strict=True))
    guess = None
    if scale is None and (scale := markers.metres_per_unit) is None:
        width = float(np.median(np.linalg.norm(raw["LASI"] - raw["RASI"], axis=-1)))
        scale = guess = _guess_unit(width, remarks)
    with np.errstate(all="ignore"):  # the loader says which joint is too far away
        places = {name: place * scale for name, place in raw.items()}
        joints, more = plug_in_gait.joint_centres(subject, places, markers.measures)
        for side, letter in plug_in_gait.SIDES.items():
            joints[f"toe_{side}"] = places[f"{letter}TOE"]
        joints = {role: joint / scale for role, joint in joints.items()}
    heels = {
        side: raw[heel]
        for side, heel in zip(plug_in_gait.SIDES, plug_in_gait.HEELS, strict=True)
        if heel in raw
    }
    if unseen := [heel for heel in plug_in_gait.HEELS if heel not in raw]:
        remarks.append(
            f"without {' and '.join(unseen)}, how a foot rolls is a guess: as its knee's hinge does"
        )
    pelvis = [raw["LASI"], raw["RASI"], np.mean([raw[name] for name in subject.back], axis=0)]
    return JointMotion(_skeleton(joints, pelvis, heels), known, used, guess, (*remarks, *more))


def _guess_unit(width: float, remarks: list[str]) -> float:
    usual = plug_in_gait.PELVIS_WIDTH
    if not 0 < width < np.inf:
        raise ValueError("LASI and RASI are at the same place; wanted both sides of a pelvis")
    unit_name = min(UNITS, key=lambda name: abs(np.log(width * UNITS[name] / usual)))
    remarks.append(
        f"no unit is stated (POINT:UNITS): {width:.4g} between LASI and RASI are taken as "
        f"{unit_name}"
    )
    return UNITS[unit_name]


def from_map(markers: Markers, joints: Mapping[str, str]) -> JointMotion:
    """The joints that a joint map names by their markers.

    Args:
        markers: in the file's unit.
        joints: role to a marker, or to several with " + " between.

    Raises:
        ValueError: a role without a marker, or names that the file lacks.
    """
    members = {role: _members(markers, role, text) for role, text in joints.items()}
    toes = [f"toe_{role.removeprefix('hip_')}" for role in joints if role.startswith("hip_")]
    if missing := [toe for toe in toes if not joints.get(toe)]:
        raise ValueError(f"the joint map has no {missing[0]}; for markers it names all joints")
    used = tuple(dict.fromkeys(index for indices in members.values() for index in indices))
    known = _known(markers, used)
    positions = markers.positions[known]
    places = {role: positions[:, members[role]].mean(axis=1) for role in joints}
    pelvis = [positions[:, index] for index in members["pelvis"]]
    if len(pelvis) > 3:
        pelvis = [*pelvis[:2], np.mean(pelvis[2:], axis=0)]
    return JointMotion(_skeleton(places, pelvis if len(pelvis) == 3 else [], {}), known, used)


def _members(markers: Markers, role: str, text: str) -> list[int]:
    """The markers of a role: one of that name, or those between which "+" stands."""
    names = [text] if text in markers.names else [name.strip() for name in text.split(AND.strip())]
    if unknown := [name for name in names if name not in markers.names]:
        raise ValueError(
            f"{role} is {text!r}, and there is no marker {unknown[0]!r}; there are "
            f"{list(markers.names)}"
        )
    return [markers.names.index(name) for name in names]


def _known(markers: Markers, used: tuple[int, ...]) -> Bool[np.ndarray, " frames"]:
    """Where all of these markers were seen; ValueError if that is nowhere."""
    seen = markers.seen[:, used]
    known = np.asarray(seen.all(axis=1))
    if not known.any():
        rarest = [markers.names[used[index]] for index in np.argsort(seen.sum(axis=0))[:3]]
        raise ValueError(
            f"no frame has all of the {len(used)} markers that are needed; least often seen are "
            f"{', '.join(rarest)}"
        )
    return known


def _skeleton(joints: Places, pelvis: Sequence[Vectors], heels: Places) -> Skeleton:
    """Joints with parents and rotations.

    Args:
        joints: by role.
        pelvis: three points that move with it, or none.
        heels: by the name of the leg, where there are any.
    """
    names = tuple(sorted(joints, key=lambda name: ORDER.index(name.partition("_")[0])))
    roles = find_roles(names, (-1,) * len(names), {name: name for name in names})
    parents = [-1] * len(names)
    for leg in roles.legs:
        for joint, parent in zip(leg.joints, (roles.pelvis, *leg.joints), strict=False):
            parents[joint] = parent
    hips, knees = ([joints[names[leg.joints[n]]] for leg in roles.legs] for n in (0, 1))
    left = unit(_mean_hip(hips, roles.legs, 1.0) - _mean_hip(hips, roles.legs, -1.0))
    up = np.mean(hips, axis=0) - np.mean(knees, axis=0)
    if pelvis:
        normal = np.cross(pelvis[1] - pelvis[0], pelvis[2] - pelvis[0])
        up = normal * np.where(np.median(np.sum(unit(normal) * unit(up), axis=-1)) < 0, -1.0, 1.0)
    try:
        rotations = {"pelvis": _axes(left, up)}
        for leg in roles.legs:
            of_leg = [joints[names[joint]] for joint in leg.joints]
            turned = _leg_rotations(of_leg, left, heels.get(leg.name))
            rotations |= {names[j]: turn for j, turn in zip(leg.joints, turned, strict=True)}
    except ValueError:  # SciPy's, of axes without length
        raise ValueError("in a frame, markers lie at one point or on one line; wanted joints "
                         "apart from each other") from None  # fmt: skip
    return Skeleton(
        tuple(map(joint_name, names)),
        tuple(parents),
        *(np.stack([of[n] for n in names], 1) for of in (joints, rotations)),
    )


def _mean_hip(hips: Sequence[Vectors], legs: Sequence[Leg], side: float) -> Vectors:
    """The middle of the hips of one side, 1 for left and -1 for right."""
    of_side = [hip for hip, leg in zip(hips, legs, strict=True) if leg.side == side]
    if not of_side:
        raise ValueError(
            f"the legs are {[leg.name for leg in legs]}; wanted left ones and right ones"
        )
    return np.mean(of_side, axis=0)


def _leg_rotations(
    leg: Sequence[Vectors], left: Vectors, heel: Vectors | None
) -> tuple[Rotations, ...]:
    """Rotations of hip, knee, ankle and toe from their places."""
    hip, knee, ankle, toe = leg
    thigh, shin = leg_rotations(hip, knee, ankle, left)
    if heel is None:
        hinge = Rotation.from_quat(shin, scalar_first=True).apply([1.0, 0.0, 0.0])
        foot = _axes(hinge, np.cross(toe - ankle, hinge))
    else:
        up = reject(ankle - heel, unit(toe - heel))
        foot = _axes(np.cross(up, toe - heel), up)
    return thigh, shin, foot, foot


def _axes(left: Vectors, up: Vectors) -> Rotations:
    """Rotations whose x axis is `left`, and whose y axis is `up` as far as that allows."""
    x = unit(left)
    y = unit(reject(up, x))
    axes = np.stack([x, y, np.cross(x, y)], axis=-1)
    return Rotation.from_matrix(axes).as_quat(scalar_first=True)


def _follows(text: str, side: str, words: tuple[str, ...]) -> bool:
    """Whether a name is that of a side, or its first letter, and then one of the words."""
    rests = [text.removeprefix(start) for start in (side, side[0]) if text.startswith(start)]
    return any(rest.lstrip("_ .-").startswith(words) for rest in rests)


def guess_map(names: tuple[str, ...]) -> dict[str, str]:
    """The best guess of a joint map by what names contain; "" for what is unknown."""
    plain_names = {name: name.rpartition(":")[2].lower() for name in names}
    pelvis = [name for name, text in plain_names.items() if text in PELVIS_MARKERS]
    roles = {"pelvis": AND.join(pelvis)}
    for side in LEG_NAMES.values():
        for role in LEG_ROLES:
            choices = (
                AND.join(name for name, text in plain_names.items() if _follows(text, side, words))
                for words in GUESSES[role]
            )
            roles[f"{role}_{side}"] = next(filter(None, choices), "")
    return roles
