"""Holds a C3D file against its own bytes before ezc3d opens it.

ezc3d ends the process with a segmentation fault, or never returns, where some bytes of a file are
damaged (3 % and 1 % of files with random damage, version 1.7.2). So the header and all parameters
are walked first, as the C3D User Guide describes them: whatever they claim has to lie within the
file, which also bounds the memory that reading takes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

BLOCK = 512  # bytes
KEY = 0x50  # second byte of every C3D file
Order = Literal["little", "big"]
PROCESSORS: dict[int, tuple[Order, int]] = {  # and the byte of a float that holds its sign
    84: ("little", 3),  # Intel
    85: ("little", 1),  # DEC
    86: ("big", 0),  # MIPS
}
WIDTHS = {-1: 1, 1: 1, 2: 2, 4: 4}  # bytes of a value, by the type of a parameter
TEXT, INTEGER, FLOAT = -1, 2, 4
MOST_DIMENSIONS = 7
KINDS = {  # of the parameters by which ezc3d finds its way
    "POINT": {
        "USED": {INTEGER}, "SCALE": {FLOAT}, "RATE": {FLOAT}, "DATA_START": {INTEGER},
        "FRAMES": {INTEGER, FLOAT}, "LABELS": {TEXT}, "DESCRIPTIONS": {TEXT}, "UNITS": {TEXT},
    },
    "ANALOG": {
        "USED": {INTEGER}, "RATE": {FLOAT}, "GEN_SCALE": {FLOAT}, "SCALE": {FLOAT},
        "OFFSET": {INTEGER}, "LABELS": {TEXT}, "DESCRIPTIONS": {TEXT}, "UNITS": {TEXT},
        "FORMAT": {TEXT},
    },
}  # fmt: skip


@dataclass(frozen=True)
class Parameter:
    """A parameter as it lies in the file."""

    kind: int
    """Type of its values: -1 text, 1 bytes, 2 integers, 4 floats."""
    shape: tuple[int, ...]
    content: bytes


class Structure:
    """The header of a file, and its parameters by the names of group and parameter."""

    def __init__(self, content: bytes):
        if len(content) < 2 * BLOCK or content[1] != KEY or not content[0]:
            raise ValueError(
                f"{len(content)} bytes that begin with {content[:2].hex(' ') or 'nothing'}; wanted "
                f"a C3D file, whose second byte is {KEY:x}, of at least {2 * BLOCK}"
            )
        self.content = content
        start = (content[0] - 1) * BLOCK
        if start + 4 > len(content) or content[start + 3] not in PROCESSORS or start < BLOCK:
            raise ValueError(
                f"its parameters are said to begin at byte {start} of {len(content)}, where there "
                f"are none; wanted the kind of processor, {list(PROCESSORS)}, in their fourth byte"
            )
        self.order: Order
        self.order, self.sign = PROCESSORS[content[start + 3]]
        self.parameters = self._read_parameters(start + 4)

    def word(self, number: int) -> int:
        """A word of the header, counted from 1 as in the guide, without a sign."""
        return int.from_bytes(self.content[2 * number - 2 : 2 * number], self.order)

    def count(self, group: str, name: str) -> int | None:
        """A whole number that a parameter holds, without a sign; None if there is none."""
        parameter = self.parameters.get((group, name))
        if parameter is None or not parameter.content or parameter.kind != INTEGER:
            return None
        return int.from_bytes(parameter.content[:2], self.order)

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
        if lost := {number for number, _ in parameters} - set(groups):
            raise ValueError(f"parameters belong to group {min(lost)}, which is not there")
        return {(groups[number], name): value for (number, name), value in parameters.items()}

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
            step = int.from_bytes(self.content[name_end : name_end + 2], self.order)
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


def check_structure(path: Path) -> None:
    """Raises ValueError, without the file's name, for a file that ezc3d must not open."""
    structure = Structure(path.read_bytes())
    for group, kinds in KINDS.items():
        for name, wanted in kinds.items():
            parameter = structure.parameters.get((group, name))
            if parameter is not None and parameter.kind not in wanted:
                raise ValueError(f"{group}:{name} has values of type {parameter.kind}; "
                                 f"wanted {sorted(wanted)}")  # fmt: skip
    points, samples = structure.word(2), structure.word(3)
    used = structure.count("POINT", "USED")
    if used is not None and used != points:
        raise ValueError(f"{points} markers in the header, and {used} in POINT:USED")
    first, last = structure.word(4), structure.word(5)
    frames = max(last - first + 1, 0)
    value = 4 if structure.content[12 + structure.sign] & 0x80 else 2
    size = frames * value * (4 * points + samples)
    begin = (structure.word(9) - 1) * BLOCK
    if not 2 * BLOCK <= begin + BLOCK or begin + size > len(structure.content):
        raise ValueError(
            f"{frames} frames of {points} markers and {samples} analog values begin at byte {begin}"
            f" and take {size} bytes; the file has {len(structure.content)}"
        )
