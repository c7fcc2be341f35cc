"""Fits that are killed or interrupted, and what the next call makes of their folders."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import fitting
from fitting.cli import main
from fitting.experiments import problems
from fitting.inference.optimisation.solution import Progress
from fitting.inference.profiles import profiling
from fitting.jobs import fits
from fitting.runtime.storage.claimed_folder import LOCK, claimed
from fitting.studies import assess, run_folder
from support import quick, runs
from support.experiments import CLIP, ROOT, write

# All 20 starts are made: some three seconds in which a kill may come.
LONG = "[fit]\nstarts = 20\n[fit.search]\nagreeing_starts = 21\nsweep_values = 60\n"
FEW = "[fit]\nstarts = 2\n[fit.search]\nagreeing_starts = 3\n"


@pytest.fixture
def experiment_file(tmp_path, monkeypatch, undrawn) -> Path:
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    return write(tmp_path, clips=CLIP, clip="start = 1.0\nend = 1.5", rest=FEW)


def content(path: Path) -> Any:
    """A JSON file without durations."""

    def without_seconds(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: without_seconds(v) for k, v in value.items() if k != "seconds"}
        return [without_seconds(v) for v in value] if isinstance(value, list) else value

    return without_seconds(json.loads(path.read_text()))


class Stop(Exception):
    """In place of a kill, where a process need not really die."""


def stop(*_: object) -> None:
    raise Stop


# In this process


@pytest.fixture
def killed(experiment_file, tmp_path, monkeypatch) -> Path:
    """A run that died between its search and its profiles."""
    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(Stop):
        patch.setattr(assess, "assess_identifiability", stop)
        fitting.fit(experiment_file, run)
    assert (run / run_folder.SEARCH).is_file() and not (run / run_folder.FIT).exists()
    return run


def test_a_killed_fit_goes_on_to_the_fit_of_an_unbroken_one(killed, experiment_file, monkeypatch):
    monkeypatch.setattr(fits.fit_report, "write_fit", lambda *_, **__: None)
    lines: list[str] = []
    fitting.fit(experiment_file, killed, log=lines.append)
    assert "a fit that was interrupted here goes on after 14 stages of its search" in lines
    assert not (killed / run_folder.SEARCH).exists() and not (killed / LOCK).exists()
    whole = killed.parent / "whole"
    fitting.fit(experiment_file, whole)
    assert content(killed / run_folder.FIT) == content(whole / run_folder.FIT)
    assert runs.placeless(killed) == runs.placeless(whole)
    parameters = run_folder.PARAMETERS
    assert (killed / parameters).read_text() == (whole / parameters).read_text()


def test_a_fit_that_was_killed_in_its_profiles_goes_on_after_their_last_stage(
    killed, experiment_file, monkeypatch
):
    stages = list(profiling.STAGES)
    with monkeypatch.context() as patch, pytest.raises(Stop):
        patch.setattr(profiling, "STAGES", [*stages[:4], stop])
        fitting.fit(experiment_file, killed)
    whole = fitting.fit(experiment_file)
    lines: list[str] = []
    monkeypatch.setattr(profiling, "STAGES", [stop] * 4 + stages[4:])
    monkeypatch.setattr(fits.fit_report, "write_fit", lambda *_, **__: None)
    again = fitting.fit(experiment_file, killed, log=lines.append)
    (line,) = [line for line in lines if "goes on after" in line]
    assert line.endswith(" stages of its search and 4 of its profiles")
    assert again.parameters == whole.parameters
    assert not (killed / run_folder.SEARCH).exists()


@pytest.mark.parametrize("change", ["seed = 1", 'loss = "huber"'])
def test_the_search_of_another_experiment_is_not_used(killed, experiment_file, change, monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr(assess, "assess_identifiability", stop)
    other = experiment_file.with_name("other.toml")
    other.write_text(f"{change}\n{experiment_file.read_text()}")
    with pytest.raises(Stop):
        fitting.fit(other, killed, log=lines.append)
    (line,) = [line for line in lines if run_folder.SEARCH in line]
    assert "of another fit, or of another version; the fit begins anew" in line


def test_an_interrupted_fit_goes_on(experiment_file, tmp_path, monkeypatch):
    run, reports = tmp_path / "run", []

    def interrupt(report: Progress) -> None:
        reports.append(report)
        if len(reports) == 40:
            raise KeyboardInterrupt

    monkeypatch.setattr(fits.fit_report, "write_fit", lambda *_, **__: None)
    first = fitting.fit(experiment_file, run, progress=interrupt)
    assert first.solution.interrupted and (run / run_folder.SEARCH).is_file()
    second, whole = fitting.fit(experiment_file, run), fitting.fit(experiment_file)
    assert second.solution.u.tolist() == whole.solution.u.tolist()
    assert second.solution.message == whole.solution.message
    assert not (run / run_folder.SEARCH).exists()


@pytest.mark.parametrize("command", ["fit", "ablate", "calibrate", "population"])
def test_a_second_command_in_a_folder_is_refused(killed, experiment_file, command, capsys):
    (killed / run_folder.SEARCH).unlink()
    before = sorted(path.name for path in killed.iterdir())
    with claimed(killed):
        words = [command, str(experiment_file), "-o", str(killed)]
        assert main.main(words) == main.MISTAKE
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{killed}: in use by process {os.getpid()} on " in line
    assert sorted(path.name for path in killed.iterdir()) == before


# In processes of their own


def start(experiment: Path, run: Path) -> subprocess.Popen:
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    return subprocess.Popen(
        [sys.executable, "-m", "support.quick", "fit", str(experiment), "-o", str(run)],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def kill_when(process: subprocess.Popen, path: Path, seconds: float = 0.0) -> None:
    """Kills a process so many seconds after a file has appeared."""
    began = time.monotonic()
    while not path.is_file():
        assert process.poll() is None and time.monotonic() - began < 120
        time.sleep(0.01)
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


@pytest.mark.slow
def test_a_fit_that_is_killed_at_random_searches_on_as_if_it_had_not_been(tmp_path):
    path = write(tmp_path, clips=CLIP, clip="start = 1.0\nend = 1.5", rest=LONG)
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    kill_when(start(path, whole), whole / run_folder.PARAMETERS)
    moment = random.uniform(0.0, 3.0)
    kill_when(start(path, killed), killed / run_folder.SEARCH, moment)
    assert (killed / LOCK).is_file(), moment
    kill_when(start(path, killed), killed / run_folder.PARAMETERS)
    text = (whole / run_folder.PARAMETERS).read_text()
    assert (killed / run_folder.PARAMETERS).read_text() == text, moment
    assert content(killed / run_folder.SEARCH) == content(whole / run_folder.SEARCH), moment
