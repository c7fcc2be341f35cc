"""Calibration: replicates, what is judged, the report and the command."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from distributed import LocalCluster

import fitting
from fitting.cli import main
from fitting.experiments import problems
from fitting.experiments.experiment_files import load_experiment
from fitting.inference.noise.model import noise_of
from fitting.inference.profiles.profile import make_profile
from fitting.problem.residuals import residuals_of_scenes as residuals_of_motion
from fitting.problem.simulation import simulate as simulate_motion
from fitting.report.calibration import calibration_report, calibration_tables
from fitting.report.plots import calibration_plots
from fitting.studies import run_folder
from fitting.studies.calibration import calibration, replicates
from fitting.studies.calibration.assessment import Assessment, assess, summarise
from fitting.studies.calibration.calibration import Calibration, CalibrationProgress, Observers
from support import small_studies
from support.experiments import ROOT
from support.pages import Page
from support.small_studies import SAMPLE, kept, write_calibration

NUMBERS = "replicates", "level", "inside", "outside", "fit_coverage", "ranks", "chain_coverage"


@pytest.fixture
def experiment_file(tmp_path, monkeypatch) -> Path:
    return small_studies.quick_calibration(tmp_path, monkeypatch)


def calibrate(path: Path, folder: Path | None, count: int, **options) -> Assessment:
    return fitting.calibrate(path, folder, replicates=count, **options)


def calibrate_study(path: Path, folder: Path | None, count: int, **options) -> Calibration:
    experiment = load_experiment(path)
    with jax.enable_x64(True):
        problem = problems.make_problem(experiment)
        return calibration.calibrate(experiment, problem, folder, count, **options)


class Made(NamedTuple):
    """What was made of four replicates."""

    folder: Path
    printed: str
    found: Calibration


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Made:
    folder, lines = tmp_path_factory.mktemp("calibration"), []
    with pytest.MonkeyPatch.context() as patch:
        path, out = small_studies.quick_calibration(folder, patch), folder / "out"
        calibrate(path, out, 4, chains=True, log=lines.append)
        return Made(out, "\n".join(lines), calibrate_study(path, out, 4, chains=True))


@pytest.fixture
def made(finished, tmp_path) -> Made:
    """The same, to be changed."""
    folder = Path(shutil.copytree(finished.folder, tmp_path / "out"))
    fits = json.loads(json.dumps(finished.found.fits))
    return finished._replace(folder=folder, found=Calibration(fits, finished.found.chains))


# What is judged


def test_a_right_program_is_inside_all_bounds(experiment_file):
    assessment = calibrate(experiment_file, None, 8, chains=True)
    assert assessment.inside and assessment.outside == []
    assert assessment.fit_coverage.total == 16 and assessment.fit_coverage.fraction > 0.85
    assert list(assessment.profile_coverage) == [0.5, 0.8]
    assert list(assessment.ranks) == ["pelvis.on_gain", "foot.max_pitch", "log-probability"]
    assert {len(test.ranks) for test in assessment.ranks.values()} == {8}
    assert assessment.valley.hits == 8 and assessment.wrong == ()
    assert list(assessment.chain_coverage) == [0.5, 0.8, 0.95]


@pytest.mark.parametrize(
    ("wrong", "count"),
    [({"noise": 3.0}, 24), ({"shift": 3.0}, 8)],
)
@pytest.mark.slow
def test_a_wrong_noise_is_found_by_intervals_and_ranks(tmp_path, monkeypatch, wrong, count):
    path = small_studies.quick_calibration(tmp_path, monkeypatch, **wrong)
    assessment = calibrate(path, None, count, chains=True)
    assert not assessment.inside
    assert "the fit's 95 % intervals" in assessment.outside
    assert {"the ranks of pelvis.on_gain", "the ranks of foot.max_pitch"} <= {*assessment.outside}
    assert "the posterior's 95 % intervals" in assessment.outside
    assert "the 80 % intervals of profiles" in assessment.outside
    assert assessment.valley.inside, "the search is not to blame"


def test_a_wrong_valley_is_counted_whether_or_not_the_fit_says_so(made):
    fits: list[Any] = made.found.fits
    fits[1]["cost"] += 3.5
    fits[2] |= {"cost": fits[2]["cost"] + 90.0, "converged": False}
    fits[3]["cost"] += 2.5
    assessment = assess(Calibration(fits, []))
    assert (assessment.wrong, assessment.wrong_but_converged) == ((2, 3), (2,))
    assert assessment.unconverged == (3,) and assessment.valley.hits == 2
    text = calibration_report.calibration_text(assessment)
    assert "Replicates in another valley: 2, 3 (2 in all)." in text
    assert "In another valley, but said to have converged: 2 (1 in all)." in text
    assert "a valley 3.5 above the truth's" in calibration_report.fit_line(fits[1])


def test_only_the_intervals_of_thresholds_may_cover_more_than_they_promise(made):
    """Whose ends lie on plateaus of the cost: 95 % is what they promise at least."""
    fitted = made.found.fits[0]
    rows = [{**row, "interval": [row["low"], row["high"]]} for row in fitted["parameters"]]
    always: Any = {**fitted, "parameters": [{**rows[0], "kind": "threshold"}, rows[1]]}
    covered = assess(Calibration([always] * 400, [])).fit_coverage_of
    assert covered["pelvis.on_gain"].inside and not covered["foot.max_pitch"].inside


def test_recovery_counts_determined_parameters_within_5_percent_of_their_range(made):
    fits = made.found.fits[:2]
    for fitted, shift in zip(fits, (0.06, 0.04), strict=True):
        first, second = fitted["parameters"]
        value = fitted["truth"][0] + shift * (first["high"] - first["low"])
        first |= {"value": value, "determined": True}
        second["determined"] = False
    assessment = assess(Calibration(fits, []))
    assert (assessment.recovery.hits, assessment.recovery.total) == (1, 2)
    assert assessment.recovery_of["foot.max_pitch"].total == 0
    assert "0 of 0" in str(calibration_tables.parameter_table(assessment))


@pytest.mark.parametrize("count", [30, 99, 400])
def test_ranks_are_uniform_however_many_draws_a_chain_has(count):
    random = np.random.default_rng(6)
    normal = random.normal(size=(3000, count + 1, 1))
    ranks = [replicates.rank(row[0], row[1:], random)[0] for row in normal]
    assert 0 <= min(ranks) and max(ranks) <= replicates.DRAWS
    deciles = np.histogram(ranks, 10, range=(0, 100))[0]
    np.testing.assert_allclose(deciles, 300, atol=80)


def test_the_level_at_a_truth_is_that_of_a_parabola_between_points(experiment_file):
    experiment = load_experiment(experiment_file)
    with jax.enable_x64(True):
        problem = problems.make_problem(experiment)
    parameter = problem.space.parameters[1]  # linear
    values = np.array([0.1, 0.2, 0.4, 0.45, 0.8])
    rises = 200 * (values - 0.4) ** 2
    path = np.stack([values, values], axis=1)
    profile = make_profile(parameter, path, values, rises, np.zeros(5))
    for value in (0.32, 0.38, 0.42, 0.5):
        expected = scipy.stats.chi2(1).cdf(400 * (value - 0.4) ** 2)
        level = replicates.level_at(profile, parameter, value)
        assert level == pytest.approx(expected, abs=0.03)


# Replicates


def test_truths_come_from_the_prior_and_differ(experiment_file):
    experiment = load_experiment(experiment_file)
    with jax.enable_x64(True):
        problem = problems.make_problem(experiment)
        truths = [replicates.draw_truth(problem, experiment, i) for i in range(400)]
        other = dataclasses.replace(experiment, seed=1)
        assert (replicates.draw_truth(problem, other, 0).u != truths[0].u).all()
    probability = problem.space.prior.cumulative(np.stack([truth.u for truth in truths]))
    np.testing.assert_allclose(np.mean(probability, axis=0), 0.5, atol=0.06)
    np.testing.assert_allclose(np.var(probability, axis=0), 1 / 12, atol=0.012)
    assert len({truth.noise_seed for truth in truths} | {t.seed for t in truths}) == 800


def test_a_cluster_makes_the_same_replicates(made, experiment_file, tmp_path):
    there = tmp_path / "there"
    reports: list[CalibrationProgress] = []
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(n_workers=1, processes=False, **options) as workers:
        address: str = workers.scheduler_address  # pyright: ignore[reportAttributeAccessIssue]
        found = calibrate(experiment_file, there, 2, scheduler=address, progress=reports.append)
    assert summarise(found) == summarise(assess(Calibration(made.found.fits[:2], [])))
    here = kept(made.folder)
    assert all(here[name] == fit for name, fit in kept(there).items() if name.startswith("fits/"))
    assert {report.replicate for report in reports} == {1, 2}
    assert reports[-1].stage == "2 of 2 fits done" and reports[-1].remaining == 0.0


def test_finished_replicates_are_not_repeated_and_more_may_follow(made, experiment_file):
    for name in ("fits/0003.json", "chains/0003.json", "chains/0002.json"):
        (made.folder / name).unlink()
    new: list[str] = []
    observers = Observers(
        on_fit=lambda fitted: new.append(f"fit {fitted['number']}"),
        on_chain=lambda chain: new.append(f"chain {chain['number']}"),
    )
    first = calibrate_study(experiment_file, made.folder, 3, observers=observers)
    assert not new and first == Calibration(made.found.fits[:3], [])
    calibrate_study(experiment_file, made.folder, 4, chains=True, observers=observers)
    assert new == ["fit 3", "chain 2", "chain 3"]


def test_nothing_compiles_between_replicates(experiment_file):
    compiled: list[str] = []

    def listen(event: str, *_: object, **__: object) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    calibrate_study(experiment_file, None, 1, chains=True)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        calibrate_study(experiment_file, None, 3, chains=True)
        assert not compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.parametrize(
    ("top", "rest", "words"),
    [
        ("seed = 1", SAMPLE, "differs from .* in: seed; name another folder"),
        ("fps = 20.0", SAMPLE, "in: problem; name"),
        ("", SAMPLE.replace("400", "500"), "in: sample; name"),
        ("", SAMPLE + "[fit]\nstarts = 3\n", "in: fit; name"),
        ("", SAMPLE + "[start]\npelvis.on_gain = 0.5\n", "in: start; name"),
    ],
)
def test_the_folder_of_another_calibration_is_refused(
    made, experiment_file, tmp_path, top, rest, words
):
    before = kept(made.folder)
    with pytest.raises(ValueError, match=words):
        calibrate_study(write_calibration(tmp_path, top, rest), made.folder, 1)
    assert kept(made.folder) == before


def test_replicates_of_an_unknown_experiment_are_refused(made, experiment_file):
    identity = made.folder / "identity.json"
    identity.write_text('{"seed": 0}')
    with pytest.raises(ValueError, match="identity.json: not written by `jaxik calibrate`"):
        calibrate_study(experiment_file, made.folder, 1)
    identity.unlink()
    with pytest.raises(ValueError, match=r"out: has replicates but no identity.json"):
        calibrate_study(experiment_file, made.folder, 1)


def test_a_mistake_in_a_replicate_says_in_which(experiment_file, monkeypatch):
    def fail(*_: object) -> None:
        raise ValueError("too steep")

    monkeypatch.setattr(replicates, "simulate", fail)
    with pytest.raises(ValueError, match="replicate 1: too steep"):
        calibrate_study(experiment_file, None, 2)


# Report and command


def test_the_folder_has_a_report(finished):
    out, printed, _ = finished
    assert "4 truths of 2 parameters of record" in printed
    assert "replicate 3: the truth's valley, 2 of 2 starts agree" in printed
    assert "Calibrated: on 4 simulated motions everything is inside its bounds." in printed
    assert f"read {out / 'summary.md'}" in printed
    summary = (out / "summary.md").read_text()
    assert summary.startswith("# hill: calibration\n\nCalibrated: on 4 simulated motions")
    for picture in ("ranks.png", "recovery.png"):
        assert f"({picture})" in summary and (out / picture).stat().st_size > 10_000
    page = Page(out / run_folder.PAGE)
    assert "but 4 simulated motions prove little, as these bounds are wide" in page.text
    assert page.elements.count("img") == 2 and "h2 Ranks" in page.headings
    numbers = json.loads((out / "calibration.json").read_text())
    assert set(NUMBERS) <= numbers.keys() and numbers["experiment"] == "hill"
    assert numbers["inside"] is True and len(numbers["ranks"]["pelvis.on_gain"]["ranks"]) == 4
    assert set(numbers["chain_coverage"]) == {"0.5", "0.8", "0.95"}


def test_what_is_outside_is_named_and_ends_with_status_5(tmp_path, monkeypatch, capsys, undrawn):
    path = small_studies.quick_calibration(tmp_path, monkeypatch, shift=6.0)
    out = tmp_path / "out"
    assert main.main(["calibrate", str(path), "-n", "8", "-o", str(out)]) == 5
    printed = capsys.readouterr().out
    assert "Not calibrated: on 8 simulated motions, outside their bounds: the fit's 95 %" in printed
    assert "**no**, too few" in printed
    assert not (out / "ranks.png").exists(), "there are no chains"
    page = Page(out / run_folder.PAGE)
    assert "hill Not calibrated ◐ Of 8 simulated motions, outside their bounds: the" in page.text
    assert "No posterior was sampled" in page.text and "no, too few" in page.text


def test_the_picture_marks_ranks_that_leave_their_band(made):
    ranks = assess(made.found).ranks
    wrong = dataclasses.replace(ranks["pelvis.on_gain"], ranks=np.zeros(40, int))
    figure = calibration_plots.ranks({**ranks, "foot.max_pitch": wrong}, "title")
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles[:6] == [
        "pelvis.on_gain", "", "foot.max_pitch", "outside its band", "log-probability", ""
    ]  # fmt: skip


@pytest.mark.slow
def test_noise_that_is_not_as_assumed_is_simulated_and_assumed_no_more(
    experiment_file, monkeypatch
):
    """Residuals of the truth are twice as large; the problem that is fitted assumes what it did."""
    monkeypatch.setattr(replicates, "simulate", simulate_motion)
    experiment = load_experiment(experiment_file)
    problem = problems.make_problem(experiment)
    problem = dataclasses.replace(problem, residual_function=residuals_of_motion)
    truth = replicates.draw_truth(problem, experiment, 0)
    rms = []
    for factor in (1.0, 2.0):
        simulated = replicates._simulated(problem, truth, factor)
        assert noise_of(simulated) == noise_of(problem)
        residuals = np.asarray(simulated.residuals(jnp.asarray(truth.u)))[:-2]
        rms.append(np.sqrt(np.mean(residuals[residuals != 0] ** 2)))
    assert rms == pytest.approx([1.0, 2.0], rel=0.1)


@pytest.mark.slow
def test_ozz_is_calibrated(tmp_path):
    """The whole path, through the pipeline and as users run it, with a fixed seed."""
    experiment = ROOT / "data" / "experiments" / "calibration" / "ozz.toml"
    out = tmp_path / "out"
    command = ["calibrate", str(experiment), "-n", "8", "-o", str(out)]
    done = subprocess.run(
        [sys.executable, "-m", "fitting.cli.main", *command],
        cwd=ROOT,
        env=os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    numbers = json.loads((out / "calibration.json").read_text())
    assert numbers["inside"] and not numbers["wrong"] and not numbers["unconverged"]
    assert numbers["fit_coverage"]["hits"] >= 48 and numbers["fit_coverage"]["total"] == 56
    assert numbers["recovery"]["hits"] == numbers["recovery"]["total"] >= 44
