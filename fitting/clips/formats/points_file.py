"""Places of named points over time: tables (.trc, .csv) and arrays (.npy, .npz)."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from fitting.clips.clip import FASTEST, FURTHEST, SLOWEST

from . import npz
from .c3d_file import UNITS, Markers
from .npz import Wanted

RATE = 30.0  # Hz, where none is stated
UNTIMED = (
    f"no frame rate is stated: taken as {RATE:g} Hz; an .npz with `fps` beside `positions` states "
    "it, a table has a column `time` (fps=... in Python)"
)
# Joints of the SMPL body model in its order, as AMASS and HumanML3D store them; the last two lack
# in files of 22.
SMPL = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar",
    "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
SMPL_SIZES = (22, 24)
COLUMN = re.compile(
    r"(?P<name>.+?)[ _.:-]*(?P<axis>[xyz])(?:[ _]*[\[(]?(?P<unit>mm|cm|m)[\])]?)?", re.IGNORECASE
)
TIME = re.compile(r"(time|t)(?:[ _]*[\[(]?(s|sec|seconds)[\])]?)?", re.IGNORECASE)
TRC_HEAD = 5  # lines
FARTHEST = FURTHEST / min(UNITS.values())  # of a point, in the file's unit
ARRAYS = {
    "positions": Wanted("number", ("frames", "joints", 3), low=-FURTHEST, high=FURTHEST),
    "names": Wanted("text", ("joints",), distinct=True, optional=True),
    "fps": Wanted("number", low=SLOWEST, high=FASTEST, optional=True),
}


def read_table(path: Path) -> Markers:
    """The points of a table: a row a frame, in the first row the columns' names.

    Columns named NAME_x, NAME_y and NAME_z, at best with a unit as in NAME_x_mm, hold a point. A
    column `time` holds seconds. An empty cell is a point that was not seen.

    Raises:
        ValueError: without the file's name, but with the line: it is no such table.
    """
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines() or [""]
    delimiter = max(",;\t", key=lines[0].count)
    names, *rows = csv.reader(lines, delimiter=delimiter) if lines[0] else [[""]]
    columns: dict[str, dict[str, int]] = {}
    units: set[str] = set()
    for number, name in enumerate(names):
        if match := COLUMN.fullmatch(name.strip()):
            columns.setdefault(match["name"], {})[match["axis"].lower()] = number
            units |= {match["unit"].lower()} if match["unit"] else set()
    points = {name: at for name, at in columns.items() if len(at) == 3}
    if not points:
        raise ValueError(
            f"line 1: no point in the columns {[name.strip() for name in names][:8]}; wanted "
            "NAME_x, NAME_y and NAME_z of each"
        )
    values = _numbers(rows, len(names), 2)
    times = [number for number, name in enumerate(names) if TIME.fullmatch(name.strip())]
    frame_time = _frame_time(values[:, times[0]]) if times else None
    order = [[at[axis] for axis in "xyz"] for at in points.values()]
    stated = UNITS[units.pop()] if len(units) == 1 else None
    return _markers(tuple(points), values[:, order], frame_time, stated)


def read_trc(path: Path) -> Markers:
    """The markers of a TRC file, as OpenSim and Motion Analysis write them.

    Raises:
        ValueError: without the file's name, but with the line: it is no such file.
    """
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    if len(lines) <= TRC_HEAD or not lines[0].startswith("PathFileType"):
        raise ValueError(
            f"{len(lines)} lines that begin with {lines[0][:20] if lines else ''!r}; wanted "
            f"PathFileType, and more than {TRC_HEAD}"
        )
    stated = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    names = tuple(name.strip() for name in lines[3].split("\t")[2:] if name.strip())
    if not names:
        raise ValueError("line 4: no names of markers behind Frame# and Time")
    rows = [line.split("\t") for line in lines[TRC_HEAD:]]
    values = _numbers(rows, 2 + 3 * len(names), TRC_HEAD + 1)
    rate = _number_of(stated.get("DataRate", ""))
    frame_time = 1.0 / rate if rate and SLOWEST <= rate <= FASTEST else _frame_time(values[:, 1])
    unit = UNITS.get(stated.get("Units", "").strip().lower())
    return _markers(names, values[:, 2:].reshape(len(values), -1, 3), frame_time, unit)


def read_array(path: Path) -> Markers:
    """The points of an array (frames, joints, 3): of 22 or 24 those of SMPL, else by number.

    Raises:
        ValueError: it is no such array of numbers.
    """
    array = npz.read_array(path)
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind not in "fiu" or not array.size:
        raise ValueError(f"holds {array.dtype} {array.shape}; wanted numbers (frames, joints, 3)")
    return _of_array(array, None, None)


def read_archive(path: Path) -> Markers:
    """The points of an archive with the array `positions`, at best with `names` and `fps`.

    Raises:
        ValueError: those are not finite (frames, joints, 3), (joints,) of text, and a number.
    """
    content = npz.read_arrays(path)
    npz.check_arrays(path, content, ARRAYS)
    names = content.get("names")
    frame_time = 1.0 / float(content["fps"]) if "fps" in content else None
    return _of_array(content["positions"], None if names is None else names.tolist(), frame_time)


def holds_points(path: Path) -> bool:
    """Whether a file is an archive of points, not of a clip."""
    names = npz.array_names(path) if path.suffix.lower() == ".npz" else ()
    return "positions" in names and "format" not in names and "pelvis_rot" not in names


READERS = {".trc": read_trc, ".csv": read_table, ".npy": read_array}
"""By the suffix."""


def _of_array(array: np.ndarray, names: Sequence[str] | None, frame_time: float | None) -> Markers:
    count, remarks = array.shape[1], []
    if names is None and count in SMPL_SIZES:
        names = SMPL[:count]
        remarks = [f"its {count} joints are taken for those of SMPL, in its order"]
    elif names is None:
        names, remarks = list(map(str, range(count))), ["its joints are named by number, from 0"]
    return _markers(tuple(names), array.astype(np.float64), frame_time, None, *remarks)


def _markers(
    names: tuple[str, ...],
    positions: Float64[np.ndarray, "frames points 3"],
    frame_time: float | None,
    unit: float | None,
    *remarks: str,
) -> Markers:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{names.count(twice)} points are named {twice!r}; wanted unique names")
    with np.errstate(invalid="ignore"):
        far = np.argwhere(np.abs(positions) > FARTHEST)
    if len(far):
        frame, point, axis = far[0]
        raise ValueError(
            f"{names[point]} is at {positions[frame, point, axis]:g} in frame {frame}; wanted "
            f"{FARTHEST:g} at most"
        )
    if frame_time is None:
        frame_time, remarks = 1.0 / RATE, (*remarks, UNTIMED)
    return Markers(names, positions, frame_time, unit, "", "", {}, remarks)


def _numbers(
    rows: Sequence[Sequence[str]], width: int, first: int
) -> Float64[np.ndarray, "frames columns"]:
    """The cells of all rows that are not empty; NaN where a cell is.

    Args:
        rows: of the file.
        width: how many cells there are at most; missing ones at the end are empty.
        first: number of the first line.
    """
    table = []
    for number, row in enumerate(rows, first):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) > width and any(cell.strip() for cell in row[width:]):
            raise ValueError(f"line {number}: {len(row)} cells; wanted {width}")
        cells = [_cell(cell, number) for cell in row[:width]]
        table.append(cells + [np.nan] * (width - len(cells)))
    if not table:
        raise ValueError("no frames below its head")
    return np.array(table)


def _cell(text: str, line: int) -> float:
    if not text.strip():
        return np.nan
    number = _number_of(text)
    if number is None:
        raise ValueError(f"line {line}: {text.strip()[:20]!r} is not a number")
    return number


def _number_of(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _frame_time(times: Float64[np.ndarray, " frames"]) -> float | None:
    """s, between two frames at the given times; None if they say nothing."""
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) else np.nan
    return step if 1.0 / FASTEST <= step <= 1.0 / SLOWEST else None
