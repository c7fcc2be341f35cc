"""Biovision BVH files.

Reading is lenient where files in circulation differ: any line ending, tabs or blanks, any spacing
in `End Site` and `Frames:`, any channel and rotation order per joint, and position channels that
replace the offset of any joint. Angles are in degrees. End sites become joints named
`<parent>_end`. Existing libraries failed on the reference files: pybvh refuses joints with six
channels, upc-pymotion reads those wrongly without an error and fails on roots that list rotations
first, and bvhio 1.5.4 is correct but works in float32 and takes 9 s for 994 frames.

A clip that came from a BVH file is written into its hierarchy: the same joints, offsets, channels,
axes, unit and frame time. Any other clip gets a standard one: centimetres, y up, and angles in the
order ZXY. A joint whose channels cannot hold the motion, such as a knee that could only bend, gets
further ones, so that joint positions are always exact.
"""

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from fitting.clips.assemble import common_rate
from fitting.clips.clip import Y_UP_FROM_Z_UP, Clip, Recording, local_from_world
from fitting.clips.rigs import rotation

CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)

STANDARD_SCALE = 0.01  # m per unit of a file
STANDARD_ORDER = "ZXY"
SHIFT = 5e-6  # m; a joint that moves further against its parent needs position channels
TURN = 1e-5  # degrees; a joint that turns further about an axis needs a channel for it
LENGTH_DIGITS = 7  # after the point, of metres
ANGLE_DIGITS = 6  # after the point, of degrees


def read_bvh(path: Path) -> Recording:
    """The joints and motion of a BVH file, in its own units and axes.

    Frames beyond the declared count are left out with a remark.

    Raises:
        ValueError: with file and line, where the text is not BVH, a number is missing, superfluous
            or not finite, a joint has no offset or states something twice, or there are fewer
            frames than declared.
    """
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return _Reader(path, lines).read()


def _as_number(word: str) -> float:
    """NaN for what is not a number."""
    try:
        return float(word)
    except ValueError:
        return np.nan


