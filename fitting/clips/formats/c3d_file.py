"""The markers of a C3D file: their names, places and gaps, and what the file says of them.

Header, parameters and points are read as the C3D User Guide has them. Whatever they claim has to
lie within the file, which also bounds the memory that reading takes. Analog values are skipped.
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

from fitting.clips.clip import FASTEST, SLOWEST

BLOCK = 512  # bytes
KEY = 0x50  # second byte of every C3D file
DEC = 85
Order = Literal["little", "big"]
ORDERS: dict[int, Order] = {84: "little", DEC: "little", 86: "big"}  # Intel, DEC and MIPS
TEXT, FLOAT = -1, 4
WIDTHS = {TEXT: 1, 1: 1, 2: 2, FLOAT: 4}  # bytes of a value, by the type of a parameter
MOST_DIMENSIONS = 7

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
AXES = {
    f"{sign}{letter}": (1.0 if sign != "-" else -1.0) * np.eye(3)[axis]
    for axis, letter in enumerate("XYZ")
    for sign in ("", "+", "-")
}
# What models compute of markers, and store as points: parameters that list it, and ends of names.
OUTPUTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
OUTPUT_NAME = re.compile("(angle|force|moment|power|grf)s?$", re.IGNORECASE)
NAMED = 8  # points, in a remark


@dataclass(frozen=True)
class Parameter:
    """A parameter as it lies in the file."""

    kind: int
    """Type of its values: -1 text, 1 bytes, 2 integers, 4 floats."""
    shape: tuple[int, ...]
    content: bytes


class Structure:
    """The header of a file, its parameters by the names of group and parameter, and its points.

    Raises:
        ValueError: without the file's name, where what it claims does not lie within the file.
    """

    def __init__(self, content: bytes):
        if len(content) < 2 * BLOCK or content[1] != KEY or not content[0]:
            raise ValueError(
                f"{len(content)} bytes that begin with {content[:2].hex(' ') or 'nothing'}; wanted "
                f"a C3D file, whose second byte is {KEY:x}, of at least {2 * BLOCK}"
            )
        self.content = content
        start = (content[0] - 1) * BLOCK
        if start + 4 > len(content) or content[start + 3] not in ORDERS or start < BLOCK:
            raise ValueError(
                f"its parameters are said to begin at byte {start} of {len(content)}, where there "
                f"are none; wanted the kind of processor, {list(ORDERS)}, in their fourth byte"
            )
        self._processor = content[start + 3]
        self._order: Order = ORDERS[self._processor]
        self.parameters = self._read_parameters(start + 4)

    def texts(self, group: str, name: str) -> list[str]:
        """What a parameter holds, without blanks around; empty if it is not there or no text."""
        parameter = self.parameters.get((group, name))
        if parameter is None or parameter.kind != TEXT or not parameter.content:
            return []
        width = parameter.shape[0]
        starts = range(0, len(parameter.content), width)
        texts = [parameter.content[start : start + width] for start in starts]
        return [text.decode(errors="replace").strip(" \0") for text in texts]

    def numbers(self, group: str, name: str) -> Float64[np.ndarray, " values"]:
        """What a parameter holds, integers without a sign; empty if it is not there or text."""
        parameter = self.parameters.get((group, name))
        if parameter is None or parameter.kind == TEXT:
            return np.zeros(0)
        if parameter.kind == FLOAT:
            return self._floats(parameter.content)
        return self._array(parameter.content, f"u{WIDTHS[parameter.kind]}").astype(np.float64)

    def number(self, group: str, name: str) -> float:
        """The first number of a parameter; 0 if there is none."""
        return float(next(iter(self.numbers(group, name)), 0.0))

    def points(self) -> Float64[np.ndarray, "frames points 4"]:
        """Places in the file's unit and axes, and a number with a minus where nothing was seen.

        Raises:
            ValueError: without the file's name, where header and parameters contradict each other,
                or more is claimed than the file holds.
        """
        count, first, last = (self._word(number) for number in (2, 4, 5))
        used = self.numbers("POINT", "USED")
        if len(used) and used[0] != count:
            raise ValueError(f"{count} markers in the header, and {used[0]:g} in POINT:USED")
        scales = self.numbers("POINT", "SCALE")
        scale = scales[0] if len(scales) else self._floats(self.content[12:16])[0]
        width = 4 if scale < 0 else 2  # bytes of a value: floats where the scale is negative
        frames, begin = max(last - first + 1, 0), (self._word(9) - 1) * BLOCK
        samples = self._samples(frames * width, 4 * count, len(self.content) - begin)
        size = frames * width * (4 * count + samples)
        if begin < BLOCK or begin + size > len(self.content):
            raise ValueError(
                f"{frames} frames of {count} markers and {samples} analog values begin at byte "
                f"{begin} and take {size} bytes; the file has {len(self.content)}"
            )
        content = self.content[begin : begin + size]
        if scale < 0:
            values = self._floats(content)
        else:
            with np.errstate(all="ignore"):  # what is not finite was not seen
                values = self._array(content, "i2") * scale
        values = values.reshape(frames, 4 * count + samples)[:, : 4 * count]
        return values.reshape(frames, count, 4)

    def _samples(self, column: int, coordinates: int, room: int) -> int:
        """Analog values beside the points of a frame.

        Where the header and the parameters contradict each other, that number is right with which
        the data, or the block in which they end, end with the file.

        Args:
            column: bytes that a value of each frame takes.
            coordinates: values of each frame that belong to points.
            room: bytes from the first frame to the end of the file.
        """
        samples = self._word(3)
        channels = self.numbers("ANALOG", "USED")
        rate, point_rate = self.number("ANALOG", "RATE"), self.number("POINT", "RATE")
        times = rate / point_rate if rate > 0 and point_rate > 0 else self._word(10)
        if not len(channels) or not times:
            return samples
        stated = float(channels[0]) * times
        if not 0 <= stated < np.inf or round(stated) == samples:
            return samples
        counts = (samples, round(stated))
        sizes = [column * (coordinates + n) for n in counts]
        ends = [room in (size, math.ceil(size / BLOCK) * BLOCK) for size in sizes]
        if sum(ends) != 1:
            raise ValueError(
                f"{counts[0]} analog values a frame in the header, and {counts[1]} by ANALOG:USED "
                "and the rates, and the file's length does not show which is right; "
                "export it again"
            )
        return counts[ends.index(True)]

    def _word(self, number: int) -> int:
        """A word of the header, counted from 1 as in the guide, without a sign."""
        return int.from_bytes(self.content[2 * number - 2 : 2 * number], self._order)

    def _array(self, content: bytes, kind: str) -> np.ndarray:
        return np.frombuffer(content, np.dtype(kind).newbyteorder(self._order))

    def _floats(self, content: bytes) -> Float64[np.ndarray, " values"]:
        with np.errstate(all="ignore"):  # of values that are not numbers
            if self._processor != DEC:
                return self._array(content, "f4").astype(np.float64)
            swapped = self._array(content, "u2").reshape(-1, 2)[:, ::-1].tobytes()
            return self._array(swapped, "f4") / 4.0  # the bias of the exponent is 2 more

    def _read_parameters(self, start: int) -> dict[tuple[str, str], Parameter]:
        groups: dict[int, str] = {}
        parameters: dict[tuple[int, str], Parameter] = {}
        for number, name, at, end in self._entries(start):
            if number < 0:
                if -number in groups:
                    raise ValueError(f"two groups of parameters have the number {-number}")
                groups[-number] = name
                self._check_description(name, at, end)
            elif (number, name) in parameters:
                raise ValueError(f"the parameter {name} is twice in group {number}")
            else:
                parameters[number, name] = self._read_parameter(name, at, end)
        return {  # without those of a group that is not there
            (groups[number], name): value
            for (number, name), value in parameters.items()
            if number in groups
        }

    def _entries(self, start: int) -> Iterator[tuple[int, str, int, int]]:
        """Number, name and place of each entry; that of a group is negative."""
        at = start
        while True:
            length, number = self._signed(at), self._signed(at + 1)
            if not length:
                return
            name_end = at + 2 + abs(length)
            raw = self.content[at + 2 : name_end]
            if not number or not raw.isascii() or not raw.decode("ascii").isprintable():
                raise ValueError(f"no name of a parameter at byte {at}, but {raw[:20]!r}")
            step = int.from_bytes(self.content[name_end : name_end + 2], self._order)
            end = name_end + step if step else len(self.content)
            if end > len(self.content) or 0 < step < 3:
                raise ValueError(
                    f"the parameter {raw.decode('ascii')} ends at byte {end} of {len(self.content)}"
                )
            yield number, raw.decode("ascii").strip().upper(), name_end + 2, end
            if not step:
                return
            at = end

    def _signed(self, at: int) -> int:
        if at >= len(self.content):
            raise ValueError(f"its parameters do not end within its {len(self.content)} bytes")
        return int.from_bytes(self.content[at : at + 1], signed=True)

    def _read_parameter(self, name: str, at: int, end: int) -> Parameter:
        kind, dimensions = self._signed(at), self._signed(at + 1)
        fewest = 1 if kind == TEXT else 0
        if kind not in WIDTHS or not fewest <= dimensions <= MOST_DIMENSIONS:
            raise ValueError(
                f"the parameter {name} has values of type {kind} in {dimensions} dimensions; "
                f"wanted a type of {list(WIDTHS)}, and {fewest} to {MOST_DIMENSIONS}"
            )
        first = at + 2 + dimensions
        shape = tuple(self.content[at + 2 : first])
        last = first + WIDTHS[kind] * math.prod(shape)
        if last > end:
            raise ValueError(
                f"the parameter {name} of shape {shape} ends at byte {last}; the next begins "
                f"at {end}"
            )
        self._check_description(name, last, end)
        return Parameter(kind, shape, self.content[first:last])

    def _check_description(self, name: str, at: int, end: int) -> None:
        if at >= end or at + 1 + self.content[at] > end:
            raise ValueError(f"the description of the parameter {name} does not end before {end}")


@dataclass(frozen=True, eq=False)
class Markers:
    """Points in the file's unit and axes; NaN where a marker was not seen."""

    names: tuple[str, ...]
    """Unique, as in the file but for blanks around them."""
    positions: Float64[np.ndarray, "frames markers 3"]
    frame_time: float
    """Seconds."""
    metres_per_unit: float | None
    """None where the file does not state a unit."""
    right: str
    """Axis to the right on a screen (POINT:X_SCREEN), such as "+X"; empty if not stated."""
    up: str
    """Axis upwards on a screen (POINT:Y_SCREEN); empty if not stated."""
    measures: Mapping[str, float]
    """What was measured on the subject (PROCESSING), mm, by names in capitals."""
    remarks: tuple[str, ...] = ()

    @cached_property
    def seen(self) -> Bool[np.ndarray, "frames markers"]:
        """Where each marker was seen."""
        return np.asarray(np.isfinite(self.positions).all(axis=-1))


