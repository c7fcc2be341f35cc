"""Many fits: what is fitted, what is kept, and what survives failures and kills."""

import csv
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest
from distributed import LocalCluster

import fitting
from fitting.cli import main
from fitting.experiments import problems
from fitting.experiments.experiment_files import load_experiment
from fitting.jobs.many import task as task_of_worker
from fitting.runtime.parallel import first_use
from fitting.runtime.storage.claimed_folder import claimed
from fitting.studies import run_folder
from fitting.studies.many import rows, table
from fitting.studies.many.tasks import plan
from support import quick
from support.experiments import CLIP, ROOT, write

FEW = "[fit]\nstarts = 1\n[fit.search]\nagreeing_starts = 1\n"
TWO = f"{CLIP}start = 1.0\nend = 1.5\n{CLIP}start = 2.0\nend = 2.5\n"


@pytest.fixture
def experiment_file(tmp_path, monkeypatch) -> Path:
    """Two clips whose fits take no time."""
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    return write(tmp_path, "walks.toml", clips=TWO, rest=FEW)


def fit_many(experiment: Path | list[Path], folder: Path, **options: Any) -> fitting.ManyFits:
    """In this process, without pictures of each run."""
    return fitting.fit_many(experiment, folder, workers=0, report=False, **options)


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


# What is fitted


def test_every_clip_is_fitted_with_every_seed_in_a_folder_of_its_own(experiment_file):
    experiment = load_experiment(experiment_file)
    alone = plan([experiment, experiment], seeds=2)
    runs = [task.run.as_posix() for task in alone]
    assert len(set(runs)) == len(alone) == 8
    assert runs[:2] == [f"runs/walks_1/uneven_walk_from_1_s/seed_{seed}" for seed in (0, 1)]
    assert [len(task.experiment.clips) for task in alone] == [1] * 8
    assert [task.experiment.seed for task in alone[:2]] == [0, 1]
    (together,) = plan([experiment], together=True)
    assert together.run == Path("runs/walks/seed_0") and len(together.experiment.clips) == 2


def test_a_fit_is_another_one_if_its_experiment_or_a_file_of_it_changes(experiment_file, tmp_path):
    experiment = load_experiment(experiment_file)
    clip = tmp_path / "clip.npz"
    shutil.copy(ROOT / "data/clips/uneven_walk.npz", clip)
    entry = dataclasses.replace(experiment.clips[0], reference=clip)
    (task, *_) = plan([dataclasses.replace(experiment, clips=(entry,))])
    identity = task.identity()
    assert task.identity() == identity
    other = dataclasses.replace(task.experiment, loss="huber")
    assert dataclasses.replace(task, experiment=other).identity() != identity
    clip.write_bytes(clip.read_bytes() + b"more")
    assert task.identity() != identity


