"""How far many fits are, and what was found in the end."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from .rows import Row, kept_row
from .tasks import FitTask


@dataclasses.dataclass(frozen=True)
class ManyProgress:
    """How far many fits are; reported with each that ends."""

    done: int
    """Those of earlier calls included."""
    total: int
    failed: int
    elapsed: float
    """s, of this call."""
    made: int
    """In this call."""

    @property
    def rate(self) -> float:
        """Fits a minute, in this call."""
        return 60.0 * self.made / max(self.elapsed, 1e-9)

    @property
    def remaining(self) -> float:
        """s, estimated; infinite before the first fit of this call is done."""
        return 60.0 * (self.total - self.done) / self.rate if self.made else float("inf")


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
    def unconverged(self) -> list[Row]:
        """The rows of finished fits whose search has not converged."""
        return [
            row for row in self.finished if "outcome" in row and not row["outcome"]["converged"]
        ]


class Tally:
    """The rows of many fits: those that are kept from earlier calls, and new ones as they end."""

    def __init__(self, folder: Path, tasks: Sequence[FitTask]) -> None:
        """Looks for finished fits.

        Raises:
            ValueError: the folder has the fit of an experiment that was changed since.
        """
        self.folder, self.tasks = folder, tasks
        kept = [kept_row(folder, task) for task in tasks]
        self.missing = [task for task, row in zip(tasks, kept, strict=True) if row is None]
        """The fits that are to be made."""
        runs = [task.run.as_posix() for task in tasks]
        self._rows = dict(zip(runs, kept, strict=True))
        self._began = time.monotonic()
        self._made = self._failed = 0

    def add(self, row: Row) -> None:
        """Takes the row of a fit that was missing."""
        self._rows[row["run"]] = row
        self._made += 1
        self._failed += row["state"] == "failed"

    def look_again(self) -> None:
        """Takes the rows that were written and not yet told of, as an interrupt came between."""
        for task in self.missing:
            if self._rows[task.run.as_posix()] is None and (row := kept_row(self.folder, task)):
                self.add(row)

    def progress(self) -> ManyProgress:
        """How far the fits are."""
        done = len(self.tasks) - len(self.missing) + self._made
        return ManyProgress(done, len(self.tasks), self._failed, self._elapsed, self._made)

    def fits(self, *, interrupted: bool) -> ManyFits:
        """All rows there are, in the order of the tasks."""
        rows = tuple(row for row in self._rows.values() if row is not None)
        total = len(self.tasks)
        return ManyFits(rows, total, self.folder, self._elapsed, self._made, interrupted)

    @property
    def _elapsed(self) -> float:
        return time.monotonic() - self._began
