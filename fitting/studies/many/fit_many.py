"""The job that fits clips × experiments × seeds, each in a run folder of its own."""

import functools
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.in_memory import with_files
from fitting.runtime import activity, cluster, files
from fitting.runtime.cluster import Stopwatch, first_alone, waiting_for
from fitting.runtime.plain_tree import NotPlainError
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import program_key
from fitting.runtime.threads import usable_cores
from fitting.runtime.validation import in_one_line
from fitting.studies.campaign import Campaign
from fitting.studies.fit import run_folder
from fitting.studies.fit.fit import Fit
from fitting.studies.fit.fit_jobs import Loaded, fit
from fitting.studies.output import output_folder, publish

from . import many_report, many_tasks
from .many_tasks import (
    ROW,
    RUNS,
    FitTask,
    ManyFits,
    Row,
    make_row,
    outcome_of,
    plan,
    read_row,
    row_store,
)

if TYPE_CHECKING:
    from distributed import Client


INPUTS = "inputs"  # folder of what experiments have in memory

ERROR = "error.txt"


@in_float64
def fit_many(
    experiments: Experiment | str | Path | Sequence[Experiment | str | Path],
    output: str | Path,
    *,
    seeds: int = 1,
    together: bool = False,
    report: bool = True,
    workers: int | None = None,
    scheduler: str | None = None,
) -> ManyFits:
    """Fits each clip of each experiment alone, with each seed: every fit is a run folder.

    A call with the same folder makes the fits that are missing or have failed, and no others. A
    fit that fails says why in the table and stops nothing. When a worker dies, others make its
    fits; when this process dies, only fits that were being made are lost, and of these, finished
    stages of their search are kept.

    Args:
        experiments: experiments, or paths of their files.
        output: folder for the runs, the table and the report.
        seeds: fits of each clip: with the experiment's seed and those that follow it.
        together: whether the clips of an experiment are fitted together, as `fit` does.
        report: whether each run gets its tables, pictures and page. They are a third of a short
            fit's time and most of its size.
        workers: processes on this machine that compute; None is one for each core, and 0 computes
            in this process.
        scheduler: address of the scheduler of a Dask cluster that computes instead. Its machines
            need this package, and the same files under the same paths.

    Raises:
        ValueError: an experiment cannot be read; there is none, or not one seed; the folder cannot
            be made, holds something that is no such fit, or the fit of another experiment; there is
            no such cluster.
    """
    loaded = _loaded(experiments)
    _check_folder(Path(output))
    with output_folder(output) as folder:
        assert folder is not None
        folder = folder.absolute()
        inputs = folder / INPUTS
        loaded = [with_files(entry, inputs / f"{number}") for number, entry in enumerate(loaded, 1)]
        tasks, began = plan(loaded, seeds, together=together), time.monotonic()
        count = len(tasks)
        with activity.announced(f"Looking for finished fits among {count}"):
            campaign = Campaign(
                f"Making {count} fit{'s' * (count != 1)}",
                tasks,
                functools.partial(fit_task, folder, report=report),
                functools.partial(read_row, folder),
                line=many_report.row_line,
                name=lambda task: task.run.as_posix(),
                failed=lambda task, error: make_row(task, in_one_line(error)),
            )
        missing, interrupted = len(campaign.missing), False
        activity.log(many_report.plan_line(len(loaded), count, missing, seeds))
        if workers is None and scheduler is None:
            workers = usable_cores()
        try:
            with _connected(missing, workers, scheduler) as client:
                campaign.run(client)
        except KeyboardInterrupt:
            interrupted = True
            campaign.look()  # a row may have been written, and not come back
            activity.log("interrupted; writing the table of the finished fits")
        rows, made = tuple(campaign.finished()), missing - len(campaign.missing)
        fits = ManyFits(rows, count, folder, time.monotonic() - began, made, interrupted)
        _write(fits, loaded)
        return fits


def _loaded(
    experiments: Experiment | str | Path | Sequence[Experiment | str | Path],
) -> list[Experiment]:
    """Experiments, read where they are paths of files."""
    if isinstance(experiments, Experiment | str | Path):
        experiments = [experiments]
    return [
        entry if isinstance(entry, Experiment) else load_experiment(entry) for entry in experiments
    ]


def _check_folder(folder: Path) -> None:
    """Raises ValueError where a folder is not of an earlier call, and not a new one either."""
    if not any((folder / name).is_dir() for name in (RUNS, INPUTS)):
        run_folder.check_new_folder(folder)


