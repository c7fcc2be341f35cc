"""Calls spread over the cores of a CPU, since one compiled XLA program here runs on one core."""

import functools
import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from .precision import for_other_thread

Output = TypeVar("Output")


def usable_cores() -> int:
    """Number of cores to spread work over: all this process may use, or 1 if a GPU computes."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_block(size: int) -> int | None:
    """The block size on a CPU, whose cache a block should fit; None (no blocks) on a GPU."""
    return size if jax.default_backend() == "cpu" else None


def on_all_cores(calls: Sequence[Callable[[], Output]]) -> list[Output]:
    """The outputs of these calls, in order, computed by as many threads as there are cores.

    The calling thread computes too, because waking another one takes 0.1 ms or more. After a call
    that fails or is interrupted, no further call starts.
    """
    pending = deque(enumerate(calls))
    outputs: dict[int, Output] = {}

    def work() -> None:
        try:
            while (task := _next_task(pending)) is not None:
                number, call = task
                outputs[number] = jax.block_until_ready(call())
        finally:
            pending.clear()

    helpers = min(usable_cores(), len(calls)) - 1
    pool = _thread_pool(usable_cores())
    futures = [pool.submit(for_other_thread(work)) for _ in range(helpers)]
    work()
    for future in futures:
        future.result()
    return [outputs[number] for number in range(len(calls))]


def _next_task(
    pending: deque[tuple[int, Callable[[], Output]]],
) -> tuple[int, Callable[[], Output]] | None:
    try:
        return pending.popleft()
    except IndexError:  # checking for emptiness first would race with the other threads
        return None


@functools.cache
def _thread_pool(size: int) -> ThreadPoolExecutor:
    """A pool that stays alive: starting a thread takes 0.4 ms."""
    return ThreadPoolExecutor(size)
