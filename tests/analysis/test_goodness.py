"""Goodness of fit on playbacks whose errors are known: noise, misfits, the worst window."""

import dataclasses
import re
from typing import Any

import jax
import numpy as np
import pytest
from scipy import stats

from fitting.motion import goodness
from fitting.motion.goodness import MEDIAN, Assumed, Verdict, measure_groups
from fitting.motion.playback import RESIDUAL_KINDS, Playback
from fitting.motion.worst_window import find_worst_window
from fitting.problem.scene import PER_LEG, Sigmas
from fitting.problem.simulation import autoregression
from support.playbacks import FPS, FRAMES, SHAPES, SIGMAS, error, playback

KINDS = ("ankle", "knee", "pelvis")
FINE = {kind: 0.1 * SIGMAS[kind] for kind in KINDS}  # with noise too small to be seen
SEEDS = 20  # each violation must be found in all of them
RHO = 0.95
ASSUMED = {"correlation": RHO}
WHITENED = r"even where the estimate is taken out.*set `correlation = \"counted\"` in \[noise\]"


def simulate(seed: int, *, rho: float = 0.0, scale: float = 1.0, outliers: float = 0.0) -> Playback:
    """A playback of noise, `scale` times as large as its sigmas."""
    random = np.random.default_rng(seed)
    errors = {}
    for kind in KINDS:
        values = scale * autoregression(random.normal(size=(FRAMES, *SHAPES[kind])), rho)
        values += 10 * random.normal(size=values.shape) * (random.random(values.shape) < outliers)
        errors[kind] = FINE[kind] * values
    return playback(errors, FINE)


def whiten(play: Playback, rho: float) -> Playback:
    """The playback as a fit sees it to which this correlation was given."""
    residuals = {}
    for kind in KINDS:
        values = play.residuals[kind]
        innovations = (values[1:] - rho * values[:-1]) / np.sqrt(1 - rho**2)
        residuals[kind] = np.concatenate([values[:1], innovations])
    return dataclasses.replace(play, residuals={**play.residuals, **residuals})


def judge(play: Playback, correlation: float = 0.0, **assumed) -> Verdict:
    assumptions = Assumed(**assumed)
    given: list[dict[str, float]] = [dict.fromkeys(KINDS, correlation)]
    groups = measure_groups([whiten(play, correlation)], given, assumptions)
    return goodness.judge(groups, assumptions, goodness.measure_distances([play], [play]))


# The verdict on simulated noise


@pytest.mark.parametrize(
    ("made", "given"),
    [
        ({}, {}),
        ({"rho": RHO}, {"correlation": RHO}),
        ({"rho": RHO}, {"weight": (1 - RHO) / (1 + RHO)}),
        ({"outliers": 0.03}, {"loss": "cauchy"}),
    ],
)
def test_noise_as_assumed_fits(made, given):
    verdicts = [judge(simulate(seed, **made), **given) for seed in range(100)]
    assert sum(verdict.sentence.startswith("Fits: ") for verdict in verdicts) >= 97
    assert all(verdict.fits for verdict in verdicts)


def test_a_robust_loss_finds_noise_that_is_in_one_axis_only():
    """As under an animation that has the captured paths seen from above."""
    random = np.random.default_rng(0)
    errors = {kind: np.zeros((FRAMES, *SHAPES[kind])) for kind in KINDS}
    for kind in KINDS:
        shape = errors[kind][..., 1].shape
        errors[kind][..., 1] = np.sqrt(3) * SIGMAS[kind] * random.normal(size=shape)
        errors[kind][..., 0] = 1e-15 * random.normal(size=shape)
    play = playback(errors)
    for loss in ("squares", "cauchy", "student"):
        found = measure_groups([play], [{}], Assumed(loss=loss))
        for group in found:
            expected = MEDIAN / Assumed(loss=loss).median if loss == "student" else 1.0
            assert group.plain.scale == pytest.approx(expected, rel=0.12), (loss, group.kind)
            assert not group.has_outliers


