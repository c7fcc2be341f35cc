"""Studies that are interrupted or killed, and what the next call makes of their folders."""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple
from unittest.mock import Mock

import pytest

import fitting
from fitting.cli import main
from fitting.experiment.experiment_files import load_experiment
from fitting.inference.profiles import profiling
from fitting.runtime.claimed_folder import LOCK, claimed
from fitting.studies import ablation, population
from fitting.studies.calibrate import replicates
from fitting.studies.fit import assess, fit_jobs, run_folder
from fitting.studies.fit.fit import Fit
from fitting.studies.many import fit_many
from fitting.studies.many.fit_many import plan
from support import runs, small_studies
from support.experiments import ROOT, write
from support.small_studies import HALF_SECOND, ONE_START, TWO_HALF_SECONDS, kept
from support.watching import listening

FEW = "[fit]\nstarts = 2\n[fit.search]\nagreeing_starts = 3\n"
SEARCH = "search_with_noise"

# Interrupted; `tests/test_jobs.py` interrupts fits


class Stop(NamedTuple):
    """An interrupt in the middle of a call of a function, and how many files there are then."""

    module: ModuleType
    function: str
    call: int
    files: str
    count: int


class Study(NamedTuple):
    """A command that is interrupted, once or in several places one after another."""

    prepare: Callable[[Path, pytest.MonkeyPatch], Path]
    options: str
    stops: list[Stop]
    missing: int
    """Calls of the last function that the last command has to make."""
    unfinished: str = "none"
    """What an interrupted search leaves."""


STUDIES = {
    "ablate": Study(
        small_studies.quick_ablation, "", [Stop(ablation, SEARCH, 2, ablation.NUMBERS, 1)], 5
    ),
    "calibrate": Study(
        small_studies.quick_calibration,
        "--replicates 2 --chains",
        [
            Stop(replicates, SEARCH, 2, "fits/*.json", 1),
            Stop(replicates, "sample_around", 2, "chains/*.json", 1),
        ],
        1,
    ),
    "population": Study(
        small_studies.quick_population,
        "",
        [Stop(population, SEARCH, 6, "searches/*.json", 5)],
        2,
        "searches/*.part",
    ),
    "fit-many": Study(
        small_studies.quick_many,
        "--workers 0 --no-reports",
        [Stop(fit_jobs, SEARCH, 2, "runs/**/row.json", 1)],
        1,
        "runs/**/search.json",
    ),
}


def watch(patch: pytest.MonkeyPatch, stop: Stop, *, interrupted: bool = False) -> list[str]:
    """The calls of a function from now on, of which one may be interrupted as it goes on."""
    function, calls = getattr(stop.module, stop.function), []

    def interrupt(report) -> None:
        if getattr(report, "stage", "polish").startswith("polish"):
            raise KeyboardInterrupt

    def called(*arguments, **named):
        calls.append(stop.function)
        if interrupted and len(calls) == stop.call:
            with listening(reported=interrupt):
                return function(*arguments, **named)
        return function(*arguments, **named)

    patch.setattr(stop.module, stop.function, called)
    return calls


@pytest.mark.parametrize(
    "name",
    [
        name if name == "fit-many" else pytest.param(name, marks=pytest.mark.slow)
        for name in STUDIES
    ],
)
def test_an_interrupted_command_goes_on_to_what_an_unbroken_one_finds(
    name, tmp_path, monkeypatch, undrawn
):
    study, out, whole = STUDIES[name], tmp_path / "out", tmp_path / "whole"
    experiment = study.prepare(tmp_path, monkeypatch)

    def command(folder: Path) -> int:
        return main.main([name, str(experiment), *study.options.split(), "-o", str(folder)])

    for stop in study.stops:
        with monkeypatch.context() as patch:
            watch(patch, stop, interrupted=True)
            assert command(out) == main.INTERRUPTED
        assert len(list(out.glob(stop.files))) == stop.count
    assert study.unfinished == "none" or len(list(out.glob(study.unfinished))) == 1
    with monkeypatch.context() as patch:
        calls = watch(patch, study.stops[-1])
        assert command(out) == 0
    assert len(calls) == study.missing, "what is finished is not repeated"
    assert not list(out.glob(study.unfinished))
    assert command(whole) == 0
    assert kept(whole) == kept(out)


# Killed


@pytest.fixture
def experiment_file(tmp_path, monkeypatch) -> Path:
    """Of a fit without a report, which alone needs the pipeline."""
    small_studies.quick_fits(monkeypatch)
    monkeypatch.setattr(Fit, "groups", [])
    monkeypatch.setattr(fit_jobs, "WarmUp", Mock())
    monkeypatch.setattr(fit_jobs.fit_report, "write_fit", lambda *_, **__: None)
    return write(tmp_path, clips=HALF_SECOND, rest=FEW)


