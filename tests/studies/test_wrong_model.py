"""Calibration under a wrong model: errors of captures, truths, what is judged, the command."""

import dataclasses
import json
import math
import shutil
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import fitting
import jaxik
from fitting.cli import main
from fitting.clips import contacts
from fitting.experiment import problems
from fitting.experiment.experiment_files import load_experiment
from fitting.inference import sensitivity
from fitting.motion.goodness import CLOSE
from fitting.problem.space import present_value
from fitting.report import document, pages
from fitting.studies.calibrate import wrong_model
from fitting.studies.calibrate.wrong_model import (
    LARGEST,
    SPREAD,
    ErrorSizes,
    assess,
    draw_system,
    is_true,
)
from support import small_studies
from support.experiments import CLIP, ROOT, write
from support.pages import Page

NONE = ErrorSizes(*np.zeros(6))
TIME = np.arange(600) / 60
SMALL = {"ankle": 0.01, "knee": 0.015, "pelvis": 0.01, "foot": 0.05}  # half of what looks the same


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    path = write(tmp_path_factory.mktemp("errors"), clips=CLIP + "end = 6.0\n")
    with jax.enable_x64(True):
        return problems.make_problem(load_experiment(path))


class Changes(NamedTuple):
    """What errors do to a reference."""

    pelvis: np.ndarray
    """m, (frames, 3)."""
    knee: np.ndarray
    """m, (frames, legs, 3), like ankle."""
    ankle: np.ndarray
    turn: np.ndarray
    """rad, (frames, 3), of the pelvis about its own axes."""
    seen: np.ndarray
    """(frames)."""


def changes(problem, mask_pops=False, seed=0, **sizes: float) -> Changes:
    random = np.random.default_rng(seed)
    with jax.enable_x64(True):
        sizes_of_errors = dataclasses.replace(NONE, **sizes)
        captured = wrong_model.with_errors(problem, sizes_of_errors, [mask_pops], random)
    before, after = (jax.tree.map(np.asarray, p.data[0].reference) for p in (problem, captured))
    return Changes(
        after.pelvis.pos - before.pelvis.pos,
        after.knee_ws - before.knee_ws,
        after.ankle.pos - before.ankle.pos,
        (heading(before).inv() * heading(after)).as_rotvec(),
        after.observed | after.held_out,
    )


def heading(reference) -> Rotation:
    return Rotation.from_quat(np.asarray(reference.pelvis.rot), scalar_first=True)


# Errors


