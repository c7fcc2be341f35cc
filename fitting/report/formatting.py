"""Numbers as text, and tables of text for a terminal or for Markdown.

Text for a terminal is a plain string. One that `aligned` or `joined` has made also knows the tables
in it, so that the command line can draw them; to everybody else it is what it says.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

Table: TypeAlias = list[list[str]]  # rows of cells, the heading first

NARROWEST = 28  # characters of prose beside the other columns; else it goes below them
INDENT = "    "


class TableText(str):
    """A table as text, with its cells."""

    rows: Table
    is_prose: bool
    """Whether its last column is prose, and rows of one cell are headings."""

    def __new__(cls, text: str, rows: Table, *, is_prose: bool = False) -> "TableText":
        """The text with the cells of which it was made."""
        table = super().__new__(cls, text)
        table.rows, table.is_prose = rows, is_prose
        return table


class JoinedText(str):
    """Text that knows its parts, which a line break separates."""

    parts: tuple[str, ...]

    def __new__(cls, parts: Sequence[str]) -> "JoinedText":
        """The parts, one below the other."""
        text = super().__new__(cls, "\n".join(parts))
        text.parts = tuple(parts)
        return text


def joined(paragraphs: Iterable[str], *, apart: bool = False) -> JoinedText:
    """Texts one below the other, `apart` by an empty line; their tables stay known."""
    parts: list[str] = []
    for paragraph in paragraphs:
        parts += [""] if apart and parts else []
        parts += parts_of(paragraph)
    return JoinedText(parts)


def parts_of(text: str) -> tuple[str, ...]:
    """The parts of a text, which a line break separates: plain ones, and each `TableText`."""
    return text.parts if isinstance(text, JoinedText) else (text,)


def number(value: float) -> str:
    """A number with four significant digits."""
    return f"{value:.4g}"


def counted(count: int, noun: str) -> str:
    """So many of something that has a regular plural."""
    return f"{count} {noun}{'s' * (count != 1)}"


def percent(fraction: float, digits: int = 1) -> str:
    """A fraction of 1 in per cent."""
    return f"{100 * fraction:.{digits}f} %"


def interval(low: float, high: float) -> str:
    """Both ends of an interval with four significant digits each."""
    return f"{low:.4g} to {high:.4g}"


def bullets(lines: Sequence[str]) -> str:
    """A Markdown list."""
    return "\n".join(f"- {line}" for line in lines)


def aligned(table: Table) -> TableText:
    """A table in columns of equal width, for a terminal."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]
    text = "\n".join([lines[0], "-" * max(len(line) for line in lines), *lines[1:]])
    return TableText(text, table)


def wrapped(table: Table, width: int) -> TableText:
    """A table as lines of at most this many characters, where no single cell is wider.

    Args:
        table: rows of cells, the last of which is prose. A row of one cell is a heading.
        width: characters in a line.
    """
    rows = [row for row in table if len(row) > 1]
    columns = list(zip(*rows, strict=True))[:-1]
    widths = [max(map(len, column)) for column in columns]
    left = sum(size + 2 for size in widths)
    lines = []
    for row in table:
        if len(row) == 1:
            lines += ["", row[0]]
            continue
        cells = [cell.ljust(size) for cell, size in zip(row, widths, strict=False)]
        head, prose = "  ".join(cells), row[-1]
        if width - left >= NARROWEST:
            parts = textwrap.wrap(prose, width - left) or [""]
            lines.append(f"{head}  {parts[0]}".rstrip())
            lines += [f"{' ' * left}{part}" for part in parts[1:]]
        else:
            lines.append(head.rstrip())
            lines += textwrap.wrap(prose, width, initial_indent=INDENT, subsequent_indent=INDENT)
    return TableText("\n".join(lines).strip("\n"), table, is_prose=True)


def markdown(table: Table) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in table]
    return "\n".join([lines[0], "|" + " --- |" * len(table[0]), *lines[1:]])


def transposed(rows: Table) -> Table:
    """A table with its rows as columns."""
    return [list(column) for column in zip(*rows, strict=True)]


class Label(NamedTuple):
    """What a quantity is called, and the unit in which it is shown."""

    name: str
    unit: str
    factor: float
    """Shown value / value in SI units and radians."""


RESIDUALS = {
    "ankle": Label("Ankle position", "cm", 100.0),
    "knee": Label("Knee position", "cm", 100.0),
    "pelvis": Label("Pelvis position", "cm", 100.0),
    "foot": Label("Foot orientation", "degrees", 180 / math.pi),
    "body": Label("Pelvis orientation", "degrees", 180 / math.pi),
    "contact": Label("Contact weight", "of 1", 1.0),
    "smooth": Label("Ankle acceleration", "m/s²", 1.0),
}
DIFFERENCES = {  # of `motion.accuracy`
    "ankle": Label("ankles", "mm", 1000.0),
    "knee": Label("knees", "mm", 1000.0),
    "pelvis": Label("pelvis", "mm", 1000.0),
    "foot": Label("orientation of the feet", "°", 180.0 / math.pi),
    "body": Label("orientation of the pelvis", "°", 180.0 / math.pi),
}


