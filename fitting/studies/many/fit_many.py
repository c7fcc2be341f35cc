"""Fits of clips × experiments × seeds, each in a run folder, with a table of all and a report.

runs/EXPERIMENT/CLIP/seed_0   where a clip is fitted alone
runs/EXPERIMENT/seed_0        where the clips of an experiment are fitted together

The row of a fit is the last file that is written into its run folder: a folder that has it is
whole. The table has a row for each fit, as CSV and, with pyarrow, as Parquet. It has the parameters
of all experiments; those that a fit lacks are empty.
"""

import csv
import dataclasses
import functools
import hashlib
import io
import re
import statistics
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NotRequired, TypeAlias, TypedDict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from fitting.experiment import file_tables
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.experiment_files import clip_to_table, experiment_to_toml
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import LoadedExperiment
from fitting.report import pages
from fitting.report.document import Document, Finding, Grid, Plot, Points, Section, Text
from fitting.report.formatting import Table, counted, listed, number, percent
from fitting.report.style import AFTER, BEFORE, CAPTURED, panels, styled
from fitting.runtime import activity, cluster, files
from fitting.runtime.cluster import Effort, Stopwatch, first_alone, waiting_for
from fitting.runtime.json_files import JsonFile, Store
from fitting.runtime.plain_tree import NotPlainError
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import program_key
from fitting.runtime.threads import usable_cores
from fitting.runtime.validation import in_one_line
from fitting.studies.campaign import Campaign, clip_names
from fitting.studies.fit import run_folder
from fitting.studies.fit.fit import Fit, FitRecord, FittedParameter
from fitting.studies.fit.fit_jobs import fit
from fitting.studies.output import as_experiment, output_folder, publish

if TYPE_CHECKING:
    from distributed import Client


RUNS = "runs"
TOGETHER = "all clips"
MAX_SEEDS = 10_000

ROW = "row.json"

CSV, PARQUET = "fits.csv", "fits.parquet"
MISSING = f"no {PARQUET}, as pyarrow is not installed: pip install 'jaxik[parquet]'"
Cells: TypeAlias = dict[str, Any]  # by column
OF_SEARCH = {
    "converged": "converged", "cost_before": "cost_before", "cost": "cost", "starts": "starts",
    "agreeing": "agreeing", "steps": "steps", "search_seconds": "seconds",
}  # fmt: skip
"""Keys of a search's record by column."""
OUTCOME = (
    "converged", "fits", "verdict", "cost_before", "cost", "starts", "agreeing", "steps",
    "search_seconds", "frames",
)  # fmt: skip
EFFORT = ("seconds", "waited", "cpu_seconds", "peak_mb", "host", "process")
WHAT = ("experiment", "clip", "seed", "run", "state", "error")

INPUTS = "inputs"  # folder of what experiments have in memory

ERROR = "error.txt"

SUMMARY, FIGURE = "summary.md", "fits.png"
MANY = 50  # rows of a table for people; all are in the file
SPREAD = (
    "Of each parameter: the median of the fitted values of all fits that determine it, where 80 % "
    "of them lie, and how many fits determine it."
)

COLUMNS = 4
DRAWN = 15  # parameters
SHORTEST = 1e-3  # s, of a fit as the histogram shows it
SINGLE = 150  # fits, up to which each has its interval

LIMITS = [
    "Each clip is fitted as if there were no others: that values differ does not say that people "
    "do. `jaxik population` tells spread from uncertainty.",
    "Fits of one clip with several seeds differ by their search only.",
]
TABLES = {"fits.csv": "a row for each fit", "fits.parquet": "the same for pandas and the like"}


@dataclasses.dataclass(frozen=True)
class FitTask:
    """One fit."""

    experiment: Experiment
    """As it is fitted: with its own clips and seed."""
    name: str
    """Of the experiment from which it comes."""
    clip: str
    run: Path
    """From the folder of all fits."""

    def identity(self) -> str:
        """64 characters that change with the experiment and with the content of its files."""
        clips = [entry.with_paths(lambda path: Path(path.name)) for entry in self.experiment.clips]
        text = experiment_to_toml(dataclasses.replace(self.experiment, clips=tuple(clips)))
        contents = [
            _digest(value)
            for entry in self.experiment.clips
            for value in (*clip_to_table(entry).values(), *entry.contacts_files)
            if isinstance(value, Path)
        ]
        return hashlib.sha256(repr((text, contents)).encode()).hexdigest()


