"""Joint maps: TOML files in which a user says which joint of a skeleton is which.

pelvis = "Hüfte"
hip_left = "Oberschenkel.L"     # legs may have any names; those that end in l or left are left legs
knee_left = "Unterschenkel.L"
ankle_left = "Fuß.L"
toe_left = "Zehen.L"            # may be left out
"""

import re
from pathlib import Path

import tomli_w

from fitting.runtime import validation

from .dialects import LEG_NAMES, LEG_ROLES, plain, recognise

ROLE = re.compile(r"pelvis|(hip|knee|ankle|toe)_.+")
NAME = validation.Constraint("the name of a joint", validation.TEXT.accepts)
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


def read_joint_map(path: Path) -> dict[str, str]:
    """The joint names in a file by role, as `joint_roles.find_roles` takes them.

    Raises:
        ValueError: the file does not exist or is not TOML, a key is no role, or a value no name.
    """
    return check_joint_map(validation.read_toml(path, "a joint map"), f"{path}")


def check_joint_map(content: validation.Table, where: str) -> dict[str, str]:
    """The table, if it is a joint map; which joints there are is not known yet.

    Raises:
        ValueError: a key is no role, a value no name, or the pelvis is missing.
    """
    for role, name in content.items():
        if not ROLE.fullmatch(role):
            raise ValueError(
                f"{where}: {role!r} is no role; wanted pelvis, and hip_NAME, knee_NAME, ankle_NAME "
                "and toe_NAME of each leg"
            )
        if not NAME.accepts(name):
            raise ValueError(f"{where}: {role} is {name!r}; wanted {NAME.description}")
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
    tree = [f"#{'  ' * depth[joint]}{_shown(name)}" for joint, name in enumerate(names)]
    head = HEAD.format(source=_shown(source), state=GUESSED if match is None else KNOWN)
    return f"{head}\n{tomli_w.dumps(roles)}{TAIL}" + "\n".join(tree)


def marker_template(names: tuple[str, ...], roles: dict[str, str], source: str) -> str:
    """A joint map of markers to be edited: a guess of each role, and all markers.

    Args:
        names: the markers.
        roles: "" where nothing is guessed.
        source: name of the clip.
    """
    head = HEAD.format(source=_shown(source), state=GUESSED)
    markers = "\n".join(f"#{_shown(name)}" for name in names)
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


def _shown(name: str) -> str:
    """A name as a comment can hold it."""
    return name if name.isprintable() else ascii(name)
