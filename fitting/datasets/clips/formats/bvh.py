"""Reader of Biovision BVH files.

It is lenient where files in circulation differ: any line ending, tabs or blanks, any spacing in
`End Site` and `Frames:`, any channel and rotation order per joint, and position channels that
replace the offset of any joint. Angles are in degrees. End sites become joints named
`<parent>_end`.

Existing libraries failed on the reference files: pybvh refuses joints with six channels,
upc-pymotion reads those wrongly without an error and fails on roots that list rotations first, and
bvhio 1.5.4 is correct but works in float32 and takes 9 s for 994 frames.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.recording import Recording

CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)


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
    """NaN for what is no number."""
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
