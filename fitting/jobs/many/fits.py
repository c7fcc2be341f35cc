"""The job that fits clips × experiments × seeds, each in a run folder of its own."""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.in_memory.saving import with_files
from fitting.jobs.output import Log, log_output, output_folder, silent
from fitting.report.formatting import joined
from fitting.report.many import many_report
from fitting.report.page.studies import many_page
from fitting.runtime import activity
from fitting.runtime.parallel import cluster
from fitting.runtime.precision import in_float64
from fitting.runtime.threads import usable_cores
from fitting.runtime.validation import in_one_line
from fitting.studies.many import table
from fitting.studies.many.progress import ManyFits, ManyProgress
from fitting.studies.many.rows import Row, failed_row, kept_row
from fitting.studies.many.tasks import FitTask, plan

from .task import fit_task

if TYPE_CHECKING:
    from distributed import Client

INPUTS = "inputs"  # folder of what experiments have in memory


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
    progress: Callable[[ManyProgress], None] = lambda report: None,
    log: Log = silent,
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
        progress: called with each fit that ends.
        log: called with what the command line prints.

    Raises:
        ValueError: an experiment cannot be read; there is none, or not one seed; the folder cannot
            be made or holds the fit of another experiment; there is no such cluster.
    """
    if isinstance(experiments, Experiment | str | Path):
        experiments = [experiments]
    loaded = [
        entry if isinstance(entry, Experiment) else load_experiment(entry) for entry in experiments
    ]
    with output_folder(output) as folder:
        assert folder is not None
        folder = folder.absolute()
        inputs = folder / INPUTS
        loaded = [with_files(entry, inputs / f"{number}") for number, entry in enumerate(loaded, 1)]
        tasks = plan(loaded, seeds, together=together)
        with activity.announced(f"Looking for finished fits among {len(tasks)}"):
            kept = [kept_row(folder, task) for task in tasks]
        missing = [task for task, row in zip(tasks, kept, strict=True) if row is None]
        log(many_report.plan_line(len(loaded), len(tasks), len(missing), seeds))
        if workers is None:
            workers = 0 if scheduler is not None else min(usable_cores(), len(missing))
        elif missing:
            workers = min(workers, len(missing))
        rows = dict(zip(tasks_by_run(tasks), kept, strict=True))
        began, made, interrupted = time.monotonic(), 0, False
        make = functools.partial(fit_task, folder, report=report)
        title = f"Fitting {len(tasks)} clips" if seeds == 1 else f"Making {len(tasks)} fits"
        try:
            with (
                cluster.connect(
                    workers if missing else 0, scheduler if missing else None, dashboard=True
                ) as client,
                activity.announced(title, len(tasks), done=len(tasks) - len(missing)) as fitting,
            ):
                log_dashboard(client, log)
                for row in _computed(client, make, missing):
                    rows[row["run"]] = row
                    made += 1
                    log(many_report.row_line(row))
                    now = _progress(rows, len(tasks), made, time.monotonic() - began)
                    fitting.advance()
                    activity.note(many_report.progress_line(now))
                    progress(now)
        except KeyboardInterrupt:
            interrupted = True
        present = tuple(row for row in rows.values() if row is not None)
        elapsed = time.monotonic() - began
        fits = ManyFits(present, len(tasks), folder, elapsed, made, interrupted)
        if present:
            _write(fits, loaded, log)
        log(joined(["", many_report.many_text(fits)]))
        log_output(log, folder, many_report.SUMMARY)
        return fits


def tasks_by_run(tasks: Sequence[FitTask]) -> dict[str, FitTask]:
    """The tasks by their run folders."""
    return {task.run.as_posix(): task for task in tasks}


def log_dashboard(client: "Client | None", log: Log) -> None:
    """Logs where Dask shows its workers, or what is missing for that."""
    if client is None:
        return
    if cluster.has_dashboard():
        log(f"Dask's dashboard: {client.dashboard_link}")
    else:
        log("no dashboard, as bokeh is not installed: pip install 'jaxik[dask]'")


def _computed(
    client: "Client | None", make: Callable[[FitTask], Row], tasks: Sequence[FitTask]
) -> Iterator[Row]:
    """The rows of these tasks as they end, of whatever process."""
    if client is None:
        yield from map(make, tasks)
        return
    for index, future in cluster.compute(client, make, tasks):
        try:
            yield future.result()
        except Exception as error:  # its workers died one after another
            yield failed_row(tasks[index], in_one_line(error))


def _progress(rows: dict[str, Row | None], total: int, made: int, elapsed: float) -> ManyProgress:
    present = [row for row in rows.values() if row is not None]
    failed = sum(row["state"] == "failed" for row in present)
    return ManyProgress(len(present), total, failed, elapsed, made)


def _write(fits: ManyFits, experiments: Sequence[Experiment], log: Log) -> None:
    """The table, the picture and the page of what there is."""
    with activity.announced("Writing the table"):
        written = table.write(fits.folder, fits.rows)
    if table.PARQUET not in written:
        log(table.MISSING)
    with activity.announced("Drawing the report"):
        many_report.write(fits, written)
        many_page.write(fits, experiments, written)