@contextmanager
def _connected(
    missing: int, workers: int | None, scheduler: str | None
) -> "Iterator[Client | None]":
    """The cluster that makes the missing fits, no larger than they need; None is this process."""
    workers = min(workers or 0, missing)
    with cluster.connect(workers, scheduler if missing else None, dashboard=True) as client:
        if client is not None:
            _log_dashboard(client)
            if scheduler is not None:
                activity.log(_workers_line(cluster.hosts(client), scheduler))
        yield client


def _log_dashboard(client: "Client") -> None:
    """Logs where Dask shows its workers, or what is missing for that."""
    if cluster.has_dashboard():
        activity.log(f"Dask's dashboard: {client.dashboard_link}")
    else:
        activity.log("no dashboard, as bokeh is not installed: pip install 'jaxik[dask]'")


def _workers_line(hosts: Sequence[str], scheduler: str) -> str:
    """Who will compute on a running cluster: a host for each worker."""
    if not hosts:
        return f"no worker has joined yet; fits begin once one has: dask worker {scheduler}"
    machines = len(set(hosts))
    return (
        f"{len(hosts)} worker{'s' * (len(hosts) != 1)} on {machines} "
        f"machine{'s' * (machines != 1)}; more may join at any time"
    )


def _write(fits: ManyFits, experiments: Sequence[Experiment]) -> None:
    """The table, the picture and the page of what there is, and what the terminal shows."""
    written: Sequence[str] = ()
    if fits.rows:
        with activity.announced("Writing the table"):
            written = many_tasks.write(fits.folder, fits.rows)
        if many_tasks.PARQUET not in written:
            activity.log(many_tasks.MISSING)
    folder = fits.folder if fits.rows else None
    publish(folder, many_report.document(fits, experiments, written))


class FailedError(RuntimeError):
    """A fit has failed; the message says why, in one line."""


def fit_task(folder: Path, task: FitTask, *, report: bool = True) -> Row:
    """Makes one fit as `fit` does, and says at last that its run folder is whole.

    The first fit with certain programs keeps others of this machine that need the same ones waiting
    until it has compiled them. The folder of all fits exists, also where another machine made it.

    Raises:
        FailedError: the fit could not be made.
        KeyboardInterrupt: it was interrupted; half a fit counts for nothing.
    """
    watch, run = Stopwatch(), folder / task.run
    try:
        _check_shared_folder(folder)
        with warnings.catch_warnings(record=True) as caught, waiting_for(run.with_suffix(".lock")):
            if (row := read_row(folder, task)) is not None:
                return row  # of another worker that was thought to be dead
            warnings.simplefilter("default")
            fitted = _fit(run, task.experiment, report, watch)
        row = make_row(task)
        row["notes"] = list(dict.fromkeys(in_one_line(Warning(note.message)) for note in caught))
        row["outcome"], row["effort"] = outcome_of(fitted), watch.read()
        (run / ERROR).unlink(missing_ok=True)
        row_store(folder).write(f"{row['run']}/{ROW}", row)
        return row
    except Exception as error:
        if not isinstance(error, ValueError | OSError):  # which are told in a sentence
            run.mkdir(parents=True, exist_ok=True)
            files.write_text(run / ERROR, "".join(traceback.format_exception(error)))
        raise FailedError(in_one_line(error)) from None


class _Wait(activity.Watcher):
    """Waits, once a fit has its problem, while another process compiles the same programs."""

    def __init__(self, watch: Stopwatch, stack: ExitStack) -> None:
        self._watch, self._stack = watch, stack

    def reported(self, result: object) -> None:
        if isinstance(result, Loaded):
            problem = result.problem
            # A rule of the user's own is never kept, so that nobody need wait.
            with suppress(NotPlainError):
                key = program_key(problem.residual_function, ((problem,), {}))
                with self._watch.waiting():
                    self._stack.enter_context(first_alone(key))


def _fit(run: Path, experiment: Experiment, report: bool, watch: Stopwatch) -> Fit:
    with ExitStack() as stack, activity.quiet(), activity.watched_by(_Wait(watch, stack)):
        fitted = fit(experiment, run, report=report)
    if fitted.solution.interrupted:
        (run / run_folder.FIT).unlink(missing_ok=True)
        raise KeyboardInterrupt
    return fitted


def _check_shared_folder(folder: Path) -> None:
    """Raises ValueError where a worker does not see the folder of its client."""
    if not folder.is_dir():
        raise ValueError(
            f"{folder}: there is no such folder on this worker's machine; all machines of a "
            "cluster need the same files under the same paths"
        )