def test_the_floor_drifts_slowly_and_everything_with_it(problem):
    pelvis, knee, ankle, turn, _ = changes(problem, drift=0.01)
    height = pelvis[:, 1]
    np.testing.assert_allclose(pelvis, height[:, None] * [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(knee, np.broadcast_to(pelvis[:, None], knee.shape), atol=1e-12)
    np.testing.assert_allclose(ankle, knee, atol=1e-12)
    assert 0.001 < np.ptp(height) <= 0.02 and not turn.any()
    fastest = 0.01 * 2 * math.pi / wrong_model.DRIFT_PERIODS[0]  # m/s
    dt = np.asarray(problem.data[0].frames.dt)
    assert np.abs(np.diff(height) / dt[1:]).max() < fastest


def test_offsets_are_constant_in_the_pelvis_and_turns_constant(problem):
    everything = []
    for seed in range(40):
        pelvis, knee, ankle, turn, _ = changes(problem, seed=seed, offset=0.01, turn=0.03)
        for shift in (pelvis, *knee.transpose(1, 0, 2), *ankle.transpose(1, 0, 2)):
            own = heading(problem.data[0].reference).inv().apply(shift)
            np.testing.assert_allclose(own, np.broadcast_to(own[0], own.shape), atol=1e-9)
            everything.append(own[0] / 0.01)
        np.testing.assert_allclose(turn, np.broadcast_to(turn[0], turn.shape), atol=1e-9)
        everything.append(turn[0] / 0.03)
    assert np.std(everything) == pytest.approx(1.0, abs=0.1)


def test_a_swing_leaves_its_path_smoothly_and_a_standing_foot_stays(problem):
    pelvis, knee, ankle, turn, _ = changes(problem, swing=0.03)
    moving = np.asarray(problem.data[0].frames.foot_speed) > wrong_model.SWING_SPEED
    size = np.linalg.norm(ankle, axis=-1)
    assert not size[~moving].any() and not pelvis.any() and not turn.any()
    np.testing.assert_allclose(knee, 0.5 * ankle, atol=1e-12)
    swings = [run for leg in moving.T for run in contacts.runs(leg)]
    longest = max(last - first + 1 for first, last in swings)
    assert size.max() == pytest.approx(0.03, rel=0.02) and longest > 10
    steepest = 0.03 * math.pi / longest  # of the longest swing; others are cut off by the clip
    assert np.median(np.abs(np.diff(size, axis=0))[moving[1:]]) < steepest


def test_markers_jump_for_a_few_frames_which_a_fit_leaves_out(problem):
    shape = (len(TIME), 5, 3)
    jumps = [
        wrong_model.marker_jumps(shape, TIME, 0.1, np.random.default_rng(seed))
        for seed in range(200)
    ]
    size = np.linalg.norm(jumps, axis=-1)
    np.testing.assert_allclose(size[size > 0], 0.1)
    runs = [contacts.runs(joint > 0) for replicate in size for joint in replicate.T]
    lengths = [last - first + 1 for each in runs for first, last in each]
    assert len(lengths) / 200 == pytest.approx(TIME[-1] / wrong_model.JUMP_EVERY, rel=0.1)
    assert set(lengths) >= {1, 2, 3, 4} and np.mean(lengths) == pytest.approx(2.5, abs=0.2)
    whole, masked = (changes(problem, mask, seed=3, jump=1.0).seen for mask in (False, True))
    assert whole.all() and 0 < (~masked).sum() < 60


def test_sizes_are_drawn_between_none_and_the_largest():
    random = np.random.default_rng(0)
    drawn = np.array([dataclasses.astuple(wrong_model.draw_sizes(random, 2.0)) for _ in range(999)])
    fractions = drawn / (2 * np.array(dataclasses.astuple(LARGEST)))
    np.testing.assert_allclose(fractions.mean(axis=0), 0.5, atol=0.04)
    assert fractions.min() >= 0 and fractions.max() <= 1


# Truths


def test_truths_lie_around_the_system_and_what_is_off_stays_off():
    with jax.enable_x64(True):
        ik = jaxik.presets.ozz()
        drawn = [draw_system(ik, None, np.random.default_rng(seed)) for seed in range(50)]
    names = list(sensitivity.all_parameters(ik))
    before = np.array([present_value(ik, name) for name in names])
    values = np.array([[values[name] for name in names] for _, values in drawn])
    vectors = [i for i, name in enumerate(names) if "[" in name]
    np.testing.assert_allclose(
        values[:, vectors], np.broadcast_to(before[vectors], (50, len(vectors)))
    )
    still = (before == 0) | np.isclose(values, before, rtol=1e-3, atol=1e-4).all(axis=0)
    assert (values[:, before == 0] == 0).all()
    kept = {name for name, unmoved in zip(names, still, strict=True) if unmoved}
    assert {"leg.weight", "leg.twist", "foot.weight"} <= kept
    assert not kept & {"target.foot_height", "probe.ray_down", "pelvis.limit"}
    np.testing.assert_allclose(
        [present_value(drawn[0][0], name) for name in names], values[0], rtol=1e-6
    )
    height = values[:, names.index("target.foot_height")] / 0.2  # of its range
    u = np.log(height / (1 - height))
    assert np.std(u) == pytest.approx(SPREAD, rel=0.3)


# What is judged


def motions(animation=4.0, before=2.0, fitted=1.0) -> dict[str, dict[str, float]]:
    """Distances of three motions on some frames, in units of `SMALL`."""
    sizes = {"animation": animation, "before": before, "fitted": fitted}
    return {motion: {kind: size * SMALL[kind] for kind in SMALL} for motion, size in sizes.items()}


def judgement(fits: bool = True, held_out: Any = None) -> dict[str, Any]:
    distances = {"fitted": motions(), "held_out": motions() if held_out is None else held_out}
    return {"fits": fits, "sentence": "Said.", "distances": distances}


def replicate(
    captured: Any = None, noise_free: Any = None, lasting: Any = None, **changed: Any
) -> Any:
    """A fit that fits and says so, but for what is given."""
    row = {"name": "target.foot_height", "interval": [0.07, 0.1]}
    return {
        **{"number": 0, "converged": True, "seconds": 1.0, "parameters": [row]},
        **{"truth_values": {"target.foot_height": 0.08, "leg.soften": 0.9}, "errors": {}},
        "captured": captured or judgement(),
        "lasting": lasting or noise_free or judgement(),
        "noise_free": noise_free or judgement(),
        **changed,
    }


FAR = judgement(False, motions(before=3.0, fitted=2.5))
NEAR_FAR = judgement(False, motions(before=3.0, fitted=2.05))
WORSE = judgement(False, motions(before=1.0, fitted=1.5))


@pytest.mark.parametrize(
    ("captured", "noise_free", "word", "true"),
    [
        (judgement(), judgement(), "fits", True),
        (judgement(), NEAR_FAR, "fits", True),
        (judgement(), FAR, "fits", False),
        (judgement(), WORSE, "fits", False),
        (FAR, FAR, "does not fit", True),
        (FAR, judgement(True, motions(fitted=1.95)), "does not fit", True),
        (FAR, judgement(), "does not fit", False),
        (judgement(False), NEAR_FAR, "does not fit", True),
        (WORSE, judgement(True, motions(before=1.0, fitted=1.01)), "worse", True),
        (WORSE, judgement(True, motions(before=1.0, fitted=0.99)), "worse", False),
    ],
)
def test_a_verdict_is_true_unless_the_motion_without_errors_says_otherwise(
    captured, noise_free, word, true
):
    fit = replicate(captured, noise_free)
    if word == "does not fit":  # which is not about the motion without errors
        fit = replicate(captured, FAR if not true else judgement(), noise_free)
    assert wrong_model.word(captured) == word
    assert is_true(fit) is true
    assert (", which is not true" in wrong_model.fit_line(fit)) is not true


def test_a_selected_system_that_is_worse_than_the_animation_is_outside():
    worse = judgement(False, motions(animation=1.0, before=2.0, fitted=1.3))
    assessment = assess([replicate(), replicate(worse, worse), replicate()])
    assert assessment.outside == ["the selected system against the animation"]
    assert assessment.worse == (2,) and assessment.false == ()
    assert assessment.fitted_no_worse.hits == assessment.kept_no_worse_noise_free.hits == 2
    near = judgement(False, motions(animation=1.0, before=2.0, fitted=1.14))  # 1.7 mm rms
    feet = judgement(False, motions(animation=1.0, fitted=1.0))
    feet["distances"]["held_out"]["fitted"]["foot"] *= 1.4  # 1.15 degrees
    assessment = assess([replicate(near, near), replicate(feet, feet)])
    assert assessment.inside and assessment.kept_no_worse_anywhere.hits == 0
    saved = judgement(False, motions(animation=1.0, before=1.0, fitted=1.3))
    saved["distances"]["fitted"] = saved["distances"]["held_out"]
    assessment = assess([replicate(saved, saved)])
    assert assessment.inside and assessment.fitted_no_worse.hits == 0
    assert assessment.medians["kept"] == assessment.medians["before"]


def test_false_verdicts_are_outside_and_shown(tmp_path):
    fits = [replicate(judgement(), FAR)] * 3 + [replicate()]
    assessment = assess(fits)
    assert assessment.outside == ["the share of true verdicts"] and assessment.false == (1, 2, 3)
    assert (assessment.verdicts_of["fits"].hits, assessment.verdicts_of["fits"].total) == (1, 4)
    experiment = load_experiment(write(tmp_path))
    text = document.text(wrong_model.document(experiment, "mec", fits, assessment))
    assert "outside their bounds: the share of true verdicts" in text
    assert 'Replicate 1 says: "Said." Without errors: ankles 1.0 cm, knees 1.5 cm' in text
    assert "ankles 2.5 cm, knees 3.8 cm" in text


def test_intervals_of_shared_parameters_are_counted_and_not_judged():
    missed = {"target.foot_height": 0.12}
    assessment = assess([replicate(), replicate(truth_values=missed)])
    assert set(assessment.coverage_of) == {"target.foot_height"}
    assert assessment.coverage_of["target.foot_height"].hits == 1 and assessment.inside


def test_small_distances_are_half_of_what_looks_the_same():
    assert {kind: 2 * size for kind, size in SMALL.items()} == CLOSE


# The command


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Two replicates of a walk at 10 Hz, made by `ozz`; fits take no time."""
    folder = tmp_path_factory.mktemp("wrong_model")
    path = write(folder, top="fps = 10.0", clips=CLIP + "end = 3.1\n")
    with pytest.MonkeyPatch.context() as patch:
        small_studies.quick_fits(patch)
        status = main.main(
            ["calibrate", str(path), "--truth", "record", "-n", "2", "-o", f"{folder}/out"]
        )
    return path, folder / "out", status


def test_the_command_reports_what_it_found(finished):
    _, out, status = finished
    numbers = json.loads((out / "calibration.json").read_text())
    assert status == (0 if numbers["inside"] else 5) and numbers["replicates"] == 2
    kept = [json.loads((out / f"wrong_model/000{n}.json").read_text()) for n in range(2)]
    assert kept[0]["truth_values"] != kept[1]["truth_values"]
    assert set(kept[0]["errors"]) == set(dataclasses.asdict(LARGEST))
    for fit in kept:
        captured, lasting, noise_free = (
            fit[key]["distances"]["held_out"] for key in ("captured", "lasting", "noise_free")
        )
        assert captured != lasting != noise_free and captured["animation"]["ankle"] > 0.01
    summary = (out / "summary.md").read_text()
    assert "drawn around `record`" in summary and "| true verdicts | " in summary
    page = Page(out / pages.PAGE)
    assert "h2 Checks" in page.headings and "Made by record" in page.text
    assert "So few motions prove little: the share of true verdicts may be" in page.text


def test_finished_replicates_are_kept_and_another_truth_is_refused(
    finished, tmp_path, monkeypatch, capsys
):
    path, out, status = finished
    copy = shutil.copytree(out, tmp_path / "out")
    words = ["calibrate", str(path), "-n", "2", "-o", str(copy), "--truth"]
    small_studies.quick_fits(monkeypatch)
    assert main.main([*words, "record"]) == status
    for text, others in (
        ("truth", ["mec"]),
        ("noise_factor", ["record", "--noise-factor", "2"]),
    ):
        assert main.main([*words, *others]) == 2
        assert "in: " in (error := capsys.readouterr().err) and text.split()[-1] in error


@pytest.mark.parametrize(
    ("top", "words", "message"),
    [
        ("", ["--truth", "ozy"], "truth takes a preset or a parameter .toml"),
        ("", ["--truth", "ozz", "--chains"], "leave --chains or --truth out"),
        ("holdout = 0.0", ["--truth", "ozz"], "no frame is held out"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, capsys, top, words, message):
    path = write(tmp_path, top=f"fps = 10.0\n{top}", clips=CLIP + "end = 3.1\n")
    assert main.main(["calibrate", str(path), *words, "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert message in error


@pytest.mark.slow
def test_fits_of_ozz_to_mec_are_worth_keeping_and_say_what_they_are(tmp_path):
    """The whole path, with a fixed seed."""
    assessment = fitting.calibrate_wrong_model(
        ROOT / "data/experiments/calibration/ozz_wrong_model.toml", "mec", tmp_path, replicates=4
    )
    assert assessment.inside and assessment.kept_no_worse.hits == assessment.verdicts.hits == 4
