"""Run folders: what they hold, where they may be, and those of earlier releases.

`tests/support/released` has a run of each release, written by its own code: two parameters fitted
with the residuals of `support.quick`, and four steps of a chain.
"""

import dataclasses
import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from fitting.experiments import experiment_files, parameter_files, problems, systems
from fitting.inference.noise.settings import NoiseOptions
from fitting.runtime.storage.claimed_folder import LOCK
from fitting.studies import run_folder
from fitting.studies.fit import MAX_START_SD, THRESHOLD_SD, Fit, gain_readings
from fitting.studies.sample import walker_start
from jaxik.maths import parameter_tree
from support import quick, small_studies
from support.experiments import ROOT, write
from support.refusals import refusal
from support.runs import NAMES, invented_fit, save

RELEASED = sorted((ROOT / "tests" / "support" / "released").iterdir())


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    """A fit with invented numbers; no search has run."""
    folder = tmp_path_factory.mktemp("experiment")
    return invented_fit(folder)


def test_a_run_holds_the_experiment_the_system_and_the_numbers(fitted, tmp_path):
    run = tmp_path / "deep" / "run"
    save(run, fitted)
    experiment, summary = run_folder.load_fit(run)
    assert [row["name"] for row in summary["parameters"]] == list(NAMES)
    assert [row["u"] for row in summary["parameters"]] == [0.3, -0.2]
    assert [row["start_sd"] for row in summary["parameters"]] == [0.01, THRESHOLD_SD]
    assert [(row["prior"]["shape"], row["prior"]["spread"]) for row in summary["parameters"]] == [
        ("normal", 1.6)
    ] * 2
    assert [row["determined"] for row in summary["parameters"]] == [True, False]
    assert [row["at_bound"] for row in summary["parameters"]] == ["", "high"]
    assert summary["correlated"] == [[*NAMES, 0.95]] and summary["history"][0]["stage"] == "start"
    ik, preset = parameter_files.load_system(run / run_folder.PARAMETERS)
    assert preset == systems.DEFAULT_PRESET and not parameter_tree.get(ik, "lock.enabled")
    values = [float(parameter_tree.get(ik, name)) for name in NAMES]
    np.testing.assert_allclose(values, fitted.solution.values, rtol=1e-12)
    assert (experiment.free, experiment.clips) == (fitted.experiment.free, fitted.experiment.clips)


def test_the_experiment_in_a_run_does_not_need_its_original_file(fitted, tmp_path):
    sigmas = {"ankle": 0.01, "body": math.inf, "correlation.ankle": 0.9, "correlation.foot": 0.5}
    noise = NoiseOptions("estimated", "whitened")
    changed = dataclasses.replace(fitted.experiment, sigmas=sigmas, noise=noise)
    (tmp_path / "again.toml").write_text(experiment_files.experiment_to_toml(changed))
    again = experiment_files.load_experiment(tmp_path / "again.toml")
    for field in ("clips", "free", "preset", "name", "fps", "loss", "seed", "parameters", "fit"):
        assert getattr(again, field) == getattr(changed, field), field
    assert (again.sample, again.sigmas, again.noise) == (changed.sample, sigmas, noise)
    (scene,) = problems.make_problem(again).data
    found = {kind: float(scene.sigmas.correlation_of(kind)) for kind in ("ankle", "knee", "foot")}
    assert found == {"ankle": 0.9, "knee": 0.0, "foot": 0.5}


def project(folder: Path) -> Path:
    """An experiment beside files for its clip, and a run of it, in `folder`; returns the run."""
    (folder / "data").mkdir(parents=True)
    for name in ("walk.npz", "steps.ply"):
        (folder / "data" / name).touch()
    clip = 'reference = "data/walk.npz"\nterrain = "data/steps.ply"\n'
    path = write(folder, clips=f"[[clips]]\n{clip}")
    experiment, run = experiment_files.load_experiment(path), folder / "runs" / "walk"
    run.mkdir(parents=True)
    text = experiment_files.experiment_to_toml(experiment, run)
    (run / run_folder.EXPERIMENT).write_text(text, encoding="utf-8")
    return run


def terrain_of(run: Path) -> Path:
    (clip,) = experiment_files.load_experiment(run / run_folder.EXPERIMENT).clips
    return clip.terrain


def test_a_run_and_its_data_may_be_moved_together(tmp_path):
    run = project(tmp_path / "first")
    assert 'terrain = "../../data/steps.ply"' in (run / run_folder.EXPERIMENT).read_text()
    (tmp_path / "first").rename(tmp_path / "second")
    assert terrain_of(tmp_path / "second/runs/walk") == tmp_path / "second/data/steps.ply"


def test_a_run_may_be_moved_alone(tmp_path):
    run = project(tmp_path / "first")
    moved = run.rename(tmp_path / "alone")
    assert terrain_of(moved) == tmp_path / "first/data/steps.ply"
    (tmp_path / "first/data/steps.ply").unlink()
    with pytest.raises(ValueError) as refused:
        terrain_of(moved)
    places = [tmp_path.parent / "data/steps.ply", tmp_path / "first/data/steps.ply"]
    assert all(str(place) in str(refused.value) for place in places)


