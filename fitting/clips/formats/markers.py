"""Joints with their rotations, from markers that a joint map or Plug-in Gait names.

Positions are joint centres, as in Vicon's Plug-in Gait (lower body) but for the hips: those lie
where the regression of Harrington et al. (2007, J. Biomech. 40:595, their equations with one
predictor each) puts them between the pelvis' markers. Plug-in Gait itself uses that of Davis et al.
(1991, Hum. Mov. Sci. 10:575), which needs the length of the leg and is further off: 25 mm against
12 mm, of 67 pelves in a CT scanner (Mantovani et al. 2016, Gait & Posture 44:48). Both take the
centres of the markers for the bone below them. Knees and ankles lie where Davis' chord function
puts them: in the plane of the joint above, the marker on the joint and the marker on the wand or
segment, half a joint's width and the radius of a marker inwards, with a right angle at the joint.

Rotations are what positions and further markers show: the pelvis' from three of its markers, or
else from hips and thighs; thigh and shin as in `clips.rigs`; the foot's from ankle, heel and toe,
or else from the foot and the hinge of the knee.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation, Slerp

from fitting.clips import joint_maps
from fitting.clips.clip import Recording, local_from_world
from fitting.clips.joint_maps import LEG_NAMES, LEG_ROLES, Leg, find_roles
from fitting.clips.rigs import Vectors, leg_rotations, reject, rotation, unit
from fitting.runtime.validation import error_context

from . import points_file
from .c3d_file import AXES, UNITS, Markers, listed, read_markers

READERS = {".c3d": read_markers} | points_file.READERS
"""Of places without rotations, by the suffix; archives are recognised by their arrays."""
MM = 1e-3  # m
MARKER_RADIUS = 7.0 * MM  # m, of the usual marker of 14 mm
KNEE_WIDTH, ANKLE_WIDTH = 0.11, 0.08  # of a leg's length; where none was measured
PELVIS_WIDTH = 0.25  # m, between an adult's anterior spines: to guess a unit by
SIDES = {"left": "L", "right": "R"}
HEELS = tuple(f"{letter}HEE" for letter in SIDES.values())
PELVIS = ("LASI", "RASI")
BACKS = (("LPSI", "RPSI"), ("SACR",))
# What labs store beside markers, or Plug-in Gait computes: the first that a file has is used.
MODELLED = {"hip": ("HJC", "FEP"), "knee": ("KJC", "FEO"), "ankle": ("AJC", "TIO")}
MARKED = {"hip": (), "knee": ("KNE", "THI"), "ankle": ("ANK", "TIB")}

Places = Mapping[str, Vectors]

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
Rotations = Float64[np.ndarray, "known 4"]

UNEVEN = 0.1  # of a bone's length, by which it changes in a capture that is in order
UNRECOGNISED = (
    "no set of markers recognised: known is Plug-in Gait, lower body (LASI, RASI, LPSI and RPSI or "
    "SACR, and of each leg THI, KNE, TIB, ANK, TOE, at best HEE)"
)
FROM_PLACES = (
    "rotations follow from the places of joints: how feet roll is a guess, as the hinges of their "
    "knees do"
)
UPRIGHT = 0.5  # of the way from the ankles to the pelvis, at least, goes up


@dataclass(frozen=True)
class Subject:
    """Which of a file's markers belong to the set."""

    names: Mapping[str, str]
    """Names in the file, by those of Plug-in Gait: `LASI` may be `Ann:LASI`."""
    back: tuple[str, ...]
    """Both posterior spines, or the sacrum."""
    modelled: Mapping[str, str]
    """For joints of which the file holds the centres, the ending of their names, as `FEP`."""
    heels: tuple[str, ...]
    """The heels' names in Plug-in Gait, of both legs, of one or of none."""

    @property
    def used(self) -> tuple[str, ...]:
        """Names of Plug-in Gait whose places are needed."""
        joints = [
            (self.modelled[joint],) if joint in self.modelled else MARKED[joint] for joint in MARKED
        ]
        endings = [*(ending for joint in joints for ending in joint), "TOE"]
        of_legs = [letter + ending for letter in SIDES.values() for ending in endings]
        return (*PELVIS, *self.back, *of_legs, *self.heels)


def find_subject(names: tuple[str, ...]) -> Subject | None:
    """The markers of the set, with any prefix that ends in a colon; None if some are not there.

    Raises:
        ValueError: several subjects wear the set.
    """
    subjects: dict[str, dict[str, str]] = {}
    for name in names:
        prefix, _, label = name.rpartition(":")
        subjects.setdefault(prefix, {})[label.strip().upper()] = name
    wearers = {prefix: subject for prefix, own in subjects.items() if (subject := _subject(own))}
    if len(wearers) > 1:
        raise ValueError(
            f"{len(wearers)} subjects wear Plug-in Gait markers, {list(wearers)}; name those of one"
        )
    return next(iter(wearers.values()), None)


