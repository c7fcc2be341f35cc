"""What is fitted: each clip of each experiment, with each seed, in a run folder of its own.

runs/EXPERIMENT/CLIP/seed_0   where a clip is fitted alone
runs/EXPERIMENT/seed_0        where the clips of an experiment are fitted together

The row of a fit: what the table of many fits says of it, kept in its run folder.

The file is the last that is written there: a folder that has it is whole.

The table of many fits: a row for each, as CSV and, with pyarrow, as Parquet.

Parameters of different experiments share the table: what a fit has not is empty.
"""

import csv
import dataclasses
import functools
import hashlib
import io
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NotRequired, TypeAlias, TypedDict

from fitting.experiment import file_tables
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.experiment_files import experiment_to_toml
from fitting.runtime import files
from fitting.runtime.cluster import Effort
from fitting.runtime.json_files import Finite, JsonFile
from fitting.runtime.store import Store
from fitting.studies.campaign import clip_names
from fitting.studies.fit.fit import Fit, Interval

RUNS = "runs"
TOGETHER = "all clips"
MAX_SEEDS = 10_000


ROW = "row.json"


CSV, PARQUET = "fits.csv", "fits.parquet"
MISSING = f"no {PARQUET}, as pyarrow is not installed: pip install 'jaxik[parquet]'"
Cells: TypeAlias = dict[str, Any]  # by column
OUTCOME = (
    "converged", "fits", "verdict", "cost_before", "cost", "starts", "agreeing", "steps",
    "search_seconds", "frames",
)  # fmt: skip
EFFORT = ("seconds", "waited", "cpu_seconds", "peak_mb", "host", "process")
WHAT = ("experiment", "clip", "seed", "run", "state", "error")


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
            for value in vars(entry).values()
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
    """A name as a folder may have it on any system."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._")[:80] or "unnamed"


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, with a number where several are alike."""
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


class FittedValue(TypedDict):
    """What a fit says of a parameter."""

    value: Finite
    unit: str
    interval: Interval
    """95 %."""
    determined: bool


class Outcome(TypedDict):
    """What a fit found."""

    converged: bool
    fits: bool
    verdict: str
    """One sentence."""
    cost_before: Finite
    cost: Finite
    starts: int
    agreeing: int
    steps: int
    search_seconds: float
    """Of the effort; all else prepares and assesses."""
    frames: int
    """Of its clips."""
    parameters: dict[str, FittedValue]


class Row(TypedDict):
    """A fit that was tried."""

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
    outcome: NotRequired[Outcome]
    effort: NotRequired[Effort]


ROW_FILE = JsonFile(
    Row, "written by `jaxik fit-many`", "delete it to fit anew, or name another folder"
)


def outcome_of(fitted: Fit) -> Outcome:
    """What a finished fit found."""
    summary = fitted.summary
    parameters: dict[str, FittedValue] = {
        row["name"]: {
            "value": row["value"],
            "unit": row["unit"],
            "interval": row["interval"],
            "determined": row["determined"],
        }
        for row in summary["parameters"]
    }
    return {
        "converged": summary["converged"],
        "fits": summary["goodness"]["fits"],
        "verdict": summary["goodness"]["sentence"],
        "cost_before": summary["cost_before"],
        "cost": summary["cost"],
        "starts": summary["starts"],
        "agreeing": summary["agreeing"],
        "steps": summary["steps"],
        "search_seconds": summary["seconds"],
        "frames": sum(scene.frames.dt.shape[0] for scene in fitted.problem.data),
        "parameters": parameters,
    }


def make_row(task: FitTask, error: str = "") -> Row:
    """The row of a fit that could not be made, or of one that is whole but for what it found."""
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
        ValueError: the folder has the fit of an experiment that was changed since.
    """
    name = f"{task.run / ROW}"
    if not (folder / name).is_file():
        return None  # without the identity, which takes reading all of the clips
    return row_store(folder).read(name, {"identity": task.identity()})


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
    def outcomes(self) -> dict[str, Outcome]:
        """What finished fits found, by run."""
        return {row["run"]: row["outcome"] for row in self.rows if "outcome" in row}

    @property
    def efforts(self) -> list[Effort]:
        """What finished fits took."""
        return [row["effort"] for row in self.rows if "effort" in row]

    @property
    def unconverged(self) -> list[str]:
        """The runs of finished fits whose search has not converged."""
        return [run for run, outcome in self.outcomes.items() if not outcome["converged"]]

    @property
    def misfits(self) -> int:
        """How many finished fits leave more of the motion over than noise of the given sigmas."""
        return sum(not outcome["fits"] for outcome in self.outcomes.values())


def columns(rows: Sequence[Row]) -> list[str]:
    """The names of all columns; those of parameters last, in the order in which they appear."""
    parameters = dict.fromkeys(
        name for row in rows if "outcome" in row for name in row["outcome"]["parameters"]
    )
    each = [f"{name}{ending}" for name in parameters for ending in ("", ".low", ".high", ".known")]
    return [*WHAT, "notes", *OUTCOME, *EFFORT, *each]


def cells(row: Row) -> Cells:
    """A row of the table; what it has not is left out.

    Of each parameter: its value under its name, both ends of its 95 % interval, and whether the
    clip determines it.
    """
    content: Cells = {key: row[key] for key in WHAT} | {"notes": "; ".join(row["notes"])}
    if "outcome" in row:
        outcome = row["outcome"]
        content |= {key: outcome[key] for key in OUTCOME}
        for name, fitted in outcome["parameters"].items():
            low, high = fitted["interval"]
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
