"""Progress on stderr while a command works, and Ctrl-C that is never lost meanwhile."""

import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Generic, TypeAlias, TypeVar

import numpy as np

from fitting.inference.optimisation.solution import Progress
from fitting.inference.sampling.posterior import SamplingProgress
from fitting.studies.calibration.calibration import CalibrationProgress

MARKED = re.compile(r"\S+!(?=\s|$)")
Report = TypeVar("Report")
Handler: TypeAlias = Callable[[int, FrameType | None], object] | int | None  # of a signal


class ProgressLine(Generic[Report]):
    """Shows reports: on one line of a terminal, or as a new line every ten seconds elsewhere.

    Inside this context no Ctrl-C is lost. One that arrives while Python collects garbage ends in a
    hook of JAX that swallows it; it is raised again at the next report.
    """

    def __init__(self, show: Callable[[Report], str]):
        self.show = show
        self.live = sys.stderr.isatty()
        self.last = -1e9
        self.handler: Handler = None
        self.interrupted = False

    def __enter__(self) -> "ProgressLine[Report]":
        in_main = threading.current_thread() is threading.main_thread()
        if in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self.handler = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        if self.handler is not None:
            signal.signal(signal.SIGINT, self.handler)

    def _interrupt(self, *_: object) -> None:
        self.interrupted = True
        raise KeyboardInterrupt

    def __call__(self, report: Report) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        now = time.monotonic()
        if now - self.last < (0.1 if self.live else 10.0):
            return
        self.last = now
        text = self.show(report)
        print(
            f"\r{text:<100}" if self.live else text,
            end="" if self.live else "\n",
            file=sys.stderr,
            flush=True,
        )


def fit_line(progress: Progress) -> str:
    """The progress of a search in one line."""
    return (
        f"{progress.seconds:6.1f} s  start {progress.start + 1}  {progress.stage:<9} step "
        f"{progress.step:<4} cost {progress.cost:.6g}  best {progress.best:.6g}"
    )


def sample_line(progress: SamplingProgress) -> str:
    """The progress of a sampling in one line."""
    slowest = progress.autocorrelation_time
    ending = "" if np.isnan(slowest) else f"  slowest autocorrelation {slowest:.0f} steps"
    return (
        f"{progress.elapsed:6.1f} s  step {progress.step} of at most {progress.max_steps}  "
        f"acceptance {progress.acceptance:.2f}  log p {progress.log_probability:.1f}{ending}"
    )


def calibration_line(progress: CalibrationProgress) -> str:
    """The progress of a calibration in one line."""
    minutes = progress.remaining / 60
    left = "" if np.isnan(minutes) else f"  {max(minutes, 0.0):.1f} min left"
    return (
        f"{progress.elapsed:6.1f} s  replicate {progress.replicate} of {progress.replicates}  "
        f"{progress.stage}{left}"
    )


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Prints on stderr what is running, and then how long it took."""
    print(f"{name} ... ", end="", file=sys.stderr, flush=True)
    start, result = time.perf_counter(), "stopped"
    try:
        yield
        result = f"{time.perf_counter() - start:.1f} s"
    finally:
        print(result, file=sys.stderr, flush=True)


def print_marked(text: str) -> None:
    """Prints text on stdout, on a terminal with red where it is marked with exclamation marks."""
    if sys.stdout.isatty() and not os.environ.get("NO_COLOR"):
        text = MARKED.sub("\033[31m\\g<0>\033[0m", text)
    print(text, flush=True)


def print_line(line: str) -> None:
    """Prints a line on stderr that stays, over the progress that a terminal shows there."""
    print(f"\r{line:<100}" if sys.stderr.isatty() else line, file=sys.stderr, flush=True)
