"""What a command is busy with, in lines at the bottom of a terminal that rich keeps up to date."""

import sys
from collections.abc import Iterable

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
)
from rich.text import Text

from fitting.runtime.activity import Work

from . import plain_lines

BAR = 8  # columns
BESIDE = 44  # columns that bar and counts take at most
DIM = "dim"  # style


class LiveLines:
    """A line for each work that is going on, with a bar where its parts are counted.

    What took longer than a moment leaves a line with its duration, unless it is part of other work.
    """

    def __init__(self, console: Console):
        self._console = console
        self._going_on: list[tuple[Work, TaskID]] = []
        self._lines: _Lines | None = None

    def __enter__(self) -> "LiveLines":
        return self

    def __exit__(self, *error: object) -> None:
        if self._lines is not None:  # an interrupt came between the beginning and the end
            self._lines.stop()
            self._lines = None

    def began(self, work: Work) -> None:
        """Called before the work begins."""
        if self._lines is None:
            self._lines = _Lines(self._console)
            self._lines.start()
        title, room = "  " * len(self._going_on) + work.title, self._console.width - BESIDE
        title = title if len(title) <= room else f"{title[: room - 1]}…"
        task = self._lines.add_task(title, total=work.total, completed=work.done, work=work)
        self._going_on.append((work, task))

    def changed(self, work: Work) -> None:
        """Called with a new count or note."""
        if self._lines is not None:
            for entry, task in self._going_on:
                if entry is work:
                    self._lines.update(task, completed=work.done)

    def ended(self, work: Work) -> None:
        """Called when it is done, or has failed."""
        ended = [pair for pair in self._going_on if pair[0] is work]
        if self._lines is None or not ended:  # an interrupt came before it had begun
            return
        self._going_on.remove(ended[0])
        self._lines.remove_task(ended[0][1])
        if not self._going_on:
            self._lines.stop()
            self._lines = None
            if work.seconds >= plain_lines.PATIENCE:
                self._console.print(Text(plain_lines.ending(work), DIM))


class _Lines(Progress):
    """The lines, and below them what is compiled, or what the innermost work last said."""

    def __init__(self, console: Console):
        super().__init__(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            _Bar(bar_width=BAR),
            _Pace(),
            console=console,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),  # what goes elsewhere must go there
        )

    def get_renderables(self) -> Iterable[RenderableType]:
        """The parts of what is shown."""
        yield self.make_tasks_table(self.tasks)
        works = [task.fields["work"] for task in self.tasks]
        notes = [work.compiling or work.note for work in works]
        if note := next(filter(None, reversed(notes)), ""):
            yield Text(f"  {note}", DIM, no_wrap=True, overflow="ellipsis")


class _Bar(BarColumn):
    """A bar where parts are counted."""

    def render(self, task: Task) -> RenderableType:  # type: ignore[override]  # or nothing
        return Text() if task.total is None else super().render(task)


class _Pace(ProgressColumn):
    """How many parts are done, how fast, how long the rest takes; of other work, its time."""

    def render(self, task: Task) -> Text:
        """The text of a line."""
        work: Work = task.fields["work"]
        if work.total is None:
            return Text(plain_lines.duration(work.seconds))
        text = f"{work.done} of {work.total}"
        each = work.seconds_each
        if each is None or work.seconds < plain_lines.PATIENCE:
            return Text(text)
        if each > 0:
            text += f", {1 / each:.0f}/s" if each < 0.5 else f", {each:.1f} s each"
        if (left := work.seconds_left) is not None:
            text += f", {plain_lines.duration(left)} left"
        return Text(text)
