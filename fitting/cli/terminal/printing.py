"""Results on stdout, with tables that rich draws where there is a terminal."""

import os
import sys
from contextvars import ContextVar
from typing import IO, TYPE_CHECKING, Protocol, cast, runtime_checkable

if TYPE_CHECKING:
    from rich.console import Console

INCAPABLE = ("dumb", "unknown")  # values of TERM, of terminals that know no escape codes

console_in_use: "ContextVar[Console | None]" = ContextVar("console_in_use", default=None)
"""That of the lines of progress: what is printed by it stays above them."""


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
    from . import drawing

    drawing.draw(console, text)
