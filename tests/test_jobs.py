"""Whole jobs, from Python and the command line: what they return, announce, and where they write.

One fit and its sampling are looked at by most tests here. They were made where JAX has 32 bits.
"""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import fitting
import jaxik
from fitting import jobs
from fitting.cli import main
from fitting.experiment import problems
from fitting.inference.identifiability import assess_identifiability
from fitting.inference.optimise import search
from fitting.inference.optimise.solution import Report
from fitting.inference.profiles import profiling
from fitting.inference.sample import posterior
from fitting.inference.sample.posterior import Posterior
from fitting.motion import playback
from fitting.report import document, pages
from fitting.runtime import activity
from fitting.runtime.precision import with_floats
from fitting.studies.fit import assess, fit_jobs, fit_report, fit_tables, run_folder
from fitting.studies.sample import posterior_report, replay, sample_jobs
from jaxik.maths import parameter_tree
from jaxik.stages import foot
from support import quick
from support.experiments import CLIP, ROOT, write
from support.watching import Recorder, listening

NAME = r"../../elsewhere $\frac{$"  # no path, and no formula
TOP = f"""
name = '{NAME}'
preset = 'ozz'
faithful = true
rules.foot = "PitchRollFoot"
"""
HALF_SECOND = f"start = 1.0\nend = 1.5\nlabel = '{NAME}'\nsubject = '{NAME}'"
SAMPLE = "[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 20"
PLAY = (playback, "run")
# What is announced, and the functions that take long while that is the innermost work going on.
READ_AND_PREPARE = [
    ("Reading the clip and its ground", (problems, "load_clip_data")),
    ("Preparing the comparison", (problems, "make_scene")),
]
FIT_WORK = [
    *READ_AND_PREPARE,
    ("Preparing the programs of the search", (search, "_begin")),
    ("Searching from up to 6 starts", (search, "search_from")),
    ("Weighing the residuals", PLAY),
    ("Following 2 parameters over their ranges", (profiling, "lowest")),
    ("Writing the motions and numbers of the fit", (run_folder, "save_clip")),
    ("Playing the clips with the system before the fit", PLAY),
    ("Playing the clips with the fitted system", PLAY),
    ("Drawing the curves of the parameters", (fit_report, "_draw_search")),
    (f"Drawing {NAME}", (fit_report, "_draw_clip")),
    ("Measuring where limits are in effect", (fit_report.playback, "measure_activity"), PLAY),
    ("Finding what determines 2 parameters", (fit_tables, "find_evidence"), PLAY),
    ("Writing the page", (document.Document, "write")),
    ("Finishing the pictures",),
]
SAMPLE_WORK = [
    *READ_AND_PREPARE,
    ("Sampling up to 20 steps of 8 walkers", (posterior, "_check")),
    ("Placing 8 walkers",),
    ("Summing up the chain", (posterior, "_posterior")),
    ("Playing 20 draws of the posterior", (replay._Clip, "add"), PLAY),
    ("Writing the posterior",),
    (
        "Drawing the posterior",
        (posterior_report, "corner"),
        (document.Document, "write"),
    ),
]
LONG = {function for _, *functions in FIT_WORK + SAMPLE_WORK for function in functions}


def system() -> jaxik.FootIK:
    """The system of the experiment: it compiles in half the time of others, and all here run it."""
    return dataclasses.replace(jaxik.presets.ozz(faithful=True), foot=foot.PitchRollFoot())


