"""Joint roles: which joint of a skeleton is the pelvis, and which are hip, knee, ankle and toe.

Roles are recognised by joint name, in one of the naming conventions of `joints.dialects`, or named
by the caller.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from .joints.dialects import DIALECTS, LEG_NAMES, LEG_ROLES, plain, recognise
from .joints.map_files import ADVICE

SIDES = {"left": 1.0, "right": -1.0}

# Where no head shows the way, names of the spine's lowest joint, as `plain` spells them.
SPINES = (
    "lowerback", "spine", "spine0", "spine1", "spine01", "spine001", "abdomen", "torso", "chest"
)  # fmt: skip


@dataclass(frozen=True)
class Leg:
    """One leg's joints by index; the toe is the ball of the foot, or the joint nearest to it."""

    name: str
    side: float
    """+1 left, -1 right, 0 neither."""
    joints: tuple[int, int, int, int]
    """Hip, knee, ankle, toe; the toe of a foot that ends at the ankle is the ankle."""

    @property
    def ends_at_ankle(self) -> bool:
        """Whether no joint shows where the foot points."""
        return self.joints[2] == self.joints[3]


@dataclass(frozen=True)
class Roles:
    """The joints of a rig, by index."""

    dialect: str
    """Key of `DIALECTS`, or "by hand"."""
    pelvis: int
    legs: tuple[Leg, ...]


@dataclass(frozen=True)
class Trunk:
    """The joints that lean, by index; None for what a skeleton lacks."""

    spine: int | None
    """Base of the spine: the first joint from the pelvis to the head."""
    head: int | None


def find_trunk(names: tuple[str, ...], parents: tuple[int, ...], pelvis: int) -> Trunk:
    """The base of the spine and the head, which all known conventions call "head".

    Between pelvis and head the spine needs no known name; without a head it is a child of the
    pelvis with a name of `SPINES`.
    """
    plain_names = _without_prefix([plain(name) for name in names], pelvis)
    if "head" not in plain_names:
        spines = (
            j for j, name in enumerate(plain_names) if name in SPINES and parents[j] == pelvis
        )
        return Trunk(next(spines, None), None)
    head = spine = plain_names.index("head")
    below = {-1, pelvis}
    while parents[pelvis] >= 0:
        pelvis = parents[pelvis]
        below.add(pelvis)
    while parents[spine] not in below:
        spine = parents[spine]
    return Trunk(None if spine == head or parents[spine] < 0 else spine, head)


def _without_prefix(plain_names: list[str], pelvis: int) -> list[str]:
    """Names without the prefix that the head, or the spine, shares with the pelvis."""
    for name in plain_names:
        for word in ("head", *SPINES):
            prefix = name.removesuffix(word)
            if prefix != name and prefix and plain_names[pelvis].startswith(prefix):
                return [text.removeprefix(prefix) for text in plain_names]
    return plain_names


def find_roles(
    names: tuple[str, ...], parents: tuple[int, ...], joints: Mapping[str, str] | None = None
) -> Roles:
    """The roles of a skeleton's joints.

    A foot without a toe joint uses the first child of its ankle, usually an end site; without that
    it ends at the ankle.

    Args:
        names: the joints.
        parents: index of each joint's parent, -1 at the root.
        joints: role to joint name; None recognises the names. Roles are `pelvis` and, for any
            number of legs, each with its own suffix, `hip_l`, `knee_l`, `ankle_l` and optionally
            `toe_l`. A suffix that ends in l or left is a left leg, one in r or right a right leg.

    Raises:
        ValueError: no pair of legs is recognised, or several are; or `joints` has wrong roles or
            unknown names, or one joint in two roles. The message lists what exists.
    """
    if joints is not None:
        return _by_hand(names, parents, joints)
    try:
        match = recognise(names, parents)
    except ValueError as error:
        raise ValueError(f"{error}; {ADVICE}") from None
    if match is None:
        raise ValueError(
            f"no pair of legs recognised among the joints {list(names)}; known are the names of "
            f"{', '.join(DIALECTS)}; for others, {ADVICE}"
        )
    legs = []
    for (name, side), (*bones, toe) in zip(SIDES.items(), (match.left, match.right), strict=True):
        hip, knee, ankle = bones
        toe = _end_of_foot(parents, ankle) if toe is None else toe
        legs.append(Leg(name, side, (hip, knee, ankle, toe)))
    return Roles(match.dialect, match.pelvis, tuple(legs))


def _by_hand(names: tuple[str, ...], parents: tuple[int, ...], joints: Mapping[str, str]) -> Roles:
    """The roles that the caller named."""
    joints = {role: name for role, name in joints.items() if name or not role.startswith("toe_")}
    if empty := [role for role, name in joints.items() if not name]:
        raise ValueError(f"{empty[0]} is empty; wanted the name of a joint, of {list(names)}")
    suffixes = [role.removeprefix("hip_") for role in joints if role.startswith("hip_")]
    allowed = {"pelvis"} | {f"{role}_{suffix}" for role in LEG_ROLES for suffix in suffixes}
    required = {role for role in allowed if not role.startswith("toe_")}
    if not suffixes or set(joints) - allowed or required - set(joints):
        raise ValueError(
            f"joints has the roles {sorted(joints)}; wanted pelvis and for each leg hip_NAME, "
            f"knee_NAME, ankle_NAME and, if there is one, toe_NAME"
        )
    if unknown := sorted(set(joints.values()) - set(names)):
        raise ValueError(f"no joints named {unknown}; there are {list(names)}")
    index_of = {role: names.index(name) for role, name in joints.items()}
    legs = []
    for role, name in joints.items():
        others = [other for other in joints if other not in (role, "pelvis")]
        alike = [other for other in others if joints[other] == name]
        if alike and role != "pelvis":  # at which a leg may begin
            raise ValueError(f"the joint {name} is both {role} and {alike[0]}")
    for suffix in suffixes:
        hip, knee, ankle = (index_of[f"{role}_{suffix}"] for role in LEG_ROLES[:3])
        letter = re.sub(r"(?<=l)eft$|(?<=r)ight$", "", suffix)[-1:]
        leg = LEG_NAMES.get(suffix, suffix)
        toe = index_of.get(f"toe_{suffix}")
        toe = _end_of_foot(parents, ankle) if toe is None else toe
        legs.append(Leg(leg, SIDES.get(LEG_NAMES.get(letter, ""), 0.0), (hip, knee, ankle, toe)))
    return Roles("by hand", index_of["pelvis"], tuple(legs))


def _end_of_foot(parents: tuple[int, ...], ankle: int) -> int:
    """For a foot without a toe joint, the first child of its ankle, or else the ankle."""
    return parents.index(ankle) if ankle in parents else ankle


def partners(names: tuple[str, ...]) -> tuple[int, ...]:
    """For each joint or leg the index of its counterpart on the other side, or its own index."""
    return tuple(
        next((names.index(other) for other in _other_sides(name) if other in names), index)
        for index, name in enumerate(names)
    )


def _other_sides(name: str) -> list[str]:
    """What the same joint may be called on the other side."""
    opposite = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"}
    opposite |= {right: left for left, right in opposite.items()}
    word = re.search(r"left|right", name, re.IGNORECASE)
    if word and word[0] in opposite:
        return [name[: word.start()] + opposite[word[0]] + name[word.end() :]]
    others = []
    for match in re.finditer(r"^[lr]|(?<=[:_ .])[lr](?![a-z])|(?<=[_ .])[lr]$|[lr]$", name, re.I):
        others.append(name[: match.start()] + opposite[match[0]] + name[match.end() :])
    return others
