"""Goodness of fit on playbacks whose errors are simulated noise, misfits and outliers."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from scipy import signal, stats

from fitting.analysis.goodness import verdict
from fitting.analysis.goodness.groups import Assumed, measure_groups
from fitting.analysis.goodness.noise import MEDIAN
from fitting.analysis.goodness.verdict import Verdict
from fitting.analysis.playback import Playback
from fitting.problem.residuals import whitened
from support.playbacks import FPS, FRAMES, SHAPES, SIGMAS, playback

KINDS = ("ankle", "knee", "pelvis")
SEEDS = 20  # each violation must be found in all of them
RHO = 0.95
ASSUMED = {"correlation": RHO}
WHITENED = r"even where the estimate is taken out.*set `correlation = \"counted\"` in \[noise\]"


def autoregression(random: np.random.Generator, shape: tuple[int, ...], rho: float) -> np.ndarray:
    """Noise of unit variance, correlated from frame to frame."""
    values = random.normal(size=shape)
    values[1:] *= np.sqrt(1 - rho**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -rho], values, axis=0))


def simulate(seed: int, *, rho: float = 0.0, scale: float = 1.0, outliers: float = 0.0) -> Playback:
    """A playback of noise, `scale` times as large as its sigmas."""
    random = np.random.default_rng(seed)
    errors = {}
    for kind in KINDS:
        values = scale * autoregression(random, (FRAMES, *SHAPES[kind]), rho)
        values += 10 * random.normal(size=values.shape) * (random.random(values.shape) < outliers)
        errors[kind] = SIGMAS[kind] * values
    return playback(errors)


@jax.jit
def all_whitened(residuals: dict[str, jax.Array], seen: jax.Array, rho: jax.Array) -> dict:
    return {kind: whitened(values, seen, rho) for kind, values in residuals.items()}


def whiten(play: Playback, rho: float) -> Playback:
    """The playback as a fit sees it to which this correlation was given."""
    if not rho:
        return play
    residuals = all_whitened({kind: play.residuals[kind] for kind in KINDS}, play.seen, rho)
    return dataclasses.replace(play, residuals=play.residuals | jax.tree.map(np.asarray, residuals))


def judge(play: Playback, correlation: float = 0.0, **assumed) -> Verdict:
    assumptions = Assumed(**assumed)
    groups = measure_groups([play], [dict.fromkeys(KINDS, correlation)], assumptions)
    return verdict.judge(groups, assumptions)


# The verdict on simulated noise


@pytest.mark.parametrize(
    ("made", "given"),
    [
        ({}, {}),
        ({"rho": RHO}, {"correlation": RHO}),
        ({"rho": RHO}, {"independent_fraction": (1 - RHO) / (1 + RHO)}),
        ({"outliers": 0.03}, {"loss": "cauchy"}),
    ],
)
def test_noise_as_assumed_fits(made, given):
    plays = [whiten(simulate(s, **made), given.get("correlation", 0.0)) for s in range(100)]
    verdicts = [judge(play, **given) for play in plays]
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
        found = judge(whiten(simulate(seed, **made), given.get("correlation", 0.0)), **given)
        assert re.search(f"^Fits, but .*{said}", found.sentence), found.sentence
        assert not_said not in found.sentence and found.fits, found.sentence
        if percent := re.search(r"(\S+) % of the residuals", found.sentence):
            assert 1.5 < float(percent[1]) < 4.5


def with_bump(play: Playback, kind: str, size: float, frames: slice) -> Playback:
    """A playback with a smooth misfit of so many sigmas, rms in these frames."""
    errors = np.array(play.errors[kind])
    arch = np.sin(np.linspace(0, np.pi, frames.stop - frames.start)) * np.sqrt(2)
    errors[frames] += SIGMAS[kind] * size * arch.reshape(-1, *[1] * (errors.ndim - 1))
    return dataclasses.replace(
        play,
        errors={**play.errors, kind: errors},
        residuals={**play.residuals, kind: errors / SIGMAS[kind]},
    )


def test_a_misfit_is_named_with_its_kind_size_and_time():
    for seed in range(SEEDS):
        play = with_bump(simulate(seed), "knee", 3.0, slice(190, 250))
        found = judge(play)
        start, end = (float(time) for time in re.findall(r"(\d+\.\d) s", found.sentence))
        assert not found.fits
        assert "knees 1." in found.sentence and "worse than their sigma" in found.sentence
        assert abs(start - 190 / FPS) < 0.3 and abs(end - 250 / FPS) < 0.3, found.sentence


def test_a_misfit_over_the_whole_clip_is_no_noise():
    for seed in range(SEEDS):
        found = judge(with_bump(simulate(seed), "ankle", 2.0, slice(0, FRAMES)))
        assert found.sentence.startswith("Does not fit: ankles 2."), found.sentence


def test_a_small_misfit_is_none():
    """Five per cent more than the noise: significant in ten thousand residuals, but small."""
    found = judge(with_bump(simulate(0), "ankle", 0.32, slice(0, FRAMES)))
    assert found.fits


def test_only_tolerances_count_without_noise():
    def tolerated(play: Playback) -> Verdict:
        return verdict.judge_tolerances(measure_groups([play], [{}], Assumed()))

    assert tolerated(playback()).fits
    assert tolerated(with_bump(playback(), "ankle", 0.9, slice(0, FRAMES))).fits
    found = tolerated(with_bump(playback(), "ankle", 4.0, slice(100, 160)))
    assert not found.fits and "ankles" in found.sentence and "tolerance" in found.sentence


# The numbers


def test_p_values_are_uniform_where_the_noise_is_as_assumed():
    for rho, given in ((0.0, 0.0), (RHO, RHO), (RHO, 0.0)):
        plays = [whiten(simulate(seed, rho=rho), given) for seed in range(150)]
        given_of: list[dict[str, float]] = [{kind: given for kind in KINDS}]
        left = [g.left for play in plays for g in measure_groups([play], given_of, Assumed())]
        assert stats.kstest([noise.p for noise in left], "uniform").pvalue > 1e-3, (rho, given)
        if rho == given:
            p = [noise.autocorrelation_p for noise in left]
            assert stats.kstest(p, "uniform").pvalue > 1e-3
