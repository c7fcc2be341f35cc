"""Numbers as text, and tables of text for a terminal or for Markdown.

Text for a terminal is a plain string. One that `aligned` or `joined` has made also knows the tables
in it, so that the command line can draw them; to everybody else it is what it says.
"""

from collections.abc import Iterable, Sequence
from typing import TypeAlias

Table: TypeAlias = list[list[str]]  # rows of cells, the heading first


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


def percent(fraction: float, digits: int = 1) -> str:
    """A fraction of 1 in per cent."""
    return f"{100 * fraction:.{digits}f} %"


def interval(low: float, high: float) -> str:
    """Both ends of an interval with four significant digits each."""
    return f"{low:.4g} to {high:.4g}"


def bullets(lines: list[str]) -> str:
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


def markdown(table: Table) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in table]
    return "\n".join([lines[0], "|" + " --- |" * len(table[0]), *lines[1:]])


def transposed(rows: Table) -> Table:
    """A table with its rows as columns."""
    return [list(column) for column in zip(*rows, strict=True)]
