"""Calibration: replicates, resuming, what is judged, the report and the command."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
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
from support.experiments import CLIP, ROOT, write
from support.pages import Page

SIGMA = 0.02
FREE = "pelvis.on_gain = {}\nfoot.max_pitch = { low = 0.1 }\n"
SAMPLE = "[sample]\nwalkers = 8\nstop_at = 25.0\nmax_steps = 400\n"
NUMBERS = "replicates", "level", "inside", "outside", "fit_coverage", "ranks", "chain_coverage"


def values_of(ik) -> jax.Array:
    return jnp.stack([ik.pelvis.on_gain, ik.foot.max_pitch])


def residuals_of_scenes(ik, scenes):
    """Two parameters against two numbers that stand in the reference."""
    measured = scenes[0].reference.pelvis.pos[0, :2]
    return (values_of(ik) - measured) / jnp.asarray(SIGMA, measured.dtype)


def simulation(noise: float = 1.0, shift: float = 0.0):
    """Writes the truth, plus noise in standard deviations, into the reference."""

    def simulate(problem, u, seed):
        errors = SIGMA * (shift + noise * np.random.default_rng(seed).normal(size=2))
        measured = values_of(problem.space.unpack(u)) + errors
        pos = problem.data[0].reference.pelvis.pos
        return eqx.tree_at(
            lambda p: p.data[0].reference.pelvis.pos, problem, pos.at[0, :2].set(measured)
        )

    return simulate


@pytest.fixture
def experiment_file(tmp_path, monkeypatch) -> Path:
    """Half a second of the uneven walk, with residuals and a simulation that compile at once."""
    monkeypatch.setattr(problems, "residuals_of_scenes", residuals_of_scenes)
    monkeypatch.setattr(replicates, "simulate", simulation())
    return write_half_second(tmp_path)


def write_half_second(folder: Path, top: str = "", rest: str = SAMPLE) -> Path:
    clip = "start = 1.0\nend = 1.5"
    return write(folder, "hill.toml", top=top, clips=CLIP, clip=clip, free=FREE, rest=rest)


def calibrate(path: Path, folder: Path | None, count: int, **options) -> Assessment:
    return fitting.calibrate(path, folder, replicates=count, **options)


def kept(folder: Path) -> dict[str, dict]:
    """All replicates on disk without how long they took."""
    return {
        f"{path.parent.name}/{path.name}": json.loads(path.read_text()) | {"seconds": 0}
        for path in sorted(folder.glob("*/*.json"))
    }


# What is judged


def test_a_right_program_is_inside_all_bounds(experiment_file):
    assessment = calibrate(experiment_file, None, 24, chains=True)
    assert assessment.inside and assessment.outside == []
    assert assessment.fit_coverage.total == 48 and assessment.fit_coverage.fraction > 0.85
    assert list(assessment.profile_coverage) == [0.5, 0.8]
    assert list(assessment.ranks) == ["pelvis.on_gain", "foot.max_pitch", "log-probability"]
    assert {len(test.ranks) for test in assessment.ranks.values()} == {24}
    assert assessment.valley.hits == 24 and assessment.wrong == ()
    assert list(assessment.chain_coverage) == [0.5, 0.8, 0.95]


@pytest.mark.parametrize(
    ("noise", "shift", "count"),
    [(3.0, 0.0, 24), (1.0, 2.0, 12)],
    ids=["three times the noise", "a shift"],
)
def test_a_wrong_noise_is_found_by_intervals_and_ranks(
    experiment_file, monkeypatch, noise, shift, count
):
    monkeypatch.setattr(replicates, "simulate", simulation(noise, shift))
    assessment = calibrate(experiment_file, None, count, chains=True)
    assert not assessment.inside
    assert "the fit's 95 % intervals" in assessment.outside
    assert {"the ranks of pelvis.on_gain", "the ranks of foot.max_pitch"} <= {*assessment.outside}
    assert "the posterior's 95 % intervals" in assessment.outside
    assert "the 80 % intervals of profiles" in assessment.outside
    assert assessment.valley.inside, "the search is not to blame"


def test_a_wrong_valley_is_counted_whether_or_not_the_fit_says_so(experiment_file, tmp_path):
    made = calibrate_study(experiment_file, tmp_path / "out", 4)
    fits = [{**fitted} for fitted in made.fits]
    fits[1]["cost"] += 3.5
    fits[2] |= {"cost": fits[2]["cost"] + 90.0, "converged": False}
    fits[3]["cost"] += 2.5
    assessment = assess(Calibration(fits, []))  # type: ignore[arg-type]
    assert (assessment.wrong, assessment.wrong_but_converged) == ((2, 3), (2,))
    assert assessment.unconverged == (3,) and assessment.valley.hits == 2
    text = calibration_report.calibration_text(assessment)
    assert "Replicates in another valley: 2, 3 (2 in all)." in text
    assert "In another valley, but said to have converged: 2 (1 in all)." in text
    assert "a valley 3.5 above the truth's" in calibration_report.fit_line(fits[1])  # type: ignore[arg-type]


def test_only_the_intervals_of_thresholds_may_cover_more_than_they_promise(experiment_file):
    """Whose ends lie on plateaus of the cost: 95 % is what they promise at least."""
    fitted = calibrate_study(experiment_file, None, 1).fits[0]
    rows = [{**row, "interval": [row["low"], row["high"]]} for row in fitted["parameters"]]
    always: Any = {**fitted, "parameters": [{**rows[0], "kind": "threshold"}, rows[1]]}
    covered = assess(Calibration([always] * 400, [])).fit_coverage_of
    assert covered["pelvis.on_gain"].inside and not covered["foot.max_pitch"].inside


def calibrate_study(path: Path, folder: Path | None, count: int, **options) -> Calibration:
    experiment = load_experiment(path)
    with jax.enable_x64(True):
        problem = problems.make_problem(experiment)
        return calibration.calibrate(experiment, problem, folder, count, **options)


def test_recovery_counts_determined_parameters_within_5_percent_of_their_range(
    experiment_file, tmp_path
):
    made = calibrate_study(experiment_file, tmp_path / "out", 2)
    for i, (shift, determined) in enumerate([(0.06, True), (0.04, True)]):
        row = made.fits[i]["parameters"][0]
        width = row["high"] - row["low"]
        row |= {"value": made.fits[i]["truth"][0] + shift * width, "determined": determined}
        made.fits[i]["parameters"][1]["determined"] = False
    assessment = assess(made)
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


# Replicates and resuming


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


def test_a_cluster_makes_the_same_replicates(experiment_file, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    expected = calibrate(experiment_file, here, 2)
    reports: list[CalibrationProgress] = []
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(n_workers=1, processes=False, **options) as workers:
        address: str = workers.scheduler_address  # pyright: ignore[reportAttributeAccessIssue]
        assessment = calibrate(
            experiment_file, there, 2, scheduler=address, progress=reports.append
        )
    assert summarise(assessment) == summarise(expected)
    assert kept(there) == kept(here)
    assert {report.replicate for report in reports} == {1, 2}
    assert reports[-1].stage == "2 of 2 fits done" and reports[-1].remaining == 0.0


def test_an_interrupted_calibration_continues_bit_by_bit(experiment_file, tmp_path):
    whole, out = tmp_path / "whole", tmp_path / "out"
    expected = calibrate(experiment_file, whole, 3, chains=True)

    def stop_in(stage: str):
        def stop(report: CalibrationProgress) -> None:
            if report.replicate == 2 and report.stage.startswith(stage):
                raise KeyboardInterrupt

        return stop

    for stage, unfinished in (("polish", "fits/0001.json"), ("chain", "chains/0001.json")):
        with pytest.raises(KeyboardInterrupt):
            calibrate(experiment_file, out, 3, chains=True, progress=stop_in(stage))
        assert unfinished not in kept(out)
        assert unfinished.replace("1", "0") in kept(out)
    assessment = calibrate(experiment_file, out, 3, chains=True)
    assert kept(out) == kept(whole) and len(kept(out)) == 6
    for name in ("calibration.json", "summary.md"):
        assert (out / name).read_text() == (whole / name).read_text()
    assert assessment.fit_coverage == expected.fit_coverage


def test_finished_replicates_are_not_repeated_and_more_may_follow(experiment_file, tmp_path):
    new: list[str] = []
    observers = Observers(
        on_fit=lambda fitted: new.append(f"fit {fitted['number']}"),
        on_chain=lambda chain: new.append(f"chain {chain['number']}"),
    )
    out = tmp_path / "out"
    first = calibrate_study(experiment_file, out, 1, observers=observers)
    more = calibrate_study(experiment_file, out, 2, chains=True, observers=observers)
    assert new == ["fit 0", "fit 1", "chain 0", "chain 1"]
    assert more.fits[:1] == first.fits
    assert calibrate_study(experiment_file, out, 2, observers=observers) == Calibration(
        more.fits, []
    )
    assert len(new) == 4


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
def test_the_folder_of_another_calibration_is_refused(experiment_file, tmp_path, top, rest, words):
    out = tmp_path / "out"
    calibrate_study(experiment_file, out, 1)
    before = kept(out)
    other = write_half_second(tmp_path, top, rest)
    with pytest.raises(ValueError, match=words):
        calibrate_study(other, out, 1)
    assert kept(out) == before


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"number": 3}', '{"number": 0}', "[" * 10**5])
@pytest.mark.parametrize("name", ["identity.json", "fits/0000.json"])
def test_a_file_of_something_else_is_refused(experiment_file, tmp_path, name, text):
    out = tmp_path / "out"
    calibrate_study(experiment_file, out, 1)
    (out / name).write_text(text)
    with pytest.raises(ValueError, match=f"{name}: not written by `jaxik calibrate`"):
        calibrate_study(experiment_file, out, 1)
    assert (out / name).read_text() == text


def test_replicates_without_an_identity_are_refused(experiment_file, tmp_path):
    calibrate_study(experiment_file, tmp_path / "out", 1)
    (tmp_path / "out" / "identity.json").unlink()
    with pytest.raises(ValueError, match=r"out: has replicates but no identity.json"):
        calibrate_study(experiment_file, tmp_path / "out", 1)


def test_a_mistake_in_a_replicate_says_in_which(experiment_file, monkeypatch):
    def fail(*_: object) -> None:
        raise ValueError("too steep")

    monkeypatch.setattr(replicates, "simulate", fail)
    with pytest.raises(ValueError, match="replicate 1: too steep"):
        calibrate_study(experiment_file, None, 2)


# Report and command


def test_the_command_writes_a_report_and_ends_with_status_0(experiment_file, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["calibrate", str(experiment_file), "-n", "3", "--chains", "-o", str(out)]
    assert main.main(words) == 0
    printed = capsys.readouterr().out
    assert "3 truths of 2 parameters of record" in printed
    assert "replicate 3: the truth's valley, 2 of 2 starts agree" in printed
    assert "Calibrated: on 3 simulated motions everything is inside its bounds." in printed
    assert f"read {out / 'summary.md'}" in printed
    summary = (out / "summary.md").read_text()
    assert summary.startswith("# hill: calibration\n\nCalibrated: on 3 simulated motions")
    for picture in ("ranks.png", "recovery.png"):
        assert f"({picture})" in summary and (out / picture).stat().st_size > 10_000
    page = Page(out / run_folder.PAGE)
    assert "but 3 simulated motions prove little, as these bounds are wide" in page.text
    assert page.elements.count("img") == 2 and "h2 Ranks" in page.headings
    numbers = json.loads((out / "calibration.json").read_text())
    assert set(NUMBERS) <= numbers.keys() and numbers["experiment"] == "hill"
    assert numbers["inside"] is True and len(numbers["ranks"]["pelvis.on_gain"]["ranks"]) == 3
    assert set(numbers["chain_coverage"]) == {"0.5", "0.8", "0.95"}


def test_what_is_outside_is_named_and_ends_with_status_5(
    experiment_file, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(replicates, "simulate", simulation(shift=6.0))
    words = ["calibrate", str(experiment_file), "-n", "8", "-o", str(tmp_path / "out")]
    assert main.main(words) == 5
    printed = capsys.readouterr().out
    assert "Not calibrated: on 8 simulated motions, outside their bounds: the fit's 95 %" in printed
    assert "**no**, too few" in printed
    assert not (tmp_path / "out" / "ranks.png").exists(), "there are no chains"
    page = Page(tmp_path / "out" / run_folder.PAGE)
    assert "hill Not calibrated ◐ Of 8 simulated motions, outside their bounds: the" in page.text
    assert "No posterior was sampled" in page.text and "no, too few" in page.text


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


@pytest.mark.parametrize("factor", [0.0, -1.0])
def test_noise_that_is_not_positive_is_a_mistake(experiment_file, tmp_path, factor):
    with pytest.raises(ValueError, match=f"noise_factor is {factor:g}; wanted a positive number"):
        fitting.calibrate(experiment_file, tmp_path / "out", noise_factor=factor)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("count", [0, -2])
def test_fewer_than_one_replicate_is_a_mistake(experiment_file, tmp_path, count):
    with pytest.raises(ValueError, match=f"replicates is {count}; wanted 1 or more"):
        fitting.calibrate(experiment_file, tmp_path / "out", replicates=count)
    assert not (tmp_path / "out").exists()


def test_ctrl_c_ends_with_status_130_and_keeps_what_is_finished(
    experiment_file, tmp_path, monkeypatch
):
    make = calibration.fit_replicate

    def interrupted(problem, experiment, number, progress, **options):
        if number == 1:
            signal.raise_signal(signal.SIGINT)
        return make(problem, experiment, number, progress, **options)

    monkeypatch.setattr(calibration, "fit_replicate", interrupted)
    out = tmp_path / "out"
    assert main.main(["calibrate", str(experiment_file), "-n", "3", "-o", str(out)]) == 130
    assert kept(out).keys() == {"fits/0000.json"}


def test_the_picture_marks_ranks_that_leave_their_band(experiment_file):
    assessment = calibrate(experiment_file, None, 3, chains=True)
    wrong = dataclasses.replace(assessment.ranks["pelvis.on_gain"], ranks=np.zeros(40, int))
    ranks = {**assessment.ranks, "foot.max_pitch": wrong}
    figure = calibration_plots.ranks(ranks, "title")
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles[:6] == [
        "pelvis.on_gain", "", "foot.max_pitch", "outside its band", "log-probability", ""
    ]  # fmt: skip


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
