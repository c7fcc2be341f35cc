"""Reports of a search or a sampling, in a line, and Ctrl-C that is never lost meanwhile."""

import math
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING, Generic, TypeAlias, TypeVar

from fitting.runtime import activity

from . import start

if TYPE_CHECKING:
    from fitting.inference.optimise.solution import Progress
    from fitting.inference.sample.posterior import SamplingProgress
    from fitting.studies.calibrate.calibration import CalibrationProgress

Report = TypeVar("Report")
Handler: TypeAlias = Callable[[int, FrameType | None], object] | int | None  # of a signal


class ProgressLine(Generic[Report]):
    """Notes reports with the work that is going on.

    Inside this context no Ctrl-C is lost. One that arrives while Python collects garbage ends in a
    hook of JAX that swallows it; it is raised again at the next report. The second Ctrl-C ends the
    process at once.
    """

    def __init__(self, show: Callable[[Report], str]):
        self.show = show
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
        if self.interrupted:
            start.end()
        self.interrupted = True
        start.say("interrupted; ending what is being computed; Ctrl-C again stops at once")
        raise KeyboardInterrupt

    def __call__(self, report: Report) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        activity.note(self.show(report))


def fit_line(progress: "Progress") -> str:
    """The progress of a search in one line."""
    return (
        f"start {progress.start + 1}  {progress.stage:<9} step {progress.step:<4} "
        f"cost {progress.cost:.6g}  best {progress.best:.6g}"
    )


def sample_line(progress: "SamplingProgress") -> str:
    """The progress of a sampling in one line."""
    slowest = progress.autocorrelation_time
    ending = "" if math.isnan(slowest) else f"  slowest autocorrelation {slowest:.0f} steps"
    return (
        f"step {progress.step} of at most {progress.max_steps}  acceptance "
        f"{progress.acceptance:.2f}  log p {progress.log_probability:.1f}{ending}"
    )


def calibration_line(progress: "CalibrationProgress") -> str:
    """The progress of a calibration in one line."""
    return f"replicate {progress.replicate} of {progress.replicates}  {progress.stage}"
