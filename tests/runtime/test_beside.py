"""Calls in other processes beside what goes on here."""

import multiprocessing
import os
import warnings
from pathlib import Path

import pytest
from loky import get_reusable_executor

from fitting.runtime.parallel import beside


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beside, "cpu_count", lambda: 2)


def write_process(path: Path) -> None:
    path.write_text(str(os.getpid()))


def warn(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=1)


def fail(message: str) -> None:
    raise ValueError(message)


def test_calls_run_elsewhere_and_have_finished_at_the_end(tmp_path):
    paths = [tmp_path / str(number) for number in range(5)]
    with beside.calls_beside():
        for path in paths:
            beside.call(write_process, path)
    processes = {int(path.read_text()) for path in paths}
    assert os.getpid() not in processes and len(processes) <= 2


def mark() -> None:
    os.environ["JAXIK_TEST_MARK"] = "prepared"


def write_mark(path: Path) -> None:
    path.write_text(os.environ.get("JAXIK_TEST_MARK", "") + f" {os.getpid()}")


def test_processes_can_be_prepared(tmp_path):
    get_reusable_executor(2, timeout=beside.IDLE).shutdown(wait=True)
    beside.prepare(mark)
    paths = [tmp_path / str(number) for number in range(20)]
    with beside.calls_beside():
        for path in paths:
            beside.call(write_mark, path)
    marks = [path.read_text().split() for path in paths]
    assert ["prepared"] in [mark[:-1] for mark in marks]
    assert str(os.getpid()) not in [mark[-1] for mark in marks]


def test_on_one_core_nothing_is_prepared(monkeypatch):
    monkeypatch.setattr(beside, "cpu_count", lambda: 1)
    beside.prepare(mark)
    assert "JAXIK_TEST_MARK" not in os.environ


def test_without_it_calls_run_here_and_at_once(tmp_path):
    beside.call(write_process, tmp_path / "file")
    assert int((tmp_path / "file").read_text()) == os.getpid()


def test_on_one_core_they_run_here(tmp_path, monkeypatch):
    monkeypatch.setattr(beside, "cpu_count", lambda: 1)
    with beside.calls_beside():
        beside.call(write_process, tmp_path / "file")
        assert int((tmp_path / "file").read_text()) == os.getpid()


def draw_in_a_daemon(path: Path) -> None:
    beside.cpu_count = lambda: 2
    with beside.calls_beside():
        beside.call(write_process, path)


def test_processes_that_may_have_no_children_call_themselves(tmp_path):
    """Such as workers of Dask."""
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=draw_in_a_daemon, args=(tmp_path / "file",), daemon=True)
    process.start()
    process.join()
    assert int((tmp_path / "file").read_text()) == process.pid


def test_an_error_is_raised_at_the_end():
    with pytest.raises(ValueError, match="no such colour"):
        with beside.calls_beside():
            beside.call(fail, "no such colour")


def test_warnings_are_given_at_the_end():
    with pytest.warns(RuntimeWarning, match="a glyph is missing"):
        with beside.calls_beside():
            beside.call(warn, "a glyph is missing")


def test_an_error_here_does_not_wait_for_calls(tmp_path):
    with pytest.raises(KeyError, match="here"):
        with beside.calls_beside():
            for number in range(20):
                beside.call(write_process, tmp_path / str(number))
            raise KeyError("here")
    with beside.calls_beside():  # and spoils nothing
        beside.call(write_process, tmp_path / "afterwards")
    assert (tmp_path / "afterwards").exists()