def _subject(names: Mapping[str, str]) -> Subject | None:
    back = next((back for back in BACKS if set(back) <= set(names)), None)
    if back is None:
        return None
    modelled = {
        joint: ending
        for joint, endings in reversed(MODELLED.items())
        for ending in reversed(endings)
        if {letter + ending for letter in SIDES.values()} <= set(names)
    }
    if not {"knee", "ankle"} <= set(modelled):  # the widths of both follow from markers on both
        modelled = {joint: ending for joint, ending in modelled.items() if joint == "hip"}
    subject = Subject(names, back, modelled, tuple(heel for heel in HEELS if heel in names))
    return subject if set(subject.used) <= set(names) else None


@dataclass(frozen=True)
class Widths:
    """Widths of the joints of a leg, m."""

    knee: float
    ankle: float
    measured: bool
    """Whether the file states both."""


def leg_widths(letter: str, places: Places, measures: Mapping[str, float]) -> Widths:
    """What was measured of a leg, or what follows from its length.

    Args:
        letter: L or R.
        places: markers by their names in Plug-in Gait, m.
        measures: of the subject, mm, by names in capitals.
    """
    hip, knee, ankle = (places[letter + ending] for ending in ("ASI", "KNE", "ANK"))
    upper, lower = (np.median(np.linalg.norm(v, axis=-1)) for v in (knee - hip, ankle - knee))
    usual = {"KNEE": KNEE_WIDTH * (upper + lower), "ANKLE": ANKLE_WIDTH * (upper + lower)}
    widths = {name: measures.get(f"{letter}{name}WIDTH", 0.0) * MM for name in usual}
    return Widths(
        *(float(widths[name] or usual[name]) for name in usual), measured=all(widths.values())
    )


def hip_centres(
    left_asis: Vectors, right_asis: Vectors, back: Vectors, width: float | None = None
) -> tuple[Vectors, Vectors]:
    """Centres of the left and the right hip, m (Harrington et al. 2007).

    In the pelvis' axes, from the middle between the anterior spines, in mm: 0.24 PD + 9.9 back,
    0.30 PW + 10.9 down, and 0.33 PW + 7.3 to the side, for a pelvis PW wide and PD deep.

    Args:
        left_asis: marker on the left anterior spine, m.
        right_asis: marker on the right anterior spine, m.
        back: middle between the posterior spines, or the sacrum, m.
        width: m between the anterior spines; None measures it, as the depth, over all frames.
    """
    middle = (left_asis + right_asis) / 2
    left = unit(left_asis - right_asis)
    forward = unit(reject(middle - back, left))
    up = np.cross(forward, left)
    width = width or float(np.median(np.linalg.norm(left_asis - right_asis, axis=-1)))
    depth = float(np.median(np.linalg.norm(middle - back, axis=-1)))
    origin = middle - (0.24 * depth + 9.9 * MM) * forward - (0.30 * width + 10.9 * MM) * up
    side = (0.33 * width + 7.3 * MM) * left
    return origin + side, origin - side


def chord(above: Vectors, marker: Vectors, wand: Vectors, offset: float) -> Vectors:
    """The joint's centre, m: at a right angle between the joint above and the marker on the joint.

    Args:
        above: centre of the joint above, m.
        marker: on the outside of the joint, m.
        wand: marker in the plane of the three, on the outside of the segment, m.
        offset: m, of the centre from the marker; at most as far as the joint above.
    """
    distance = np.linalg.norm(marker - above, axis=-1, keepdims=True)
    along = unit(marker - above)
    outwards = unit(reject(wand - above, along))
    cos = np.clip(offset / np.maximum(distance, offset), 0.0, 1.0)  # of the angle at the marker
    return marker - offset * (cos * along + np.sqrt(1.0 - cos**2) * outwards)


def joint_centres(
    subject: Subject, places: Places, measures: Mapping[str, float]
) -> tuple[dict[str, Vectors], tuple[str, ...]]:
    """Pelvis, hips, knees and ankles, m, by role as in a joint map, and remarks.

    Args:
        subject: which markers there are.
        places: their places by their names in Plug-in Gait, m.
        measures: of the subject, mm, by names in capitals.
    """
    back = np.mean([places[name] for name in subject.back], axis=0)
    front = np.mean([places[name] for name in PELVIS], axis=0)
    width = measures.get("INTERASISDISTANCE", 0.0) * MM
    hips = hip_centres(places["LASI"], places["RASI"], back, width or None)
    radius = measures.get("MARKERDIAMETER", 0.0) * MM / 2 or MARKER_RADIUS
    joints: dict[str, Float64[np.ndarray, "frames 3"]] = {"pelvis": (front + back) / 2}
    remarks: list[str] = []
    for (side, letter), hip in zip(SIDES.items(), hips, strict=True):
        above = hip
        for joint in MODELLED:
            if joint in subject.modelled:
                above = places[letter + subject.modelled[joint]]
            elif joint != "hip":
                widths = leg_widths(letter, places, measures)
                offset = (widths.knee if joint == "knee" else widths.ankle) / 2 + radius
                marker, wand = (places[letter + ending] for ending in MARKED[joint])
                above = chord(above, marker, wand, offset)
                if joint == "ankle" and not widths.measured:
                    remarks.append(
                        f"the widths of the {side} knee and ankle are taken as "
                        f"{widths.knee / MM:.0f} and {widths.ankle / MM:.0f} mm, from the leg's "
                        "length, as the file lacks them (PROCESSING)"
                    )
            joints[f"{joint}_{side}"] = above
    return joints, tuple(remarks)


