"""Tables and text as rich draws them."""

import re
from collections.abc import Iterable

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from fitting.report.formatting import TableText, parts_of
from fitting.report.guides.layout import INDENT, NARROWEST

MARKED = re.compile(r"\S+!(?=\s|$)")  # beyond a bound, or wrong
NAME, HEADING, MARK = "cyan", "bold", "red"  # styles
SPACE = 2  # columns between others


def draw(console: Console, text: str) -> None:
    """Draws text and its tables, within the width of the console."""
    for part in parts_of(text):
        if not isinstance(part, TableText):
            # A path that is longer than a line stays whole, so that it can be copied.
            console.print(Text(part), overflow="ignore", crop=False)
        elif not part.is_prose:
            _draw_table(console, part.rows)
        else:
            _draw_prose(console, part.rows)


def _draw_table(console: Console, rows: list[list[str]]) -> None:
    """A table, or where it is too wide several, which all begin with the first column."""
    widths = [_width(column) for column in zip(*rows, strict=True)]
    wholes, left = [[0]], console.width - widths[0]
    for number, width in enumerate(widths[1:], 1):
        if left < width + SPACE and wholes[-1] != [0]:
            wholes.append([0])
            left = console.width - widths[0]
        wholes[-1].append(number)
        left -= width + SPACE
    for index, columns in enumerate(wholes):
        if index:
            console.print()
        table = Table(
            box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False,
            header_style=HEADING,
        )  # fmt: skip
        for column in columns:
            style, width = NAME if column == 0 else None, widths[column]
            table.add_column(_marked(rows[0][column]), style=style, min_width=width)
        for row in rows[1:]:
            table.add_row(*(_marked(row[column]) for column in columns))
        console.print(table)


def _width(column: Iterable[str]) -> int:
    """Characters that a column needs: all, or for prose as many as are easy to read."""
    cells = list(column)
    widest = max(map(len, cells))
    longest_word = max((len(word) for cell in cells for word in cell.split()), default=0)
    return widest if widest <= NARROWEST else max(NARROWEST, longest_word)


def _draw_prose(console: Console, rows: list[list[str]]) -> None:
    """Columns of equal width in all sections; prose is below the others where there is no room."""
    columns = list(zip(*(row for row in rows if len(row) > 1), strict=True))
    widths = [max(map(len, column)) for column in columns[:-1]]
    shortest = console.width // max(len(widths), 1) - SPACE
    beside = console.width - sum(width + SPACE for width in widths) >= NARROWEST
    for number, row in enumerate(rows):
        if len(row) == 1:
            console.print(Text(f"\n{row[0]}" if number else row[0], HEADING))
            continue
        grid = Table.grid(padding=(0, SPACE, 0, 0))
        for index, width in enumerate(widths):
            style = NAME if index == 0 else None
            grid.add_column(min_width=min(width, shortest), style=style, overflow="fold")
        if beside:
            grid.add_row(*map(_marked, row))
        else:
            grid.add_row(*map(_marked, row[:-1]))
        console.print(grid)
        if not beside:
            console.print(Padding(_marked(row[-1]), (0, 0, 0, len(INDENT))))


def _marked(text: str) -> Text:
    drawn = Text(text)
    drawn.highlight_regex(MARKED, MARK)
    return drawn