def read_markers(path: Path) -> Markers:
    """The markers of a file.

    A marker was not seen where its residual is below 0, or where it lies exactly at the origin.
    Angles, forces and other numbers that a model has computed are not markers.

    Raises:
        ValueError: without the file's name, where it is not a whole C3D file, has no markers, no
            frames or no rate.
    """
    structure = Structure(path.read_bytes())
    points = structure.points()
    frames, count, _ = points.shape
    if not count:
        raise ValueError("no markers, only analog channels; wanted a C3D file of motion")
    if not frames:
        raise ValueError(f"no frames of its {count} markers")
    labels = (_labels(structure, "LABELS") + [""] * count)[:count]
    stated = _stated_outputs(structure)
    guessed = [name for name in labels if name not in stated and OUTPUT_NAME.search(name)]
    selected = [n for n, label in enumerate(labels) if label not in stated and label not in guessed]
    if not selected:
        raise ValueError(f"no markers, only {count} angles, forces and the like; wanted markers")
    points, names = points[:, selected], _unique_names(labels)
    remark = f"taken for angles, forces or the like by their names, and left out: {listed(guessed)}"
    positions, lost = points[..., :3], np.signbit(points[..., 3])
    lost |= (positions == 0.0).all(axis=-1) | ~np.isfinite(positions).all(axis=-1)
    rate = structure.number("POINT", "RATE")
    if not SLOWEST <= rate <= FASTEST:
        raise ValueError(f"POINT:RATE is {rate:g} Hz; wanted {SLOWEST:g} to {FASTEST:g}")
    return Markers(
        names=tuple(names[n] for n in selected),
        positions=np.where(lost[..., None], np.nan, positions),
        frame_time=1.0 / rate,
        metres_per_unit=UNITS.get(_text(structure, "UNITS").lower()),
        right=_axis(structure, "X_SCREEN"),
        up=_axis(structure, "Y_SCREEN"),
        measures=_measures(structure),
        remarks=(remark,) if guessed else (),
    )