class Killed(Exception):
    """In place of a kill, where a process need not really die."""


def kill(*_: object) -> None:
    raise Killed


@pytest.fixture
def killed(experiment_file, tmp_path, monkeypatch) -> Path:
    """A run that died between its search and its profiles."""
    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(assess, "assess_identifiability", kill)
        fitting.fit(experiment_file, run)
    assert (run / run_folder.SEARCH).is_file() and not (run / run_folder.FIT).exists()
    return run


def test_a_killed_fit_goes_on_after_its_search_and_after_the_last_stage_of_its_profiles(
    killed, experiment_file, monkeypatch
):
    stages, lines = list(profiling.STAGES), []
    with monkeypatch.context() as patch, pytest.raises(Killed), listening(lines.append):
        patch.setattr(profiling, "STAGES", [*stages[:4], kill])
        fitting.fit(experiment_file, killed)
    assert "a fit that was interrupted here goes on after 14 stages of its search" in lines
    whole, warm_up = killed.parent / "whole", Mock()
    monkeypatch.setattr(fit_jobs, "WarmUp", warm_up)
    fitting.fit(experiment_file, whole, report=False)
    warm_up.assert_not_called()  # its motions are for the report
    monkeypatch.setattr(profiling, "STAGES", [kill] * 4 + stages[4:])
    with listening(lines.append):
        fitting.fit(experiment_file, killed)
    assert any(line.endswith(" of its search and 4 of its profiles") for line in lines)
    assert not (killed / run_folder.SEARCH).exists() and not (killed / LOCK).exists()
    assert kept(killed) == kept(whole)
    assert runs.placeless(killed) == runs.placeless(whole)
    parameters = run_folder.PARAMETERS
    assert (killed / parameters).read_text() == (whole / parameters).read_text()


@pytest.mark.slow
def test_the_search_of_another_experiment_is_not_used(killed, experiment_file, monkeypatch):
    monkeypatch.setattr(assess, "assess_identifiability", kill)
    other = experiment_file.with_name("other.toml")
    for change in ("seed = 1", 'loss = "huber"'):
        lines: list[str] = []
        other.write_text(f"{change}\n{experiment_file.read_text()}")
        with pytest.raises(Killed), listening(lines.append):
            fitting.fit(other, killed)
        (line,) = [line for line in lines if run_folder.SEARCH in line]
        assert "of another fit, or of another version; the fit begins anew" in line, change


# In a terminal of its own

SPAWN = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_one_ctrl_c_ends_a_command_with_workers_and_the_same_command_goes_on(tmp_path):
    experiment = write(tmp_path, "walks.toml", clips=TWO_HALF_SECONDS, rest=ONE_START)
    out, screen = tmp_path / "out", tmp_path / "screen"
    words = ["fit-many", str(experiment), "-o", str(out), "--workers", "2", "--no-reports"]
    command = [sys.executable, "-m", "fitting.cli.main", *words]
    in_terminal = [sys.executable, "-c", SPAWN, *command]
    _, second = plan([load_experiment(experiment)])

    def whole() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in out.glob(f"runs/**/{fit_many.ROW}")}

    with (
        claimed((out / second.run).with_suffix(".lock")),  # so that it cannot end meanwhile
        open(screen, "wb") as shown,
        subprocess.Popen(in_terminal, stdin=subprocess.PIPE, stdout=shown, cwd=ROOT) as terminal,
    ):
        assert terminal.stdin is not None
        try:
            end = time.monotonic() + 400.0
            while b"1 of 2" not in screen.read_bytes():  # in its bar
                assert terminal.poll() is None and time.monotonic() < end
                time.sleep(0.01)
            terminal.stdin.write(b"\x03")  # the terminal sends it to the command and its workers
            terminal.stdin.flush()
            assert terminal.wait(120.0) == main.INTERRUPTED
        finally:
            terminal.kill()  # and so its terminal is gone, which ends the command
    text, before = screen.read_text(), whole()
    assert "1 of 2 fits are finished" in text and "Traceback" not in text
    assert "the same command makes the 1 that is missing" in text
    assert len((out / fit_many.CSV).read_text().splitlines()) == 1 + len(before) == 2
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=500)
    assert done.returncode in (0, 3), done.stderr
    assert "1 are there already" in done.stdout and "http://127.0.0.1:" in done.stdout
    assert before.items() <= whole().items() and len(whole()) == 2
