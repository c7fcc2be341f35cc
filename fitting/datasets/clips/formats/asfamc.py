"""Reader of Acclaim ASF (skeleton) and AMC (motion).

A bone turns at its start and carries its children at its end: joint `lfemur` here is the hip.
Each bone has an axis rotation C in the rest pose; its local rotation is C M C⁻¹, where M is of
the angles of the AMC, turned about x, y and z in the order that the axis names. Leaf bones get a
last joint `<bone>_end`. Lengths are inches over the file's length unit: metres are
`value 0.0254 / length`. An AMC says no rate; the CMU files have 120 Hz.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.recording import Recording

AMC_RATE = 120.0  # Hz, by convention of the CMU database
INCH = 0.0254  # m
ROTATIONS = ("rx", "ry", "rz")
MOTIONS = (*ROTATIONS, "tx", "ty", "tz")  # "l", a bone of changing length, is refused


@dataclass
class _Bone:
    name: str
    direction: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: tuple[np.ndarray, str] = (np.zeros(3), "XYZ")  # angles, order
    freedoms: list[str] = field(default_factory=list)
    parent: str | None = None


@dataclass
class _Skeleton:
    bones: dict[str, _Bone]  # parents before children, the root first
    position: np.ndarray  # of the root, file units
    unit: float  # the file's length unit
    degrees: bool


class _Lines:
    """The lines of a file that say something, with their numbers; comments start with #."""

    def __init__(self, path: Path) -> None:
        self.path = path
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        self.rows = [
            (number, line.split("#", 1)[0].split())
            for number, line in enumerate(text.splitlines(), 1)
        ]
        self.rows = [(number, words) for number, words in self.rows if words]

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
    """The skeleton beside an AMC: of its name, its subject's (`03` of `03_01`), or the only one."""
    beside = sorted(path for path in amc.parent.iterdir() if path.suffix.lower() == ".asf")
    for stem in (amc.stem, amc.stem.split("_")[0]):
        for path in beside:
            if path.stem.lower() == stem.lower():
                return path
    if len(beside) == 1:
        return beside[0]
    raise ValueError(
        f"{amc}: an AMC needs its ASF; wanted {amc.stem}.asf or {amc.stem.split('_')[0]}.asf "
        f"beside it, or asf=...; there are {[path.name for path in beside]}"
    )


def read_asfamc(amc: Path, asf: Path) -> Recording:
    """The joints and motion of an ASF/AMC pair, in the files' own units.

    Errors: ValueError with file and line for text that is neither, bones that the skeleton lacks or
    a frame lacks, and wrong counts of numbers.
    """
    skeleton = _read_asf(asf)
    values, degrees = _read_amc(amc, skeleton, asf)
    return _assemble(skeleton, values, degrees)


def _read_asf(path: Path) -> _Skeleton:
    lines = _Lines(path)
    root, bone = _Bone("root"), None
    bones: dict[str, _Bone] = {"root": root}
    position, unit, degrees, section = np.zeros(3), 1.0, True, ""
    children: list[tuple[int, list[str]]] = []
    for number, words in lines.rows:
        key, rest = words[0].lower(), words[1:]
        if key.startswith(":"):
            section = key[1:]
        elif section == "units" and key == "length":
            unit = float(lines.numbers(number, rest, 1, "length")[0])
            if unit <= 0:
                raise lines.error(number, "wanted a length unit above 0", words)
        elif section == "units" and key == "angle":
            degrees = rest[:1] == ["deg"]
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
    """One line of the bone data; returns the bone that is being told about."""
    key, rest = words[0].lower(), words[1:]
    if key == "begin":
        return _Bone("")
    if bone is None:
        raise lines.error(number, "wanted begin", words)
    if key == "end":
        if not bone.name or bone.name in bones:
            raise lines.error(number, "wanted a bone name that is not taken yet", [bone.name])
        bones[bone.name] = bone
        return None
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
    return bone  # id, limits (over any number of lines), masses: nothing that a pose needs


def _freedom(lines: _Lines, number: int, words: list[str], word: str) -> str:
    if word.lower() not in MOTIONS:
        raise lines.error(number, f"wanted degrees of freedom out of {MOTIONS}", words)
    return word.lower()


def _order(lines: _Lines, number: int, words: list[str]) -> str:
    if len(words) != 1 or sorted(words[0].upper()) != ["X", "Y", "Z"]:
        raise lines.error(number, "wanted an axis order such as XYZ", words)
    return words[0].upper()


def _in_order(path: Path, bones: dict[str, _Bone]) -> dict[str, _Bone]:
    """The bones with parents before children; every bone must hang on the root."""
    ordered = {"root": bones["root"]}
    while len(ordered) < len(bones):
        new = {
            name: bone
            for name, bone in bones.items()
            if name not in ordered and bone.parent in ordered
        }
        if not new:
            loose = [name for name in bones if name not in ordered]
            raise ValueError(f"{path}: bones without a way to the root in :hierarchy: {loose}")
        ordered |= new
    return ordered


