"""Records as CSV text, under their own names."""

import csv
import dataclasses
import io
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from .layout import (
    FLAG_NAMES,
    FLAGS,
    FLOAT_NAMES,
    QUIET_NAN,
    Record,
    pack_float,
)

Value = TypeVar("Value")

COLUMNS = ("kneeAxisType", *FLAG_NAMES, "padflag", "pad1", *FLOAT_NAMES, "pad3")


def to_csv(records: list[Record]) -> str:
    """CSV text with a row per record, the record's own names, and padding in hexadecimal."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(COLUMNS)
    for record in records:
        flags = [int(record.flag(name)) for name in FLAG_NAMES]
        head = [record.knee_axis_type, *flags, record.flags >> 3, record.padding.hex()]
        rows.writerow([*head, *map(_shortest, record.floats), record.tail.hex()])
    return out.getvalue()


def from_csv(text: str) -> list[Record]:
    """The records in CSV text; columns may be in any order, and those of padding may be missing.

    Raises:
        ValueError: naming the row and column at fault.
    """
    rows = csv.DictReader(io.StringIO(text))
    columns = list(rows.fieldnames or [])
    needed = [name for name in COLUMNS if not name.startswith("pad")]
    if missing := [name for name in needed if name not in columns]:
        raise ValueError(f"the CSV has no column {missing}; it has {columns}")
    if unknown := [name for name in columns if name not in COLUMNS]:
        raise ValueError(f"the CSV has unknown columns {unknown}; a record has {list(COLUMNS)}")
    if twice := [name for name in COLUMNS if columns.count(name) > 1]:
        raise ValueError(f"the CSV has column {twice} more than once")
    records = []
    for values in rows:
        cells = _Cells(f"row {rows.line_num}", values)
        if None in values or None in values.values():
            raise ValueError(f"{cells.row} has not the {len(columns)} cells of the header")
        flags = cells.read("padflag", _whole(0x1F), "a whole number from 0 to 31", "0") << 3
        for bit, name, _ in FLAGS:
            flags |= cells.read(name, _whole(1), "0 or 1") << bit
        axis = cells.read("kneeAxisType", _whole(0xFF), "a whole number from 0 to 255")
        floats = tuple(cells.read(name, pack_float, "a 32-bit number") for name in FLOAT_NAMES)
        padding = cells.read("pad1", bytes.fromhex, "bytes in hexadecimal", "0000")
        tail = cells.read("pad3", bytes.fromhex, "bytes in hexadecimal")
        if len(padding) != 2:
            raise ValueError(f"{cells.row}, column pad1: {padding.hex()!r} is not two bytes")
        records.append(Record(axis, flags, padding, floats, tail))
    return records


@dataclasses.dataclass(frozen=True)
class _Cells:
    """One row of a CSV."""

    row: str  # such as "row 2"
    values: dict[str, str]

    def read(
        self, name: str, convert: Callable[[str], Value], expected: str, default: str = ""
    ) -> Value:
        """A cell, converted; an empty or missing one is read as `default`."""
        cell = (self.values.get(name) or default).strip()
        try:
            return convert(cell)
        except ValueError:
            raise ValueError(f"{self.row}, column {name}: {cell!r} is not {expected}") from None


def _whole(maximum: int) -> Callable[[str], int]:
    """A reader of whole numbers from 0 to `maximum`."""
    return lambda cell: range(maximum + 1).index(int(cell))


def _shortest(stored: bytes) -> str:
    """The shortest decimal that reads back as the same f32; for a NaN with a payload, its bits."""
    value = np.frombuffer(stored, "<f4")[0]
    if np.isnan(value) and stored != QUIET_NAN:
        return f"nan(0x{stored[::-1].hex()})"
    return str(value)
