"""The command `jaxik` from its first moment, and what Ctrl-C does to it.

An interrupt in the middle of an import is lost, comes out as another error or, in modules of C,
ends the process with a segmentation fault. So while the command imports, Ctrl-C ends the process at
once, with a line and the exit status of an interrupt. Imports nothing that takes time.
"""

import atexit
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from fitting.runtime import activity

MISTAKE, INTERRUPTED = 2, 130  # exit statuses
AGAIN = 0.05  # s until an interrupt that was lost is raised again
SHOW_CURSOR = "\x1b[?25h"  # which a progress bar hides


def main() -> int:
    """Runs the command; this is what the shell calls."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # the last thing that is done
        signal.signal(signal.SIGINT, end)
    try:
        from .main import main as run

        return run()
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        if package in ("jaxik", "fitting"):
            raise
        say(f'needs {package}: pip install "jaxik[fit]"')
        return MISTAKE


def end(*_: object) -> None:
    """Ends the process at once, with a line."""
    say("interrupted", SHOW_CURSOR if os.isatty(2) else "")
    os._exit(INTERRUPTED)


def say(text: str, code: str = "") -> None:
    """Prints a line on stderr, also where an interrupt came in the middle of another one."""
    with suppress(OSError):
        os.write(2, f"{code}\n{' '.join(['jaxik', *sys.argv[1:2]])}: {text}\n".encode())


@contextmanager
def interrupts_raised() -> Iterator[None]:
    """Has Ctrl-C raise KeyboardInterrupt in this context, for work that knows what to finish."""
    if signal.getsignal(signal.SIGINT) is not end:  # a program of its own calls this
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.unraisablehook = _raise_again
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, end)


def _raise_again(unraisable: "sys.UnraisableHookArgs") -> None:
    """Raises an interrupt again that came where none can be raised, as in a hook of JAX."""
    if not isinstance(unraisable.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
    elif signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        import _thread

        threading.Timer(AGAIN, _thread.interrupt_main).start()


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
            end()
        self.interrupted = True
        say("interrupted; ending what is being computed; Ctrl-C again stops at once")
        raise KeyboardInterrupt

    def reported(self, result: object) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
