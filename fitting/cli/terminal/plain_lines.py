"""What a command is busy with, in plain lines: for a pipe, a file, a log."""

import threading
import time
from types import TracebackType

from fitting.runtime.activity import Work

from .printing import Stream

PATIENCE = 1.5  # s, after which work is announced; what is shorter says nothing
INTERVAL = 10.0  # s between reports of what goes on
SILENCE = 60.0  # s, the longest time without a line
TICK = 0.2  # s between looks at the clock


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
