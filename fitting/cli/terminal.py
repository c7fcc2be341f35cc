"""Shows what a command is busy with, on stderr, in the way that suits where that leads."""

import io
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import IO, Any, Protocol, cast, runtime_checkable

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
from fitting.runtime import activity
from fitting.runtime.activity import Work

BAR = 8  # columns
BESIDE = 44  # columns that bar and counts take at most
DIM = "dim"  # style

MARKED = re.compile(r"\S+!(?=\s|$)")  # beyond a bound, or wrong
NAME, HEADING, MARK = "cyan", "bold", "red"  # styles
SPACE = 2  # columns between others

INCAPABLE = ("dumb", "unknown")  # values of TERM, of terminals that know no escape codes

console_in_use: "ContextVar[Console | None]" = ContextVar("console_in_use", default=None)
"""That of the lines of progress: what is printed by it stays above them."""


PATIENCE = 1.5  # s, after which work is announced; what is shorter says nothing
INTERVAL = 10.0  # s between reports of what goes on
SILENCE = 60.0  # s, the longest time without a line
TICK = 0.2  # s between looks at the clock


@contextmanager
def watched() -> Iterator[None]:
    """Shows the work of this context: with bars on a terminal, elsewhere in plain lines."""
    # Where results go to a terminal, too, it is the same one, and one console keeps them apart.
    console = None
    if sys.stderr is None:  # it was closed
        yield
        return
    if make_console(sys.stderr) is not None:
        console = make_console(sys.stdout) or make_console(sys.stderr)
    if console is None:
        with PlainLines(sys.stderr) as lines, activity.watched_by(lines):
            yield
        return

    token = console_in_use.set(console)
    try:
        with LiveLines(console) as lines, activity.watched_by(lines):
            yield
    finally:
        console_in_use.reset(token)


class LiveLines:
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
            if work.seconds >= PATIENCE:
                self._console.print(Text(ending(work), DIM))


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
            return Text(duration(work.seconds))
        text = f"{work.done} of {work.total}"
        each = work.seconds_each
        if each is None or work.seconds < PATIENCE:
            return Text(text)
        if each > 0:
            text += f", {1 / each:.0f}/s" if each < 0.5 else f", {each:.1f} s each"
        if (left := work.seconds_left) is not None:
            text += f", {duration(left)} left"
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


@runtime_checkable
class Stream(Protocol):
    """Where text goes: a file, a pipe, a terminal."""

    def write(self, text: str, /) -> int:
        """Writes text."""
        ...

    def flush(self) -> None:
        """Passes on what was written."""
        ...

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        ...


def can_draw(stream: Stream | None) -> bool:
    """Whether a stream is a terminal that knows escape codes and lines; None is a closed one."""
    if stream is None or not stream.isatty():
        return False
    encoding = getattr(stream, "encoding", None) or "utf-8"
    knows_lines = encoding.lower().startswith("utf")
    return knows_lines and os.environ.get("TERM", "").lower() not in INCAPABLE


def make_console(stream: Stream | None) -> "Console | None":
    """What draws on a stream; None where nothing can, or where rich cannot be imported."""
    if not can_draw(stream):
        return None
    try:
        from rich.console import Console
    except ImportError:  # `jaxik doctor` says so, and must be able to
        return None
    return Console(
        file=cast(IO[str], stream), force_terminal=True, highlight=False, markup=False, emoji=False
    )


def show(text: str) -> None:
    """Prints a result on stdout at once: the next one may take an hour.

    Args:
        text: as it is printed in a pipe. On a terminal its tables are drawn, if it knows them as
            `report.formatting` does.
    """
    console = console_in_use.get() if can_draw(sys.stdout) else None
    if (console := console or make_console(sys.stdout)) is None:
        print(text, flush=True)
        return

    draw(console, text)


