"""The row of a fit: what the table of many fits says of it, kept in its run folder.

The file is the last that is written there: a folder that has it is whole.
"""

from pathlib import Path
from typing import Literal, NotRequired, TypedDict

from fitting.runtime.parallel.effort import Effort
from fitting.runtime.storage.declared_types import Finite
from fitting.runtime.storage.json_files import JsonFile
from fitting.studies.fit import Fit, Interval

from .tasks import FitTask

ROW = "row.json"


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


ROW_FILE = JsonFile(Row, "written by `jaxik fit-many`", "delete it to fit anew")


def outcome_of(fitted: Fit) -> Outcome:
    """What a finished fit found."""
    summary = fitted.summary
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
        "parameters": {
            row["name"]: {
                "value": row["value"],
                "unit": row["unit"],
                "interval": row["interval"],
                "determined": row["determined"],
            }
            for row in summary["parameters"]
        },
    }


def finished_row(task: FitTask, outcome: Outcome, effort: Effort, notes: list[str]) -> Row:
    """The row of a fit that is whole."""
    row = _row(task, "finished", "")
    row["notes"], row["outcome"], row["effort"] = notes, outcome, effort
    return row


def failed_row(task: FitTask, error: str) -> Row:
    """The row of a fit that could not be made."""
    return _row(task, "failed", error)


def kept_row(folder: Path, task: FitTask) -> Row | None:
    """The row of a fit that is whole already, in the folder of all fits; None if there is none.

    Raises:
        ValueError: the folder has the fit of an experiment that was changed since.
    """
    path = folder / task.run / ROW
    if not path.is_file():
        return None
    row = ROW_FILE.read(path)
    if row["identity"] != task.identity():
        raise ValueError(
            f"{path.parent}: has the fit of another experiment, or of one that has changed since; "
            "name another folder, or delete this one to fit it anew"
        )
    return row


def write_row(folder: Path, row: Row) -> None:
    """Says that a run is whole."""
    ROW_FILE.write(folder / row["run"] / ROW, row)


def _row(task: FitTask, state: Literal["finished", "failed"], error: str) -> Row:
    return {
        "experiment": task.name,
        "clip": task.clip,
        "seed": task.experiment.seed,
        "run": task.run.as_posix(),
        "state": state,
        "error": error,
        "identity": task.identity(),
        "notes": [],
    }
