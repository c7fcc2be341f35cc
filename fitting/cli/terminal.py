"""Shows what a command is busy with, on stderr, in the way that suits where that leads."""

import io
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, TextIO, cast

from fitting.runtime import activity
from fitting.runtime.activity import Work

if TYPE_CHECKING:
    from rich.console import Console

INCAPABLE = ("dumb", "unknown")  # values of TERM, of terminals that know no escape codes

console_in_use: "ContextVar[Console | None]" = ContextVar("console_in_use", default=None)
"""That of the lines of progress: what is printed by it stays above them."""

PATIENCE = 1.5  # s, after which work is announced; what is shorter says nothing
INTERVAL = 10.0  # s between reports of what goes on
SILENCE = 60.0  # s, the longest time without a line
TICK = 0.2  # s between updates


@contextmanager
def watched() -> Iterator[None]:
    """Shows the work of this context: with bars on a terminal, elsewhere in plain lines."""
    # Results that go to a terminal, too, go to the same one: one console separates both.
    console = None
    if sys.stderr is None:  # it was closed
        with activity.watched_by(LogPrinter()):
            yield
        return
    if make_console(sys.stderr) is not None:
        console = make_console(sys.stdout) or make_console(sys.stderr)
    if console is None:
        with PlainLines(sys.stderr) as lines, activity.watched_by(lines):
            yield
        return
    from .drawing import LiveLines

    token = console_in_use.set(console)
    try:
        with LiveLines(console) as lines, activity.watched_by(lines):
            yield
    finally:
        console_in_use.reset(token)


def can_draw(stream: "TextIO | _Stream | None") -> bool:
    """Whether a stream is a terminal that knows escape codes and lines; None is a closed one."""
    if stream is None or not stream.isatty():
        return False
    encoding = getattr(stream, "encoding", None) or "utf-8"
    knows_lines = encoding.lower().startswith("utf")
    return knows_lines and os.environ.get("TERM", "").lower() not in INCAPABLE


def make_console(stream: "TextIO | _Stream | None") -> "Console | None":
    """What draws on a stream; None where nothing can, or where rich cannot be imported."""
    if not can_draw(stream):
        return None
    try:
        from rich.console import Console
    except ImportError:  # `jaxik doctor` says so, and must be able to
        return None
    file = cast("IO[str]", stream)  # rich needs no more of a stream than ours has
    return Console(file=file, force_terminal=True, highlight=False, markup=False, emoji=False)


def show(text: str) -> None:
    """Prints a result on stdout at once: the next one may take an hour.

    In a pipe it is printed as it is; on a terminal its tables are drawn, as `report.formatting`
    made them.
    """
    console = console_in_use.get() if can_draw(sys.stdout) else None
    if (console := console or make_console(sys.stdout)) is None:
        print(text, flush=True)
        return
    from .drawing import draw

    draw(console, text)


def show_help(text: str) -> None:
    """Prints the help of a command on stdout, on a terminal in colour."""
    if (console := make_console(sys.stdout)) is None:
        print(text, end="")
        return
    from .drawing import draw_help

    draw_help(console, text)


class LogPrinter(activity.Watcher):
    """Prints what is logged, and shows nothing of work."""

    def logged(self, text: str) -> None:
        """Called with a line or a table."""
        show(text)


class PlainLines(LogPrinter):
    """Announces work that takes longer than a moment, and reports on it now and then.

    Inner work is announced once for each title, so that a study of a thousand fits does not print a
    thousand announcements. Another thread watches the clock, since the one that works cannot.
    """

    def __init__(self, stream: "TextIO | _Stream"):
        self._stream = stream
        self._lock = threading.RLock()
        self._going_on: list[Work] = []
        self._announced: set[int] = set()
        """Depths of the work that is going on."""
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

    def update(self) -> None:
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
            self.update()

    def _report(self) -> None:
        """Prints how far each work that goes on has come."""
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
