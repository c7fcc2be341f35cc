"""Whole jobs from Python: what they return, and that they write only where they are told to."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxik
from fitting import jobs
from fitting.analysis import playback
from fitting.experiments import problems
from fitting.inference.identifiability import assess_identifiability
from fitting.report import fit_report
from fitting.runtime.precision import with_floats
from fitting.studies import assess, run_folder
from jaxik.maths import parameter_tree
from support import quick
from support.experiments import CLIP, ROOT, write

SAMPLE = "[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 20"


@pytest.fixture
def experiment_file(tmp_path, monkeypatch, undrawn) -> Path:
    """Half a second of the uneven walk, with residuals that compile at once."""
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    monkeypatch.chdir(tmp_path)
    clip = "start = 1.0\nend = 1.5"
    return write(tmp_path, "hill.toml", clips=CLIP, clip=clip, rest=SAMPLE)


def test_jobs_without_an_output_write_nothing(experiment_file):
    fitted = fitting.fit(experiment_file)
    posterior = fitting.sample(fitted)
    values = dict(zip(fitted.solution.names, fitted.solution.values, strict=True))
    assert values == pytest.approx(quick.TARGETS, abs=0.003)
    assert posterior.names == fitted.solution.names and len(posterior.u) == 20
    assert list(experiment_file.parent.iterdir()) == [experiment_file]


@pytest.mark.slow
def test_a_fit_with_an_output_can_be_sampled_from_memory_and_from_disk(experiment_file):
    run, lines = experiment_file.parent / "run", []
    experiment = fitting.load_experiment(experiment_file)
    fitted = fitting.fit(experiment, run, log=lines.append)
    assert fitted.run == run and lines[0].startswith("fitting 2 parameters of record to 1 clip")
    summary, page = run / run_folder.SUMMARY, run / run_folder.PAGE
    assert lines[-1] == f"written to {run}; read {summary}, or open {page} in a browser"
    first = fitting.sample(fitted)
    assert (run / run_folder.CHAIN).is_file() and (run / run_folder.POSTERIOR).is_file()
    continued = fitting.sample(run, max_steps=30)
    assert (continued.u[:20] == first.u).all() and len(continued.u) == 30


def worsen(run: Path) -> dict:
    """Moves the fit of a run off its optimum; what its file then holds."""
    worse = json.loads((run / run_folder.FIT).read_text())
    for row in worse["parameters"]:
        row["u"] += 3 * row["start_sd"]
    (run / run_folder.FIT).write_text(json.dumps(worse))
    return worse


@pytest.mark.slow
def test_a_lower_point_of_a_chain_becomes_the_fit_of_its_run(experiment_file):
    run, lines = experiment_file.parent / "run", []
    fitted = fitting.fit(experiment_file, run)
    best = fitted.summary["parameters"]
    worsen(run)
    posterior = fitting.sample(run, log=lines.append)
    assert any("higher than the fit's; the fit goes on from there" in line for line in lines)
    _, adopted = run_folder.load_fit(run)
    for before, after in zip(best, adopted["parameters"], strict=True):
        assert after["u"] == pytest.approx(before["u"], abs=0.1 * before["start_sd"])
    assert posterior.improvement <= assess.MIN_IMPROVEMENT
    numbers = json.loads((run / run_folder.POSTERIOR).read_text())
    assert numbers["lower_point"] is None and not (run / run_folder.LOWER_POINT).exists()
    text = (run / run_folder.SUMMARY).read_text()
    assert "## Posterior" in text and "The chain contradicts its fit: it met" not in text


@pytest.mark.slow
def test_an_interrupted_adoption_leaves_the_old_fit_and_the_lower_point(
    experiment_file, monkeypatch
):
    run = experiment_file.parent / "run"
    fitting.fit(experiment_file, run)
    worse = worsen(run)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs.fits, "assess_solution", interrupt)
    fitting.sample(run)
    assert {"format": 1, **run_folder.load_fit(run)[1]} == worse
    assert (run / run_folder.LOWER_POINT).is_file()


@pytest.mark.slow
def test_a_replay_that_is_interrupted_leaves_the_report_of_the_chain(experiment_file, monkeypatch):
    run = experiment_file.parent / "run"
    fitted = fitting.fit(experiment_file, run)

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs.fits, "replay", interrupt)
    posterior = fitting.sample(fitted)
    assert posterior.interrupted and (run / run_folder.POSTERIOR).is_file()
    assert "## Posterior" in (run / run_folder.SUMMARY).read_text()


def test_a_solution_is_on_disk_before_anything_else_is_computed(experiment_file, monkeypatch):
    run = experiment_file.parent / "run"

    def interrupt(*_):
        assert (run / run_folder.PARAMETERS).is_file()
        raise KeyboardInterrupt

    monkeypatch.setattr(assess, "assess_identifiability", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fitting.fit(experiment_file, run)
    assert not (run / run_folder.FIT).exists()


# Precision

IN_A_PROCESS_OF_32_BITS = """
import json, sys
import jax
import jax.numpy as jnp
import fitting
from fitting.experiments import problems
from support import quick

