"""What rich draws on a terminal: tables, help, and lines of work with bars."""

import re
import sys
from collections.abc import Iterable

from rich import box
from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
)
from rich.table import Table
from rich.text import Text

from fitting.report.formatting import INDENT, NARROWEST, TableText, parts_of
from fitting.runtime.activity import Work

from . import terminal

BAR = 8  # columns
BESIDE = 44  # columns that bar and counts take at most
DIM = "dim"  # style

MARKED = re.compile(r"\S+!(?=\s|$)")  # beyond a bound, or wrong
TITLE = re.compile(r"^[a-z].*:$|^usage:", re.MULTILINE)  # in help
WORD = re.compile(r"(?<=^ {4})[a-z-]+(?=  |$)|(?<![\w-])--?[a-z][\w-]*", re.MULTILINE)
NAME, HEADING, MARK = "cyan", "bold", "red"  # styles
SPACE = 2  # columns between others


class LiveLines(terminal.LogPrinter):
    """A line for each work that is going on, with a bar where its parts are counted.

    What took longer than a moment leaves a line with its duration, unless it is part of other work.
    """

    def __init__(self, console: Console):
        self._console = console
        self._going_on: list[tuple[Work, TaskID]] = []
        self._lines: _Lines | None = None

    def __enter__(self) -> "LiveLines":
        return self

    def __exit__(self, *error: object) -> None:
        if self._lines is not None:  # an interrupt came between the beginning and the end
            self._lines.stop()
            self._lines = None

    def began(self, work: Work) -> None:
        """Called before the work begins."""
        if self._lines is None:
            self._lines = _Lines(self._console)
            self._lines.start()
        title, room = "  " * len(self._going_on) + work.title, self._console.width - BESIDE
        title = title if len(title) <= room else f"{title[: room - 1]}…"
        task = self._lines.add_task(title, total=work.total, completed=work.done, work=work)
        self._going_on.append((work, task))

    def changed(self, work: Work) -> None:
        """Called with a new count or note."""
        if self._lines is not None:
            for entry, task in self._going_on:
                if entry is work:
                    self._lines.update(task, completed=work.done)

    def ended(self, work: Work) -> None:
        """Called when it is done, or has failed."""
        ended = [pair for pair in self._going_on if pair[0] is work]
        if self._lines is None or not ended:  # an interrupt came before it had begun
            return
        self._going_on.remove(ended[0])
        self._lines.remove_task(ended[0][1])
        if not self._going_on:
            self._lines.stop()
            self._lines = None
            if work.seconds >= terminal.PATIENCE:
                self._console.print(Text(terminal.ending(work), DIM))


class _Lines(Progress):
    """The lines, and below them what is compiled, or what the innermost work last said."""

    def __init__(self, console: Console):
        super().__init__(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            _Bar(bar_width=BAR),
            _Pace(),
            console=console,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),  # what goes elsewhere must go there
        )

    def get_renderables(self) -> Iterable[RenderableType]:
        """The parts of what is shown."""
        yield self.make_tasks_table(self.tasks)
        works = [task.fields["work"] for task in self.tasks]
        notes = [work.compiling or work.note for work in works]
        if note := next(filter(None, reversed(notes)), ""):
            yield Text(f"  {note}", DIM, no_wrap=True, overflow="ellipsis")


class _Bar(BarColumn):
    """A bar where parts are counted."""

    def render(self, task: Task) -> RenderableType:  # type: ignore[override]  # or nothing
        return Text() if task.total is None else super().render(task)


class _Pace(ProgressColumn):
    """How many parts are done, how fast, how long the rest takes; of other work, its time."""

    def render(self, task: Task) -> Text:
        """The text of a line."""
        work: Work = task.fields["work"]
        if work.total is None:
            return Text(terminal.duration(work.seconds))
        text = f"{work.done} of {work.total}"
        each = work.seconds_each
        if each is None or work.seconds < terminal.PATIENCE:
            return Text(text)
        if each > 0:
            text += f", {1 / each:.0f}/s" if each < 0.5 else f", {each:.1f} s each"
        if (left := work.seconds_left) is not None:
            text += f", {terminal.duration(left)} left"
        return Text(text)


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


def draw_help(console: Console, text: str) -> None:
    """Prints help with its titles and the words of a command marked."""
    help_text = Text(text, end="")
    help_text.highlight_regex(TITLE, HEADING)
    help_text.highlight_regex(WORD, NAME)
    console.print(help_text, overflow="ignore", crop=False)


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