@dataclass(frozen=True)
class Column:
    """How one figure is shown in a table, and what it means."""

    heading: str
    unit: str
    factor: float
    """Shown value / value in SI units and radians."""
    digits: int
    """After the decimal point."""
    meaning: str

    def format(self, value: float) -> str:
        """The value in the unit of the column; a dash for NaN."""
        return "–" if math.isnan(value) else f"{self.factor * value:.{self.digits}f}"


ACCURACY = {
    "pelvis": Column(
        "pelvis", "cm", 100.0, 2,
        "Difference in height between the solved and the captured pelvis; rms over frames.",
    ),
    "ankle": Column(
        "ankle", "cm", 100.0, 2,
        "Distance between solved and captured ankles; rms over frames and legs.",
    ),
    "ankle_stance": Column(
        "ankle in stance", "cm", 100.0, 2, "The same over the frames in which the foot stands."
    ),
    "knee": Column(
        "knee", "cm", 100.0, 2,
        "Distance between solved and captured knees; rms over frames and legs.",
    ),
    "knee_stance": Column(
        "knee in stance", "cm", 100.0, 2, "The same over the frames in which the foot stands."
    ),
    "knee_angle": Column(
        "knee angle", "°", math.degrees(1.0), 2,
        "Difference between solved and captured knee angles; rms over frames and legs.",
    ),
    "knee_angle_stance": Column(
        "knee angle in stance", "°", math.degrees(1.0), 2,
        "The same over the frames in which the foot stands.",
    ),
    "straight": Column(
        "straight", "%", 100.0, 2,
        "Fraction of frames and legs in which the distance from hip to ankle is at least 99.9 % of "
        "the length of the leg.",
    ),
    "pop": Column(
        "pop", "cm a frame", 100.0, 2,
        "Largest change, from one frame to the next, of an ankle's height over the animated "
        "ankle. It grows with the duration of a frame.",
    ),
    "added_slip": Column(
        "added slip", "mm a frame", 1000.0, 3,
        "How much further a standing ankle moves horizontally, from one frame to the next, than "
        "the captured one; mean, where frames in which it moves less count as 0.",
    ),
    "bone_length": Column(
        "bone length", "mm", 1000.0, 3, "Largest error in the length of a thigh or a shin."
    ),
}  # fmt: skip

MEASURES = {
    "penetration_mean": Column(
        "penetration, mean", "cm", 100.0, 2,
        "Depth of a foot in the ground, mean over all frames and feet; 0 for a foot above the "
        "ground. It is the deeper of two points of the sole, one below the ankle and one below "
        "the ball (the toe joint). Each is as far below its joint, along the foot's up axis, as "
        "the joint is above the floor while the animated foot stands flat.",
    ),
    "penetration_max": Column(
        "penetration, max", "cm", 100.0, 1, "Largest depth of any foot in the ground."
    ),
    "clearance": Column(
        "sole clearance", "cm", 100.0, 2,
        "Air under a standing foot, mean over its frames: height above the ground of the lower of "
        "the same two points, 0 where one of them touches the ground or is in it.",
    ),
    "slide": Column(
        "slide per stance", "cm", 100.0, 2,
        "Length of the horizontal path of the ball of the foot (the toe joint) during a stance; "
        "median over the stances of all feet.",
    ),
    "pop_max": Column(
        "largest pop", "cm in 1/60 s", 100.0, 1,
        "Fastest change of an ankle's correction, that is, of its position after foot IK minus "
        "its animated position. It is the change over 1/60 s; where frames are longer, the change "
        "over a frame scaled to 1/60 s, so that clips at different frame rates compare.",
    ),
    "pops": Column(
        "pops", "count", 1.0, 0,
        "How often an ankle's correction changes by more than 2 cm in 1/60 s. Consecutive frames "
        "above that speed count as one pop.",
    ),
    "knee_jerk": Column(
        "knee jerk", "rad/s³", 1.0, 0,
        "Third derivative of the knee angle, by differences of four consecutive frames; root mean "
        "square over all knees. It grows with the frame rate of a clip: compare it with that of "
        "the animation.",
    ),
    "pelvis_jerk": Column(
        "pelvis jerk", "m/s³", 1.0, 1,
        "The same for the height of the pelvis.",
    ),
    "reached": Column(
        "targets reached", "%", 100.0, 1,
        "Fraction of the ankle targets, over all frames and feet with ground under them, that "
        "ankles miss by less than 5 mm (of an adult).",
    ),
    "straight": Column(
        "straight knees", "%", 100.0, 1,
        "Fraction of all frames and legs in which the knee angle is above 175°.",
    ),
}  # fmt: skip


def headings(columns: Mapping[str, Column]) -> list[str]:
    """Headings of a table, each with its unit."""
    return [f"{column.heading}, {column.unit}" for column in columns.values()]


def meanings(columns: Mapping[str, Column]) -> list[list[str]]:
    """What each column means: its heading with its unit, and a text."""
    return [[f"{column.heading} ({column.unit})", column.meaning] for column in columns.values()]