@pytest.mark.parametrize(
    ("made", "given", "said", "not_said"),
    [
        ({"scale": 1 / 3}, {}, "noise is about 0.3.*too wide", "correlated"),
        ({"scale": 0.5}, {}, "noise is about 0..*too wide", "correlated"),
        ({"scale": 2.0}, {}, "noise is about .*too narrow", "correlated"),
        ({"scale": 3.0}, {}, "noise is about .*too narrow", "correlated"),
        ({"rho": RHO}, {}, r"correlated \(0.9.*too narrow; set `correlation = 0.9", "the noise"),
        ({}, ASSUMED, r"frame to the next, not by 0.95\): the intervals.*too wide", "noise"),
        ({"outliers": 0.03}, {}, 'outliers.*set `loss = "cauchy"`', "the noise"),
        ({}, ASSUMED | {"whitened": True}, WHITENED, "too narrow"),
        ({"outliers": 0.03}, {"sigmas_estimated": True}, 'set `loss = "student"`', "cauchy"),
    ],
)
def test_what_is_otherwise_than_assumed_is_named(made, given, said, not_said):
    for seed in range(SEEDS):
        found = judge(simulate(seed, **made), **given)
        assert re.search(f"^Fits, but .*{said}", found.sentence), found.sentence
        assert not_said not in found.sentence and found.fits, found.sentence
        if percent := re.search(r"(\S+) % of the residuals", found.sentence):
            assert 1.5 < float(percent[1]) < 4.5


def with_bump(play: Playback, kind: str, size: float, frames: slice) -> Playback:
    """A playback with a smooth misfit of so many sigmas, rms in these frames."""
    errors, sigma = np.array(play.errors[kind]), play.sigmas[kind]
    arch = np.sin(np.linspace(0, np.pi, frames.stop - frames.start)) * np.sqrt(2)
    errors[frames] += sigma * size * arch.reshape(-1, *[1] * (errors.ndim - 1))
    return dataclasses.replace(
        play,
        errors={**play.errors, kind: errors},
        residuals={**play.residuals, kind: errors / sigma},
    )


def test_a_misfit_is_named_with_its_kind_size_and_time_unless_it_is_small():
    for seed in range(SEEDS):
        noise = simulate(seed)
        found = judge(with_bump(noise, "knee", 3.0, slice(190, 250)))
        start, end = (float(time) for time in re.findall(r"(\d+\.\d) s", found.sentence))
        assert not found.fits
        assert "knees 1." in found.sentence and "worse than their sigma" in found.sentence
        assert abs(start - 190 / FPS) < 0.3 and abs(end - 250 / FPS) < 0.3, found.sentence
        whole = judge(with_bump(noise, "ankle", 2.0, slice(0, FRAMES)))
        assert whole.sentence.startswith("Does not fit: ankles 2."), whole.sentence
    # Five per cent more than the noise: significant in ten thousand residuals, but small.
    assert judge(with_bump(simulate(0), "ankle", 0.32, slice(0, FRAMES))).fits


def test_only_tolerances_count_without_noise():
    def tolerated(play: Playback) -> Verdict:
        return goodness.judge_tolerances(measure_groups([play], [{}], Assumed()))

    assert tolerated(playback()).fits
    assert tolerated(with_bump(playback(), "ankle", 0.9, slice(0, FRAMES))).fits
    found = tolerated(with_bump(playback(), "ankle", 4.0, slice(100, 160)))
    assert not found.fits and "ankles" in found.sentence and "tolerance" in found.sentence


# The numbers


@pytest.mark.slow
def test_p_values_are_uniform_where_the_noise_is_as_assumed():
    for rho, given in ((0.0, 0.0), (RHO, RHO), (RHO, 0.0)):
        plays = [whiten(simulate(seed, rho=rho), given) for seed in range(150)]
        correlations: list[dict[str, float]] = [dict.fromkeys(KINDS, given)]
        left = [g.left for play in plays for g in measure_groups([play], correlations, Assumed())]
        assert stats.kstest([noise.p for noise in left], "uniform").pvalue > 1e-3, (rho, given)
        if rho == given:
            p = [noise.autocorrelation_p for noise in left]
            assert stats.kstest(p, "uniform").pvalue > 1e-3


# The worst two seconds


def test_the_worst_window_knows_every_kind_of_residual():
    sigmas = {field.name for field in dataclasses.fields(Sigmas)} - {"correlation"}
    assert set(SHAPES) == set(RESIDUAL_KINDS) == sigmas
    assert set(PER_LEG) == set(RESIDUAL_KINDS) - {"pelvis", "body"}
    window = find_worst_window(playback())  # of a perfect fit
    assert window.rms == 0.0 and window.size == 0.0 and window.leg_fractions.sum() == 0.0


def test_the_window_is_the_two_seconds_with_the_largest_residuals():
    errors = error("pelvis", slice(150, 200), 0.0, -0.06, 0.0)["pelvis"]
    errors += error("pelvis", slice(20, 80), 0.0, -0.02, 0.0)["pelvis"]
    window = find_worst_window(playback({"pelvis": errors}))
    assert window.end - window.start == 60 and window.start <= 150 and window.end >= 199
    # In 50 of 61 frames one of the fifteen residuals is three sigmas.
    assert window.rms == pytest.approx(np.sqrt(50 * 9 / (61 * 15)))
    assert window.clip_rms == pytest.approx(np.sqrt((50 * 9 + 60) / (FRAMES * 15)))
    assert window.fractions == {"pelvis": 1.0, "ankle": 0.0, "knee": 0.0}
    assert window.leg is None and window.size == pytest.approx(0.06)
    assert window.pelvis == pytest.approx(-0.06 * 50 / 61)


