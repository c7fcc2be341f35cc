"""Which joint of a file is which joint of a leg: recognised by name, or given by hand."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

SIDES = {"l": 1.0, "r": -1.0}
LEG_NAMES = {"l": "left", "r": "right"}

# pelvis, hip, knee, ankle, toe, as `plain` spells them; `l` and `left` stand for either side.
DIALECTS = {
    "ASF": ("root", "{l}femur", "{l}tibia", "{l}foot", "{l}toes"),
    "cgspeed": ("hips", "{left}hip", "{left}knee", "{left}ankle", "{left}toe"),
    "MotionBuilder": ("hips", "{left}upleg", "{left}leg", "{left}foot", "{left}toebase"),
    "Poser": ("hip", "{l}thigh", "{l}shin", "{l}foot", "{l}toe"),
    "Bandai": ("hips", "upperleg{l}", "lowerleg{l}", "foot{l}", "toes{l}"),
    "Unreal": ("pelvis", "thigh{l}", "calf{l}", "foot{l}", "ball{l}"),
    "SMPL": ("pelvis", "{l}hip", "{l}knee", "{l}ankle", "{l}foot"),
    "jaxik": ("pelvis", "{left}hip", "{left}knee", "{left}ankle", "{left}toe"),
}


@dataclass(frozen=True)
class Leg:
    """One leg's joints, by index; the toe is the ball of the foot, or what comes nearest to it."""

    name: str
    side: float  # +1 left, -1 right, 0 neither
    joints: tuple[int, int, int, int]  # hip, knee, ankle, toe


@dataclass(frozen=True)
class Roles:
    """The joints that a rig needs."""

    dialect: str
    pelvis: int
    legs: tuple[Leg, ...]


def plain(name: str) -> str:
    """A joint name without namespace, case and joining marks: `mixamorig:LeftLeg` is `leftleg`."""
    last = re.split(r"[:|]", name.strip())[-1].lower()
    return re.sub(r"^mixamorig\d*|[ _.\-]", "", last)


def find_roles(
    names: tuple[str, ...], parents: tuple[int, ...], joints: Mapping[str, str] | None = None
) -> Roles:
    """The roles of a file's joints.

    A foot without toe joint takes the first child of its ankle, as a rule an end site.

    Args:
        names: the joints.
        parents: their parents, -1 at the root.
        joints: role to joint name, where the names are not to be recognised: `pelvis`, and for any
            number of legs, each with a suffix of its own, `hip_l`, `knee_l`, `ankle_l` and, if
            there is one, `toe_l`. A suffix that ends in l or left is a left leg, in r or right a
            right one.

    Errors: ValueError, with the list of joints, where no leg is found or a name is not there.
    """
    if joints is not None:
        return _by_hand(names, parents, joints)
    known = {plain(name): index for index, name in reversed(list(enumerate(names)))}
    for dialect, (pelvis, *leg) in DIALECTS.items():
        legs = []
        for letter in SIDES:
            spelt = [part.format(l=letter, left=LEG_NAMES[letter]) for part in leg]
            found = [known.get(name) for name in spelt]
            if None not in found[:3]:
                legs.append(_leg(names, parents, LEG_NAMES[letter], SIDES[letter], *found))
        if pelvis in known and len(legs) == len(SIDES):
            return Roles(dialect, known[pelvis], tuple(legs))
    spellings = "; ".join(f"{name}: {', '.join(parts)}" for name, parts in DIALECTS.items())
    raise ValueError(
        f"no pair of legs recognised among the joints {list(names)}; wanted, in any case, one of "
        f"{spellings}; or joints={{'pelvis': ..., 'hip_l': ..., 'knee_l': ..., 'ankle_l': ...}}"
    )


def _by_hand(names: tuple[str, ...], parents: tuple[int, ...], joints: Mapping[str, str]) -> Roles:
    known = {name: index for index, name in enumerate(names)}
    suffixes = [role.removeprefix("hip_") for role in joints if role.startswith("hip_")]
    allowed = {"pelvis"} | {
        f"{part}_{suffix}" for part in ("hip", "knee", "ankle", "toe") for suffix in suffixes
    }
    needed = {role for role in allowed if not role.startswith("toe_")}
    if not suffixes or set(joints) - allowed or needed - set(joints):
        raise ValueError(
            f"joints has the roles {sorted(joints)}; wanted pelvis and for each leg hip_NAME, "
            f"knee_NAME, ankle_NAME and, if there is one, toe_NAME"
        )
    if unknown := sorted(set(joints.values()) - set(names)):
        raise ValueError(f"no joints named {unknown}; there are {list(names)}")
    legs = []
    for suffix in suffixes:
        index = [known.get(joints.get(f"{part}_{suffix}", "")) for part in
                 ("hip", "knee", "ankle", "toe")]  # fmt: skip
        letter = re.sub(r"(?<=l)eft$|(?<=r)ight$", "", suffix)[-1:]
        name = LEG_NAMES.get(suffix, suffix)
        legs.append(_leg(names, parents, name, SIDES.get(letter, 0.0), *index))
    return Roles("by hand", known[joints["pelvis"]], tuple(legs))


def _leg(
    names: tuple[str, ...],
    parents: tuple[int, ...],
    name: str,
    side: float,
    hip: int | None,
    knee: int | None,
    ankle: int | None,
    toe: int | None,
) -> Leg:
    assert hip is not None and knee is not None and ankle is not None  # both callers looked
    if toe is None:
        if ankle not in parents:
            raise ValueError(
                f"the {name} foot has neither toe nor end site: nothing hangs on {names[ankle]}; "
                f"the joints are {list(names)}"
            )
        toe = parents.index(ankle)
    return Leg(name, side, (hip, knee, ankle, toe))


def partners(names: tuple[str, ...]) -> tuple[int, ...]:
    """For each joint (or leg) name the index of its other side; itself where it has none."""
    return tuple(
        next((names.index(other) for other in _other_sides(name) if other in names), index)
        for index, name in enumerate(names)
    )


def _other_sides(name: str) -> list[str]:
    """How the same joint may be called on the other side."""
    words = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"}
    words |= {right: left for left, right in words.items()}
    found = re.search(r"left|right", name, re.IGNORECASE)
    if found and found[0] in words:
        return [name[: found.start()] + words[found[0]] + name[found.end() :]]
    others = []
    for match in re.finditer(r"^[lr]|(?<=[:_ .])[lr](?![a-z])|(?<=[_ .])[lr]$|[lr]$", name, re.I):
        others.append(name[: match.start()] + words[match[0]] + name[match.end() :])
    return others