def plan(
    experiments: Sequence[Experiment], seeds: int = 1, *, together: bool = False
) -> list[FitTask]:
    """All fits, in the order of experiments, clips and seeds; arguments as of `fit_many`.

    Raises:
        ValueError: there is no experiment, or not one seed; a capture of one of several clips is
            fitted, which each would be alone.
    """
    if not experiments:
        raise ValueError("no experiments; wanted one or more")
    if not 1 <= seeds <= MAX_SEEDS:
        raise ValueError(f"seeds is {seeds}; wanted 1 to {MAX_SEEDS}")
    names = _distinct([_stem(experiment) for experiment in experiments])
    tasks = []
    for name, experiment in zip(names, experiments, strict=True):
        for clip, part, folder in _parts(_with_whole_paths(experiment), together=together):
            for seed in range(experiment.seed, experiment.seed + seeds):
                run = Path(RUNS, name, *folder, f"seed_{seed}")
                tasks.append(FitTask(dataclasses.replace(part, seed=seed), name, clip, run))
    return tasks


def _parts(
    experiment: Experiment, *, together: bool
) -> list[tuple[str, Experiment, tuple[str, ...]]]:
    """The name of what is fitted, its experiment, and its folder."""
    clips = clip_names(experiment.clips)
    if together:
        return [(clips[0] if len(clips) == 1 else TOGETHER, experiment, ())]
    file_tables.check_unnumbered(experiment.capture, str(experiment.path))
    folders = _distinct([_file_name(clip) for clip in clips])
    return [
        (clip, _alone(experiment, entry), (folder,))
        for clip, entry, folder in zip(clips, experiment.clips, folders, strict=True)
    ]


def _alone(experiment: Experiment, entry: ClipEntry) -> Experiment:
    """The experiment with one of its clips, from which nothing differs any more."""
    shared = dataclasses.replace(experiment.hierarchy, per_clip=(), per_subject=())
    whole = None if experiment.whole is None else _alone(experiment.whole, entry)
    return dataclasses.replace(experiment, clips=(entry,), hierarchy=shared, whole=whole)


def _with_whole_paths(experiment: Experiment) -> Experiment:
    """The experiment for a process in another folder."""
    whole = None if experiment.whole is None else _with_whole_paths(experiment.whole)
    clips = tuple(entry.with_paths(Path.absolute) for entry in experiment.clips)
    return dataclasses.replace(experiment, clips=clips, whole=whole)


def _stem(experiment: Experiment) -> str:
    return _file_name(experiment.path.stem or experiment.name or "experiment")


def _file_name(text: str) -> str:
    """A name that a folder may have on any system."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._")[:80] or "unnamed"


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, numbered where several are equal."""
    counts = Counter(name.casefold() for name in names)
    return [
        f"{name}_{number}" if counts[name.casefold()] > 1 else name
        for number, name in enumerate(names, 1)
    ]


def _digest(path: Path) -> str:
    """Of a file's content; of one that cannot be read, why, which the fit then says better."""
    try:
        status = path.stat()
        return _digest_of_state(path, status.st_size, status.st_mtime_ns)
    except OSError as error:
        return str(error.strerror)


