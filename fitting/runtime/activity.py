"""What a program is doing and what it has found: long work reports it here, to watchers.

```python
with activity.announced("Drawing pictures", total=len(plots)) as work:
    for plot in plots:
        draw(plot)
        work.advance()

class Printer(activity.Watcher):
    def logged(self, text):
        print(text)

with activity.watched_by(Printer()):
    fitting.fit("walk.toml")
```

A title says what is done and to how much of it; it is announced before the work begins. Without a
watcher nothing happens. The command line watches; so may any program. Work in other processes is
not seen; in another thread it is where `threads.for_other_thread` carries the context there.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Value = TypeVar("Value")


class Work:
    """Something that takes long, while it is going on."""

    def __init__(
        self, title: str, total: int | None, watchers: "tuple[Watcher, ...]", done: int = 0
    ):
        self.title = title
        self.total = total
        """How many parts it has, or has at most; None if unknown."""
        self.done = done
        """Of these parts."""
        self._first: tuple[int, float] | None = None
        self.note = ""
        """What it last said of itself, in a line."""
        self._compiling: dict[str, float] = {}
        self.failed = False
        self.began = time.monotonic()
        self._watchers = watchers

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self.began

    @property
    def seconds_each(self) -> float | None:
        """Of its parts; None before the second one, since the first may compile programs."""
        if self._first is None or self.done <= self._first[0]:
            return None
        done, seconds = self._first
        return (self.seconds - seconds) / (self.done - done)

    @property
    def seconds_left(self) -> float | None:
        """If it goes on as before; None while unknown, and at the end."""
        each = self.seconds_each
        if self.total is None or each is None or self.done >= self.total:
            return None
        return each * (self.total - self.done)

    @property
    def compiling(self) -> str:
        """Which programs are traced and compiled for it at this moment, and since when."""
        begun = list(self._compiling.items())
        programs = [f"{name} ({time.monotonic() - since:.0f} s)" for name, since in begun]
        return f"compiling {', '.join(programs)}" if programs else ""

    def began_compiling(self, program: str) -> None:
        """Says that it waits for a program from now on."""
        self._compiling[program] = time.monotonic()
        self.changed()

    def ended_compiling(self, program: str) -> None:
        """Says that it has the program."""
        if self._compiling.pop(program, None) is not None:
            self.changed()

    def advance(self) -> None:
        """Says that one more part is done."""
        self.reach(self.done + 1)

    def reach(self, done: int) -> None:
        """Says how many parts are done."""
        self.done = done
        if self._first is None:
            self._first = done, self.seconds
        self.changed()

    def changed(self) -> None:
        """Tells the watchers of a new count or note."""
        for watcher in self._watchers:
            watcher.changed(self)

    @contextmanager
    def part(self, title: str) -> Iterator["Work"]:
        """Announces one of the parts, which is done at the end."""
        with announced(title) as work:
            yield work
        self.advance()


class Watcher:
    """Its methods are called in the thread that works; work within other work ends before it."""

    def began(self, work: Work) -> None:
        """Called before the work begins."""

    def changed(self, work: Work) -> None:
        """Called with a new count or note."""

    def ended(self, work: Work) -> None:
        """Called when it is done, or has failed."""

    def logged(self, text: str) -> None:
        """Called with a line or a table, as the command line prints it."""

    def reported(self, result: object) -> None:
        """Called with an intermediate result: a step of a search, a state of a chain, a new row."""


_watchers: ContextVar[tuple[Watcher, ...]] = ContextVar("watchers", default=())
_innermost: ContextVar[Work | None] = ContextVar("innermost", default=None)
_quiet: ContextVar[bool] = ContextVar("quiet", default=False)


@contextmanager
def watched_by(watcher: Watcher) -> Iterator[None]:
    """Tells a watcher, after those there are, of all work that is done in this context."""
    with _set(_watchers, (*_watchers.get(), watcher)):
        yield


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps what is logged in this context from all watchers: a job within another one."""
    with _set(_quiet, True):
        yield


@contextmanager
def announced(title: str, total: int | None = None, *, done: int = 0) -> Iterator[Work]:
    """Announces work before it is done.

    Args:
        title: says what is done, for the reader: "Reading 3 clips".
        total: how many parts it has, or has at most.
        done: how many of them were done before.
    """
    watchers = _watchers.get()
    work = Work(title, total, watchers, done)
    with _set(_innermost, work):
        try:
            for watcher in watchers:
                watcher.began(work)
            yield work
        except BaseException:
            work.failed = True
            raise
        finally:
            for watcher in watchers:
                watcher.ended(work)


def innermost() -> Work | None:
    """The work that is going on in this context, if it was announced."""
    return _innermost.get()


def note(text: str) -> None:
    """Says in a line how far the innermost work is."""
    if (work := _innermost.get()) is not None:
        work.note = text
        work.changed()


def log(text: str) -> None:
    """Gives the reader a line or a table."""
    for watcher in () if _quiet.get() else _watchers.get():
        watcher.logged(text)


def report(result: object, text: str = "") -> None:
    """Hands an intermediate result to the watchers.

    Args:
        result: a step of a search, a state of a chain, a new row.
        text: what the innermost work notes of it.
    """
    for watcher in _watchers.get():
        watcher.reported(result)
    if text:
        note(text)


@contextmanager
def _set(variable: ContextVar[Value], value: Value) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)
