"""Whole jobs from Python: what they return, and that they write only where they are told to."""

from pathlib import Path

import jax
import pytest

import fitting
from fitting import jobs
from fitting.experiments import problems
from fitting.studies import run_folder
from support import quick
from support.experiments import CLIP, write

SAMPLE = "[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 20"


@pytest.fixture(scope="module", autouse=True)
def unoptimised():
    """Compiles without optimisations, as each program runs once or twice."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def experiment_file(tmp_path, monkeypatch) -> Path:
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
    assert lines[-1] == f"written to {run}; read {run / run_folder.SUMMARY}"
    first = fitting.sample(fitted)
    assert (run / run_folder.CHAIN).is_file() and (run / run_folder.POSTERIOR).is_file()
    continued = fitting.sample(run, max_steps=30)
    assert (continued.u[:20] == first.u).all() and len(continued.u) == 30


def test_a_solution_is_on_disk_before_anything_else_is_computed(experiment_file, monkeypatch):
    run = experiment_file.parent / "run"

    def interrupt(*_):
        assert (run / run_folder.PARAMETERS).is_file()
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs, "assess_identifiability", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fitting.fit(experiment_file, run)
    assert not (run / run_folder.FIT).exists()
