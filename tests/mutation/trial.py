"""A throwaway copy of the checkout in which mutants are tested; the checkout stays as it is.

Tests run in processes that are forked from one that has imported JAX but computed nothing with it,
which saves two seconds each time.
"""

import contextlib
import json
import math
import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest

from .mutants import Mutant
from .survey import EVERYTHING

COPIED = ("data", "fitting", "jaxik", "tests", "pyproject.toml", "README.md", "CHANGELOG.md")
SHARED = "shared"  # reference material beside the checkout
PRELOADED = ["jax", "jax.numpy", "equinox", "scipy.stats", "scipy.spatial", "trimesh"]
SECONDS = 180.0  # of CPU for one test, beyond which it hangs
LONGEST = 3600.0  # seconds for all tests together, waiting included
OPTIONS = ["-x", "-q", "--hypothesis-seed=0", "-p", "no:cacheprovider", "-m", EVERYTHING]
OPTIONS += ["-W", "ignore:Module already imported"]  # among what is preloaded
OUTPUT = "output.txt"  # beside the checkout: what pytest prints
NOTES = "notes.json"
PASSED, NO_TESTS = 0, 5  # exit statuses of pytest


class Workplace:
    """The copy, in a folder that is deleted afterwards."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.root = root
        self.checkout = folder / "checkout"
        self._written = 0
        ignored = shutil.ignore_patterns("__pycache__", ".*")
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, self.checkout / name, ignore=ignored)
            elif (root / name).exists():
                shutil.copy2(root / name, self.checkout / name)
        if (root.parent / SHARED).exists():
            (folder / SHARED).symlink_to((root.parent / SHARED).resolve())

    @contextlib.contextmanager
    def mutated(self, mutant: Mutant) -> Iterator[None]:
        """With a mutant in place of its module."""
        path = self.checkout / mutant.path
        path.write_text(mutant.source(self.root), encoding="utf-8")
        # Python recognises a changed module by its size and the second in which it was written.
        self._written += 1
        os.utime(path, (self._written, self._written))
        try:
            yield
        finally:
            shutil.copy2(self.root / mutant.path, path)


@dataclass
class Outcome:
    """What tests did."""

    status: int = PASSED  # of pytest, or minus the signal that ended the process
    last: str = ""  # the test that failed, or the last that began; empty before the first
    stopped: bool = False  # whether there was no time for more tests

    @property
    def none_failed(self) -> bool:
        """Whether all tests passed, as far as there was time for them."""
        return self.stopped or self.status in (PASSED, NO_TESTS)


class Watch:
    """A plugin of pytest: the order of tests, an end to those that hang, notes of what happens."""

    def __init__(self, asked: list[str], notes: Path, budget: float) -> None:
        self.places = {name: place for place, name in enumerate(asked)}
        self.notes, self.budget = notes, budget
        self.session: pytest.Session | None = None
        self.outcome = Outcome()
        self._restart_clock()

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, items: list[pytest.Item]
    ) -> None:
        """Leaves the tests that are asked, in their order."""
        self.session = session
        items[:] = [item for item in items if self._place(item) is not None]
        items.sort(key=self._place)  # pyright: ignore[reportArgumentType]

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Starts the clock of a test."""
        self.outcome.last = item.nodeid
        self._note()
        self._restart_clock()

    def pytest_runtest_logfinish(self) -> None:
        """Ends the run where there is no time for more tests."""
        if time.process_time() > self.budget and self.session and not self.session.shouldfail:
            self.session.shouldstop = "no time is left"
            self.outcome.stopped = True
            self._note()

    def _place(self, item: pytest.Item) -> int | None:
        """Of a test, or of its file where that is asked whole."""
        return self.places.get(item.nodeid, self.places.get(item.nodeid.partition("::")[0]))

    def _note(self) -> None:
        self.notes.write_text(json.dumps(asdict(self.outcome)), encoding="utf-8")

    def _restart_clock(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, SECONDS)  # its signal ends the process


def run_tests(checkout: Path, asked: list[str], budget: float = math.inf) -> Outcome:
    """Runs tests, or whole files, in this order, until one fails or hangs or all took so long."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    notes = checkout.parent / NOTES
    notes.unlink(missing_ok=True)
    process: Any = context.Process(target=_pytest, args=(checkout, asked, budget))
    process.start()
    try:
        process.join(LONGEST)
    finally:  # also what it started
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.join()
    known: dict[str, Any] = json.loads(notes.read_text()) if notes.exists() else {}
    return Outcome(**{**known, "status": process.exitcode or PASSED})


def _pytest(checkout: Path, asked: list[str], budget: float) -> None:
    os.setsid()
    os.chdir(checkout)
    with open(checkout.parent / OUTPUT, "w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    own = [str(checkout), str(checkout / "tests")]
    os.environ["PYTHONPATH"] = os.pathsep.join(own)  # of processes that tests start
    sys.path[:] = [*own, *sys.path]
    watch = Watch(asked, checkout.parent / NOTES, budget)
    files = dict.fromkeys(name.partition("::")[0] for name in asked)
    sys.exit(pytest.main([*OPTIONS, *files], plugins=[watch]))
