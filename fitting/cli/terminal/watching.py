"""Shows what a command is busy with, on stderr, in the way that suits where that leads."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from fitting.runtime import activity

from .plain_lines import PlainLines
from .printing import console_in_use, make_console


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
    from .live_lines import LiveLines

    token = console_in_use.set(console)
    try:
        with LiveLines(console) as lines, activity.watched_by(lines):
            yield
    finally:
        console_in_use.reset(token)
