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
import numpy as np
import pytest
import scipy.stats
from distributed import LocalCluster

import fitting
from fitting.cli import main
from fitting.experiment import problems
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.inference.noise import noise_of
from fitting.inference.profiles.profile import make_profile
from fitting.problem.problem import Problem
from fitting.report import document, pages
from fitting.studies.calibrate import calibration, replicates
from fitting.studies.calibrate.calibration import (
    Assessment,
    Calibration,
    assess,
)
from support import small_studies
from support.experiments import ROOT
from support.pages import Page
from support.problems import compilations
from support.small_studies import SAMPLE, kept, write_calibration
from support.watching import listening

RANKED = ["pelvis.half_life", "foot.max_pitch", "log-probability"]
COUNT = 5  # of the replicates that all tests share


@pytest.fixture
def experiment_file(tmp_path, monkeypatch) -> Path:
    return small_studies.quick_calibration(tmp_path, monkeypatch)


@pytest.fixture
def experiment(experiment_file) -> Experiment:
    return load_experiment(experiment_file)


@pytest.fixture
def problem(experiment) -> Problem:
    with jax.enable_x64(True):
        return problems.make_problem(experiment)


def calibrate(path: Path, folder: Path | None, count: int, **options) -> Calibration:
    experiment = load_experiment(path)
    with jax.enable_x64(True):
        problem = problems.make_problem(experiment)
        return calibration.make_fits_and_chains(experiment, problem, folder, count, **options)


class Made(NamedTuple):
    """Replicates, and where they are."""

    folder: Path
    printed: str
    assessment: Assessment
    kept: Calibration


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Made:
    folder, lines = tmp_path_factory.mktemp("calibration"), []
    with pytest.MonkeyPatch.context() as patch, listening(lines.append):
        path, out = small_studies.quick_calibration(folder, patch), folder / "out"
        found = fitting.calibrate(path, out, replicates=COUNT, chains=True)
        return Made(out, "\n".join(lines), found, calibrate(path, out, COUNT, chains=True))


@pytest.fixture
def made(finished, tmp_path) -> Made:
    """The same, to be changed."""
    folder = Path(shutil.copytree(finished.folder, tmp_path / "out"))
    fits, chains = json.loads(json.dumps([finished.kept.fits, finished.kept.chains]))
    return finished._replace(folder=folder, kept=Calibration(fits, chains))


# What is judged


def test_a_right_program_is_inside_all_bounds(finished):
    assessment = finished.assessment
    assert assessment.inside and assessment.outside == []
    assert assessment.fit_coverage.total == 2 * COUNT and assessment.fit_coverage.fraction > 0.85
    assert list(assessment.profile_coverage) == [0.5, 0.8]
    assert list(assessment.ranks) == RANKED
    assert {len(test.ranks) for test in assessment.ranks.values()} == {COUNT}
    assert assessment.minimum.hits == COUNT and assessment.wrong == ()
    assert list(assessment.chain_coverage) == [0.5, 0.8, 0.95]


def test_wrong_profiles_and_a_wrong_posterior_are_named(made):
    fits: list[Any] = made.kept.fits
    chains: list[Any] = made.kept.chains
    for fitted, chain in zip(fits, chains, strict=True):
        fitted["truth_levels"] = [0.99, 0.99]
        chain |= {
            "ranks": dict.fromkeys(RANKED, 0),
            "intervals": dict.fromkeys(RANKED[:2], [[-2.0, -1.0]] * 3),
        }
    assert assess(Calibration(fits, chains)).outside == [
        *(f"the {level} % intervals of profiles" for level in (50, 80)),
        *(f"the posterior's {level} % intervals" for level in (50, 80, 95)),
        *(f"the ranks of {name}" for name in RANKED),
    ]


def test_a_wrong_minimum_is_counted_whether_or_not_the_fit_says_so(made, experiment):
    fits: list[Any] = made.kept.fits[:4]
    fits[1]["cost"] += 3.5
    fits[2] |= {"cost": fits[2]["cost"] + 90.0, "converged": False}
    fits[3]["cost"] += 2.5
    changed = Calibration(fits, [])
    assessment = assess(changed)
    assert (assessment.wrong, assessment.wrong_but_converged) == ((2, 3), (2,))
    assert assessment.unconverged == (3,) and assessment.minimum.hits == 2
    text = document.text(calibration.document(experiment, changed, assessment))
    assert "Replicates in another minimum: 2, 3 (2 in all)." in text
    assert "In another minimum, but said to have converged: 2 (1 in all)." in text
    assert "a minimum 3.5 above the truth's" in replicates.fit_line(fits[1])


def test_costs_of_minima_are_compared_without_the_weight_of_residuals(experiment_file):
    path = write_calibration(experiment_file.parent, "independent_every = 0.5")
    (fitted,) = calibrate(path, None, 1).fits
    assert fitted["cost"] == pytest.approx(fitted["truth_valley_cost"], abs=1e-3)
    assert fitted["cost"] > 0.1


