"""Reader of Acclaim ASF (skeleton) and AMC (motion) files.

A bone rotates about its start and carries its children at its end, so the joint `lfemur` is the
hip. Each bone has an axis rotation C in the rest pose; its local rotation is C M C⁻¹, where M is
composed of the AMC's angles about x, y and z in the order that the axis line names. Leaf bones get
a final joint `<bone>_end`. Lengths are in inches divided by the file's length unit: metres are
`value * 0.0254 / length`. An AMC states no frame rate; the CMU files have 120 Hz.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.clips.clip import INCH, Recording
from fitting.runtime.validation import check_file

AMC_RATE = 120.0  # Hz, by convention of the CMU database
ROTATIONS = ("rx", "ry", "rz")
ANGLES = {"deg": True, "degrees": True, "rad": False, "radians": False}  # whether in degrees
PLACE = ("direction", "length", "axis")  # what each bone must state
DEGREES_OF_FREEDOM = (*ROTATIONS, "tx", "ty", "tz")  # "l", a changing bone length, is refused


@dataclass
class _Bone:
    name: str
    direction: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: tuple[np.ndarray, str] = (np.zeros(3), "XYZ")  # angles and their order
    freedoms: list[str] = field(default_factory=list)
    parent: str | None = None
    stated: set[str] = field(default_factory=set)  # the keys of its lines


@dataclass
class _Skeleton:
    bones: dict[str, _Bone]  # parents before children, the root first
    position: np.ndarray  # of the root, file units
    unit: float  # the file's length unit
    degrees: bool


class _Lines:
    """The words of each line with its number, without comments (`#`) and empty lines."""

    def __init__(self, path: Path) -> None:
        check_file(path)
        self.path = path
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        numbered = (
            (number, line.split("#", 1)[0].split())
            for number, line in enumerate(text.splitlines(), 1)
        )
        self.numbered = [(number, words) for number, words in numbered if words]

    def error(self, number: int, what: str, words: list[str]) -> ValueError:
        return ValueError(f"{self.path}:{number}: {what}; got {' '.join(words)[:60]!r}")

    def numbers(self, number: int, words: list[str], count: int, what: str) -> np.ndarray:
        try:
            values = np.array([float(word) for word in words])
        except ValueError as error:
            raise self.error(number, f"wanted {count} numbers of {what} ({error})", words) from None
        if len(values) != count or not np.isfinite(values).all():
            raise self.error(number, f"wanted {count} finite numbers of {what}", words)
        return values


def find_asf(amc: Path) -> Path:
    """The skeleton in the folder of an AMC file.

    It has the AMC's name, or that of its subject (`03.asf` for `03_01.amc`), or is the only one.

    Raises:
        ValueError: there is no such file.
    """
    skeletons = sorted(path for path in amc.parent.iterdir() if path.suffix.lower() == ".asf")
    for stem in (amc.stem, amc.stem.split("_")[0]):
        for path in skeletons:
            if path.stem.lower() == stem.lower():
                return path
    if len(skeletons) == 1:
        return skeletons[0]
    raise ValueError(
        f"{amc}: an AMC needs its ASF; wanted {amc.stem}.asf or {amc.stem.split('_')[0]}.asf "
        f"beside it, or asf=...; there are {[path.name for path in skeletons]}"
    )


def read_asfamc(amc: Path, asf: Path | None = None) -> Recording:
    """The joints and motion of an ASF/AMC pair, in the files' own units.

    Args:
        amc: the motion.
        asf: the skeleton; None looks for it in the same folder, see `find_asf`.

    Raises:
        ValueError: with file and line, where the text is neither ASF nor AMC, the skeleton or a
            frame lacks a bone, a bone lacks its place or states something twice, frames are not
            numbered in turn, or a line has the wrong count of numbers.
    """
    asf = find_asf(amc) if asf is None else asf
    skeleton = _read_asf(asf)
    values, degrees = _read_amc(amc, skeleton, asf)
    with np.errstate(all="ignore"):  # the loader says which joint is too far away
        return _assemble(skeleton, values, degrees)


def _read_asf(path: Path) -> _Skeleton:
    lines = _Lines(path)
    root, bone = _Bone("root"), None
    bones: dict[str, _Bone] = {"root": root}
    position, unit, degrees, section = np.zeros(3), 1.0, True, ""
    children: list[tuple[int, list[str]]] = []
    for number, words in lines.numbered:
        key, rest = words[0].lower(), words[1:]
        if key.startswith(":"):
            section = key[1:]
        elif section == "units" and key == "length":
            unit = float(lines.numbers(number, rest, 1, "length")[0])
            if unit <= 0:
                raise lines.error(number, "wanted a length unit above 0", words)
        elif section == "units" and key == "angle":
            if (word := rest[0].lower() if rest else "") not in ANGLES:
                raise lines.error(number, f"wanted an angle out of {tuple(ANGLES)}", words)
            degrees = ANGLES[word]
        elif section == "root" and key == "order":
            root.freedoms = [_freedom(lines, number, words, word) for word in rest]
        elif section == "root" and key == "axis":
            root.axis = (root.axis[0], _order(lines, number, rest))
        elif section == "root" and key == "position":
            position = lines.numbers(number, rest, 3, "position")
        elif section == "root" and key == "orientation":
            root.axis = (lines.numbers(number, rest, 3, "orientation"), root.axis[1])
        elif section == "bonedata":
            bone = _bone_line(lines, number, words, bone, bones)
        elif section == "hierarchy" and key not in ("begin", "end"):
            children.append((number, words))
    for number, (parent, *names) in children:
        for name in (parent, *names):
            if name not in bones:
                raise lines.error(number, f"no bone named {name}; there are {list(bones)}", [name])
        for name in names:
            bones[name].parent = parent
    return _Skeleton(_in_order(path, bones), position, unit, degrees)


def _bone_line(
    lines: _Lines, number: int, words: list[str], bone: _Bone | None, bones: dict[str, _Bone]
) -> _Bone | None:
    """Reads one line of the bone data; returns the bone that it belongs to, None between bones."""
    key, rest = words[0].lower(), words[1:]
    if key == "begin":
        return _Bone("")
    if bone is None:
        raise lines.error(number, "wanted begin", words)
    if key == "end":
        if not bone.name or bone.name in bones:
            raise lines.error(number, "wanted a bone name that is not taken yet", [bone.name])
        if missing := [place for place in PLACE if place not in bone.stated]:
            raise lines.error(number, f"wanted {' and '.join(missing)} before its end", [bone.name])
        bones[bone.name] = bone
        return None
    if key in ("name", *PLACE, "dof"):
        if key in bone.stated:
            raise lines.error(number, f"wanted {key} once in a bone", words)
        bone.stated.add(key)
    if key == "name":
        bone.name = " ".join(rest)
    elif key == "direction":
        bone.direction = lines.numbers(number, rest, 3, "direction")
    elif key == "length":
        bone.length = float(lines.numbers(number, rest, 1, "length")[0])
    elif key == "axis":
        bone.axis = (lines.numbers(number, rest[:3], 3, "axis"), _order(lines, number, rest[3:]))
    elif key == "dof":
        bone.freedoms = [_freedom(lines, number, words, word) for word in rest]
    return bone  # id, limits (over any number of lines) and masses do not affect the pose


def _freedom(lines: _Lines, number: int, words: list[str], word: str) -> str:
    if word.lower() not in DEGREES_OF_FREEDOM:
        raise lines.error(number, f"wanted degrees of freedom out of {DEGREES_OF_FREEDOM}", words)
    return word.lower()


def _order(lines: _Lines, number: int, words: list[str]) -> str:
    if len(words) != 1 or sorted(words[0].upper()) != ["X", "Y", "Z"]:
        raise lines.error(number, "wanted an axis order such as XYZ", words)
    return words[0].upper()


def _in_order(path: Path, bones: dict[str, _Bone]) -> dict[str, _Bone]:
    """The bones with parents before children; every bone must be connected to the root."""
    ordered = {"root": bones["root"]}
    while len(ordered) < len(bones):
        new = {
            name: bone
            for name, bone in bones.items()
            if name not in ordered and bone.parent in ordered
        }
        if not new:
            detached = [name for name in bones if name not in ordered]
            raise ValueError(f"{path}: bones not connected to the root in :hierarchy: {detached}")
        ordered |= new
    return ordered


def _read_amc(path: Path, skeleton: _Skeleton, asf: Path) -> tuple[dict[str, np.ndarray], bool]:
    """Values by bone, (frames, its degrees of freedom), and whether angles are in degrees."""
    lines = _Lines(path)
    degrees, frame, start, label = skeleton.degrees, 0, 0, 0
    counts = {name: len(bone.freedoms) for name, bone in skeleton.bones.items()}
    values: dict[str, list[list[float]]] = {name: [] for name, count in counts.items() if count}
    for number, words in lines.numbered:
        name = words[0]
        if name.startswith(":"):
            degrees = {":degrees": True, ":radians": False}.get(name.lower(), degrees)
        elif len(words) == 1 and name.isdecimal():
            _check_complete(lines, start, values, frame)
            if frame and int(name) != label + 1:
                raise lines.error(number, f"wanted frame {label + 1} after frame {label}", words)
            frame, start, label = frame + 1, number, int(name)
        elif name not in values or not frame:
            wanted = f"wanted a frame number, then bones of {asf.name} out of {list(values)}"
            raise lines.error(number, wanted, words)
        elif len(values[name]) == frame:
            raise lines.error(number, f"wanted {name} once in frame {frame}", words)
        else:
            count = counts[name]
            try:  # fast path: a file has some 100,000 lines
                numbers = [float(word) for word in words[1:]]
            except ValueError:
                numbers = []
            if len(numbers) != count or not all(map(math.isfinite, numbers)):
                lines.numbers(number, words[1:], count, f"{name} in frame {frame}")  # raises
            values[name].append(numbers)
    _check_complete(lines, start, values, frame)
    if not frame:
        raise ValueError(f"{path}:1: wanted frames: a number alone on a line, then bones; got none")
    return {name: np.array(frames) for name, frames in values.items()}, degrees


def _check_complete(
    lines: _Lines, start: int, values: dict[str, list[list[float]]], frame: int
) -> None:
    """ValueError unless every bone has values in this frame, which begins on line `start`."""
    if missing := [name for name, frames in values.items() if len(frames) != frame]:
        raise lines.error(start, f"wanted all bones in frame {frame}; without {missing}", [])


def _assemble(skeleton: _Skeleton, values: dict[str, np.ndarray], degrees: bool) -> Recording:
    """Joints at the start of every bone, and at the end of each leaf bone."""
    frames = len(values["root"]) if "root" in values else len(next(iter(values.values())))
    bones = list(skeleton.bones.values())
    leaves = [bone for bone in bones[1:] if all(other.parent != bone.name for other in bones)]
    names = [bone.name for bone in bones]
    offsets, parents, positions, rotations = [], [], [], []
    for bone in bones:
        parent = skeleton.bones[bone.parent] if bone.parent else None
        parents.append(names.index(bone.parent) if bone.parent else -1)
        offsets.append(parent.direction * parent.length if parent else skeleton.position)
        channels = values.get(bone.name, np.zeros((frames, 0)))
        translation, rot = _bone_motion(bone, channels, skeleton.degrees, degrees)
        positions.append(offsets[-1] + translation)
        rotations.append(rot.as_quat(scalar_first=True))
    for bone in leaves:
        names.append(f"{bone.name}_end")
        parents.append(names.index(bone.name))
        offsets.append(bone.direction * bone.length)
        positions.append(np.tile(offsets[-1], (frames, 1)))
        rotations.append(np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)))
    return Recording(
        tuple(names), tuple(parents), np.array(offsets), np.stack(positions, axis=1),
        np.stack(rotations, axis=1), 1.0 / AMC_RATE, metres_per_unit=INCH / skeleton.unit,
        remarks=("an AMC states no frame rate; taken as 120 Hz, the convention",),
    )  # fmt: skip


def _bone_motion(
    bone: _Bone, channels: np.ndarray, axis_in_degrees: bool, channels_in_degrees: bool
) -> tuple[np.ndarray, Rotation]:
    """Translation, (frames, 3), and local rotation C M C⁻¹ of a bone, from (frames, channels)."""
    angles, order = bone.axis
    rest = Rotation.from_euler(order.lower(), angles, degrees=axis_in_degrees)
    translation, euler = np.zeros((len(channels), 3)), np.zeros((len(channels), 3))
    for column, freedom in enumerate(bone.freedoms):
        if freedom in ROTATIONS:
            euler[:, order.index(freedom[1].upper())] = channels[:, column]
        else:
            translation[:, "xyz".index(freedom[1])] = channels[:, column]
    # Lower-case letters are SciPy's extrinsic rotations: for "xyz" about x first, then y, then z.
    moving = Rotation.from_euler(order.lower(), euler, degrees=channels_in_degrees)
    return translation, rest * moving * rest.inv()
