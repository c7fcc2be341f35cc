"""Studies that are interrupted or killed, and what the next call makes of their folders."""

import inspect
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from unittest.mock import Mock

import pytest

import fitting
from fitting.cli import main
from fitting.experiments.experiment_files import load_experiment
from fitting.inference.profiles import profiling
from fitting.jobs import fits
from fitting.runtime.storage.claimed_folder import LOCK, claimed
from fitting.studies import ablation, assess, run_folder
from fitting.studies.calibration import replicates
from fitting.studies.fit import Fit
from fitting.studies.hierarchy import kept_searches
from fitting.studies.many import rows, table
from fitting.studies.many.tasks import plan
from support import runs, small_studies
from support.experiments import ROOT, write
from support.refusals import refusal
from support.small_studies import HALF_SECOND, ONE_START, TWO_HALF_SECONDS, content, kept

# All 20 starts are made: some three seconds in which a kill may come.
LONG = "[fit]\nstarts = 20\n[fit.search]\nagreeing_starts = 21\nsweep_values = 60\n"
FEW = "[fit]\nstarts = 2\n[fit.search]\nagreeing_starts = 3\n"
SEARCH = "search_with_noise"

# Interrupted


def quick_fit(folder: Path, patch: pytest.MonkeyPatch) -> Path:
    """A fit without a report, which alone needs the pipeline."""
    small_studies.quick_fits(patch)
    patch.setattr(Fit, "groups", [])
    patch.setattr(fits, "Rehearsal", Mock())
    patch.setattr(fits.fit_report, "write_fit", lambda *_, **__: None)
    return write(folder, clips=HALF_SECOND, rest=FEW)


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
    options: list[str]
    stops: list[Stop]
    missing: int
    """Calls of the last function that the last command has to make."""
    unfinished: str = "none"
    """What an interrupted search leaves."""


