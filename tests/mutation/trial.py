"""Runs tests on the copy of the checkout, in a process of its own.

The process is forked from one that has imported JAX but computed nothing with it, which saves
two seconds each time.
"""

import contextlib
import json
import math
import multiprocessing
import os
import signal
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest

from .ranking import Group

PRELOADED = ["jax", "jax.numpy", "equinox", "scipy.stats", "scipy.spatial", "trimesh"]
SECONDS = 180.0  # of CPU for one test, beyond which it hangs
LONGEST = 3600.0  # seconds for all tests together, waiting included
OPTIONS = ["-x", "-q", "--hypothesis-seed=0", "-p", "no:cacheprovider", "-m", "slow or not slow"]
OPTIONS += ["-W", "ignore:Module already imported"]  # among what is preloaded
OUTPUT = "output.txt"  # beside the checkout: what pytest prints
NOTES = "notes.json"
PASSED, NO_TESTS = 0, 5  # exit statuses of pytest


@dataclass
class Outcome:
    """What tests did."""

    status: int = PASSED
    """Of pytest, or minus the signal that ended the process."""
    last: str = ""
    """The test that failed, or the last that began; empty before the first."""
    slow: bool = False
    """Whether that test is marked as slow."""
    passed: dict[str, tuple[float, bool]] = field(default_factory=dict)
    """CPU seconds of each test that passed, and whether it is marked as slow."""
    stopped: bool = False
    """Whether there was no time for more tests."""

    @property
    def none_failed(self) -> bool:
        """Whether all tests passed, as far as there was time for them."""
        return self.stopped or self.status in (PASSED, NO_TESTS)


class Watch:
    """A plugin of pytest: the order of tests, an end to those that hang, notes of what happens."""

    def __init__(self, groups: list[Group], notes: Path, budget: float) -> None:
        self.places = {group: place for place, group in enumerate(groups)}
        self.notes, self.budget = notes, budget
        self.session: pytest.Session | None = None
        self.outcome = Outcome()
        self.begin = 0.0
        self._restart_clock()

    def pytest_sessionstart(self, session: pytest.Session) -> None:
        """Takes hold of what can be stopped."""
        self.session = session

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leaves the tests of the groups, in their order."""
        if self.places:
            items[:] = [item for item in items if _group(item) in self.places]
            items.sort(key=lambda item: self.places[_group(item)])

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Starts the clock of a test."""
        self.outcome.last, self.outcome.slow = item.nodeid, _group(item).slow
        self._note()
        self._restart_clock()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Notes that a test passed."""
        if report.when == "call" and report.passed:
            seconds = round(_cpu_seconds() - self.begin, 2)
            self.outcome.passed[report.nodeid] = seconds, self.outcome.slow
            self._note()

    def pytest_runtest_logfinish(self) -> None:
        """Ends the run where there is no time for more tests."""
        if _cpu_seconds() > self.budget and self.session and not self.session.shouldfail:
            self.session.shouldstop = "no time is left"
            self.outcome.stopped = True
            self._note()

    def _note(self) -> None:
        self.notes.write_text(json.dumps(asdict(self.outcome)), encoding="utf-8")

    def _restart_clock(self) -> None:
        self.begin = _cpu_seconds()
        signal.setitimer(signal.ITIMER_PROF, SECONDS)  # its signal ends the process


def run_groups(checkout: Path, groups: list[Group], budget: float) -> Outcome:
    """Runs groups of tests until a test fails or hangs, or all took so many CPU seconds."""
    return _run(checkout, list(dict.fromkeys(group.file for group in groups)), groups, budget)


def run_test(checkout: Path, test: str) -> Outcome:
    """Runs a single test, named as pytest does."""
    return _run(checkout, [test], [], math.inf)


def _run(checkout: Path, names: list[str], groups: list[Group], budget: float) -> Outcome:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    notes = checkout.parent / NOTES
    notes.unlink(missing_ok=True)
    process = context.Process(target=_pytest, args=(checkout, names, groups, budget))
    process.start()
    try:
        process.join(LONGEST)
    finally:
        _end(process)
    known: dict[str, Any] = json.loads(notes.read_text()) if notes.exists() else {}
    return Outcome(**{**known, "status": process.exitcode or PASSED})


def _pytest(checkout: Path, names: list[str], groups: list[Group], budget: float) -> None:
    os.setsid()
    os.chdir(checkout)
    with open(checkout.parent / OUTPUT, "w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    own = [str(checkout), str(checkout / "tests")]
    os.environ["PYTHONPATH"] = os.pathsep.join(own)  # of processes that tests start
    sys.path[:] = [*own, *sys.path]
    watch = Watch(groups, checkout.parent / NOTES, budget)
    sys.exit(pytest.main([*OPTIONS, *names], plugins=[watch]))


def _end(process: Any) -> None:
    """Ends a process and those that it started, if they still run."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.join()


def _group(item: pytest.Item) -> Group:
    file = item.nodeid.partition("::")[0]
    return Group(file, item.get_closest_marker("slow") is not None)


def _cpu_seconds() -> float:
    times = os.times()
    return times.user + times.system
