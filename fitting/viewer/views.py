"""Jobs that show a page in the browser: a run, a clip, or a fit while it goes on."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import jaxik
from fitting import viewer
from fitting.experiment.problems import LoadedExperiment
from fitting.inference.optimise.solution import Report
from fitting.problem.capture_system import alone
from fitting.problem.problem import Problem
from fitting.runtime import activity
from fitting.viewer.server import HERE, Address, Server, Viewer

BEST = "best so far"
EVERY = 0.5  # s, at least, between two points of a fit that are drawn


@contextmanager
def opened(session: viewer.Session, folder: Path, address: Address = HERE) -> Iterator[Server]:
    """The server of a page while it is open; it has a `viewer`.

    Args:
        session: what is viewed.
        folder: where Save writes.
        address: of the page.

    Raises:
        ValueError: the address or the folder does not exist.
    """
    check_folder(folder)
    with closing(Server(Viewer(session, folder), address)) as server:
        activity.log(f"{session.title}: open {server.url} in a browser")
        if not address.is_local:
            note = f"note: whoever reaches {address.host} can move sliders, and save into {folder}"
            activity.log(note)
        yield server


def view(
    session: viewer.Session,
    folder: str | Path,
    address: Address = HERE,
    *,
    until: threading.Event | None = None,
) -> None:
    """Shows a page until an event is set, or for ever; KeyboardInterrupt (Ctrl-C) ends it.

    Raises:
        ValueError: as `opened`.
    """
    event = until or threading.Event()
    try:
        with opened(session, Path(folder), address):
            while not event.wait(0.5):
                pass
    except KeyboardInterrupt:
        activity.log("")


def view_run(run: str | Path, folder: str | Path | None, address: Address = HERE) -> None:
    """Shows the clips of a run; Save writes into its folder, unless another one is named.

    Raises:
        ValueError: as `opened`, or the folder holds no finished fit.
    """
    if folder is not None:
        check_folder(Path(folder))
    view(viewer.session_of_run(Path(run)), folder or run, address)


def check_folder(folder: Path) -> None:
    """Checks, before anything is computed, that Save can write.

    Raises:
        ValueError: there is no such folder.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder, in which to save; make it, or name another")


@dataclass
class FitWatch(activity.Watcher):
    """Shows the best point of a fit on a page while the search goes on.

    Args:
        folder: of the run, where Save writes.
        address: of the page.
    """

    folder: Path
    address: Address
    server: Server | None = field(default=None, repr=False)
    """Once there is one."""
    _page: ExitStack = field(default_factory=ExitStack, repr=False)
    _problem: Problem[jaxik.FootIK] | None = field(default=None, repr=False)
    _last: tuple[float, float] = (float("inf"), float("-inf"))  # cost, and when it was drawn

    def __enter__(self) -> "FitWatch":
        return self

    def __exit__(self, *error: object) -> None:
        self._page.close()

    def reported(self, result: object) -> None:
        """Opens the page once the clips are loaded; then shows the best point, now and then."""
        if isinstance(result, LoadedExperiment):
            self._problem = result.problem
            page = opened(
                viewer.session_of_fit(result.experiment, result.problem, result.clips),
                self.folder,
                self.address,
            )
            self.server = self._page.enter_context(page)
        elif isinstance(result, Report) and self.server and self._problem:
            self._show(result, self._problem, self.server.viewer)

    def _show(self, report: Report, problem: Problem[jaxik.FootIK], shown: Viewer) -> None:
        """Shows the best point where it differs from the last one."""
        cost, when = self._last
        now = time.monotonic()
        if report.best != cost and now - when >= EVERY:  # it rises where noise is estimated anew
            self._last = (report.best, now)
            ik = alone(problem.space.unpack(report.best_u))
            note = f"The fit goes on: {report.stage}, best cost {report.best:.6g}."
            shown.restart(BEST, ik, note)
