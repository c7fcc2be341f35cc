"""One of many fits, as a worker makes it."""

import traceback
import warnings
from contextlib import ExitStack, suppress
from pathlib import Path

import jaxik
from fitting.experiments.experiment import Experiment
from fitting.experiments.problems import ClipData
from fitting.jobs.fits import fit
from fitting.problem.problem import Problem
from fitting.runtime import files
from fitting.runtime.parallel.effort import Stopwatch
from fitting.runtime.parallel.first_use import first_alone, waiting_for
from fitting.runtime.plain_tree import NotPlainError
from fitting.runtime.program_key import program_key
from fitting.runtime.validation import in_one_line
from fitting.studies import run_folder
from fitting.studies.fit import Fit
from fitting.studies.many.rows import (
    Row,
    failed_row,
    finished_row,
    kept_row,
    outcome_of,
    write_row,
)
from fitting.studies.many.tasks import FitTask

ERROR = "error.txt"


def fit_task(folder: Path, task: FitTask, *, report: bool = True) -> Row:
    """Makes one fit as `fit` does, and says at last that its run folder is whole.

    An error becomes its row. The first fit with certain programs keeps others of this machine that
    need the same ones waiting until it has compiled them.

    Args:
        folder: of all fits; it exists already, also where another machine made it.
        task: the fit.
        report: whether the run gets tables, pictures and a page.

    Raises:
        KeyboardInterrupt: it was interrupted; half a fit counts for nothing.
    """
    watch, run = Stopwatch(), folder / task.run
    try:
        _check_folder(folder)
        with warnings.catch_warnings(record=True) as caught, waiting_for(run.with_suffix(".lock")):
            if (row := kept_row(folder, task)) is not None:
                return row  # of another worker that was thought to be dead
            warnings.simplefilter("default")
            fitted = _fit(run, task.experiment, report, watch)
        notes = list(dict.fromkeys(in_one_line(Warning(note.message)) for note in caught))
        row = finished_row(task, outcome_of(fitted), watch.read(), notes)
        (run / ERROR).unlink(missing_ok=True)
        write_row(folder, row)
        return row
    except Exception as error:
        if not isinstance(error, ValueError | OSError):  # which are told in a sentence
            run.mkdir(parents=True, exist_ok=True)
            files.write_text(run / ERROR, "".join(traceback.format_exception(error)))
        return failed_row(task, in_one_line(error))


def _fit(run: Path, experiment: Experiment, report: bool, watch: Stopwatch) -> Fit:
    with ExitStack() as stack:

        def wait_for_programs(
            experiment: Experiment, problem: Problem[jaxik.FootIK], clips: tuple[ClipData, ...]
        ) -> None:
            # A rule of the user's own is never kept, so that nobody need wait.
            with suppress(NotPlainError):
                key = program_key(problem.residual_function, ((problem,), {}))
                with watch.waiting():
                    stack.enter_context(first_alone(key))

        fitted = fit(experiment, run, loaded=wait_for_programs, report=report)
    if fitted.solution.interrupted:
        (run / run_folder.FIT).unlink(missing_ok=True)
        raise KeyboardInterrupt
    return fitted


def _check_folder(folder: Path) -> None:
    """Raises ValueError where a worker does not see the folder of its client."""
    if not folder.is_dir():
        raise ValueError(
            f"{folder}: there is no such folder on this worker's machine; all machines of a "
            "cluster need the same files under the same paths"
        )