def test_only_the_intervals_of_thresholds_may_cover_more_than_they_promise(made):
    """Whose ends lie on plateaus of the cost: 95 % is what they promise at least."""
    fitted = made.kept.fits[0]
    rows = [{**row, "interval": [row["low"], row["high"]]} for row in fitted["parameters"]]
    always: Any = {**fitted, "parameters": [{**rows[0], "kind": "threshold"}, rows[1]]}
    covered = assess(Calibration([always] * 400, [])).fit_coverage_of
    assert covered["pelvis.half_life"].inside and not covered["foot.max_pitch"].inside


def test_recovery_counts_determined_parameters_within_5_percent_of_their_range(made):
    fits = made.kept.fits[:2]
    for fitted, shift in zip(fits, (0.06, 0.04), strict=True):
        first, second = fitted["parameters"]
        value = fitted["truth"][0] + shift * (first["high"] - first["low"])
        first |= {"value": value, "determined": True}
        second["determined"] = False
    assessment = assess(Calibration(fits, []))
    assert (assessment.recovery.hits, assessment.recovery.total) == (1, 2)
    assert assessment.recovery_of["foot.max_pitch"].total == 0
    assert "0 of 0" in str(calibration.parameter_table(assessment))


def test_ranks_are_uniform_however_many_draws_a_chain_has():
    for count in (30, 99, 400):
        random = np.random.default_rng(6)
        normal = random.normal(size=(3000, count + 1, 1))
        ranks = [replicates.rank(row[0], row[1:], random)[0] for row in normal]
        assert 0 <= min(ranks) and max(ranks) <= replicates.DRAWS
        deciles = np.histogram(ranks, 10, range=(0, 100))[0]
        np.testing.assert_allclose(deciles, 300, atol=80, err_msg=str(count))


def test_the_level_at_a_truth_is_that_of_a_parabola_between_points(problem):
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


def test_truths_come_from_the_prior_and_differ(experiment, problem):
    truths = [replicates.draw_truth(problem, experiment, i) for i in range(400)]
    other = dataclasses.replace(experiment, seed=1)
    assert (replicates.draw_truth(problem, other, 0).u != truths[0].u).all()
    probability = problem.space.prior.cumulative(np.stack([truth.u for truth in truths]))
    np.testing.assert_allclose(np.mean(probability, axis=0), 0.5, atol=0.06)
    np.testing.assert_allclose(np.var(probability, axis=0), 1 / 12, atol=0.012)
    assert len({truth.noise_seed for truth in truths} | {t.seed for t in truths}) == 800


def test_noise_that_is_not_as_assumed_is_simulated_and_assumed_no_more(
    experiment, problem, monkeypatch
):
    truth, simulated = replicates.draw_truth(problem, experiment, 0), []

    def simulate(noisy: Problem, u: np.ndarray, seed: int) -> Problem:
        simulated.append((noise_of(noisy).sigmas, u, seed))
        return noisy

    monkeypatch.setattr(replicates, "simulate", simulate)
    assumed = noise_of(problem)
    for factor in (1.0, 2.0):
        assert noise_of(replicates._simulated(problem, truth, factor)) == assumed
        sigmas = {kind: factor * sigma for kind, sigma in assumed.sigmas.items()}
        assert simulated[-1] == (sigmas, truth.u, truth.noise_seed)


def test_a_cluster_makes_the_same_replicates(made, experiment_file, tmp_path):
    there = tmp_path / "there"
    reports: list[Any] = []
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(n_workers=1, processes=False, **options) as workers:
        address: str = workers.scheduler_address  # pyright: ignore[reportAttributeAccessIssue]
        with listening(reported=reports.append):
            assessment = fitting.calibrate(experiment_file, there, replicates=2, scheduler=address)
    assert assessment.summary == assess(Calibration(made.kept.fits[:2], [])).summary
    here = kept(made.folder)
    assert all(here[name] == fit for name, fit in kept(there).items() if name.startswith("fits/"))
    assert {report["number"] for report in reports} == {0, 1}


def test_finished_replicates_are_not_repeated_and_new_ones_share_their_programs(
    made, experiment_file
):
    for name in ("fits/0003", "fits/0004", "chains/0002", "chains/0003", "chains/0004"):
        (made.folder / f"{name}.json").unlink()
    programs: dict[str, int] = {}  # compiled until a replicate was made
    with compilations() as compiled:

        def note(result) -> None:
            if isinstance(result, dict):
                kind = "chain" if "draws" in result else "fit"
                programs[f"{kind} {result['number']}"] = len(compiled)

        with listening(reported=note):
            first = calibrate(experiment_file, made.folder, 3)
            assert not programs and first == Calibration(made.kept.fits[:3], [])
            calibrate(experiment_file, made.folder, COUNT, chains=True)
    assert list(programs) == ["fit 3", "fit 4", "chain 2", "chain 3", "chain 4"]
    assert programs["fit 3"] == programs["fit 4"]
    assert programs["chain 2"] == programs["chain 4"]


