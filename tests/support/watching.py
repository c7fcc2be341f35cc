"""Who watches long work in tests, and writes down what it is told."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from fitting.runtime import activity
from fitting.runtime.activity import Work


class Recorder(activity.Watcher):
    """Writes down events; others may write into the same list."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self._note = ""

    @property
    def titles(self) -> list[str]:
        """What was announced, in order."""
        starts = (event.partition("began ") for event in self.events)
        return [title for before, began, title in starts if began and not before]

    def began(self, work: Work) -> None:
        self.events.append(f"began {work.title}")

    def changed(self, work: Work) -> None:
        if work.note and work.note != self._note:
            self._note = work.note
            self.events.append(f"noted {work.note}")
        else:
            self.events.append(f"{work.title} {work.done} of {work.total}")

    def ended(self, work: Work) -> None:
        self.events.append(f"ended {work.title}")


Call = Callable[[Any], object]


class Listener(activity.Watcher):
    """Hands on what is logged and reported."""

    def __init__(self, on_text: Call, on_result: Call) -> None:
        self._on_text, self._on_result = on_text, on_result

    def logged(self, text: str) -> None:
        self._on_text(text)

    def reported(self, result: object) -> None:
        self._on_result(result)


def _ignore(event: object) -> None:
    pass


def listening(logged: Call = _ignore, reported: Call = _ignore) -> AbstractContextManager[None]:
    """Calls a function with every text, or every result, of what is done inside."""
    return activity.watched_by(Listener(logged, reported))
