"""Runs on disk."""

import json
import math
import os

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.experiments import experiment, parameter_files
from fitting.inference.identifiability import Identifiability
from fitting.inference.optimisation.search import Progress, Solution
from fitting.studies import run_folder, study
from jaxik.maths import parameter_tree
from support.experiments import CLIP, write

NAMES = ("pelvis.on_gain", "foot.max_pitch")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> study.Fit:
    """A fit that nothing has solved: its numbers are made up."""
    folder = tmp_path_factory.mktemp("store")
    rest = "[sigmas]\nbody = inf\ncorrelation = 0.4\n[parameters]\nlock.enabled = false"
    path = write(folder, rest=rest, clips=CLIP, clip="start = 1.0\nend = 1.2")
    asked = experiment_files.load_experiment(path)
    problem = problems.make_problem(asked)
    u = np.array([0.3, -0.2])
    solution = Solution(
        names=NAMES,
        u=u,
        values=np.asarray(problem.space.values(jnp.asarray(u))),
        cost_before=90.0,
        cost=10.0,
        converged=True,
        message="Converged.",
        jacobian=np.zeros((1, 2)),
        history=(Progress("start", 0, 0, 90.0, 90.0, 1.0),),
        steps=8,
        seconds=9.0,
    )
    identification = Identifiability(
        names=NAMES,
        contraction=np.array([0.9, 0.2]),
        interval=np.array([[0.1, 0.5], [0.2, 0.9]]),
        sd=np.array([0.01, np.nan]),
        at_bound=("", "high"),
        eigenvalues=np.array([0.1, 20.0]),
        weakest=("foot.max_pitch",),
        correlated=((*NAMES, 0.95),),
        profiles={},
        improvement=0.0,
    )
    return study.Fit(asked, problem, solution, identification)


def test_a_run_holds_the_experiment_the_system_and_the_numbers(fitted, tmp_path):
    run = tmp_path / "deep" / "run"
    run_folder.save_fit(run, fitted)
    asked, told = run_folder.load_fit(run)
    assert [row["name"] for row in told["parameters"]] == list(NAMES)
    assert [row["u"] for row in told["parameters"]] == [0.3, -0.2]
    assert [row["start_sd"] for row in told["parameters"]] == [0.01, study.THRESHOLD_SD]
    assert [row["determined"] for row in told["parameters"]] == [True, False]
    assert [row["at_bound"] for row in told["parameters"]] == ["", "high"]
    assert told["correlated"] == [[*NAMES, 0.95]] and told["history"][0]["stage"] == "start"
    ik, preset = parameter_files.load_system(run / run_folder.PARAMETERS)
    assert preset == "record" and not parameter_tree.get(ik, "lock.enabled")
    values = [float(parameter_tree.get(ik, name)) for name in NAMES]
    np.testing.assert_allclose(values, fitted.solution.values, rtol=1e-12)
    assert (asked.free, asked.clips) == (fitted.experiment.free, fitted.experiment.clips)


def test_the_experiment_of_a_run_is_whole_even_if_its_file_is_gone(fitted, tmp_path):
    text = experiment_files.experiment_to_toml(fitted.experiment)
    (tmp_path / "again.toml").write_text(text)
    again = experiment_files.load_experiment(tmp_path / "again.toml")
    for name in ("clips", "free", "preset", "name", "fps", "loss", "seed", "parameters", "fit"):
        assert getattr(again, name) == getattr(fitted.experiment, name), name
    assert again.sample == fitted.experiment.sample
    assert again.sigmas == {"body": math.inf, "correlation": 0.4}


def test_a_run_is_unfinished_until_its_numbers_are_written(fitted, tmp_path):
    run_folder.save_fit(tmp_path, fitted)
    run_folder.save_solution(tmp_path, fitted.experiment, fitted.problem, fitted.solution)
    with pytest.raises(ValueError, match="no fit.json; there is .*parameters.toml"):
        run_folder.load_fit(tmp_path)


def test_the_ball_of_a_threshold_is_small_and_no_ball_is_flat(fitted):
    sd = np.array([np.nan, 9.0])
    wide = study.Fit(
        fitted.experiment, fitted.problem, fitted.solution,
        Identifiability(**(vars(fitted.identifiability) | {"sd": sd})),
    )  # fmt: skip
    np.testing.assert_array_equal(wide.start_sd, [study.THRESHOLD_SD, study.MOST_SD])


def test_a_gain_reads_as_its_half_life_and_as_gains_at_other_rates():
    read = run_folder.gain_readings(0.3)
    assert read["gain_at_30_hz"] == pytest.approx(0.3)
    assert (1 - read["gain_at_60_hz"]) ** 2 == pytest.approx(0.7)
    assert 0.7 ** (30 * read["half_life"]) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("fit.json", None, "no fit.json; there is"),
        ("experiment.toml", None, "no experiment.toml"),
        ("parameters.toml", None, "no parameters.toml"),
        ("fit.json", "{", "fit.json: not the numbers of a fit"),
        ("fit.json", "[]", "fit.json: not the numbers of a fit"),
        ("fit.json", "{}", "fit.json: not the numbers of a fit: KeyError"),
        ("fit.json", '{"parameters": 3}', "fit.json: not the numbers of a fit"),
        ("fit.json", '{"parameters": [3]}', "fit.json: not the numbers of a fit"),
        ("fit.json", '{"parameters": [{"name": "x", "u": 1}]}', "parameters without .'determined'"),
        ("experiment.toml", "free = [", "experiment.toml: not TOML"),
    ],
)
def test_a_folder_that_is_no_finished_run_is_refused(fitted, tmp_path, name, text, said):
    run_folder.save_fit(tmp_path, fitted)
    if text is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=said):
        run_folder.load_fit(tmp_path)


def test_what_is_no_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no such folder; `jaxik fit` makes a run"):
        run_folder.load_fit(tmp_path / "no")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="file: a file; `jaxik fit`"):
        run_folder.load_fit(tmp_path / "file")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="there is nothing"):
        run_folder.load_fit(tmp_path / "empty")


def test_a_place_for_a_run_is_checked_and_nothing_made(tmp_path, monkeypatch):
    run_folder.check_place(tmp_path / "runs" / "walk")
    run_folder.check_place(tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("x")
    for place in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(ValueError, match="no folder for the run can be made, as .* is a file"):
            run_folder.check_place(place)
    monkeypatch.setattr(os, "access", lambda *_: False)  # the tests may run as root
    with pytest.raises(ValueError, match="is read-only"):
        run_folder.check_place(tmp_path / "run")


def test_the_numbers_are_plain_json(fitted):
    told = json.loads(json.dumps(run_folder.describe_fit(fitted), allow_nan=False))
    assert told["cost_before"] == 90.0 and told["converged"] is True
