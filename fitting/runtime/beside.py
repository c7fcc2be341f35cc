"""Calls that run in other processes beside this one, such as the drawing of pictures.

Threads would wait for each other, as Python runs one at a time. The processes import what the
functions need and nothing of the program that runs, so scripts need no guard; they end by
themselves when they have been idle for a while. What they import decides how soon they begin: JAX,
for one, takes half a second, and nothing here needs it.
"""

import multiprocessing
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeAlias

from loky import cpu_count, get_reusable_executor

IDLE = 20  # s after which the processes end
Notes: TypeAlias = list[warnings.WarningMessage]

_running: ContextVar[list[Future[Notes]] | None] = ContextVar("running", default=None)


@contextmanager
def calls_beside() -> Iterator[None]:
    """Inside, calls of `call` run in other processes; at the end all of them have finished.

    An error in one of them is raised at the end, and warnings are given there. On one core, and in
    processes that may have no children, they run at once instead.
    """
    if not _possible():
        yield
        return
    running: list[Future[Notes]] = []
    token = _running.set(running)
    try:
        yield
    except BaseException:
        for future in running:
            future.cancel()
        raise
    finally:
        _running.reset(token)
    for future in running:
        for note in future.result():
            warnings.warn_explicit(note.message, note.category, note.filename, note.lineno)


def prepare(function: Callable[[], None]) -> None:
    """Starts the processes, if there are to be any, and calls a function in each.

    Later calls then need not wait for imports, which this makes on a core that would be idle.

    Args:
        function: of the module whose functions will be called.
    """
    if _possible():
        executor = get_reusable_executor(cpu_count(), timeout=IDLE)
        for _ in range(cpu_count()):
            executor.submit(function)


def call(function: Callable[..., None], *arguments: Any) -> None:
    """Calls a function: in another process where `calls_beside`, here otherwise.

    Args:
        function: of a module.
        arguments: which can be pickled; they are pickled before this returns or soon after, and
            must not change any more.
    """
    if (running := _running.get()) is None:
        function(*arguments)
        return
    executor = get_reusable_executor(cpu_count(), timeout=IDLE)
    running.append(executor.submit(_with_notes, function, *arguments))


def _possible() -> bool:
    return cpu_count() > 1 and not multiprocessing.current_process().daemon


def _with_notes(function: Callable[..., None], *arguments: Any) -> Notes:
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("default")
        function(*arguments)
    return notes
