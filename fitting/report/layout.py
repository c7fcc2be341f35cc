"""Tables whose last column is prose, within the width of a terminal."""

import textwrap

from .formatting import Table, TableText

NARROWEST = 28  # characters of prose beside the other columns; else it goes below them
INDENT = "    "


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