@functools.lru_cache(maxsize=4096)  # a terrain may belong to thousands of clips
def _digest_of_state(path: Path, size: int, changed: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Row(TypedDict):
    """A fit, finished or failed."""

    experiment: str
    clip: str
    seed: int
    run: str
    """From the folder of all fits."""
    state: Literal["finished", "failed"]
    error: str
    """Why it failed, in one line; empty where it did not."""
    identity: str
    notes: list[str]
    """Warnings."""
    frames: NotRequired[int]
    """Of its clips."""
    effort: NotRequired[Effort]
    fit: NotRequired[FitRecord]
    """As its run folder has it, but for the history; the row's own file has none."""


ROW_FILE = JsonFile(
    Row, "written by `jaxik fit-many`", "delete it to fit anew, or name another folder"
)


def make_row(task: FitTask, error: str = "") -> Row:
    """The row of a fit that failed, or of a finished one, still without its results."""
    return {
        "experiment": task.name,
        "clip": task.clip,
        "seed": task.experiment.seed,
        "run": task.run.as_posix(),
        "state": "failed" if error else "finished",
        "error": error,
        "identity": task.identity(),
        "notes": [],
    }


def read_row(folder: Path, task: FitTask) -> Row | None:
    """The row of a fit that is whole already, in the folder of all fits; None if there is none.

    Raises:
        ValueError: the folder has the fit of an experiment that was changed since, or it is
            damaged.
    """
    name = f"{task.run / ROW}"
    if not (folder / name).is_file():
        return None  # without the identity, which takes reading all of the clips
    row = row_store(folder).read(name, {"identity": task.identity()})
    if row is not None:
        row["fit"] = _in_brief(run_folder.load_record(folder / task.run))
    return row


def _in_brief(record: FitRecord) -> FitRecord:
    """The record without its history, which would fill the memory with thousands of fits."""
    return {**record, "history": []}


def row_store(folder: Path) -> Store[Row]:
    """The rows in the folder of all fits."""
    return Store(
        ROW_FILE, folder, "has the fit of another experiment, or of one that has changed since"
    )


@dataclasses.dataclass(frozen=True)
class ManyFits:
    """Many fits, each with its row, in the order in which they were planned."""

    rows: tuple[Row, ...]
    """None of fits that an interrupt has left out."""
    total: int
    folder: Path
    elapsed: float = 0.0
    """s, of this call."""
    made: int = 0
    """In this call."""
    interrupted: bool = False

    @property
    def finished(self) -> list[Row]:
        """The rows of fits that are whole."""
        return [row for row in self.rows if row["state"] == "finished"]

    @property
    def failed(self) -> list[Row]:
        """The rows of fits that could not be made."""
        return [row for row in self.rows if row["state"] == "failed"]

    @property
    def records(self) -> dict[str, FitRecord]:
        """Of finished fits, by run."""
        return {row["run"]: row["fit"] for row in self.rows if "fit" in row}

    @property
    def efforts(self) -> list[Effort]:
        """What finished fits took."""
        return [row["effort"] for row in self.rows if "effort" in row]

    @property
    def unconverged(self) -> list[str]:
        """The runs of finished fits whose search has not converged."""
        return [run for run, record in self.records.items() if not record["converged"]]

    @property
    def misfits(self) -> int:
        """How many finished fits leave more of the motion over than noise of the given sigmas."""
        return sum(not record["goodness"]["fits"] for record in self.records.values())


def columns(rows: Sequence[Row]) -> list[str]:
    """The names of all columns; those of parameters last, in the order in which they appear."""
    parameters = dict.fromkeys(
        fitted["name"] for row in rows if "fit" in row for fitted in row["fit"]["parameters"]
    )
    each = [f"{name}{ending}" for name in parameters for ending in ("", ".low", ".high", ".known")]
    return [*WHAT, "notes", *OUTCOME, *EFFORT, *each]


def cells(row: Row) -> Cells:
    """A row of the table, without what is unknown.

    Of each parameter: its value under its name, both ends of its 95 % interval, and whether the
    clip determines it.
    """
    content: Cells = {key: row[key] for key in WHAT} | {"notes": "; ".join(row["notes"])}
    if "fit" in row:
        record = row["fit"]
        content |= {column: record[key] for column, key in OF_SEARCH.items()}
        content |= {"fits": record["goodness"]["fits"], "verdict": record["goodness"]["sentence"]}
        content["frames"] = row.get("frames")
        for fitted in record["parameters"]:
            name, (low, high) = fitted["name"], fitted["interval"]
            content |= {name: fitted["value"], f"{name}.low": low, f"{name}.high": high}
            content[f"{name}.known"] = fitted["determined"]
    if "effort" in row:
        content |= {key: row["effort"][key] for key in EFFORT}
    return content


def write(folder: Path, rows: Sequence[Row]) -> list[str]:
    """Writes the table; returns the names of its files, without that for which pyarrow is missing.

    Raises:
        ValueError: the folder cannot be written to.
    """
    names, content = columns(rows), [cells(row) for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(content)
    files.write_text(folder / CSV, text.getvalue())
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        return [CSV]
    table = pyarrow.table({name: [row.get(name) for row in content] for name in names})
    files.write(folder / PARQUET, lambda path: pyarrow.parquet.write_table(table, path))
    return [CSV, PARQUET]


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
    stages of their search stay.

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
            be made, holds something else, or the fit of another experiment; there is
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
                f"Making {counted(count, 'fit')}",
                tasks,
                functools.partial(fit_task, folder, report=report),
                functools.partial(read_row, folder),
                line=row_line,
                name=lambda task: task.run.as_posix(),
                failed=lambda task, error: make_row(task, in_one_line(error)),
            )
        missing, interrupted = len(campaign.missing), False
        activity.log(plan_line(len(loaded), count, missing, seeds))
        if workers is None and scheduler is None:
            workers = usable_cores()
        try:
            with _connected(missing, workers, scheduler) as client:
                campaign.run(client)
        except KeyboardInterrupt:
            interrupted = True
            campaign.read_stored()  # a row may have been written, and not come back
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
    return list(map(as_experiment, experiments))


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
    where = f"{counted(len(hosts), 'worker')} on {counted(len(set(hosts)), 'machine')}"
    return f"{where}; more may join at any time"


def _write(fits: ManyFits, experiments: Sequence[Experiment]) -> None:
    """The table, the picture and the page of what there is, and what the terminal shows."""
    written: Sequence[str] = ()
    if fits.rows:
        with activity.announced("Writing the table"):
            written = write(fits.folder, fits.rows)
        if PARQUET not in written:
            activity.log(MISSING)
    folder = fits.folder if fits.rows else None
    publish(folder, document(fits, experiments, written))


class FailedError(RuntimeError):
    """A fit has failed; the message says why, in one line."""


def fit_task(folder: Path, task: FitTask, *, report: bool = True) -> Row:
    """Makes one fit as `fit` does, and says at last that its run folder is whole.

    Of the fits on this machine that need the same programs, the first compiles them while the
    others wait. The folder of all fits exists, also where another machine made it.

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
        row["frames"] = sum(scene.frames.dt.shape[0] for scene in fitted.problem.data)
        row["effort"] = watch.read()
        (run / ERROR).unlink(missing_ok=True)
        row_store(folder).write(f"{row['run']}/{ROW}", row)
        row["fit"] = _in_brief(fitted.summary)
        return row
    except Exception as error:
        if not isinstance(error, ValueError | OSError):  # whose message says enough
            run.mkdir(parents=True, exist_ok=True)
            files.write_text(run / ERROR, "".join(traceback.format_exception(error)))
        raise FailedError(in_one_line(error)) from None


class _Wait(activity.Watcher):
    """Waits, once a fit has its problem, while another process compiles the same programs."""

    def __init__(self, watch: Stopwatch, stack: ExitStack) -> None:
        self._watch, self._stack = watch, stack

    def reported(self, result: object) -> None:
        if isinstance(result, LoadedExperiment):
            problem = result.problem
            # Programs with a rule of the user's own are never cached: nobody need wait.
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


def plan_line(experiments: int, tasks: int, missing: int, seeds: int) -> str:
    """The plan, in a line."""
    of = counted(experiments, "experiment")
    seed = f", {seeds} seeds for each clip" if seeds > 1 else ""
    left = "" if missing == tasks else f"; {tasks - missing} are there already"
    return f"{counted(tasks, 'fit')} of {of}{seed}{left}"


def row_line(row: Row) -> str:
    """A fit that ended, in one line."""
    if "fit" not in row:
        return f"{row['run']}: FAILED: {row['error']}"
    record = row["fit"]
    state = "" if record["converged"] else ", not converged"
    seconds = f", {row['effort']['seconds']:.1f} s" if "effort" in row else ""
    return f"{row['run']}: cost {number(record['cost'])}{seconds}{state}"


def parameter_table(fits: ManyFits) -> Table:
    """A row for each parameter of each experiment: where its fitted values lie."""
    rows = [["experiment", "parameter", "unit", "median", "10 %", "90 %", "determined"]]
    for (experiment, name), values in _by_parameter(fits).items():
        known = sorted(fitted["value"] for fitted in values if fitted["determined"])
        figures = [number(q) for q in _quantiles(known)] or ["–"] * 3
        count = f"{len(known)} of {len(values)}"
        rows.append([experiment, name, values[0]["unit"], *figures, count])
    return rows


def _quantiles(values: Sequence[float]) -> list[float]:
    """The median and the ends of the middle 80 %; empty without values."""
    if not values:
        return []
    if len(values) == 1:
        return [values[0]] * 3
    tenths = statistics.quantiles(values, n=10, method="inclusive")
    return [tenths[4], tenths[0], tenths[8]]


def failure_table(fits: ManyFits) -> Table:
    """The fits that failed, each with its error; of very many the first ones."""
    rows = [["run", "error"]]
    rows += [[row["run"], row["error"]] for row in fits.failed[:MANY]]
    if len(fits.failed) > MANY:
        rows.append(["…", f"and {len(fits.failed) - MANY} others"])
    return rows


def fit_table(fits: ManyFits) -> Table:
    """A row for each fit; of very many the first ones."""
    rows = [["run", "state", "cost", "determined", "seconds"]]
    for row in fits.rows[:MANY]:
        if "fit" not in row:
            rows.append([row["run"], "failed!", "–", "–", "–"])
            continue
        record = row["fit"]
        known = sum(fitted["determined"] for fitted in record["parameters"])
        state = "converged" if record["converged"] else "not converged!"
        seconds = f"{row['effort']['seconds']:.1f}" if "effort" in row else "–"
        count = f"{known} of {len(record['parameters'])}"
        rows.append([row["run"], state, number(record["cost"]), count, seconds])
    if len(fits.rows) > MANY:
        rows.append([f"and {len(fits.rows) - MANY} others", "", "", "", ""])
    return rows


def share_by_error(fits: ManyFits) -> list[str]:
    """Errors without what differs from fit to fit, the most frequent first."""
    counts = Counter(row["error"].rpartition(": ")[2] for row in fits.failed)
    return [f"{percent(count / fits.total, 0)}: {error}" for error, count in counts.most_common(3)]


def document(fits: ManyFits, experiments: Sequence[Experiment], tables: Sequence[str]) -> Document:
    """The report of many fits; `tables` are the files that have a row for each."""
    title = (
        "Fitted values with their 95 % intervals, blue where the clip determines the parameter and "
        "grey where it does not; and how long fits took, on a logarithmic axis"
    )
    sections = []
    if fits.finished:
        grid = Grid(parameter_table(fits), "Fitted values of all fits")
        plot = Plot(FIGURE, title, lambda: overview(fits, f"{fits.total} fits"))
        sections.append(Section("Parameters", [grid, Text(SPREAD), plot]))
    return Document(
        file=SUMMARY,
        kind="Many fits, each in a folder of its own",
        title=listed([experiment.name for experiment in experiments]),
        verdict=_verdict(fits),
        good=not (fits.failed or fits.unconverged or fits.interrupted or fits.misfits),
        findings=findings(fits),
        sections=[
            *sections,
            Section("Failed", [Grid(failure_table(fits), "Fits that failed")]),
            Section("Fits", [Grid(fit_table(fits), "All fits", brief=False)]),
            Section("Limits of the data", [Points(LIMITS)]),
        ],
        setup=[
            [
                experiment.name,
                f"{pages.system(experiment)}; {counted(len(experiment.clips), 'clip')}",
            ]
            for experiment in experiments[:MANY]
        ],
        files={name: TABLES[name] for name in tables},
    )


@styled
def overview(fits: ManyFits, title: str) -> Figure:
    """The values of each parameter in all fits, and the seconds that they took."""
    series = list(_by_parameter(fits).items())[:DRAWN]
    figure, grid = panels(len(series) + 1, COLUMNS, title, 3.6, 1.0)
    for axes, ((experiment, name), values) in zip(grid, series, strict=False):
        _values(axes, values)
        axes.set_title(f"{name}\n{experiment}", fontsize=12)
    _seconds(grid[-1], fits)
    return figure


def _by_parameter(fits: ManyFits) -> dict[tuple[str, str], list[FittedParameter]]:
    """The fitted parameters of all fits, by experiment and name."""
    series: dict[tuple[str, str], list[FittedParameter]] = {}
    for row in fits.finished:
        for fitted in row["fit"]["parameters"] if "fit" in row else ():
            series.setdefault((row["experiment"], fitted["name"]), []).append(fitted)
    return series


def _values(axes: Axes, values: Sequence[FittedParameter]) -> None:
    """Each fit's value with its 95 % interval, or a histogram of very many."""
    unit = values[0]["unit"]
    if len(values) > SINGLE:
        known = [fitted["value"] for fitted in values if fitted["determined"]]
        axes.hist([fitted["value"] for fitted in values], 40, color=BEFORE, label="all")
        axes.hist(known, 40, color=AFTER, label="determined")
        axes.set(xlabel=unit, ylabel="fits")
        return
    for row, fitted in enumerate(values, 1):
        colour = AFTER if fitted["determined"] else BEFORE
        axes.plot([row, row], fitted["interval"], color=colour, linewidth=1.2)
        axes.plot(row, fitted["value"], ".", color=colour)
    axes.set(xlabel="fit", ylabel=unit, xlim=(0.5, len(values) + 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _seconds(axes: Axes, fits: ManyFits) -> None:
    """How long fits took, and how much of that was their search."""
    whole = np.array([effort["seconds"] for effort in fits.efforts])
    search = np.array([record["seconds"] for record in fits.records.values()])
    # Logarithmic, for first fits compile and take a hundred times as long as those that follow.
    ends = min(whole.min(), search.min()), max(whole.max(), search.max())
    bins = np.geomspace(max(ends[0], SHORTEST) / 1.1, max(ends[1], SHORTEST) * 1.1, 30).tolist()
    axes.hist(whole, bins, color=AFTER, alpha=0.8, label="fit")
    axes.hist(search, bins, color=CAPTURED, alpha=0.6, label="its search")
    axes.set(xlabel="time, s", ylabel="fits", xscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title("time of a fit", fontsize=12)
    axes.margins(y=0.35)  # room for the legend
    axes.legend(loc="upper right")


def findings(fits: ManyFits) -> list[Finding]:
    """Whether all are there, whether they converged, and what a fit takes."""
    return [_completeness(fits), _convergence(fits), _effort(fits)]


def _verdict(fits: ManyFits) -> str:
    if fits.failed:
        return f"{len(fits.failed)} failed"
    if len(fits.finished) < fits.total:
        return f"{fits.total - len(fits.finished)} are missing"
    if fits.unconverged:
        return f"{len(fits.unconverged)} not converged"
    bad = fits.misfits
    return f"All converged, {bad} do{'es' * (bad == 1)} not match" if bad else "All converged"


def _completeness(fits: ManyFits) -> Finding:
    missing = fits.total - len(fits.rows)
    rest = f"the {missing} that {'is' if missing == 1 else 'are'} missing"
    if fits.failed:
        reasons = "; ".join(share_by_error(fits)).rstrip(".")
        also = f" and makes {rest}" if missing else ""
        return Finding(
            f"{len(fits.failed)} of {fits.total} fits failed: {reasons}; the same command tries "
            f"them again{also}.",
            bad=True,
        )
    if missing:
        return Finding(
            f"{len(fits.finished)} of {fits.total} fits are finished; the same command makes "
            f"{rest}.",
            bad=True,
        )
    return Finding(f"All {fits.total} fits are finished.")


def _convergence(fits: ManyFits) -> Finding:
    count = len(fits.records)
    if not count:
        return Finding("No fit is finished, so nothing was found.", bad=True)
    bad = fits.misfits
    text = f"{count - bad} of {count} match the motion to within the given sigmas"
    if fits.unconverged:
        runs = listed(fits.unconverged)
        return Finding(f"{len(fits.unconverged)} did not converge ({runs}); {text}.", bad=True)
    return Finding(f"All finished searches converged; {text}.", bad=bad > 0)


def _effort(fits: ManyFits) -> Finding:
    efforts = fits.efforts
    if not efforts:
        return Finding("Nothing is known of what a fit takes.")
    seconds = statistics.median(effort["seconds"] for effort in efforts)
    peaks = [effort["peak_mb"] for effort in efforts if effort["peak_mb"] is not None]
    memory = f", and at most {max(peaks):.0f} MB in a process" if peaks else ""
    minutes = sum(effort["cpu_seconds"] for effort in efforts) / 60
    cpu = f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
    hosts = len({effort["host"] for effort in efforts})
    return Finding(
        f"A fit took {seconds:.1f} s (median), all together {cpu} of CPU time on "
        f"{counted(hosts, 'machine')}{memory}."
    )
