"""Naming conventions of joints: a table, and what recognises them in a skeleton.

A convention is recognised with any prefix that its joints have in common: `mixamorig:`, `Bip01 `,
`DEF-`, `CC_Base_`, or the name of a character.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

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
