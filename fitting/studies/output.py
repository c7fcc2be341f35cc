"""Where a job's results and its lines of text go."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.problems import ClipData
from fitting.problem.problem import Problem
from fitting.report import pages
from fitting.runtime.claimed_folder import claimed

from .fit import run_folder

Log: TypeAlias = Callable[[str], object]
"""Takes a line or a table, as the command line prints it."""
Loaded: TypeAlias = Callable[[Experiment, Problem[jaxik.FootIK], tuple[ClipData, ...]], object]
"""Takes what a fit is about, once it is loaded."""


def silent(text: str) -> None:
    """Drops a line of the log."""


def unwatched(
    experiment: Experiment, problem: Problem[jaxik.FootIK], clips: tuple[ClipData, ...]
) -> None:
    """Looks at nothing of what is loaded."""


@contextmanager
def output_folder(output: str | Path | None) -> Iterator[Path | None]:
    """The folder for the results, if there is to be one, claimed for as long as a job fills it.

    Raises:
        ValueError: it cannot be made, or another process is filling it.
    """
    if output is None:
        yield None
        return
    run_folder.check_output_folder(Path(output))
    with claimed(Path(output)):
        yield Path(output)


def log_output(log: Log, folder: Path | None, text: str) -> None:
    """Logs where the results are, and the name of the file to read first."""
    if folder is not None:
        page = folder / pages.PAGE
        in_browser = f", or open {page} in a browser" if page.is_file() else ""
        log(f"written to {folder}; read {folder / text}{in_browser}")
