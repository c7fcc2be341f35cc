"""What a command tells on stderr while it works, and how it minds Ctrl-C meanwhile."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from fitting.inference.optimisation.solution import Progress
from fitting.inference.sampling.posterior import SamplingProgress


class Line:
    """Progress on one line of a terminal, on a line every ten seconds elsewhere.

    Within it no Ctrl-C is lost: one that comes while Python collects garbage ends in a hook of JAX,
    which goes on; it is raised again at the next report.
    """

    def __init__(self, show: Callable):
        self.show = show
        self.live = sys.stderr.isatty()
        self.last = -1e9
        self.handler: Any = None
        self.interrupted = False

    def __enter__(self) -> "Line":
        own = threading.current_thread() is threading.main_thread()
        if own and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self.handler = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        if self.handler is not None:
            signal.signal(signal.SIGINT, self.handler)

    def _interrupt(self, *_: object) -> None:
        self.interrupted = True
        raise KeyboardInterrupt

    def __call__(self, progress: object) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        now = time.monotonic()
        if now - self.last < (0.1 if self.live else 10.0):
            return
        self.last = now
        text = self.show(progress)
        print(
            f"\r{text:<100}" if self.live else text,
            end="" if self.live else "\n",
            file=sys.stderr,
            flush=True,
        )


def fit_line(progress: Progress) -> str:
    """A fit's progress in one line."""
    return (
        f"{progress.seconds:6.1f} s  start {progress.start + 1}  {progress.stage:<9} step "
        f"{progress.step:<4} cost {progress.cost:.6g}  best {progress.best:.6g}"
    )


def sample_line(progress: SamplingProgress) -> str:
    """A sampling's progress in one line."""
    time_now = progress.autocorrelation_time
    slowest = "" if np.isnan(time_now) else f"  slowest autocorrelation {time_now:.0f} steps"
    return (
        f"{progress.elapsed:6.1f} s  step {progress.step} of at most {progress.max_steps}  "
        f"acceptance {progress.acceptance:.2f}  log p {progress.log_probability:.1f}{slowest}"
    )


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Tells on stderr what is being run, and then how long it took."""
    print(f"{name} ... ", end="", file=sys.stderr, flush=True)
    began, took = time.perf_counter(), "stopped"
    try:
        yield
        took = f"{time.perf_counter() - began:.1f} s"
    finally:
        print(took, file=sys.stderr, flush=True)


def say(line: str) -> None:
    """A line on stderr that stays, over whatever a terminal shows there."""
    print(f"\r{line:<100}" if sys.stderr.isatty() else line, file=sys.stderr, flush=True)