class _Reader:
    """Parses the lines of one file in order; `index` is that of the current line."""

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path, self.lines, self.index = path, lines, -1
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[list[tuple[str, str]]] = []  # per joint, of (axis, position | rotation)
        self.spellings: list[list[str]] = []  # the same, as in the file
        self.stated: set[tuple[int, str]] = set()  # joints and what of them has been read

    def read(self) -> Recording:
        if self._next("HIERARCHY").upper() != "HIERARCHY":
            raise self._error("wanted HIERARCHY, the first line of a BVH file")
        self._hierarchy()
        frames, frame_time = self._header()
        values, remarks = self._values(frames)
        positions_ls, rotations_ls = self._motion(values)
        return Recording(
            tuple(self.names), tuple(self.parents), np.array(self.offsets, np.float64),
            positions_ls, rotations_ls, frame_time, channels=tuple(map(" ".join, self.spellings)),
            remarks=remarks,
        )  # fmt: skip

    def _error(self, what: str, word: str | None = None) -> ValueError:
        """What is wrong in the current line, or with one word of it."""
        at_end = self.index >= len(self.lines)
        line = "the end of the file" if at_end else self.lines[self.index].strip()
        line = line if len(line) <= 60 else line[:57] + "..."
        number = min(self.index, len(self.lines)) + 1
        return ValueError(f"{self.path}:{number}: {what}; got {word or line!r}")

    def _next(self, wanted: str) -> str:
        """Moves to the next line that is not empty and returns it, stripped."""
        self.index += 1
        while self.index < len(self.lines) and not self.lines[self.index].strip():
            self.index += 1
        if self.index >= len(self.lines):
            raise self._error(f"wanted {wanted}")
        return self.lines[self.index].strip()

    def _numbers(self, words: list[str], names: Sequence[str], where: str) -> list[float]:
        """The numbers with these names, which the message for a wrong one says."""
        if len(words) != len(names):
            raise self._error(f"wanted {len(names)} numbers of {where}, there are {len(words)}")
        numbers = [_as_number(word) for word in words]
        if not np.all(np.isfinite(numbers)):
            index = int(np.argmin(np.isfinite(numbers)))
            raise self._error(f"wanted a finite number as {names[index]} in {where}", words[index])
        return numbers

    def _hierarchy(self) -> None:
        """Reads joints up to MOTION; `open_joints` are those whose brace is still open."""
        open_joints: list[int] = []
        while True:
            words = self._next("JOINT, End Site, OFFSET, CHANNELS, } or MOTION").split()
            keyword = words[0].upper()
            if keyword in ("ROOT", "JOINT", "END"):
                self._begin(keyword, words, open_joints)
            elif keyword == "OFFSET" and open_joints:
                self._state(open_joints[-1], keyword)
                where = f"OFFSET of {self.names[open_joints[-1]]}"
                self.offsets[open_joints[-1]] = self._numbers(words[1:], "xyz", where)
            elif keyword == "CHANNELS" and open_joints:
                self._state(open_joints[-1], keyword)
                self.channels[open_joints[-1]] = self._channels(words)
                self.spellings[open_joints[-1]] = words[2:]
            elif keyword == "}" and open_joints:
                if (joint := open_joints.pop(), "OFFSET") not in self.stated:
                    raise self._error(f"wanted OFFSET of {self.names[joint]} before its end")
            elif keyword == "MOTION" and self.names and not open_joints:
                return
            else:
                where = f"in {self.names[open_joints[-1]]}" if open_joints else "outside a joint"
                raise self._error(
                    f"wanted JOINT, End Site, OFFSET, CHANNELS, }} or MOTION ({where})"
                )

    def _state(self, joint: int, keyword: str) -> None:
        if (joint, keyword) in self.stated:
            raise self._error(f"wanted {keyword} of {self.names[joint]} once")
        self.stated.add((joint, keyword))

    def _begin(self, keyword: str, words: list[str], open_joints: list[int]) -> None:
        if (keyword == "ROOT") != (not self.names) or (keyword != "ROOT" and not open_joints):
            raise self._error("wanted one ROOT, first, with all other joints inside it")
        braced = words[-1] == "{"  # on the line of its joint instead of the next one
        name = " ".join(words[1 : -1 if braced else None])
        if keyword == "END":
            name = f"{self.names[open_joints[-1]]}_end"
            name += str(self.names.count(name) + 1) if name in self.names else ""
        if not name or name in self.names:
            raise self._error("wanted a joint name that is not taken yet")
        self.names.append(name)
        self.parents.append(open_joints[-1] if open_joints else -1)
        self.offsets.append([0.0, 0.0, 0.0])
        self.channels.append([])
        self.spellings.append([])
        open_joints.append(len(self.names) - 1)
        if not braced and self._next("{") != "{":
            raise self._error(f"wanted {{ after joint {name}")

    def _channels(self, words: list[str]) -> list[tuple[str, str]]:
        matches = [CHANNEL.fullmatch(word) for word in words[2:]]
        if len(words) < 2 or words[1] != str(len(matches)) or None in matches:
            raise self._error("wanted CHANNELS, a count and as many of [XYZ](position|rotation)")
        channels = [(match[1].lower(), match[2].lower()) for match in matches if match]
        if len(set(channels)) < len(channels):
            raise self._error("wanted each channel once")
        return channels

    def _header(self) -> tuple[int, float]:
        """The declared number of frames and the frame time, s."""
        match = re.fullmatch(r"Frames\s*:\s*(\d{1,18})", self._next("Frames:"), re.IGNORECASE)
        if not match or int(match[1]) < 1:
            raise self._error("wanted 'Frames:' and a whole number from 1 up")
        frames = int(match[1])
        match = re.fullmatch(r"Frame\s+Time\s*:\s*(\S+)", self._next("Frame Time:"), re.IGNORECASE)
        if not match:
            raise self._error("wanted 'Frame Time:' and seconds")
        (frame_time,) = self._numbers([match[1]], ["seconds"], "Frame Time")
        if frame_time <= 0:
            raise self._error("wanted a frame time above 0 s")
        return frames, frame_time

    def _values(self, frames: int) -> tuple[np.ndarray, tuple[str, ...]]:
        """The channel values, (frames, channels), and remarks."""
        joints = zip(self.names, self.spellings, strict=True)
        names = [f"{channel} of {joint}" for joint, channels in joints for channel in channels]
        values = []
        for frame in range(frames):
            words = self._next(f"frame {frame + 1} of {frames} declared").split()
            values.append(self._numbers(words, names, f"frame {frame + 1}"))
        surplus = sum(bool(line.strip()) for line in self.lines[self.index + 1 :])
        remark = f"{frames} frames are declared and {frames + surplus} found; the rest is left out"
        array = np.array(values, np.float64).reshape(frames, len(names))
        return array, (remark,) if surplus else ()

    def _motion(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Local positions, file units, and local rotations, wxyz, of all joints."""
        frames, joints = len(values), len(self.names)
        positions_ls = np.tile(np.array(self.offsets, np.float64), (frames, 1, 1))
        rotations_ls = np.tile([1.0, 0.0, 0.0, 0.0], (frames, joints, 1))
        column = 0
        for joint, channels in enumerate(self.channels):
            rot = Rotation.identity(frames)
            for axis, kind in channels:
                if kind == "position":
                    positions_ls[:, joint, "xyz".index(axis)] = values[:, column]
                else:
                    rot = rot * Rotation.from_euler(axis, values[:, [column]], degrees=True)
                column += 1
            rotations_ls[:, joint] = rot.as_quat(scalar_first=True)
        return positions_ls, rotations_ls


@dataclass(frozen=True)
class _Joint:
    name: str
    offset: Float64[np.ndarray, "3"]
    channels: list[str]
    values: Float64[np.ndarray, "frames channels"]
    is_end: bool
    """An end site, which the file does not name."""


def check_one_root(path: Path, clip: Clip) -> None:
    """ValueError unless the clip has a single root, as a BVH file has."""
    roots = [name for name, up in zip(clip.joint_names, clip.parents, strict=True) if up < 0]
    if len(roots) > 1:
        raise ValueError(f"{path}: a BVH file has one root; this clip has {roots}")


def bvh_text(clip: Clip) -> tuple[str, tuple[str, ...]]:
    """The content of a BVH file, and the names of joints that got other channels than their own.

    Args:
        clip: with a single root.
    """
    scale, axes = _unit_and_axes(clip)
    turn = Rotation.from_matrix(axes)
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    offsets = clip.offsets_ls if clip.channels else np.median(positions_ls, axis=0)
    own = [_own_channels(clip, joint) for joint in range(len(clip.parents))]
    orders = [_order(channels) for channels in own]
    rotations = [turn * rotation(wxyz) * turn.inv() for wxyz in np.moveaxis(rotations_ls, 1, 0)]
    angles = _continuous_angles(orders, rotations)
    joints = []
    for joint, name in enumerate(_names(clip)):
        is_root = clip.parents[joint] < 0
        offset = np.zeros(3) if is_root and not clip.channels else axes @ offsets[joint]
        channels, values = _channels(
            own[joint], positions_ls[:, joint] @ axes.T, offset, orders[joint], angles[:, joint]
        )
        lengths = [_is_position(channel) for channel in channels]
        values = values / np.where(lengths, scale, 1.0)
        is_end = not channels and _is_end(clip, joint)
        joints.append(_Joint(name, offset / scale, channels, values, is_end))
    expected = own if clip.channels is None else map(str.split, clip.channels)
    changed = tuple(
        joint.name
        for joint, channels in zip(joints, expected, strict=True)
        if joint.channels != channels
    )
    return _text(clip, joints, scale), changed


def _unit_and_axes(clip: Clip) -> tuple[float, Float64[np.ndarray, "3 3"]]:
    """Metres per unit of the file, and the rotation matrix from y up to the file's axes."""
    if clip.channels is None:
        return STANDARD_SCALE, np.eye(3)
    return clip.scale, Y_UP_FROM_Z_UP.T if clip.up_axis == "z" else np.eye(3)


def _is_position(channel: str) -> bool:
    return channel.lower().endswith("position")


def _is_end(clip: Clip, joint: int) -> bool:
    """Whether a joint without channels is the end of its parent and not a joint with a name."""
    parent = clip.parents[joint]
    is_leaf = joint not in clip.parents
    return (
        parent >= 0
        and is_leaf
        and clip.joint_names[joint].startswith(f"{clip.joint_names[parent]}_end")
    )


def _own_channels(clip: Clip, joint: int) -> list[str]:
    """Those of the file that the clip came from, or else the standard ones.

    Angles about one axis twice cannot be found again: such a joint gets the standard order.
    """
    standard = [f"{axis}rotation" for axis in STANDARD_ORDER]
    if clip.channels is not None:
        channels = clip.channels[joint].split()
        turns = [channel[0].upper() for channel in channels if not _is_position(channel)]
        if len(set(turns)) == len(turns):
            return channels
        return [*filter(_is_position, channels), *standard]
    if _is_end(clip, joint):
        return []
    positions = [f"{axis}position" for axis in "XYZ"] if clip.parents[joint] < 0 else []
    return positions + standard


def _order(channels: list[str]) -> str:
    """Three different axes of rotation, as of `Rotation.as_euler`; the joint's own come first."""
    own = [channel[0].upper() for channel in channels if not _is_position(channel)]
    return "".join([*own, *(axis for axis in STANDARD_ORDER if axis not in own)])


def _continuous_angles(
    orders: list[str], rotations: list[Rotation]
) -> Float64[np.ndarray, "frames joints 3"]:
    """Angles about each joint's axes, degrees, which change as little as possible over the frames.

    Three angles have a second set for the same rotation, and each of them may make whole turns.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")  # one of its many sets will do
        first = np.stack(
            [
                rot.as_euler(order, degrees=True)
                for order, rot in zip(orders, rotations, strict=True)
            ],
            axis=1,
        )
    sets = np.stack([first, first * [1.0, -1.0, 1.0] + 180.0])
    angles = np.empty_like(first)
    last = np.zeros(first.shape[1:])
    for frame in range(len(first)):
        near = sets[:, frame] - 360.0 * np.round((sets[:, frame] - last) / 360.0)
        distance = np.abs(near - last).sum(axis=-1, keepdims=True)
        last = np.where(distance[0] <= distance[1], near[0], near[1])
        angles[frame] = last
    return angles


def _channels(
    own: list[str],
    position: Float64[np.ndarray, "frames 3"],
    offset: Float64[np.ndarray, "3"],
    order: str,
    angles: Float64[np.ndarray, "frames 3"],
) -> tuple[list[str], Float64[np.ndarray, "frames channels"]]:
    """The joint's own channels with those that it needs besides, and their values, m and degrees.

    Args:
        own: channels.
        position: in the parent's space and the axes of the file, m.
        offset: of the rest pose, in the same axes, m.
        order: axes of the angles.
        angles: degrees.
    """
    columns = {f"{axis}position": position[:, "XYZ".index(axis)] for axis in "XYZ"}
    columns |= {f"{axis}rotation": angles[:, order.index(axis)] for axis in order}
    known = {channel.capitalize() for channel in own}
    shift = np.abs(position - offset).max(axis=0)
    moved = [f"{axis}position" for axis, by in zip("XYZ", shift, strict=True) if by > SHIFT]
    turn = np.abs(angles).max(axis=0)
    turned = [f"{axis}rotation" for axis, by in zip(order, turn, strict=True) if by > TURN]
    channels = [
        *(channel for channel in moved if channel not in known),
        *own,
        *(channel for channel in turned if channel not in known),
    ]
    values = [columns[channel.capitalize()] for channel in channels]
    return channels, np.stack(values, axis=1) if values else np.zeros((len(position), 0))


def _names(clip: Clip) -> list[str]:
    """Joint names without what would end them in a file; other files may have blanks in theirs."""
    blank = "_" if clip.channels is None else " "
    names: list[str] = []
    for name in clip.joint_names:
        name = blank.join(name.split()) or "joint"
        names.append(name if name not in names else f"{name}_{len(names)}")
    return names


def _text(clip: Clip, joints: list[_Joint], scale: float) -> str:
    tree = _preorder(clip.parents)
    is_usual = common_rate(clip.raw_frame_time, []) == clip.fps
    frame_time = clip.raw_frame_time if is_usual else 1.0 / clip.fps
    lines = ["HIERARCHY", *_hierarchy(clip, joints, tree), "MOTION"]
    lines += [f"Frames: {clip.frame_count}", f"Frame Time: {_positional(frame_time)}"]
    length = f"%.{max(0, LENGTH_DIGITS + int(np.floor(np.log10(scale))))}f"
    row = " ".join(
        length if _is_position(channel) else f"%.{ANGLE_DIGITS}f"
        for joint, _ in tree
        for channel in joints[joint].channels
    )
    values = np.concatenate([joints[joint].values for joint, _ in tree], axis=1)
    lines += [row % tuple(frame) for frame in values.tolist()]
    return "\n".join(lines) + "\n"


def _hierarchy(clip: Clip, joints: list[_Joint], tree: list[tuple[int, int]]) -> Iterator[str]:
    """The lines between HIERARCHY and MOTION."""
    open_depth = -1
    for joint, depth in tree:
        this, indent = joints[joint], "\t" * depth
        yield from ("\t" * level + "}" for level in range(open_depth, depth - 1, -1))
        open_depth = depth
        named = f"{'JOINT' if depth else 'ROOT'} {this.name}"
        yield f"{indent}{'End Site' if this.is_end else named}"
        yield f"{indent}{{"
        yield f"{indent}\tOFFSET {' '.join(map(_ten_digits, this.offset))}"
        if not this.is_end:
            yield f"{indent}\t{' '.join(['CHANNELS', str(len(this.channels)), *this.channels])}"
            if clip.channels is None and joint not in clip.parents:  # the format asks for an end
                yield from (
                    f"{indent}\t{line}" for line in ("End Site", "{", "\tOFFSET 0 0 0", "}")
                )
    yield from ("\t" * level + "}" for level in range(open_depth, -1, -1))


def _preorder(parents: tuple[int, ...]) -> list[tuple[int, int]]:
    """Each joint with its depth in the tree, children directly after their parents."""
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(parents):
        children.setdefault(parent, []).append(joint)
    tree, waiting = [], [(parents.index(-1), 0)]
    while waiting:
        joint, depth = waiting.pop()
        tree.append((joint, depth))
        waiting += [(child, depth + 1) for child in reversed(children.get(joint, []))]
    return tree


def _ten_digits(value: float) -> str:
    """A number with ten digits."""
    return _positional(float(f"{value:.10g}"))


def _positional(value: float) -> str:
    """A number with as many digits as it needs, which never end in a power of ten."""
    return np.format_float_positional(value + 0.0, trim="-")