class Watcher(Recorder):
    """Also writes down what is done, with the innermost work that is going on."""

    def __init__(self) -> None:
        super().__init__()
        self.going_on: list[str] = []
        self.done: set[tuple[str, str]] = set()

    def began(self, work: activity.Work) -> None:
        super().began(work)
        self.going_on.append(work.title)

    def ended(self, work: activity.Work) -> None:
        super().ended(work)
        assert self.going_on.pop() == work.title

    def noting(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, which also writes down that it is called."""

        def called(*arguments, **named):
            if threading.current_thread() is threading.main_thread():  # others keep nobody waiting
                self.done.add((name, self.going_on[-1] if self.going_on else "nothing announced"))
            return function(*arguments, **named)

        return called


def watched(job: Callable[[], Any]) -> tuple[Any, Watcher]:
    """What a job returns, and what it announced and did."""
    watcher = Watcher()
    with pytest.MonkeyPatch.context() as patch, activity.watched_by(watcher):
        for place, name in LONG:
            patch.setattr(place, name, watcher.noting(name, getattr(place, name)))
        return job(), watcher


class Done(NamedTuple):
    """A fit and its sampling."""

    experiment: Path
    fitted: fitting.Fit
    run: Path  # before the sampling
    posterior: Posterior
    sampled: Path  # the run after the sampling
    log: list[str]  # of the fit
    watchers: tuple[Watcher, Watcher]


@pytest.fixture(scope="module", autouse=True)
def quick_jobs() -> Iterator[None]:
    """Jobs fit residuals that compile at once, and draw nothing; they play the real pipeline."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "DRAWS", 20)
        patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
        patch.setattr(Figure, "savefig", lambda figure, path, **look: Path(path).touch())
        yield


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Done:
    """Half a second of the uneven walk, fitted and sampled; tests change copies of its folders."""
    folder, log = tmp_path_factory.mktemp("files"), []
    experiment = write(folder, "hill.toml", top=TOP, clips=CLIP, clip=HALF_SECOND, rest=SAMPLE)
    run, sampled = folder / "run", tmp_path_factory.mktemp("sampled") / "run"
    jax.clear_caches()  # what other tests compiled with other options rounds differently
    with jax.enable_x64(False):
        with listening(log.append):
            fitted, of_fit = watched(lambda: fitting.fit(experiment, run))
        shutil.copytree(run, sampled)
        drawn, of_sampling = watched(lambda: fitting.sample(sampled))
    return Done(experiment, fitted, run, drawn, sampled, log, (of_fit, of_sampling))


@pytest.fixture
def run(done, tmp_path) -> Path:
    """A copy of the fit's folder."""
    return Path(shutil.copytree(done.run, tmp_path / "run"))


def tree(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def numbers_of(run: Path, name: str = run_folder.FIT) -> dict[str, Any]:
    return json.loads((run / name).read_text())


def chain_of(run: Path) -> np.ndarray:
    with h5py.File(run / run_folder.CHAIN) as file:
        return np.asarray(file["mcmc/chain"])


def interrupt(*_, **__) -> Any:
    """Ctrl-C at this moment."""
    signal.raise_signal(signal.SIGINT)


# Fit and sample


def test_a_fit_writes_numbers_tables_and_plots_and_says_where(done):
    """The names in its experiment are not paths."""
    summary, page = done.run / run_folder.SUMMARY, done.run / pages.PAGE
    assert done.fitted.run == done.run
    assert done.log[0].startswith("fitting 2 parameters of ozz")
    assert done.log[-1] == f"written to {done.run}; read {summary}, or open {page} in a browser"
    names = {run_folder.EXPERIMENT, run_folder.FIT, run_folder.PARAMETERS, run_folder.SUMMARY}
    names |= {pages.PAGE, "base.npz", "fitted.npz", "motion.png", "cost.png"}
    assert names <= tree(done.run)
    numbers = numbers_of(done.run)
    assert numbers["converged"] and numbers["experiment"] == NAME
    values = {row["name"]: row["value"] for row in numbers["parameters"]}
    assert values == pytest.approx(quick.TARGETS, abs=0.003)
    assert {path.name for path in done.run.parent.iterdir()} == {"hill.toml", "run"}
    assert f"# {NAME}" in summary.read_text()


def test_everything_is_announced_in_its_order_while_it_is_done(done):
    calls = set()
    for watcher, work in zip(done.watchers, (FIT_WORK, SAMPLE_WORK), strict=True):
        assert list(dict.fromkeys(watcher.titles)) == [title for title, *_ in work]
        assert not watcher.going_on
        announced = {(name, title) for title, *functions in work for _, name in functions}
        assert watcher.done - announced == set()
        calls |= watcher.done
    assert {name for name, _ in calls} == {name for _, name in LONG}


def test_a_fit_in_memory_continues_the_chain_that_is_in_its_folder(done, tmp_path):
    sampled = Path(shutil.copytree(done.sampled, tmp_path / "run"))
    continued = fitting.sample(dataclasses.replace(done.fitted, run=sampled), max_steps=30)
    assert (continued.u[:20] == done.posterior.u).all() and len(continued.u) == 30
    assert len(chain_of(sampled)) == 30


def worsen(run: Path) -> dict[str, Any]:
    """Moves the fit of a run off its optimum; what its file then holds."""
    worse = numbers_of(run)
    for row in worse["parameters"]:
        row["u"] += 3 * row["start_sd"]
    (run / run_folder.FIT).write_text(json.dumps(worse))
    return worse


def test_a_lower_point_of_a_chain_becomes_the_fit_of_its_run(done, run):
    worsen(run)
    lines: list[str] = []
    with listening(lines.append):
        sampled = fitting.sample(run)
    assert any("lower than the fit's; the fit goes on from there" in line for line in lines)
    _, adopted = run_folder.load_fit(run)
    for before, after in zip(done.fitted.parameters, adopted["parameters"], strict=True):
        assert after["u"] == pytest.approx(before["u"], abs=0.1 * before["start_sd"])
    assert sampled.improvement <= assess.MIN_IMPROVEMENT
    assert numbers_of(run, run_folder.POSTERIOR)["lower_point"] is None
    assert not (run / run_folder.LOWER_POINT).exists()
    text = (run / run_folder.SUMMARY).read_text()
    assert "## Posterior" in text and "The chain contradicts its fit: it met" not in text


def test_an_interrupted_adoption_leaves_the_old_fit_and_the_lower_point(run, monkeypatch):
    worse = worsen(run)
    monkeypatch.setattr(sample_jobs, "assess_solution", interrupt)
    fitting.sample(run)
    assert numbers_of(run) == worse and (run / run_folder.LOWER_POINT).is_file()


def test_a_replay_that_is_interrupted_leaves_the_report_of_the_chain(done, run, monkeypatch):
    monkeypatch.setattr(sample_jobs, "replay", interrupt)
    sampled = fitting.sample(dataclasses.replace(done.fitted, run=run))
    assert sampled.interrupted and (run / run_folder.POSTERIOR).is_file()
    assert "## Posterior" in (run / run_folder.SUMMARY).read_text()


def test_a_solution_is_on_disk_before_anything_can_fail_after_the_search(
    done, tmp_path, monkeypatch
):
    def fail(*_):
        raise ValueError("no slopes")

    monkeypatch.setattr(assess, "assess_identifiability", fail)
    with pytest.raises(ValueError, match="no slopes"):
        fitting.fit(done.experiment, tmp_path / "run")
    kept = {run_folder.EXPERIMENT, run_folder.PARAMETERS, run_folder.SEARCH}
    assert tree(tmp_path / "run") == kept


# Precision

IN_A_PROCESS_OF_32_BITS = """
import json, sys
import jax.numpy as jnp
import fitting
from fitting.experiment import problems
from fitting.studies.sample import replay
from support import quick

problems.residuals_of_scenes, replay.DRAWS = quick.residuals_of_scenes, 20
fitted = fitting.fit(sys.argv[1])
posterior = fitting.sample(fitted)
new = str(jnp.ones(1).dtype)
print(json.dumps([fitted.solution.u.tolist(), posterior.u.tolist(), fitted.summary["cost"], new]))
"""


@pytest.mark.slow
def test_a_process_with_32_bits_gets_the_numbers_of_64_keeps_its_setting_and_writes_nothing(
    done, tmp_path
):
    """In a process of its own, since the tests' has 64 bits: threads would inherit them."""
    words = [sys.executable, "-W", "error", "-c", IN_A_PROCESS_OF_32_BITS, str(done.experiment)]
    variables = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    before = tree(done.experiment.parent)
    ended = subprocess.run(words, env=variables, cwd=tmp_path, capture_output=True)
    assert not ended.returncode, ended.stderr.decode()
    u, walkers, cost, new = json.loads(ended.stdout)
    assert u == done.fitted.solution.u.tolist() and cost == done.fitted.solution.cost
    assert walkers == done.posterior.u.tolist() and len(walkers) == 20
    assert new == "float32"
    assert not list(tmp_path.iterdir()) and tree(done.experiment.parent) == before


def test_a_fit_can_be_used_and_systems_be_run_on_its_clips_where_jax_has_32_bits(done):
    problem, solution, ik = done.fitted.problem, done.fitted.solution, done.fitted.ik
    with jax.enable_x64(False):
        outputs = [
            problem.residuals(solution.u),
            problem.cost(solution.u),
            problem.jacobian(solution.u),
            problem.log_probability(solution.u),
            problem.space.values(solution.u),
            problem.space.pack(ik),
            parameter_tree.get(ik, "pelvis.half_life"),
            done.fitted.results[0].body.pos,
            assess_identifiability(problem, solution.weighted(float(problem.weight))).contraction,
        ]
        assert {output.dtype for output in outputs} == {np.dtype(np.float64)}
        unweighted = float(outputs[1] / problem.weight)
        assert unweighted == pytest.approx(solution.cost, rel=1e-12)
        assert done.fitted.summary["parameters"][0]["value"] == solution.values[0]
        assert with_floats(ik, np.float32).leg.weight.dtype == np.float32
        assert jnp.ones(1).dtype == np.float32
        single = system()
        result = playback.run(single, problem.data[0])
    assert single.leg.weight.dtype == np.float32 and result.body.pos.dtype == np.float64


@pytest.fixture
def animation(tmp_path) -> fitting.AnimationFiles:
    """Half a second of the flat walk."""
    whole = fitting.load_clip(ROOT / "data" / "clips" / "uneven_walk_base.npz")
    fitting.save_clip(tmp_path / "short.npz", whole.select(slice(30, 46)))
    ground = ROOT / "data" / "terrains" / "uneven_walk.ply"
    return fitting.AnimationFiles(tmp_path / "short.npz", ground)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::fitting.studies.animations.PlacementWarning")
def test_systems_made_in_32_bits_are_compared_in_64(animation):
    with jax.enable_x64(False):
        compared = fitting.compare({"ozz": system()}, animation)
        solved = jobs.solve(system(), animation)
    exact = jobs.solve(system(), animation)
    np.testing.assert_allclose(solved.positions_ws, exact.positions_ws, atol=1e-5)
    ankles = compared.motions["ozz"].clip.joints_ws(2)
    np.testing.assert_array_equal(ankles, solved.joints_ws(2), strict=True)


# From the command line


def test_an_interrupted_fit_writes_its_best_point_and_the_same_command_goes_on(
    done, tmp_path, monkeypatch, capsys
):
    run = tmp_path / "run"
    words = ["fit", str(done.experiment), "-o", str(run)]
    with monkeypatch.context() as patch:
        patch.setattr(Report, "__str__", interrupt)
        assert main.main(words) == main.INTERRUPTED == 130
    numbers = numbers_of(run)
    assert numbers["message"].startswith("Interrupted after 0 steps") and not numbers["converged"]
    output = capsys.readouterr().out
    assert np.isfinite(numbers["cost"]) and numbers["message"] in output
    assert "\ninterrupted; assessing and writing the best point so far\n" in output
    assert run_folder.SUMMARY in tree(run)
    assert main.main(words) == 7  # what is invented has nothing to do with the motion
    assert numbers_of(run)["parameters"] == numbers_of(done.run)["parameters"]
    assert f"read {run / run_folder.SUMMARY}" in capsys.readouterr().out


def test_an_interrupt_before_the_search_writes_nothing(done, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fit_jobs, "load", interrupt)
    words = ["fit", str(done.experiment), "-o", str(tmp_path / "run")]
    assert main.main(words) == main.INTERRUPTED
    assert capsys.readouterr().err == "\njaxik fit: interrupted\n" and not tree(tmp_path)


def test_the_exit_status_says_what_is_wrong_with_a_fit(done, tmp_path, monkeypatch):
    for status, interrupted, converged, has_noise, fits, setbacks in (
        (0, False, True, True, True, 0),
        (0, False, True, False, False, 1),  # what a translation leaves over is not a failure
        (3, False, False, True, False, 0),
        (4, False, True, True, False, 0),
        (7, False, True, True, False, 1),
        (7, False, False, True, False, 1),
        (130, True, False, True, False, 1),
    ):
        ended = {"interrupted": interrupted, "converged": converged}
        solution = dataclasses.replace(done.fitted.solution, **ended)
        fitted = dataclasses.replace(done.fitted, solution=solution, has_noise=has_noise)
        vars(fitted)["verdict"] = SimpleNamespace(fits=fits)
        vars(fitted)["distances"] = SimpleNamespace(setbacks=[None] * setbacks)
        monkeypatch.setattr(jobs, "fit", lambda *_, fitted=fitted, **__: fitted)
        assert main.main(["fit", str(done.experiment), "-o", str(tmp_path)]) == status


def test_sampling_continues_its_chain(done, run, capsys):
    assert main.main(["sample", str(run), "--max-steps", "16"]) == 0
    assert len(chain_of(run)) == 16
    assert main.main(["sample", str(run)]) == 0
    np.testing.assert_array_equal(chain_of(run), chain_of(done.sampled))
    text = capsys.readouterr().out
    assert "8 walkers, 20 steps" in text and f"read {run / run_folder.SUMMARY}" in text
    assert numbers_of(run, run_folder.POSTERIOR)["steps"] == 20 and "corner.png" in tree(run)
    assert "## Posterior" in (run / run_folder.SUMMARY).read_text()


def test_an_interrupted_sampling_keeps_its_chain(run, monkeypatch, capsys):
    monkeypatch.setattr(posterior.SamplingProgress, "__str__", interrupt)
    assert main.main(["sample", str(run), "--max-steps", "300"]) == main.INTERRUPTED
    output = capsys.readouterr().out
    assert "interrupted; summarising and writing the chain" in output
    assert "Interrupted, the chain is saved" in output
    assert len(chain_of(run)) == 100


@pytest.mark.filterwarnings("ignore::fitting.studies.animations.PlacementWarning")
def test_apply_runs_the_fitted_system_on_another_clip(done, animation, tmp_path, capsys):
    out = tmp_path / "out.npz"
    words = [done.run, animation.clip, "--terrain", animation.terrain, "-o", out]
    assert main.main(["apply", *map(str, words)]) == 0
    text = capsys.readouterr().out
    assert "16 frames in" in text and f"written to {out}" in text
    applied = fitting.load_clip(out).positions_ws
    fitted, start = (jobs.solve(ik, animation).positions_ws for ik in (done.fitted.ik, system()))
    np.testing.assert_allclose(applied, fitted, atol=1e-9)
    assert np.abs(applied - start).max() > 0.001