class PlainLines:
    """Announces work that takes longer than a moment, and reports on it now and then.

    Work within other work that has been announced once under the same title is only reported on: a
    study of a thousand fits prints no thousand announcements. Another thread looks at the clock,
    since what takes long cannot.
    """

    def __init__(self, stream: Stream):
        self._stream = stream
        self._lock = threading.RLock()
        self._going_on: list[Work] = []
        self._announced: set[int] = set()
        """Of the work that is going on, the depths."""
        self._titles: set[str] = set()
        self._last = time.monotonic()
        self._closed = threading.Event()
        self._clock = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "PlainLines":
        self._clock.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._closed.set()
        self._clock.join()

    def began(self, work: Work) -> None:
        """Called before the work begins."""
        with self._lock:
            self._going_on.append(work)

    def changed(self, work: Work) -> None:
        """Called with a new count or note."""
        if work.done != work.total and time.monotonic() - self._last >= INTERVAL:
            self._report()

    def ended(self, work: Work) -> None:
        """Called when it is done, or has failed."""
        with self._lock:
            depth = len(self._going_on) - 1
            if depth < 0 or self._going_on[depth] is not work:
                return  # an interrupt came before it had begun
            self._going_on.pop()
            if depth in self._announced:
                self._announced.discard(depth)
                self._print(ending(work))

    def look(self) -> None:
        """Announces what has been going on for a while; breaks a long silence."""
        with self._lock:
            for depth, work in enumerate(self._going_on):
                is_new = depth == 0 or work.title not in self._titles
                if is_new and depth not in self._announced and work.seconds >= PATIENCE:
                    self._announced.add(depth)
                    self._titles.add(work.title)
                    self._print(f"{': '.join(filter(None, [work.title, work.compiling]))} ...")
            compiling = any(work.compiling for work in self._going_on)
            patience = INTERVAL if compiling else SILENCE
            if self._going_on and time.monotonic() - self._last >= patience:
                self._report()

    def _watch(self) -> None:
        while not self._closed.wait(TICK):
            self.look()

    def _report(self) -> None:
        """Prints how far each work is of those that go on."""
        with self._lock:
            words = [text for work in self._going_on if (text := describe(work))]
            if words and self._going_on:
                self._print(f"{self._going_on[0].seconds:6.1f} s  {', '.join(words)}")

    def _print(self, line: str) -> None:
        print(line, file=self._stream, flush=True)
        self._last = time.monotonic()


def describe(work: Work) -> str:
    """How far some work is, what it last said of itself, and what is compiled for it."""
    parts = [work.title]
    if work.total is not None:
        parts[0] += f", {work.done} of {work.total}"
        if (seconds := work.seconds_left) is not None:
            parts[0] += f", {duration(seconds)} left"
    return ": ".join(filter(None, [*parts, work.note, work.compiling]))


def ending(work: Work) -> str:
    """What is said of work that has ended."""
    return f"{work.title}: {'stopped after ' * work.failed}{work.seconds:.1f} s"


def duration(seconds: float) -> str:
    """As few digits as say enough of what is yet to come."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


class _Stream:
    """A stream that does not fail: it falls silent when nobody reads it any more.

    It replaces characters that its encoding lacks.
    """

    def __init__(self, stream: io.TextIOBase) -> None:
        self._stream = stream

    def write(self, text: str, /) -> int:
        encoding = self._stream.encoding or "utf-8"
        known = text.encode(encoding, "replace").decode(encoding)
        return self._try(lambda: self._stream.write(known)) or len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def isatty(self) -> bool:
        return self._stream.isatty()

    def _try(self, call: Callable[[], int | None]) -> int | None:
        try:
            return call()
        except BrokenPipeError:  # what else is written, by other processes too, goes nowhere
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
            return None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def work_goes_on() -> Iterator[None]:
    """Within this context nothing fails because of stdout or stderr."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _Stream(stream) for stream in before)  # pyright: ignore
    try:
        yield
    finally:
        if sys.stdout is not None:  # a closed one
            sys.stdout.flush()
        sys.stdout, sys.stderr = before
