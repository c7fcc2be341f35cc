"""Work shared out to the cores of a CPU: a program of XLA's is one function, which runs on one."""

import functools
import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax


def usable_cores() -> int:
    """Cores that programs share: all that this process may use; one where a GPU computes."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_block(count: int) -> int | None:
    """So many at a time on a CPU, whose cache is to hold them; all where a GPU computes."""
    return count if jax.default_backend() == "cpu" else None


def on_all_cores(calls: Sequence[Callable[[], Any]]) -> list:
    """What these calls give, made as many at once as there are cores.

    The thread that asks computes too: to wake another takes 0.1 ms and more. Where a call fails
    or is interrupted, none is begun after it.
    """
    left, made = deque(enumerate(calls)), {}

    def compute() -> None:
        try:
            for number, call in iter(functools.partial(_taken, left), None):
                made[number] = jax.block_until_ready(call())
        finally:
            left.clear()

    helpers = usable_cores() - 1
    helping = [_threads(helpers).submit(compute) for _ in range(helpers)]
    compute()
    for one in helping:
        one.result()
    return [made[number] for number in range(len(calls))]


def _taken(left: deque) -> Any:
    """The next one; None where there is none."""
    try:
        return left.popleft()
    except IndexError:
        return None


@functools.cache
def _threads(count: int) -> ThreadPoolExecutor:
    """Kept, for it takes 0.4 ms to start one."""
    return ThreadPoolExecutor(count)
