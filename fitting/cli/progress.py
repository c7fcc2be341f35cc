"""Ctrl-C during a search or a sampling, of which none is lost."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from fitting.runtime import activity

from . import start


@contextmanager
def interruptible() -> Iterator[None]:
    """Inside this context no Ctrl-C is lost, and the second one ends the process at once.

    One that arrives while Python collects garbage ends in a hook of JAX that swallows it; it is
    raised again at the next report.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    interrupts = _Interrupts()
    signal.signal(signal.SIGINT, interrupts.interrupt)
    try:
        with activity.watched_by(interrupts):
            yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class _Interrupts(activity.Watcher):
    interrupted = False

    def interrupt(self, *_: object) -> None:
        if self.interrupted:
            start.end()
        self.interrupted = True
        start.say("interrupted; ending what is being computed; Ctrl-C again stops at once")
        raise KeyboardInterrupt

    def reported(self, result: object) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
