"""A trial: a loader reads one file within bounds of time and memory, and loads or refuses it."""

import logging
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fitting.runtime.validation import in_one_line

from .formats import Format

SECONDS = 10.0  # of CPU, for a file of some kilobytes
BYTES = 2**32  # of address space more than before; JAX takes one for itself
OUTCOMES = ("loaded", "refused")  # as it should be


class TooSlowError(BaseException):
    """The time of a trial is up; no loader may catch it."""


@contextmanager
def bounds() -> Iterator[None]:
    """Ends what takes too much time or memory, where the system can: MemoryError, TooSlowError."""

    def stop(*_: object) -> None:
        raise TooSlowError(f"more than {SECONDS:g} s of CPU")

    memory = Path("/proc/self/statm")
    before = resource.getrlimit(resource.RLIMIT_AS)
    if memory.exists():
        now = int(memory.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (now + BYTES, before[1]))
    handler = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    begin = time.process_time()
    try:
        yield
        if time.process_time() - begin > SECONDS:  # in C, where no signal is heard
            stop()
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def try_to_load(load: Callable[[Path], object], path: Path, names: tuple[str, ...]) -> str:
    """What became of the file: one of `OUTCOMES`, or a sentence that says what is wrong.

    Args:
        load: the loader, which also checks what it has loaded.
        path: the file.
        names: of this file and of those that belong to it; a message has to contain one of them.
    """
    messages: list[str] = []  # that libraries would print
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: messages.append(record.getMessage())
    logging.getLogger().addHandler(handler)
    outcome = "loaded"
    try:
        with bounds():
            load(path)
    except (ValueError, OSError) as error:
        message, outcome = in_one_line(error), "refused"
        if not any(name in message for name in names):
            return f"a message without the name of the file: {message}"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return f"{type(error).__name__}: {in_one_line(Exception(str(error)))[:300]}"
    finally:
        logging.getLogger().removeHandler(handler)
    return f"printed: {messages[0][:200]!r}" if messages else outcome


def run_trials(form: Format, folder: Path, seed: int, count: int) -> Iterator[tuple[int, str]]:
    """Damages and loads `count` files of a format; gives the number and the outcome of each.

    The whole file has to load. The damaged file of each trial is left in the folder until the next.
    """
    for name, whole in form.beside.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(whole())
    path, content = folder / form.file, form.whole()
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    form.load(path)  # without bounds: JAX may start now
    for number in range(count):
        random = np.random.default_rng([seed, number])
        path.write_bytes(form.damage(random, content))
        yield number, try_to_load(form.load, path, form.names)