class Skeleton(NamedTuple):
    """Joints over frames, in the file's unit and axes."""

    names: tuple[str, ...]
    """As `joint_name` has them, the pelvis first."""
    parents: tuple[int, ...]
    positions_ws: Float64[np.ndarray, "frames joints 3"]
    rotations_ws: Float64[np.ndarray, "frames joints 4"]
    """wxyz."""


@dataclass(frozen=True, eq=False)
class MarkerJoints:
    """Joints in the frames in which their markers were seen."""

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
        turns = [Slerp(known, rotation(turn))(within) for turn in rotations.swapaxes(0, 1)]
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


def from_plug_in_gait(markers: Markers, subject: Subject, scale: float | None) -> MarkerJoints:
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
        joints, more = joint_centres(subject, places, markers.measures)
        for side, letter in SIDES.items():
            joints[f"toe_{side}"] = places[f"{letter}TOE"]
        joints = {role: joint / scale for role, joint in joints.items()}
    heels = {side: raw[heel] for side, heel in zip(SIDES, HEELS, strict=True) if heel in raw}
    if unseen := [heel for heel in HEELS if heel not in raw]:
        remarks.append(
            f"without {' and '.join(unseen)}, how a foot rolls is a guess: as its knee's hinge does"
        )
    pelvis = [raw["LASI"], raw["RASI"], np.mean([raw[name] for name in subject.back], axis=0)]
    return MarkerJoints(_skeleton(joints, pelvis, heels), known, used, guess, (*remarks, *more))


def _guess_unit(width: float, remarks: list[str]) -> float:
    usual = PELVIS_WIDTH
    if not 0 < width < np.inf:
        raise ValueError("LASI and RASI are at the same place; wanted both sides of a pelvis")
    unit_name = min(UNITS, key=lambda name: abs(np.log(width * UNITS[name] / usual)))
    remarks.append(
        f"no unit is stated (POINT:UNITS): {width:.4g} between LASI and RASI are taken as "
        f"{unit_name}"
    )
    return UNITS[unit_name]


def from_map(markers: Markers, joints: Mapping[str, str]) -> MarkerJoints:
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
    skeleton = _skeleton(places, pelvis if len(pelvis) == 3 else [], {})
    return MarkerJoints(skeleton, known, used, remarks=(FROM_PLACES,))


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
        hinge = rotation(shin).apply([1.0, 0.0, 0.0])
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


def read_marked(
    path: Path, joints: Mapping[str, str] | None = None, scale: float | None = None
) -> Recording:
    """The joints of a file of markers or of joints' places, in its own unit.

    Frames in which a marker that is needed was not seen are masked: joints move there on straight
    lines between the frames before and after. Without a map, the joints are those of Plug-in Gait,
    or points that are named as joints are in other formats. Of any other file, the markers
    themselves are the joints, none of which is a leg's.

    Args:
        path: the file.
        joints: role, as in a joint map, to a marker, or to several with " + " between: their mean.
        scale: metres per unit; None takes the unit that the file states.

    Raises:
        ValueError: with the file's name: it is not what its suffix says, lacks the markers that
            are named, or no frame has them all.
    """
    with error_context(path):
        markers = _turned(_read(path))
        if joints is not None:
            checked = joint_maps.check_joint_map(dict(joints), "the joint map")
            return _recording(markers, from_map(markers, checked))
        if (subject := _subject_of(markers)) is not None:
            return _recording(markers, from_plug_in_gait(markers, subject, scale))
        if (known := _as_joints(markers.names)) is not None:
            return _recording(markers, from_map(markers, known))
        return _bare(markers)


def is_marked(path: Path) -> bool:
    """Whether a file holds places without rotations."""
    return path.suffix.lower() in READERS or points_file.holds_points(path)


def _read(path: Path) -> Markers:
    return READERS.get(path.suffix.lower(), points_file.read_archive)(path)


def _subject_of(markers: Markers) -> Subject | None:
    """Who wears Plug-in Gait, at best without the markers that were never seen."""
    names = tuple(name for n, name in enumerate(markers.names) if markers.seen[:, n].any())
    return find_subject(names) or find_subject(markers.names)


def draft_marker_map(path: Path) -> str:
    """A joint map of a file's markers, to be edited: the best guess, and all names.

    Raises:
        ValueError: with the file's name, as of `read_marked`.
    """
    with error_context(path):
        names = _read(path).names
        known = _as_joints(names)
    roles = guess_map(names) if known is None else known
    return joint_maps.marker_template(names, roles, path.name)


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


def _recording(markers: Markers, motion: MarkerJoints) -> Recording:
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
        f"({listed(names)}): fits ignore them, and joints move there on straight lines",
    )


def _uneven_bones(motion: MarkerJoints) -> tuple[str, ...]:
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