STUDIES = {
    "fit": Study(quick_fit, [], [Stop(fits, SEARCH, 1, "fit.json", 1)], 1, run_folder.SEARCH),
    "ablate": Study(
        small_studies.quick_ablation, [], [Stop(ablation, SEARCH, 2, ablation.NUMBERS, 1)], 5
    ),
    "calibrate": Study(
        small_studies.quick_calibration,
        ["--replicates", "2", "--chains"],
        [
            Stop(replicates, SEARCH, 2, "fits/*.json", 1),
            Stop(replicates, "sample_around", 2, "chains/*.json", 1),
        ],
        1,
    ),
    "population": Study(
        small_studies.quick_population,
        [],
        [Stop(kept_searches, SEARCH, 6, "searches/*.json", 5)],
        2,
        "searches/*.part",
    ),
    "fit-many": Study(
        small_studies.quick_many,
        ["--workers", "0", "--no-reports"],
        [Stop(fits, SEARCH, 2, "runs/**/row.json", 1)],
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
        bound = inspect.signature(function).bind(*arguments, **named)
        if interrupted and len(calls) == stop.call:
            bound.arguments["progress"] = interrupt
        return function(*bound.args, **bound.kwargs)

    patch.setattr(stop.module, stop.function, called)
    return calls


@pytest.mark.parametrize("name", STUDIES)
def test_an_interrupted_command_goes_on_to_what_an_unbroken_one_finds(
    name, tmp_path, monkeypatch, undrawn
):
    study, out, whole = STUDIES[name], tmp_path / "out", tmp_path / "whole"
    experiment = study.prepare(tmp_path, monkeypatch)

    def command(folder: Path) -> int:
        return main.main([name, str(experiment), *study.options, "-o", str(folder)])

    for stop in study.stops:
        with monkeypatch.context() as patch:
            watch(patch, stop, interrupted=True)
            assert command(out) == main.INTERRUPTED
        assert len(list(out.glob(stop.files))) == stop.count
    assert study.unfinished == "none" or len(list(out.glob(study.unfinished))) == 1
    with monkeypatch.context() as patch:
        calls = watch(patch, study.stops[-1])
        status = command(out)
    assert len(calls) == study.missing, "what is finished is not repeated"
    assert not list(out.glob(study.unfinished))
    assert status == command(whole) == (3 if name == "fit" else 0)
    assert kept(whole) == kept(out)


# Killed


@pytest.fixture
def experiment_file(tmp_path, monkeypatch, undrawn) -> Path:
    return quick_fit(tmp_path, monkeypatch)


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
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(profiling, "STAGES", [*stages[:4], kill])
        fitting.fit(experiment_file, killed, log=lines.append)
    assert "a fit that was interrupted here goes on after 14 stages of its search" in lines
    whole = killed.parent / "whole"
    fitting.fit(experiment_file, whole)
    monkeypatch.setattr(profiling, "STAGES", [kill] * 4 + stages[4:])
    fitting.fit(experiment_file, killed, log=lines.append)
    assert any(line.endswith(" of its search and 4 of its profiles") for line in lines)
    assert not (killed / run_folder.SEARCH).exists() and not (killed / LOCK).exists()
    assert kept(killed) == kept(whole)
    assert runs.placeless(killed) == runs.placeless(whole)
    parameters = run_folder.PARAMETERS
    assert (killed / parameters).read_text() == (whole / parameters).read_text()


@pytest.mark.parametrize("change", ["seed = 1", 'loss = "huber"'])
def test_the_search_of_another_experiment_is_not_used(killed, experiment_file, change, monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr(assess, "assess_identifiability", kill)
    other = experiment_file.with_name("other.toml")
    other.write_text(f"{change}\n{experiment_file.read_text()}")
    with pytest.raises(Killed):
        fitting.fit(other, killed, log=lines.append)
    (line,) = [line for line in lines if run_folder.SEARCH in line]
    assert "of another fit, or of another version; the fit begins anew" in line


# In processes of their own


def start(*words: object, program: str = "fitting.cli.main", **streams: Any) -> subprocess.Popen:
    """A command as a process; `program` is the module that runs it."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(
        [sys.executable, "-m", program, *map(str, words)],
        env=os.environ | {"PYTHONPATH": paths, "PYTHONWARNINGS": "default"},
        cwd=ROOT,
        **(quiet | streams),
    )


def wait_for(condition: Callable[[], bool], process: subprocess.Popen | None = None) -> None:
    """Waits for a condition, with a process that must not end before."""
    end = time.monotonic() + 400.0
    while not condition():
        assert process is None or process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)


def kill_when(process: subprocess.Popen, path: Path, seconds: float = 0.0) -> None:
    """Kills a process so many seconds after a file has appeared."""
    wait_for(path.is_file, process)
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


@pytest.mark.slow
def test_a_fit_that_is_killed_at_random_searches_on_as_if_it_had_not_been(tmp_path):
    path = write(tmp_path, clips=HALF_SECOND, rest=LONG)
    killed, whole = tmp_path / "killed", tmp_path / "whole"

    def fit(run: Path) -> subprocess.Popen:
        return start("fit", path, "-o", run, program="support.quick")

    kill_when(fit(whole), whole / run_folder.PARAMETERS)
    moment = random.uniform(0.0, 3.0)
    kill_when(fit(killed), killed / run_folder.SEARCH, moment)
    assert (killed / LOCK).is_file(), moment
    kill_when(fit(killed), killed / run_folder.PARAMETERS)
    text = (whole / run_folder.PARAMETERS).read_text()
    assert (killed / run_folder.PARAMETERS).read_text() == text, moment
    assert content(killed / run_folder.SEARCH) == content(whole / run_folder.SEARCH), moment


def workers_of(client: subprocess.Popen) -> list[int]:
    """The processes of a command that compute."""
    lines = subprocess.run(
        ["ps", "-wweo", "pid=,ppid=,args="], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    every = [(int(pid), int(ppid), words) for pid, ppid, words in (x.split(None, 2) for x in lines)]
    return [pid for pid, ppid, words in every if ppid == client.pid and "spawn_main" in words]


def is_running(process: int) -> bool:
    """Whether a process is there, and not only waits for whoever asks how it ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes() != b""
    except OSError:
        return False


def whole_runs(out: Path) -> dict[Path, bytes]:
    """The rows of the fits that are whole."""
    return {path: path.read_bytes() for path in out.glob(f"runs/**/{rows.ROW}")}


def table_of(out: Path) -> list[str]:
    """The rows of the table of all fits."""
    return (out / table.CSV).read_text().splitlines()[1:]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads processes as Linux lists them")
def test_killed_workers_and_a_killed_client_lose_only_what_was_being_made(tmp_path):
    experiment = write(tmp_path, "walks.toml", clips=TWO_HALF_SECONDS, rest=ONE_START)
    out, tasks = tmp_path / "out", plan([load_experiment(experiment)], seeds=3)
    words = ["fit-many", experiment, "-o", out, "--workers", 2, "--seeds", 3, "--no-reports"]
    with ExitStack() as held:
        # As another worker does that makes these fits, so that the command cannot end meanwhile.
        for task in tasks[2::3]:
            held.enter_context(claimed((out / task.run).with_suffix(".lock")))
        client, workers = start(*words), []
        try:
            wait_for(lambda: len(whole_runs(out)) >= 1, client)
            os.kill(workers_of(client)[0], signal.SIGKILL)
            wait_for(lambda: len(whole_runs(out)) >= 2, client)
            workers = workers_of(client)
        finally:
            client.send_signal(signal.SIGKILL)
            client.wait()
        # Nobody may be left who takes the next fit.
        wait_for(lambda: not any(map(is_running, workers)))
    before = whole_runs(out)
    assert 2 <= len(before) <= 4
    client = start(*words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    output, errors = client.communicate(timeout=500)
    assert client.returncode in (0, 3), errors
    after = whole_runs(out)
    assert {path: after[path] for path in before} == before
    assert len(after) == len(table_of(out)) == 6
    assert "Dask's dashboard: http://127.0.0.1:" in output
    assert f"3 seeds for each clip; {len(before)} are there already" in output
    assert all(json.loads(row)["outcome"]["cost"] > 0 for row in after.values())


SPAWN = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"


def start_in_terminal(screen: Path, *words: object) -> subprocess.Popen:
    """A command in a terminal of its own, whose screen is a file."""
    command = [sys.executable, "-m", "fitting.cli.main", *map(str, words)]
    with open(screen, "wb") as shown:
        return subprocess.Popen(
            [sys.executable, "-c", SPAWN, *command],
            stdin=subprocess.PIPE, stdout=shown, stderr=subprocess.DEVNULL, cwd=ROOT,
        )  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_one_ctrl_c_in_a_terminal_ends_it_and_the_same_command_goes_on(tmp_path):
    experiment = write(tmp_path, "walks.toml", clips=TWO_HALF_SECONDS, rest=ONE_START)
    out, screen = tmp_path / "out", tmp_path / "screen"
    words = ["fit-many", experiment, "-o", out, "--workers", 2, "--no-reports"]
    _, second = plan([load_experiment(experiment)])
    with (
        claimed((out / second.run).with_suffix(".lock")),  # so that it cannot end meanwhile
        start_in_terminal(screen, *words) as terminal,
    ):
        assert terminal.stdin is not None
        try:
            wait_for(lambda: len(whole_runs(out)) == 1, terminal)
            terminal.stdin.write(b"\x03")  # the terminal sends it to the command and its workers
            terminal.stdin.flush()
            assert terminal.wait(120.0) == main.INTERRUPTED
        finally:
            terminal.kill()  # and so its terminal is gone, which ends the command
    shown, before = screen.read_text(), whole_runs(out)
    assert "Finished: 1 of 2 fits" in shown and "Traceback" not in shown
    assert "the same command makes the fit that is missing" in shown
    assert len(table_of(out)) == len(before) == 1
    with start_in_terminal(screen, *words) as terminal:
        try:
            assert terminal.wait(500.0) in (0, 3)
        finally:
            terminal.kill()
    assert "1 are there already" in screen.read_text()
    assert before.items() <= whole_runs(out).items() and len(table_of(out)) == 2


# In use


@pytest.mark.parametrize("command", ["fit", "ablate", "calibrate", "population", "fit-many"])
def test_a_second_command_in_a_folder_is_refused(experiment_file, tmp_path, command, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    with claimed(folder):
        line = refusal([command, experiment_file, "-o", folder], tmp_path, capsys)
    assert f"{folder}: in use by process {os.getpid()} on " in line
    assert not list(folder.iterdir())
