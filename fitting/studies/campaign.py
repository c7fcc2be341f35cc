"""A campaign: many tasks, each of which makes a row, which is stored as soon as it is there.

Tasks run in this process, in others of this machine, or on a Dask cluster. A campaign that was
interrupted or killed goes on: rows that are stored are not made again.
"""

import functools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from fitting.experiment.experiment import ClipEntry
from fitting.runtime import activity, cluster
from fitting.runtime.validation import error_context

if TYPE_CHECKING:
    from distributed import Client

Task = TypeVar("Task")
Row = TypeVar("Row")


@dataclass
class Campaign(Generic[Task, Row]):
    """Tasks, and the rows that there are of them.

    Raises:
        ValueError: a stored row is something else.
    """

    title: str
    """Says what is done, for the reader."""
    tasks: Sequence[Task]
    make: Callable[[Task], Row]
    """It travels to other processes."""
    read: Callable[[Task], Row | None]
    """The stored row of a task; None if there is none."""
    write: Callable[[Task, Row], object] = lambda task, row: None
    """Stores a new row, where `make` has not."""
    line: Callable[[Row], str] = str
    """Of a new row, for the reader."""
    name: Callable[[Task], str] = str
    """Begins the errors of a task that are the user's."""
    failed: Callable[[Task, Exception], Row] | None = None
    """The row of a task that failed, which is not stored. None lets the first error end all."""
    rows: dict[int, Row] = field(default_factory=dict, init=False)
    """By the index of their task."""

    def __post_init__(self) -> None:
        self.read_stored()

    def read_stored(self) -> None:
        """Takes the rows that are stored."""
        for index in self.missing:
            if (row := self.read(self.tasks[index])) is not None:
                self.rows[index] = row

    @property
    def missing(self) -> list[int]:
        """The indices of the tasks without a row."""
        return [index for index in range(len(self.tasks)) if index not in self.rows]

    def finished(self) -> list[Row]:
        """The rows that there are, in the order of their tasks."""
        return [self.rows[index] for index in sorted(self.rows)]

    def run(self, client: "Client | None" = None) -> list[Row]:
        """Makes the rows that are missing; an interrupt (Ctrl-C) loses those being made, no others.

        Args:
            client: of the cluster that computes. None computes in this process.

        Returns:
            All rows, in the order of their tasks.
        """
        total, failures = len(self.tasks), 0
        with activity.announced(self.title, total, done=len(self.rows)) as work:
            for index, call in self._calls(client):
                task = self.tasks[index]
                try:
                    with error_context(self.name(task)):
                        row = call()
                    self.write(task, row)
                except Exception as error:
                    if self.failed is None:
                        raise
                    row, failures = self.failed(task, error), failures + 1
                self.rows[index] = row
                activity.log(self.line(row))
                work.advance()
                activity.report(row, f"{failures} failed" if failures else "")
        return self.finished()

    def _calls(self, client: "Client | None") -> Iterator[tuple[int, Callable[[], Any]]]:
        """What to call for each missing row, by index; on a cluster in the order of their ends."""
        missing = self.missing
        if client is None:
            for index in missing:
                yield index, functools.partial(self.make, self.tasks[index])
            return
        tasks = [self.tasks[index] for index in missing]
        for place, future in cluster.compute(client, self.make, tasks):
            yield missing[place], future.result


def clip_names(entries: Sequence[ClipEntry]) -> tuple[str, ...]:
    """A name for each clip: that of its file, and where a file has several, which part of it."""
    stems = [entry.reference.stem for entry in entries]
    counts = Counter(stems)
    names = [
        f"{stem} from {entry.start:g} s" if counts[stem] > 1 else stem
        for stem, entry in zip(stems, entries, strict=True)
    ]
    counts = Counter(names)
    return tuple(
        f"{name} ({number})" if counts[name] > 1 else name for number, name in enumerate(names, 1)
    )