problems.residuals_of_scenes = quick.residuals_of_scenes
fitted = fitting.fit(sys.argv[1])
posterior = fitting.sample(fitted)
new = str(jnp.ones(1).dtype)
print(json.dumps([fitted.solution.u.tolist(), posterior.u.tolist(), fitted.summary["cost"], new]))
"""


def test_a_process_with_32_bits_gets_the_fit_and_posterior_of_64_and_keeps_its_setting(
    experiment_file,
):
    """In a process of its own, since the tests' has 64 bits: threads would inherit them."""
    words = [sys.executable, "-W", "error", "-c", IN_A_PROCESS_OF_32_BITS, str(experiment_file)]
    paths = f"{ROOT}:{ROOT / 'tests'}"
    done = subprocess.run(words, env=os.environ | {"PYTHONPATH": paths}, capture_output=True)
    assert not done.returncode, done.stderr.decode()
    u, walkers, cost, new = json.loads(done.stdout)
    jax.clear_caches()  # what other tests compiled with other options rounds differently
    fitted = fitting.fit(experiment_file)
    assert u == fitted.solution.u.tolist() and cost == fitted.solution.cost
    assert walkers == fitting.sample(fitted).u.tolist()
    assert new == "float32"


def test_a_fit_can_be_used_where_jax_has_32_bits(experiment_file):
    with jax.enable_x64(False):
        fitted = fitting.fit(experiment_file)
        problem, solution = fitted.problem, fitted.solution
        outputs = [
            problem.residuals(solution.u),
            problem.cost(solution.u),
            problem.jacobian(solution.u),
            problem.log_probability(solution.u),
            problem.space.values(solution.u),
            problem.space.pack(fitted.ik),
            parameter_tree.get(fitted.ik, "pelvis.on_gain"),
            fitted.results[0].body.pos,
            assess_identifiability(problem, solution).contraction,
        ]
        assert {output.dtype for output in outputs} == {np.dtype(np.float64)}
        assert float(outputs[1]) == pytest.approx(solution.cost, rel=1e-12)
        assert fitted.summary["parameters"][0]["value"] == solution.values[0]
        assert with_floats(fitted.ik, np.float32).leg.weight.dtype == np.float32
        assert jnp.ones(1).dtype == np.float32


def test_a_fit_is_reported_where_jax_has_32_bits(experiment_file):
    with jax.enable_x64(False):
        fitted = fitting.fit(experiment_file)
        fit_report.write_fit(experiment_file.parent, fitted)
    assert (experiment_file.parent / run_folder.SUMMARY).is_file()


def test_a_system_made_in_32_bits_runs_in_those_of_the_clip(experiment_file):
    problem = problems.make_problem(fitting.load_experiment(experiment_file))
    with jax.enable_x64(False):
        single = jaxik.presets.record()
        result = playback.run(single, problem.data[0])
    assert single.leg.weight.dtype == np.float32 and result.body.pos.dtype == np.float64


def test_an_error_in_a_job_leaves_32_bits(tmp_path):
    with jax.enable_x64(False):
        with pytest.raises(ValueError, match="no such file"):
            fitting.fit(tmp_path / "no.toml")
        assert jnp.ones(1).dtype == np.float32


@pytest.mark.slow
def test_systems_made_in_32_bits_are_compared_in_64(tmp_path):
    short = fitting.load_clip(ROOT / "data" / "clips" / "uneven_walk_base.npz").select(slice(40))
    fitting.save_clip(tmp_path / "short.npz", short)
    ground = ROOT / "data" / "terrains" / "uneven_walk.ply"
    animation = fitting.AnimationFiles(tmp_path / "short.npz", ground)
    with jax.enable_x64(False):
        compared = fitting.compare({"record": jaxik.presets.record()}, animation)
        solved = jobs.solve(jaxik.presets.record(), animation)
    exact = jobs.solve(jaxik.presets.record(), animation)
    np.testing.assert_allclose(solved.positions_ws, exact.positions_ws, atol=1e-5)
    np.testing.assert_array_equal(
        compared.motions["record"].ankle, solved.joints_ws(2), strict=True
    )