def test_the_window_of_a_shorter_clip_is_the_whole_clip():
    long = playback(error("ankle", 5, 0.1, 0.0, 0.0, leg=0))

    def shortened(leaf: Any) -> Any:
        """The first forty frames of what has some."""
        is_series = np.ndim(leaf) and len(leaf) >= FRAMES - 2
        return leaf[: len(leaf) - FRAMES + 40] if is_series else leaf

    window = find_worst_window(jax.tree.map(shortened, long))
    assert (window.start, window.end, window.frame) == (0, 39, 5)


def test_frames_that_were_not_seen_do_not_count_however_large_their_errors():
    seen = np.ones(FRAMES, bool)
    seen[200:280] = False
    errors = error("ankle", slice(200, 280), 0.0, 5.0, 0.0, leg=1)["ankle"]
    errors += error("ankle", slice(60, 70), 0.0, 0.0, 0.04, leg=0)["ankle"]
    play = playback({"ankle": errors}, seen=seen)
    window = find_worst_window(play)
    assert window.start <= 60 and window.end >= 69 and window.leg == 0
    assert window.size == pytest.approx(0.04)
    # If a single seen frame were enough, the window around it would be the worst.
    single = dataclasses.replace(play, seen=seen | (np.arange(FRAMES) == 240))
    assert find_worst_window(single).start <= 60


def test_the_squares_are_divided_among_kinds_and_legs():
    errors = error("ankle", slice(100, 110), 0.0, 0.04, 0.0, leg=1)  # 40 squared sigmas
    errors |= error("knee", slice(100, 110), 0.0, 0.03, 0.0, leg=0)  # 10
    errors |= error("pelvis", slice(100, 110), 0.02, 0.0, 0.0)  # 10
    window = find_worst_window(playback(errors))
    assert list(window.fractions) == ["ankle", "knee", "pelvis"] and window.kind == "ankle"
    np.testing.assert_allclose(list(window.fractions.values()), [4 / 6, 1 / 6, 1 / 6])
    np.testing.assert_allclose(window.leg_fractions, [0.2, 0.8])


def test_targets_out_of_reach_are_counted_within_the_window():
    reached = np.ones((FRAMES, 2))
    reached[123:129, 0] = 0.0
    reached[200:300] = 0.0  # outside the window
    play = playback(error("knee", 123, 0.0, 0.1, 0.0, leg=0), reached=reached)
    assert find_worst_window(play).out_of_reach == pytest.approx(6 / 122)


@pytest.mark.parametrize("height", [0.02, -0.02])
def test_the_gap_of_captured_soles_is_measured_while_they_stand_in_the_window(height):
    stance = np.zeros((FRAMES, 2))
    stance[100:140, 1] = 1.0
    play = playback(error("ankle", 120, 0.0, 0.1, 0.0, leg=0), stance=stance)
    ground = play.ball_ground_ws + np.array([0.0, height, 0.0])
    ground[110, 1, 1] += height
    ground[200, 1, 1] += 9.0  # outside the window
    play = dataclasses.replace(play, ball_ground_ws=ground)
    window = find_worst_window(play)
    inside = np.arange(window.start, window.end + 1)
    count = int(np.sum((100 <= inside) & (inside < 140)))
    gap = window.sole_gap
    assert gap is not None and gap.frames == count
    assert gap.mean == pytest.approx(-height * (count + 1) / count)
    assert gap.rms == pytest.approx(0.02 * np.sqrt((count + 3) / count))
    assert (gap.largest, gap.frame, gap.leg) == (pytest.approx(-2 * height), 110, 1)
    groundless = dataclasses.replace(play, ball_grounded=np.zeros((FRAMES, 2)))
    assert find_worst_window(groundless).sole_gap is None


def test_an_acceleration_belongs_to_the_middle_of_its_three_frames():
    errors = np.zeros((FRAMES - 2, 2, 3))
    errors[149, 1] = [0.0, 30.0, 0.0]
    window = find_worst_window(playback({"smooth": errors}, sigmas={"smooth": 10.0}))
    assert (window.kind, window.frame, window.leg) == ("smooth", 150, 1)
    assert window.offset is None and window.size == 30.0