def test_a_file_beside_the_moved_run_is_preferred_to_the_old_one(tmp_path):
    run = project(tmp_path / "first")
    shutil.copytree(tmp_path / "first", tmp_path / "copy")
    assert terrain_of(tmp_path / "copy" / run.relative_to(tmp_path / "first")) == (
        tmp_path / "copy/data/steps.ply"
    )


def test_paths_to_another_drive_are_whole(tmp_path, monkeypatch):
    def no_path(*_: object) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", no_path)
    run = project(tmp_path / "first")
    whole = (tmp_path / "first/data/steps.ply").as_posix()
    assert f'terrain = "{whole}"' in (run / run_folder.EXPERIMENT).read_text()
    assert terrain_of(run.rename(tmp_path / "alone")) == Path(whole)


def test_a_run_is_unfinished_until_its_numbers_are_written(fitted, tmp_path):
    save(tmp_path, fitted)
    run_folder.save_solution(tmp_path, fitted.experiment, fitted.problem, fitted.solution)
    with pytest.raises(ValueError, match="no fit.json; there is .*parameters.toml"):
        run_folder.load_fit(tmp_path)


def test_walkers_start_near_thresholds_and_neither_too_near_nor_too_far(fitted):
    known = dataclasses.replace(fitted.identifiability, sd=np.array([np.nan, 9.0]))
    wide = dataclasses.replace(fitted, identifiability=known)
    np.testing.assert_array_equal(wide.start_sd, [THRESHOLD_SD, MAX_START_SD])


def test_a_gain_has_a_half_life_and_gains_at_other_rates():
    readings = gain_readings(0.3)
    assert readings["gain_at_30_hz"] == pytest.approx(0.3)
    assert (1 - readings["gain_at_60_hz"]) ** 2 == pytest.approx(0.7)
    assert 0.7 ** (30 * readings["half_life"]) == pytest.approx(0.5)


def test_a_fitted_system_needs_neither_experiment_nor_clips(fitted, tmp_path):
    save(tmp_path, fitted)
    whole = run_folder.load_fitted_system(tmp_path)
    (tmp_path / run_folder.EXPERIMENT).unlink()
    alone = run_folder.load_fitted_system(tmp_path)
    assert parameter_tree.get(alone, "pelvis.limit") == parameter_tree.get(whole, "pelvis.limit")
    moved = tmp_path / "moved"
    moved.mkdir()
    shutil.copy(tmp_path / run_folder.PARAMETERS, moved)
    alone = run_folder.load_fitted_system(moved)
    assert parameter_tree.get(alone, "pelvis.limit") == parameter_tree.get(whole, "pelvis.limit")
    (moved / run_folder.SEARCH).write_text("{}")
    with pytest.raises(ValueError, match="no fit.json; there is"):
        run_folder.load_fitted_system(moved)


def test_what_is_no_folder_of_a_run_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("no", "no such folder; `jaxik fit` makes a run"),
        ("file", "file: a file; `jaxik fit`"),
        ("empty", "there is nothing"),
    ):
        with pytest.raises(ValueError, match=message):
            run_folder.load_fit(tmp_path / name)


def test_checking_an_output_folder_makes_nothing(tmp_path, monkeypatch):
    run_folder.check_output_folder(tmp_path / "runs" / "walk")
    run_folder.check_output_folder(tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(ValueError, match="no folder can be made here, as .* is a file"):
            run_folder.check_output_folder(folder)
    monkeypatch.setattr(os, "access", lambda *_: False)  # the tests may run as root
    with pytest.raises(ValueError, match="is read-only"):
        run_folder.check_output_folder(tmp_path / "run")


def test_a_folder_in_which_a_search_was_killed_counts_as_new(tmp_path):
    for name in (LOCK, run_folder.SEARCH):
        (tmp_path / name).write_text("x")
        run_folder.check_new_folder(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(ValueError, match=r"something in it already: \['notes.txt'\]"):
        run_folder.check_new_folder(tmp_path)


def test_the_numbers_are_plain_json(fitted):
    summary = json.loads(json.dumps(fitted.summary, allow_nan=False))
    assert summary["cost_before"] == 90.0 and summary["converged"] is True


# Of earlier releases


@pytest.fixture(params=RELEASED, ids=lambda folder: folder.name)
def released(request, tmp_path) -> Path:
    run = Path(shutil.copytree(request.param, tmp_path / "run"))
    experiment = run / run_folder.EXPERIMENT
    experiment.write_text(experiment.read_text().replace("{data}", str(ROOT / "data")))
    return run


def test_a_released_fit_is_read_applied_and_can_be_sampled_from(released):
    experiment, summary = run_folder.load_fit(released)
    values = {row["name"]: row["value"] for row in summary["parameters"]}
    assert values == pytest.approx(quick.TARGETS, abs=0.001)
    space = problems.make_problem(experiment).space
    start = walker_start(summary["parameters"], space)
    started = dict(zip(space.names, space.values(start.u).tolist(), strict=True))
    assert started == pytest.approx(values, rel=1e-6)
    ik = run_folder.load_fitted_system(released)
    applied = {name: float(parameter_tree.get(ik, name)) for name in values}
    assert applied == pytest.approx(values, abs=0.001)


def test_a_released_chain_is_refused_in_one_sentence(released, monkeypatch, capsys):
    small_studies.quick_fits(monkeypatch)
    line = refusal(["sample", released], released, capsys)
    assert "chain.h5 holds the chain of another run" in line and "delete the file" in line