@pytest.mark.parametrize(
    ("options", "words"),
    [({"seeds": 0}, "seeds is 0; wanted 1 to"), ({"workers": -1}, "workers is -1; wanted 0")],
)
def test_numbers_that_make_no_sense_are_refused(experiment_file, tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        fitting.fit_many(experiment_file, tmp_path / "out", **{"workers": 0} | options)
    with pytest.raises(ValueError, match="no experiments; wanted one or more"):
        fit_many([], tmp_path / "out")


def test_a_folder_with_something_else_is_refused(experiment_file, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "summary.md").write_text("of another command")
    with pytest.raises(ValueError, match=r"there is something in it already: \['summary.md'\]"):
        fit_many(experiment_file, tmp_path / "out")
    assert (tmp_path / "out" / "summary.md").read_text() == "of another command"


# What is kept


def test_each_fit_is_a_run_and_a_row_and_is_not_repeated(experiment_file, tmp_path, monkeypatch):
    out, lines = tmp_path / "out", []
    fits = fit_many(experiment_file, out, seeds=2, log=lines.append)
    assert [row["state"] for row in fits.rows] == ["finished"] * 4 and not fits.interrupted
    for row in fits.rows:
        experiment, summary = run_folder.load_fit(out / row["run"])
        assert len(experiment.clips) == 1 and experiment.seed == row["seed"]
        assert "outcome" in row and summary["cost"] == row["outcome"]["cost"]
    present = read(out / table.CSV)
    assert [row["run"] for row in present] == [row["run"] for row in fits.rows]
    assert float(present[0]["pelvis.on_gain"]) == pytest.approx(0.3, abs=0.02)
    parquet = pyarrow.parquet.read_table(out / table.PARQUET).to_pylist()
    assert [row["cost"] for row in parquet] == [row["cost"] for row in map(table.cells, fits.rows)]
    assert {"fits.png", "summary.md", "report.html"} <= {path.name for path in out.iterdir()}

    monkeypatch.setattr(task_of_worker, "fit", None)
    again = fit_many(experiment_file, out, seeds=2, log=lines.append)
    assert again.rows == fits.rows and again.made == 0
    assert "4 fits of 1 experiment, 2 seeds for each clip; 4 are there already" in lines


def test_workers_of_a_scheduler_at_an_address_make_the_same_fits(experiment_file, tmp_path):
    here = fit_many(experiment_file, tmp_path / "here", seeds=2)
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(n_workers=2, processes=False, **options) as workers:
        address: str = workers.scheduler_address  # pyright: ignore[reportAttributeAccessIssue]
        out = tmp_path / "there"
        there = fitting.fit_many(experiment_file, out, seeds=2, scheduler=address, report=False)
        again = fitting.fit_many(experiment_file, out, seeds=2, scheduler=address, report=False)
    numbers = [[row[name] for name in ("run", "cost", "state")] for row in cells(here)]
    assert [[row[name] for name in ("run", "cost", "state")] for row in cells(there)] == numbers
    assert (there.made, again.made) == (4, 0) and again.rows == there.rows
    for row in there.rows:
        run_folder.load_fit(out / row["run"])


def cells(fits: fitting.ManyFits) -> list[dict[str, Any]]:
    return [table.cells(row) for row in fits.rows]


def test_the_run_of_another_experiment_is_not_taken_for_ones_own(experiment_file, tmp_path):
    fit_many(experiment_file, tmp_path / "out")
    experiment_file.write_text(f'loss = "huber"\n{experiment_file.read_text()}')
    with pytest.raises(ValueError, match=r"seed_0: has the fit of another experiment, or of one"):
        fit_many(experiment_file, tmp_path / "out")


def test_a_fit_that_fails_tells_why_stops_nothing_and_is_tried_again(
    experiment_file, tmp_path, monkeypatch
):
    out, real = tmp_path / "out", task_of_worker.fit

    def fails_first(experiment, *args, **named):
        if experiment.clips[0].start == 1.0:
            raise RuntimeError("no\nluck")
        return real(experiment, *args, **named)

    with monkeypatch.context() as patch:
        patch.setattr(task_of_worker, "fit", fails_first)
        words = ["fit-many", str(experiment_file), "-o", str(out), "--workers", "0"]
        assert main.main([*words, "--no-reports"]) == 6
    first, second = read(out / table.CSV)
    assert (first["state"], first["error"]) == ("failed", "no luck") and not first["cost"]
    assert second["state"] == "finished" and second["cost"]
    trace = out / first["run"] / task_of_worker.ERROR
    assert "RuntimeError: no\nluck" in trace.read_text()
    assert "no luck" in (out / "report.html").read_text()

    assert not fit_many(experiment_file, out).failed
    assert not trace.exists()


def test_an_interrupt_keeps_what_is_finished(experiment_file, tmp_path, monkeypatch):
    out, real = tmp_path / "out", task_of_worker.fit

    def interrupted_second(experiment, *args, **named):
        if experiment.clips[0].start == 2.0:
            raise KeyboardInterrupt
        return real(experiment, *args, **named)

    with monkeypatch.context() as patch:
        patch.setattr(task_of_worker, "fit", interrupted_second)
        words = ["fit-many", str(experiment_file), "-o", str(out), "--workers", "0"]
        assert main.main([*words, "--no-reports"]) == main.INTERRUPTED
    assert len(read(out / table.CSV)) == 1
    fits = fit_many(experiment_file, out)
    assert fits.made == 1 and len(fits.finished) == 2


def test_a_run_without_its_row_is_not_whole(experiment_file, tmp_path):
    out = tmp_path / "out"
    fits = fit_many(experiment_file, out)
    (out / fits.rows[0]["run"] / rows.ROW).unlink()
    assert fit_many(experiment_file, out).made == 1


def test_without_pyarrow_there_is_the_csv_and_a_line_that_says_so(
    experiment_file, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    lines: list[str] = []
    fit_many(experiment_file, tmp_path / "out", log=lines.append)
    assert "no fits.parquet, as pyarrow is not installed: pip install 'jaxik[parquet]'" in lines
    assert (tmp_path / "out" / table.CSV).is_file()
    assert not (tmp_path / "out" / table.PARQUET).exists()


# Several processes


def test_only_the_first_process_compiles_while_others_wait(tmp_path, monkeypatch):
    monkeypatch.setattr(first_use.cache_folder, "traced", lambda: tmp_path)
    monkeypatch.setattr(first_use, "PATIENCE", 0.0)
    key, looks = "0" * 64, []

    def look(seconds: float) -> None:
        looks.append(seconds)
        if len(looks) == 3:
            held.__exit__(None, None, None)

    monkeypatch.setattr(first_use.time, "sleep", look)
    held = claimed(tmp_path / f"first-{key}")
    held.__enter__()
    with first_use.first_alone(key):
        assert len(looks) == 3
    with claimed(tmp_path / f"first-{key}"), first_use.first_alone(key):
        assert len(looks) == 3  # they are kept by now, and nobody waits


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


def start(experiment: Path, out: Path) -> subprocess.Popen:
    """The command with two workers, as a process."""
    return subprocess.Popen(
        [sys.executable, "-m", "fitting.cli.main", "fit-many", str(experiment), "-o", str(out),
         "--workers", "2", "--seeds", "3", "--no-reports"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
        env=os.environ | {"PYTHONWARNINGS": "default"},
    )  # fmt: skip


def wait_for(condition, client: subprocess.Popen, seconds: float = 400.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert client.poll() is None, client.communicate()
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads processes as Linux lists them")
def test_killed_workers_and_a_killed_client_lose_only_what_was_being_made(tmp_path):
    experiment, out = write(tmp_path, "walks.toml", clips=TWO, rest=FEW), tmp_path / "out"
    tasks = plan([load_experiment(experiment)], seeds=3)

    def whole() -> set[Path]:
        return set(out.glob(f"runs/**/{rows.ROW}"))

    with ExitStack() as held:
        # As another worker does that makes these fits, so that the command cannot end meanwhile.
        for task in tasks[2::3]:
            held.enter_context(claimed((out / task.run).with_suffix(".lock")))
        client = start(experiment, out)
        workers: list[int] = []
        try:
            wait_for(lambda: len(whole()) >= 1, client)
            first, *_ = workers_of(client)
            os.kill(first, signal.SIGKILL)
            wait_for(lambda: len(whole()) >= 2, client)
            workers = workers_of(client)
        finally:
            client.send_signal(signal.SIGKILL)
            client.communicate()
        end = time.monotonic() + 60.0
        while any(map(is_running, workers)):  # nobody may be left who takes the next fit
            assert time.monotonic() < end
            time.sleep(0.1)
    before = {path: path.read_bytes() for path in whole()}
    assert 2 <= len(before) <= 4
    client = start(experiment, out)
    output, errors = client.communicate(timeout=500)
    assert client.returncode in (0, 3), errors
    assert {path: path.read_bytes() for path in before} == before
    assert len(whole()) == 6 and len(read(out / table.CSV)) == 6
    assert "Dask's dashboard: http://127.0.0.1:" in output
    assert f"3 seeds for each clip; {len(before)} are there already" in output
    costs = [json.loads(path.read_text())["outcome"]["cost"] for path in sorted(whole())]
    assert all(cost > 0 for cost in costs)


class Terminal:
    """The command with two workers in a terminal of its own."""

    SPAWN = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"

    def __init__(self, experiment: Path, out: Path) -> None:
        words = ["fit-many", str(experiment), "-o", str(out), "--workers", "2", "--no-reports"]
        self.process = subprocess.Popen(
            [sys.executable, "-c", self.SPAWN, sys.executable, "-m", "fitting.cli.main", *words],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=ROOT,
        )  # fmt: skip
        self._parts: list[bytes] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        while part := os.read(self.process.stdout.fileno(), 65536):
            self._parts.append(part)

    def press_ctrl_c(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(b"\x03")  # the terminal sends it to the command and its workers
        self.process.stdin.flush()

    def end(self, seconds: float) -> str:
        """What the terminal got, of a command that ends by itself."""
        try:
            self.process.wait(seconds)
        finally:
            self.process.kill()  # and so its terminal is gone, which ends the command
            self._reader.join(60.0)
            for pipe in (self.process.stdin, self.process.stdout):
                assert pipe is not None
                pipe.close()
        return b"".join(self._parts).decode()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_one_ctrl_c_in_a_terminal_ends_it_and_the_same_command_goes_on(tmp_path):
    experiment, out = write(tmp_path, "walks.toml", clips=TWO, rest=FEW), tmp_path / "out"
    _, second = plan([load_experiment(experiment)])
    with claimed((out / second.run).with_suffix(".lock")):  # so that it cannot end meanwhile
        terminal = Terminal(experiment, out)
        try:
            wait_for(lambda: len(list(out.glob(f"runs/**/{rows.ROW}"))) == 1, terminal.process)
            terminal.press_ctrl_c()
        finally:
            shown = terminal.end(120.0)
    assert terminal.process.returncode == main.INTERRUPTED
    assert "Finished: 1 of 2 fits" in shown and "Traceback" not in shown
    assert "the same command makes the fit that is missing" in shown
    (first,) = read(out / table.CSV)
    kept = (out / first["run"] / rows.ROW).read_bytes()
    shown = (again := Terminal(experiment, out)).end(500.0)
    assert again.process.returncode in (0, 3) and "1 are there already" in shown
    assert (out / first["run"] / rows.ROW).read_bytes() == kept and len(read(out / table.CSV)) == 2
