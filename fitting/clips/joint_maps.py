"""Joint roles: which joint of a skeleton is the pelvis, and which are hip, knee, ankle and toe.

They are recognised by the joints' names in a naming convention, with any prefix that the joints
have in common (`mixamorig:`, `Bip01 `, `DEF-`, `CC_Base_`, the name of a character), or named in a
joint map, a TOML file:

pelvis = "Hüfte"
hip_left = "Oberschenkel.L"     # legs may have any names; those that end in l or left are left legs
knee_left = "Unterschenkel.L"
ankle_left = "Fuß.L"
toe_left = "Zehen.L"            # may be left out
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from fitting.runtime import validation
from fitting.runtime.declarations import TEXT

SIDES = {"left": 1.0, "right": -1.0}

# Where no head shows the way, names of the spine's lowest joint, as `plain` spells them.
SPINES = (
    "lowerback", "spine", "spine0", "spine1", "spine01", "spine001", "abdomen", "torso", "chest"
)  # fmt: skip

LEG_NAMES = {"l": "left", "r": "right"}
LEG_ROLES = ("hip", "knee", "ankle", "toe")

# Names of pelvis, hip, knee, ankle and toe, as `plain` spells them, with | between alternatives.
# {l} and {left} are replaced by the side: l and r, or left and right.
DIALECTS = {
    "ASF": ("root", "{l}femur", "{l}tibia", "{l}foot", "{l}toes"),
    "cgspeed": ("hips", "{left}hip", "{left}knee", "{left}ankle", "{left}toe"),
    "MotionBuilder": ("hips", "{left}upleg", "{left}leg", "{left}foot", "{left}toebase"),
    "Biovision": ("hips", "{left}upleg", "{left}lowleg", "{left}foot", "{left}toe|{left}toebase"),
    "LAFAN1": ("hips", "{left}upleg", "{left}leg", "{left}foot", "{left}toe|{left}toes"),
    "Poser": ("hip", "{l}thigh|{l}thighbend", "{l}shin", "{l}foot", "{l}toe|{l}toes"),
    "MakeHuman": ("root|hips|pelvis", "upperleg01{l}|upleg{l}", "lowerleg01{l}|loleg{l}|lowleg{l}",
                  "foot{l}", "toe11{l}|toe{l}"),
    "Bandai": ("hips", "upperleg{l}", "lowerleg{l}", "foot{l}", "toes{l}"),
    "Unreal": ("pelvis", "thigh{l}", "calf{l}", "foot{l}", "ball{l}"),
    "Unity": ("hips", "{left}upperleg", "{left}lowerleg", "{left}foot", "{left}toes"),
    "Xsens": ("pelvis|hips", "{left}upperleg", "{left}lowerleg", "{left}foot", "{left}toe"),
    "Rokoko": ("hips", "{left}thigh", "{left}shin", "{left}foot", "{left}toe"),
    "Vicon": ("pelvis|hips|root", "{left}thigh", "{left}shank|{left}calf|{left}tibia",
              "{left}foot", "{left}toe|{left}toes"),
    "Biped": ("pelvis|hip", "{l}thigh", "{l}calf", "{l}foot", "{l}toe0|{l}toebase|{l}toe"),
    "Rigify": ("spine|hips|pelvis", "thigh{l}", "shin{l}", "foot{l}", "toe{l}"),
    "VRM": ("hips|chips", "{l}upperleg", "{l}lowerleg", "{l}foot", "{l}toebase"),
    "Kinect": ("pelvis|spinebase", "hip{left}", "knee{left}", "ankle{left}", "foot{left}"),
    "SMPL": ("pelvis", "{l}hip", "{l}knee", "{l}ankle", "{l}foot"),
    "SMPL-X": ("pelvis", "{left}hip", "{left}knee", "{left}ankle", "{left}foot"),
    "jaxik": ("pelvis", "{left}hip", "{left}knee", "{left}ankle", "{left}toe"),
}  # fmt: skip
MECHANISM = ("org", "mch")  # prefixes of Rigify's copies of a skeleton, which do not deform it
LegJoints = tuple[int, int, int, int | None]  # hip, knee, ankle and toe

ROLE = re.compile(r"pelvis|(hip|knee|ankle|toe)_.+")
ADVICE = (
    "write a map with `jaxik inspect CLIP --joints > MAP.toml`, correct it, and give it as "
    "--joints MAP.toml"
)
HEAD = """\
# Which joint of {source} is which. {state}
# Give this file to any command that reads the clip as --joints MAP.toml, or to an experiment's
# [[clips]] as joints = "MAP.toml".
"""
TAIL = """
# A toe may be left out or empty: the foot then ends in the first child of its ankle, or without one
# where the ball of a person's foot would be. Legs may have any names and number: hip_fore_left,
# knee_fore_left, ...; names that end in l or left are of left legs.
#
# All joints, each below its parent:
"""
MARKER_TAIL = """
# All lines are needed. A joint that is the mean of several markers has their names with a plus
# between them, as in "LKNE + LKNM". Legs may have any names and number, on both sides: hip_left,
# ...; names that end in l or left are of left legs.
#
# All markers:
"""
KNOWN = "These names were recognised, so no map is needed."
GUESSED = "Guessed: check every line, and fill in what is empty."
# What the names of joints contain, in the order in which it is looked for.
FEET = ("ankle", "foot", "fuss", "pied")
TOES = ("toebase", "toe", "ball")


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
    twisted: tuple[int, ...] = ()
    """The joints of the spine that share a twist, from its base up to where the arms branch off."""


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
        spine = next(spines, None)
        return Trunk(spine, None, () if spine is None else (spine,))
    head = spine = plain_names.index("head")
    chain: list[int] = []
    below = {-1, pelvis}
    while parents[pelvis] >= 0:
        pelvis = parents[pelvis]
        below.add(pelvis)
    while parents[spine] not in below:
        spine = parents[spine]
        chain.insert(0, spine)
    if spine == head or parents[spine] < 0:
        return Trunk(None, head)
    branches = (n for n, joint in enumerate(chain, 1) if parents.count(joint) > 1)
    return Trunk(spine, head, tuple(chain[: next(branches, None)]))


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


@dataclass(frozen=True)
class Match:
    """A pelvis and a pair of legs that a convention names, by index."""

    dialect: str
    """Key of `DIALECTS`."""
    pelvis: int
    left: LegJoints
    right: LegJoints

    @property
    def bones(self) -> tuple[int, ...]:
        """Hips, knees and ankles."""
        return self.left[:3] + self.right[:3]

    @property
    def has_toes(self) -> bool:
        """Whether both toes are named."""
        return self.left[3] is not None and self.right[3] is not None


def plain(name: str) -> str:
    """A joint name without namespace, case and separators: `mixamorig:LeftLeg` is `leftleg`."""
    last = re.split(r"[:|]", name.strip())[-1].lower()
    bare = re.sub(r"^mixamorig\d*|[ _.\-]", "", last)
    return re.sub(r"(?<=.)(joint|jnt)$", "", bare)


def recognise(names: tuple[str, ...], parents: tuple[int, ...]) -> Match | None:
    """The pelvis and the legs of the conventions that fit these joints; None if none does.

    Conventions that agree on the legs may differ in the pelvis: it is the one nearest to the hips.

    Raises:
        ValueError: conventions, or characters of the same file, name different legs.
    """
    matches = list(_matches(names))
    if not matches:
        return None
    choices = {match.bones: match for match in reversed(matches)}
    if len(choices) > 1:
        described = "; ".join(
            f"{match.dialect}: {', '.join(repr(names[joint]) for joint in match.bones)}"
            for match in reversed(choices.values())
        )
        raise ValueError(f"the legs may be any of these: {described}")
    matches = [match for match in matches if match.has_toes] or matches

    def steps_to_hip(match: Match) -> int:
        above, steps = match.left[0], 0
        while above >= 0 and above != match.pelvis:
            above, steps = parents[above], steps + 1
        return steps if above >= 0 else len(names)

    return min(matches, key=steps_to_hip)


def _matches(names: tuple[str, ...]) -> Iterator[Match]:
    """Every way in which a convention fits these names, by the order of `DIALECTS`."""
    indices: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        indices.setdefault(plain(name), []).append(index)
    for dialect, words in DIALECTS.items():
        spelled = {side: _spelled(words, side) for side in LEG_NAMES}
        for prefix in _prefixes(indices, spelled["l"][1]):
            pelves = [joint for name in spelled["l"][0] for joint in indices.get(prefix + name, [])]
            left, right = (
                [_joints(indices, prefix, role) for role in spelled[side][1:]] for side in LEG_NAMES
            )
            # A name that several joints have, as of two characters, is a choice for each of them.
            copies = min(map(len, (*left[:3], *right[:3])))
            for copy in range(copies):
                for pelvis in pelves:
                    yield Match(dialect, pelvis, _leg(left, copy), _leg(right, copy))


def _spelled(words: tuple[str, ...], side: str) -> list[list[str]]:
    """The alternatives of each role, on one side."""
    return [text.format(l=side, left=LEG_NAMES[side]).split("|") for text in words]


def _prefixes(indices: Mapping[str, list[int]], hips: list[str]) -> list[str]:
    """What the joints may have before the names of a convention: nothing, if that fits."""
    if any(hip in indices for hip in hips):
        return [""]
    prefixes = {name[: -len(hip)] for hip in hips for name in indices if name.endswith(hip)}
    return sorted(prefix for prefix in prefixes if prefix not in MECHANISM)


def _joints(indices: Mapping[str, list[int]], prefix: str, role: list[str]) -> list[int]:
    """The joints that the first alternative found names; none without any."""
    return next((indices[prefix + name] for name in role if prefix + name in indices), [])


def _leg(roles: list[list[int]], copy: int) -> LegJoints:
    """Hip, knee, ankle and toe of one of several legs with the same names."""
    *bones, toes = roles
    hip, knee, ankle = (joints[copy] for joints in bones)
    return hip, knee, ankle, toes[copy] if copy < len(toes) else None


def read_joint_map(path: Path) -> dict[str, str]:
    """The joint names in a file by role, as `find_roles` takes them.

    Raises:
        ValueError: the file does not exist or is not TOML, a key is not a role, or a value no name.
    """
    return check_joint_map(validation.read_toml(path, "a joint map"), f"{path}")


def check_joint_map(content: validation.Table, where: str) -> dict[str, str]:
    """The table, if it is a joint map; which joints there are is not known yet.

    Raises:
        ValueError: a key is not a role, a value no name, or the pelvis is missing.
    """
    for role, name in content.items():
        if not ROLE.fullmatch(role):
            raise ValueError(
                f"{where}: {role!r} is not a role; wanted pelvis, and hip_NAME, knee_NAME, "
                "ankle_NAME and toe_NAME of each leg"
            )
        if not TEXT.accepts(name):
            raise ValueError(f"{where}: {role} is {name!r}; wanted the name of a joint")
    if "pelvis" not in content:
        raise ValueError(f"{where}: there is no pelvis; a joint map names it, and legs")
    return dict(content)


def template(names: tuple[str, ...], parents: tuple[int, ...], source: str) -> str:
    """A joint map to be edited: the best guess of each role, and all joints of the skeleton.

    Args:
        names: the joints.
        parents: index of each joint's parent, -1 at the root.
        source: name of the clip.
    """
    try:
        match = recognise(names, parents)
    except ValueError:
        match = None
    if match is None:
        roles = _guess(names, parents)
    else:
        roles = {"pelvis": names[match.pelvis]}
        for side, leg in zip(LEG_NAMES.values(), (match.left, match.right), strict=True):
            joints = {role: joint for role, joint in zip(LEG_ROLES, leg, strict=True)}
            roles |= {f"{r}_{side}": names[j] for r, j in joints.items() if j is not None}
    depth = {-1: 0}
    for joint, parent in enumerate(parents):
        depth[joint] = depth[parent] + 1
    tree = [f"#{'  ' * depth[joint]}{_printable(name)}" for joint, name in enumerate(names)]
    head = HEAD.format(source=_printable(source), state=GUESSED if match is None else KNOWN)
    return f"{head}\n{tomli_w.dumps(roles)}{TAIL}" + "\n".join(tree)


def marker_template(names: tuple[str, ...], roles: dict[str, str], source: str) -> str:
    """A joint map of markers to be edited: a guess of each role, and all markers.

    Args:
        names: the markers.
        roles: "" where nothing is guessed.
        source: name of the clip.
    """
    head = HEAD.format(source=_printable(source), state=GUESSED)
    markers = "\n".join(f"#{_printable(name)}" for name in names)
    return f"{head}\n{tomli_w.dumps(roles)}{MARKER_TAIL}{markers}"


def _guess(names: tuple[str, ...], parents: tuple[int, ...]) -> dict[str, str]:
    """Legs as the four joints that end in what is called a toe or a foot; "" for what is unknown.

    The pelvis is where both legs meet, or else the root.
    """
    legs = {side: _guess_leg(names, parents, (letter, side)) for letter, side in LEG_NAMES.items()}
    ways = [_way_to_root(parents, leg[0]) if leg else [] for leg in legs.values()]
    common = [joint for joint in ways[0] if joint in ways[1]]
    roles = {"pelvis": names[common[0] if common else 0]}
    for side, leg in legs.items():
        known = [names[joint] for joint in leg]
        for role, name in zip(LEG_ROLES, known + [""] * (len(LEG_ROLES) - len(known)), strict=True):
            roles[f"{role}_{side}"] = name
    return roles


def _guess_leg(
    names: tuple[str, ...], parents: tuple[int, ...], side: tuple[str, str]
) -> list[int]:
    """Hip, knee, ankle and toe of a side, the toe only if it has a name; none without a foot."""
    own = [(plain(name), j) for j, name in enumerate(names) if _has_side(name, *side)]
    foot = next((j for word in FEET for text, j in own if word in text), None)
    toe = next((j for word in TOES for text, j in own if word in text), None)
    if foot is None:
        foot = None if toe is None else parents[toe]
    if foot is None or len(above := _way_to_root(parents, foot)) < 2:
        return []
    return [*reversed(above[:2]), foot, *(() if toe is None else (toe,))]


def _way_to_root(parents: tuple[int, ...], joint: int) -> list[int]:
    """The joints above a joint, the nearest one first."""
    above = []
    while (joint := parents[joint] if joint >= 0 else -1) >= 0:
        above.append(joint)
    return above


def _has_side(name: str, letter: str, side: str) -> bool:
    """Whether a name says which side it is on: `LeftFoot`, `foot.L`, `l_foot`, `lFoot`, `footL`."""
    if side in name.lower():
        return True
    capital = letter.upper()
    alone = rf"(?<![A-Za-z])[{letter}{capital}](?![A-Za-z])"
    return bool(re.search(rf"{alone}|^{letter}(?=[A-Z])|(?<=[a-z]){capital}$", name))


def _printable(name: str) -> str:
    """A name as a comment can hold it."""
    return name if name.isprintable() else ascii(name)