def test_the_folder_of_another_calibration_or_an_unknown_one_is_refused(
    made, experiment_file, tmp_path
):
    before = kept(made.folder)
    for top, rest, words in (
        ("seed = 1", SAMPLE, "differs from .* in: seed; name another folder"),
        ("fps = 20.0", SAMPLE, "in: problem; name"),
        ("", SAMPLE.replace("120", "130"), "in: sample; name"),
        ("", SAMPLE + "[fit]\nstarts = 3\n", "in: fit; name"),
        ("", SAMPLE + "[start]\npelvis.half_life = 0.5\n", "in: start; name"),
    ):
        with pytest.raises(ValueError, match=words):
            calibrate(write_calibration(tmp_path, top, rest), made.folder, 1)
        assert kept(made.folder) == before
    (made.folder / "identity.json").unlink()
    with pytest.raises(ValueError, match=r"out: has replicates but no identity.json"):
        calibrate(write_calibration(tmp_path), made.folder, 1)


def test_a_mistake_in_a_replicate_says_in_which(experiment_file, monkeypatch):
    def fail(*_: object) -> None:
        raise ValueError("too steep")

    monkeypatch.setattr(replicates, "simulate", fail)
    with pytest.raises(ValueError, match="replicate 1: too steep"):
        calibrate(experiment_file, None, 2)


# Report and command


def test_the_folder_has_a_report(finished):
    out, printed = finished.folder, finished.printed
    assert f"{COUNT} truths of 2 parameters of record" in printed
    assert "replicate 3: the truth's minimum, 2 of 2 starts agree" in printed
    everything = f"Everything is inside its bounds, but {COUNT} simulated motions prove little"
    assert everything in printed and f"read {out / 'summary.md'}" in printed
    summary = (out / "summary.md").read_text()
    kind = "Fits of simulated motion whose truth is known"
    assert summary.startswith(f"# hill\n\n{kind}: **Calibrated**.\n\n- {everything}")
    for picture in ("ranks.png", "recovery.png"):
        assert f"({picture})" in summary and (out / picture).stat().st_size > 10_000
    page = Page(out / pages.PAGE)
    assert f"but {COUNT} simulated motions prove little, as these bounds are wide" in page.text
    assert page.elements.count("img") == 2 and "h2 Ranks" in page.headings
    numbers = json.loads((out / "calibration.json").read_text())
    judged = {"replicates", "level", "inside", "outside", "fit_coverage", "ranks"}
    assert judged <= numbers.keys() and numbers["experiment"] == "hill"
    assert numbers["inside"] is True and len(numbers["ranks"]["pelvis.half_life"]["ranks"]) == COUNT
    assert set(numbers["chain_coverage"]) == {"0.5", "0.8", "0.95"}


def test_what_is_outside_is_named_and_ends_with_status_5(tmp_path, monkeypatch, capsys, undrawn):
    path = small_studies.quick_calibration(tmp_path, monkeypatch, shift=6.0)
    out = tmp_path / "out"
    assert main.main(["calibrate", str(path), "-n", "5", "-o", str(out)]) == 5
    printed = capsys.readouterr().out
    assert "\nNot calibrated.\n\n- Of 5 simulated motions, outside their bounds: the" in printed
    assert "**no**, too few" in printed
    assert not (out / "ranks.png").exists(), "there are no chains"
    page = Page(out / pages.PAGE)
    assert "hill Not calibrated ◐ Of 5 simulated motions, outside their bounds: the" in page.text
    assert "No posterior was sampled" in page.text and "no, too few" in page.text


def test_the_picture_marks_ranks_that_leave_their_band(finished):
    ranks = finished.assessment.ranks
    wrong = dataclasses.replace(ranks["pelvis.half_life"], ranks=np.zeros(40, int))
    figure = calibration.ranks({**ranks, "foot.max_pitch": wrong}, "title")
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles[:6] == [
        "pelvis.half_life", "", "foot.max_pitch", "outside its band", "log-probability", ""
    ]  # fmt: skip


@pytest.mark.slow
def test_ozz_is_calibrated(tmp_path):
    """The whole path, through the pipeline and as users run it, with a fixed seed.

    Of 8 motions, intervals of one of the seven parameters held 3 truths by chance.
    """
    experiment = ROOT / "data" / "experiments" / "calibration" / "ozz.toml"
    out = tmp_path / "out"
    command = ["calibrate", str(experiment), "-n", "60", "-o", str(out)]
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
    assert numbers["fit_coverage"]["hits"] >= 378 and numbers["fit_coverage"]["total"] == 420
    assert numbers["recovery"]["hits"] == numbers["recovery"]["total"] >= 360


@pytest.mark.slow
def test_numbers_of_a_capture_come_back_within_their_intervals():
    """Of 50 motions, with a ground, a time and ankles that are off by draws from the priors."""
    path = ROOT / "data" / "experiments" / "calibration" / "capture.toml"
    assessment = fitting.calibrate(path, replicates=50)
    assert assessment.outside == []
    recovered = {n: r.hits for n, r in assessment.recovery_of.items() if n.startswith("capture.")}
    assert recovered == {
        "capture.ground_height": 50,
        "capture.time_shift": 50,
        "capture.ankle_up": 50,
    }