def _read_amc(path: Path, skeleton: _Skeleton, asf: Path) -> tuple[dict[str, np.ndarray], bool]:
    """The values of each bone that has any, (frames, its degrees of freedom), and their unit."""
    lines = _Lines(path)
    degrees, frame, start = skeleton.degrees, 0, 0
    counts = {name: len(bone.freedoms) for name, bone in skeleton.bones.items()}
    values: dict[str, list[list[float]]] = {name: [] for name, count in counts.items() if count}
    for number, words in lines.rows:
        name = words[0]
        if name.startswith(":"):
            degrees = {":degrees": True, ":radians": False}.get(name.lower(), degrees)
        elif len(words) == 1 and name.isdecimal():
            _complete(lines, start, values, frame)
            frame, start = frame + 1, number
        elif name not in values or not frame:
            wanted = f"wanted a frame number, then bones of {asf.name} out of {list(values)}"
            raise lines.error(number, wanted, words)
        elif len(values[name]) == frame:
            raise lines.error(number, f"wanted {name} once in frame {frame}", words)
        else:
            count = counts[name]
            try:  # the quick way, 100,000 lines a file
                row = [float(word) for word in words[1:]]
            except ValueError:
                row = []
            if len(row) != count:
                lines.numbers(number, words[1:], count, name)
            values[name].append(row)
    _complete(lines, start, values, frame)
    if not frame:
        raise ValueError(f"{path}:1: wanted frames: a number alone on a line, then bones; got none")
    arrays = {name: np.array(rows) for name, rows in values.items()}
    for name, rows in arrays.items():
        if not np.isfinite(rows).all():
            bad = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0]) + 1
            raise ValueError(f"{path}: wanted finite numbers; {name} has others in frame {bad}")
    return arrays, degrees


def _complete(lines: _Lines, start: int, values: dict[str, list], frame: int) -> None:
    if missing := [name for name, rows in values.items() if len(rows) != frame]:
        raise lines.error(start, f"wanted all bones in frame {frame}; without {missing}", [])


def _assemble(skeleton: _Skeleton, values: dict[str, np.ndarray], degrees: bool) -> Recording:
    """Joints at the bones' starts, and one at the end of each leaf."""
    frames = len(values["root"]) if "root" in values else len(next(iter(values.values())))
    bones = list(skeleton.bones.values())
    leaves = [bone for bone in bones[1:] if all(other.parent != bone.name for other in bones)]
    names = [bone.name for bone in bones]
    offsets, parents, positions, rotations = [], [], [], []
    for bone in bones:
        parent = skeleton.bones[bone.parent] if bone.parent else None
        parents.append(names.index(bone.parent) if bone.parent else -1)
        offsets.append(parent.direction * parent.length if parent else skeleton.position)
        moved, turn = _bone_motion(
            bone, values.get(bone.name, np.zeros((frames, 0))), frames, skeleton, degrees
        )
        positions.append(offsets[-1] + moved)
        rotations.append(turn.as_quat(scalar_first=True))
    for bone in leaves:
        names.append(f"{bone.name}_end")
        parents.append(names.index(bone.name))
        offsets.append(bone.direction * bone.length)
        positions.append(np.tile(offsets[-1], (frames, 1)))
        rotations.append(np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)))
    return Recording(
        tuple(names), tuple(parents), np.array(offsets), np.stack(positions, axis=1),
        np.stack(rotations, axis=1), 1.0 / AMC_RATE, metres_per_unit=INCH / skeleton.unit,
        remarks=("an AMC says no rate; 120 Hz is the convention",),
    )  # fmt: skip


def _bone_motion(
    bone: _Bone, rows: np.ndarray, frames: int, skeleton: _Skeleton, degrees: bool
) -> tuple[np.ndarray, Rotation]:
    """What a bone's channels add to its place, and its local rotation C M C⁻¹."""
    angles, order = bone.axis
    rest = Rotation.from_euler(order.lower(), angles, degrees=skeleton.degrees)
    moved, turns = np.zeros((frames, 3)), np.zeros((frames, 3))
    for column, freedom in enumerate(bone.freedoms):
        if freedom in ROTATIONS:
            turns[:, order.index(freedom[1].upper())] = rows[:, column]
        else:
            moved[:, "xyz".index(freedom[1])] = rows[:, column]
    # Lower-case letters are SciPy's turns about axes at rest: x first, then y, then z for "xyz".
    return moved, rest * Rotation.from_euler(order.lower(), turns, degrees=degrees) * rest.inv()
