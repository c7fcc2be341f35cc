"""Joint centres from the markers of Vicon's Plug-in Gait, lower body.

Hips lie where the regression of Harrington et al. (2007, J. Biomech. 40:595, their equations with
one predictor each) puts them between the pelvis' markers. Plug-in Gait itself uses that of Davis et
al. (1991, Hum. Mov. Sci. 10:575), which needs the length of the leg and is further off: 25 mm
against 12 mm, of 67 pelves in a CT scanner (Mantovani et al. 2016, Gait & Posture 44:48). Both take
the centres of the markers for the bone below them.

Knees and ankles lie where Davis' chord function puts them: in the plane of the joint above, the
marker on the joint and the marker on the wand or segment, half a joint's width and the radius of a
marker inwards, with a right angle at the joint.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from fitting.datasets.clips.leg_geometry import Vectors, reject, unit

MM = 1e-3  # m
MARKER_RADIUS = 7.0 * MM  # m, of the usual marker of 14 mm
KNEE_WIDTH, ANKLE_WIDTH = 0.11, 0.08  # of a leg's length; where none was measured
PELVIS_WIDTH = 0.25  # m, between an adult's anterior spines: to guess a unit by
SIDES = {"left": "L", "right": "R"}
HEELS = tuple(f"{letter}HEE" for letter in SIDES.values())
PELVIS = ("LASI", "RASI")
BACKS = (("LPSI", "RPSI"), ("SACR",))
# What labs store beside markers, or Plug-in Gait computes: the first that is there is taken.
MODELLED = {"hip": ("HJC", "FEP"), "knee": ("KJC", "FEO"), "ankle": ("AJC", "TIO")}
MARKED = {"hip": (), "knee": ("KNE", "THI"), "ankle": ("ANK", "TIB")}

Places = Mapping[str, Vectors]


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
    complete = [subject for own in subjects.values() if (subject := _subject(own))]
    if len(complete) > 1:
        wearers = [prefix for prefix, own in subjects.items() if _subject(own)]
        raise ValueError(
            f"{len(complete)} subjects wear Plug-in Gait markers, {wearers}; name those of one"
        )
    return complete[0] if complete else None


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
        right_asis: likewise.
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
