"""Calls in other processes beside what goes on here."""

import multiprocessing
import os
import warnings
from pathlib import Path

import pytest
from loky import get_reusable_executor

from fitting.runtime import beside

MARK = "JAXIK_TEST_MARK"


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beside, "cpu_count", lambda: 2)


def mark() -> None:
    os.environ[MARK] = "prepared"


def write_process(path: Path) -> None:
    path.write_text(f"{os.getpid()} {os.environ.get(MARK, '')}")


def process_of(path: Path) -> int:
    return int(path.read_text().split()[0])


def warn(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=1)


def fail(message: str) -> None:
    raise ValueError(message)


def test_calls_run_in_processes_that_can_be_prepared_and_have_finished_at_the_end(tmp_path):
    get_reusable_executor(2, timeout=beside.IDLE).shutdown(wait=True)
    beside.prepare(mark)
    paths = [tmp_path / str(number) for number in range(20)]
    with beside.calls_beside():
        for path in paths:
            beside.call(write_process, path)
    processes = {process_of(path) for path in paths}
    assert os.getpid() not in processes and len(processes) <= 2
    assert any(path.read_text().endswith("prepared") for path in paths)


def test_without_it_and_on_one_core_calls_run_here_and_at_once(tmp_path, monkeypatch):
    beside.call(write_process, tmp_path / "without")
    assert process_of(tmp_path / "without") == os.getpid()
    monkeypatch.setattr(beside, "cpu_count", lambda: 1)
    beside.prepare(mark)
    with beside.calls_beside():
        beside.call(write_process, tmp_path / "alone")
        assert process_of(tmp_path / "alone") == os.getpid()
    assert MARK not in os.environ


def write_beside(path: Path) -> None:
    beside.cpu_count = lambda: 2
    with beside.calls_beside():
        beside.call(write_process, path)


def test_processes_that_may_have_no_children_such_as_workers_of_dask_call_themselves(tmp_path):
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=write_beside, args=(tmp_path / "file",), daemon=True)
    process.start()
    process.join()
    assert process_of(tmp_path / "file") == process.pid


def test_errors_and_warnings_come_at_the_end_and_an_error_here_does_not_wait_for_calls(tmp_path):
    with pytest.raises(ValueError, match="no such colour"):
        with beside.calls_beside():
            beside.call(fail, "no such colour")
    with pytest.warns(RuntimeWarning, match="a glyph is missing"):
        with beside.calls_beside():
            beside.call(warn, "a glyph is missing")
    with pytest.raises(KeyError, match="here"):
        with beside.calls_beside():
            for number in range(20):
                beside.call(write_process, tmp_path / str(number))
            raise KeyError("here")
    write_beside(tmp_path / "afterwards")
    assert (tmp_path / "afterwards").exists()
