"""Reader of Biovision BVH.

Our own: of the libraries tried on the reference files, pybvh refuses joints with six channels,
upc-pymotion reads those wrongly without saying so and fails on roots that list rotations first, and
bvhio 1.5.4 (MIT, by one author) is right but works in float32 and takes 9 s for 994 frames.

Read as found in the wild: any line ends, tabs and blanks, `End Site` and `Frames:` with any space,
rotation order and channel order per joint, position channels that replace the offset of any joint.
Angles are degrees. End sites become joints named `<parent>_end`.
"""

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.recording import Recording

CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)


def read_bvh(path: Path) -> Recording:
    """The joints and motion of a BVH file, in its own units and axes.

    Errors: ValueError with file and line where the text is not BVH, a number is missing, not
    finite or too many, or fewer frames follow than are declared. More frames than declared are
    left out with a remark.
    """
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return _Reader(path, lines).read()


class _Reader:
    """Walks over the lines of one file; `at` is the index of the line under the eye."""

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path, self.lines, self.at = path, lines, -1
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[list[tuple[str, str]]] = []  # per joint: (axis, position | rotation)

    def read(self) -> Recording:
        if self._next("HIERARCHY").upper() != "HIERARCHY":
            raise self._error("wanted HIERARCHY, the first line of a BVH file")
        self._hierarchy()
        frames, frame_time = self._header()
        values, remarks = self._values(frames)
        positions_ls, rotations_ls = self._motion(values)
        return Recording(
            tuple(self.names), tuple(self.parents), np.array(self.offsets, np.float64),
            positions_ls, rotations_ls, frame_time, remarks=remarks,
        )  # fmt: skip

    def _error(self, what: str) -> ValueError:
        found = self.lines[self.at].strip() if self.at < len(self.lines) else "the end of the file"
        shown = found if len(found) <= 60 else found[:57] + "..."
        return ValueError(f"{self.path}:{min(self.at, len(self.lines)) + 1}: {what}; got {shown!r}")

    def _next(self, wanted: str) -> str:
        """The next line that is not empty, stripped."""
        self.at += 1
        while self.at < len(self.lines) and not self.lines[self.at].strip():
            self.at += 1
        if self.at >= len(self.lines):
            raise self._error(f"wanted {wanted}")
        return self.lines[self.at].strip()

    def _numbers(self, words: list[str], count: int, what: str) -> list[float]:
        try:
            numbers = [float(word) for word in words]
        except ValueError as error:
            raise self._error(f"wanted {count} numbers of {what} ({error})") from None
        if len(numbers) != count:
            raise self._error(f"wanted {count} numbers of {what}, there are {len(numbers)}")
        if not np.all(np.isfinite(numbers)):
            raise self._error(f"wanted finite numbers of {what}")
        return numbers

    def _hierarchy(self) -> None:
        """Reads joints until MOTION; `open_joints` are those whose brace is not closed yet."""
        open_joints: list[int] = []
        while True:
            # A brace may stand at the end of the line of its joint.
            words = self._next("JOINT, End Site, OFFSET, CHANNELS, } or MOTION").split()
            keyword = words[0].upper()
            if keyword in ("ROOT", "JOINT", "END"):
                self._begin(keyword, words, open_joints)
            elif keyword == "OFFSET" and open_joints:
                self.offsets[open_joints[-1]] = self._numbers(words[1:], 3, "OFFSET")
            elif keyword == "CHANNELS" and open_joints:
                self.channels[open_joints[-1]] = self._channels(words)
            elif keyword == "}" and open_joints:
                open_joints.pop()
            elif keyword == "MOTION" and self.names and not open_joints:
                return
            else:
                where = f"in {self.names[open_joints[-1]]}" if open_joints else "outside a joint"
                raise self._error(
                    f"wanted JOINT, End Site, OFFSET, CHANNELS, }} or MOTION ({where})"
                )

    def _begin(self, keyword: str, words: list[str], open_joints: list[int]) -> None:
        if (keyword == "ROOT") != (not self.names) or (keyword != "ROOT" and not open_joints):
            raise self._error("wanted one ROOT, first, with all other joints inside it")
        braced = words[-1] == "{"
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
        open_joints.append(len(self.names) - 1)
        if not braced and self._next("{") != "{":
            raise self._error(f"wanted {{ after joint {name}")

    def _channels(self, words: list[str]) -> list[tuple[str, str]]:
        matches = [CHANNEL.fullmatch(word) for word in words[2:]]
        if len(words) < 2 or words[1] != str(len(matches)) or None in matches:
            raise self._error("wanted CHANNELS, a count and as many of [XYZ](position|rotation)")
        return [(match[1].lower(), match[2].lower()) for match in matches if match]

    def _header(self) -> tuple[int, float]:
        """The declared number of frames and the frame time, s."""
        match = re.fullmatch(r"Frames\s*:\s*(\d+)", self._next("Frames:"), re.IGNORECASE)
        if not match or int(match[1]) < 1:
            raise self._error("wanted 'Frames:' and a whole number from 1 up")
        frames = int(match[1])
        match = re.fullmatch(r"Frame\s+Time\s*:\s*(\S+)", self._next("Frame Time:"), re.IGNORECASE)
        if not match:
            raise self._error("wanted 'Frame Time:' and seconds")
        (frame_time,) = self._numbers([match[1]], 1, "Frame Time")
        if frame_time <= 0:
            raise self._error("wanted a frame time above 0 s")
        return frames, frame_time

    def _values(self, frames: int) -> tuple[np.ndarray, tuple[str, ...]]:
        """The channel values, (frames, channels), and what there was to remark."""
        count = sum(map(len, self.channels))
        rows = []
        for frame in range(frames):
            words = self._next(f"frame {frame + 1} of {frames} declared").split()
            rows.append(self._numbers(words, count, f"frame {frame + 1}"))
        left = sum(bool(line.strip()) for line in self.lines[self.at + 1 :])
        remark = f"{frames} frames are declared and {frames + left} found; the rest is left out"
        return np.array(rows, np.float64).reshape(frames, count), (remark,) if left else ()

    def _motion(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Local positions, in file units, and rotations, wxyz, of all joints."""
        frames, joints = len(values), len(self.names)
        positions_ls = np.tile(np.array(self.offsets, np.float64), (frames, 1, 1))
        rotations_ls = np.tile([1.0, 0.0, 0.0, 0.0], (frames, joints, 1))
        column = 0
        for joint, channels in enumerate(self.channels):
            turn = Rotation.identity(frames)
            for axis, kind in channels:
                if kind == "position":
                    positions_ls[:, joint, "xyz".index(axis)] = values[:, column]
                else:
                    turn = turn * Rotation.from_euler(axis, values[:, [column]], degrees=True)
                column += 1
            rotations_ls[:, joint] = turn.as_quat(scalar_first=True)
        return positions_ls, rotations_ls
