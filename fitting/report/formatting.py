"""Numbers as text, and tables of text for a terminal or for Markdown.

Text for a terminal is a plain string. One that `aligned` or `joined` has made also knows the tables
in it, so that the command line can draw them; to everybody else it is what it says.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

if TYPE_CHECKING:  # they need JAX, which `jaxik doctor` shows tables without
    from fitting.motion.measures import Figures, Measure

Table: TypeAlias = list[list[str]]  # rows of cells, the heading first

NARROWEST = 28  # characters of prose beside the other columns; else it goes below them
INDENT = "    "
NAMED = 3  # names of a list in a sentence, which are all given if there are no more


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


def listed(names: Sequence[str]) -> str:
    """Names in a sentence; of many only the first."""
    if len(names) > NAMED:
        return f"{', '.join(names[: NAMED - 1])} and {len(names) - NAMED + 1} others"
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


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


def figures_table(title: str, motions: "Mapping[str, Figures]", names: Iterable[str] = ()) -> Table:
    """Figures of motions, a row for each with its unit; those that none has are left out.

    Args:
        title: of the first column.
        motions: one or more, by name; a column for each.
        names: which figures; all, if there is none.
    """
    measures = next(iter(motions.values())).measures()
    known = [
        name
        for name in names or measures
        if not all(math.isnan(getattr(figures, name)) for figures in motions.values())
    ]
    rows = [[measures[n].title, *(figures.text(n) for figures in motions.values())] for n in known]
    return [[title, *motions], *rows]


def meanings(measures: "Mapping[str, Measure]") -> list[list[str]]:
    """What each measure means: its heading with its unit, and a text."""
    return [[f"{each.heading} ({each.unit})", each.meaning] for each in measures.values()]
