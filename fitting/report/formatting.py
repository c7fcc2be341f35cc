"""Numbers as text, and tables of text for a terminal or for Markdown."""

from typing import TypeAlias

Table: TypeAlias = list[list[str]]  # rows of cells, the heading first


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


def aligned(table: Table) -> str:
    """A table in columns of equal width, for a terminal."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]
    return "\n".join([lines[0], "-" * max(len(line) for line in lines), *lines[1:]])


def markdown(table: Table) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in table]
    return "\n".join([lines[0], "|" + " --- |" * len(table[0]), *lines[1:]])


def transposed(rows: Table) -> Table:
    """A table with its rows as columns."""
    return [list(column) for column in zip(*rows, strict=True)]