def listed(names: Sequence[str]) -> str:
    """The first names, with commas between."""
    return ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")


def _stated_outputs(structure: Structure) -> set[str]:
    """The points that the file itself lists as no places."""
    groups = [name.upper() for name in structure.texts("POINT", "TYPE_GROUPS")]
    groups = [name for name in groups if not name.endswith("UNITS") and "MARKER" not in name]
    return {label for group in (*OUTPUTS, *groups) for label in _labels(structure, group)}


def _text(structure: Structure, name: str) -> str:
    return next(iter(structure.texts("POINT", name)), "")


def _axis(structure: Structure, name: str) -> str:
    axis = _text(structure, name).upper()
    return axis if axis in AXES else ""


def _measures(structure: Structure) -> dict[str, float]:
    """Positive numbers only: a lab leaves 0 where nothing was measured."""
    names = [name for group, name in structure.parameters if group == "PROCESSING"]
    numbers = {name: structure.number("PROCESSING", name) for name in names}
    return {name: value for name, value in numbers.items() if 0 < value < np.inf}


def _unique_names(labels: Sequence[str]) -> list[str]:
    names: list[str] = []
    for index, label in enumerate(labels, start=1):
        label = label or f"unnamed {index}"
        names.append(label if label not in names else f"{label} ({index})")
    return names


def _labels(structure: Structure, name: str) -> list[str]:
    """Names of points; what is more than 255 of them goes on in `LABELS2` and so on."""
    labels: list[str] = []
    for number in itertools.count(1):
        more = structure.texts("POINT", name if number == 1 else f"{name}{number}")
        if not more:
            break
        labels += more
    return labels
