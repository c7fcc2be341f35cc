"""The fit of a nonlinear hierarchy: populations with known centres and spreads."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy import stats

from fitting.inference.hierarchy.grouping import Grouping
from fitting.inference.hierarchy.likelihoods import approximate_prior, expand
from fitting.inference.hierarchy.population_fit import PopulationFit, fit_population
from fitting.problem.prior import ParameterPrior, Priors
from fitting.problem.problem import Problem
from fitting.problem.space import Space
from fitting.studies.hierarchy.estimates import summarise
from support.problems import parameter, problem_of

NAMES = ("height", "decay", "start")
CENTRE = (0.4, 0.2, -1.0)
SIGMA = 0.02
TIMES = np.linspace(0.0, 2.0, 30)


class Swing(eqx.Module):
    """A foot that comes down: exponentially, once it has started to."""

    height: Array = parameter(0.5, "m", 0.0, 1.0)
    decay: Array = parameter(1.0, "1/s", 0.1, 10.0, scale="log")
    start: Array = parameter(0.3, "s", 0.0, 1.0, kind="threshold")


def heights(ik: Swing) -> Array:
    since = jnp.maximum(TIMES - ik.start, 0.0)
    return ik.height * jnp.exp(-ik.decay * since)


def residuals(ik: Swing, clips: tuple[Array, ...]) -> Array:
    """0 where a height was not seen."""
    plain = jnp.concatenate([(heights(ik) - seen) / SIGMA for seen in clips])
    return jnp.where(jnp.isnan(plain), 0.0, plain)


@pytest.fixture(scope="module")
def space() -> Space:
    """Priors that are wide, and for one parameter uniform over its range."""
    made = problem_of(Swing(), NAMES, None, residuals).space
    return made.with_prior(Priors(named={"height": ParameterPrior("uniform")}))


@eqx.filter_jit
def heights_at(space: Space, u: Array) -> Array:
    return heights(space.unpack(u))


def make_clips(space: Space, u: np.ndarray, seed: int) -> list[Problem]:
    """A problem for each row of `u`, the truth of a clip."""
    random = np.random.default_rng(seed)
    problems = []
    for row in u:
        noisy = heights_at(space, jnp.asarray(row)) + SIGMA * random.normal(size=TIMES.shape)
        problems.append(Problem(space, (noisy,), residuals))
    return problems


def population(clips: int, seed: int, *, height: float = 0.0, decay: float = 0.0) -> np.ndarray:
    """The truths of clips that differ with these spreads."""
    draws = np.random.default_rng(seed).normal(size=(clips, len(CENTRE)))
    return CENTRE + draws * [height, decay, 0.0]


def fitted(problems: list[Problem], grouping: Grouping) -> PopulationFit:
    return fit_population(problems, grouping, [np.tile(CENTRE, (len(problems), 1))])


def per_clip(clips: int, *parameters: int) -> Grouping:
    labels = [str(clip) for clip in range(clips)]
    return Grouping.of_labels([labels if k in parameters else None for k in range(len(NAMES))])


def test_the_population_is_recovered_and_intervals_cover_in_many_populations(space):
    hits, clip_hits, spreads, replicates, clips = np.zeros(2), [], [], 12, 8
    for seed in range(replicates):
        truth = population(clips, seed, decay=0.4)
        problems = make_clips(space, truth, seed)
        fit = fitted(problems, per_clip(clips, 1))
        assert fit.converged and fit.rounds < 20
        draws = fit.model.draw(np.random.default_rng(seed), 300)
        low, high = np.quantile(draws.centre, [0.025, 0.975], axis=0)
        hits += (low <= CENTRE[:2]) & (CENTRE[:2] <= high)
        low, high = np.quantile(draws.clips[:, :, 1], [0.025, 0.975], axis=0)
        clip_hits += ((low <= truth[:, 1]) & (truth[:, 1] <= high)).tolist()
        spreads.append(fit.spread[1])
        assert fit.spread[0] == fit.spread[2] == 0.0, "they are shared"
        assert (fit.clips[:, 2] == CENTRE[2]).all(), "thresholds are held"
    lowest = stats.binom(replicates, 0.95).ppf(0.005)
    assert (hits >= lowest).all(), hits
    assert 0.9 <= np.mean(clip_hits) <= 0.99
    assert np.sqrt(np.mean(np.square(spreads))) == pytest.approx(0.4, rel=0.15)


def test_clips_with_one_truth_have_a_spread_near_0(space):
    spreads = []
    for seed in range(6):
        problems = make_clips(space, np.tile(CENTRE, (6, 1)), seed)
        fit = fitted(problems, per_clip(6, 1))
        assert fit.converged
        spreads.append(fit.spread[1])
    sd = fit.model.estimate(np.zeros(2)).centre_sd[1] * np.sqrt(6)  # of a clip alone
    assert np.median(spreads) < 0.5 * sd and max(spreads) < 2 * sd
    assert min(spreads) == 0.0


def test_a_clip_is_drawn_towards_the_others_the_more_the_less_it_says(space):
    truth = population(6, 3, decay=0.3)
    truth[0, 1] = 1.2  # an outlier
    problems = make_clips(space, truth, 3)
    exact = heights_at(space, jnp.asarray(truth[0]))
    scarce = jnp.where(jnp.arange(len(TIMES)) % 10 == 9, exact, jnp.nan)
    decays = []
    for seen in (exact, scarce):
        clip = Problem(space, (seen,), residuals)
        fit = fitted([clip, *problems[1:]], per_clip(6, 1))
        decays.append(fit.clips[0, 1])
    assert fit.centre[1] < decays[1] < decays[0] - 0.02 < 1.2


def test_the_better_of_two_starts_is_kept_and_its_mode_is_the_lowest(space):
    truth = population(5, 1, height=0.5, decay=0.4)
    problems = make_clips(space, truth, 1)
    grouping = per_clip(5, 0, 1)
    pooled = np.tile(CENTRE, (5, 1))
    far = pooled + np.array([3.0, -2.0, 0.0])
    one, other = (fit_population(problems, grouping, [start]) for start in (pooled, truth))
    both = fit_population(problems, grouping, [far, pooled, truth])
    assert both.log_probability >= max(one.log_probability, other.log_probability) - 1e-3
    np.testing.assert_allclose(one.clips[:, :2], other.clips[:, :2], atol=0.02)
    np.testing.assert_allclose(one.spread, other.spread, rtol=0.05)


def test_a_left_out_clip_is_expected_at_the_centre_or_where_its_subject_is(space):
    truth = np.tile(CENTRE, (5, 1))
    truth[:, 1] += [0.5, 0.5, -0.5, -0.5, 0.0]
    problems = make_clips(space, truth, 2)
    subjects = Grouping.of_labels([None, ["a", "a", "b", "b", "c"], None])
    fit = fitted(problems[1:], subjects.without(0))
    expected = fit.predict(subjects, 0)
    assert expected[1] == fit.clips[0, 1] == pytest.approx(truth[0, 1], abs=0.2)
    np.testing.assert_array_equal(expected[[0, 2]], fit.centre[[0, 2]])
    fit = fitted(problems[:4], subjects.without(4))
    np.testing.assert_array_equal(fit.predict(subjects, 4), fit.centre)
    assert fit.clips[0, 1] == fit.clips[1, 1] > fit.centre[1] > fit.clips[2, 1]


def test_estimates_are_in_the_parameters_units(space):
    truth = population(5, 5, decay=0.4)
    problems = make_clips(space, truth, 5)
    fit = fitted(problems, per_clip(5, 1))
    rows: list[Any] = summarise(
        problems, truth, np.array(CENTRE), fit, ("shared", "clip", "shared")
    )
    height, decay, start = rows
    decays = np.array([np.asarray(space.values(row))[1] for row in jnp.asarray(truth)])
    np.testing.assert_allclose([each["value"] for each in decay["alone"]], decays, rtol=1e-6)
    low, high = np.transpose([estimate["interval"] for estimate in decay["clips"]])
    assert np.sum((low < decays) & (decays < high)) >= 4 and decay["unit"] == "1/s"
    assert height["spread"] is None and height["range"] is None
    assert start["pooled"]["interval"] is None, "a threshold has none"
    ends = [decay["range"][0], *decay["centre"]["interval"], decay["range"][1]]
    assert ends == sorted(set(ends))
    assert decay["spread"]["value"] == fit.spread[1]


def test_likelihoods_are_those_of_the_problem_without_its_prior(space):
    problems = make_clips(space, np.array([CENTRE, (0.9, -0.3, 0.2)]), 7)
    u = np.array([(0.2, 0.5, -0.7), (1.5, 0.1, 0.3)])
    found = expand(problems, u)
    for c, problem in enumerate(problems):
        point = jnp.asarray(u[c])
        slopes = np.asarray(problem.jacobian(point))[: -space.size]
        gradient = slopes.T @ np.asarray(problem.residuals(point))[: -space.size]
        smooth = np.asarray(space.smooth)
        np.testing.assert_allclose(found.gradient[c], smooth * gradient, rtol=1e-6)
        information = np.outer(smooth, smooth) * (slopes.T @ slopes)
        np.testing.assert_allclose(found.information[c], information, rtol=1e-6)
        prior = 0.5 * np.sum(np.asarray(space.prior_residuals(point)) ** 2)
        assert found.cost[c] == pytest.approx(float(problem.cost(point)) - prior)


def test_the_prior_is_approximated_by_its_residuals(space):
    slopes_at = jax.jit(jax.jacfwd(space.prior_residuals))
    for u in (-6.0, -0.3, 0.0, 1e-6, 2.0):
        point = np.full(space.size, u)
        found = approximate_prior(space.prior, point)
        slope, residual = np.diag(slopes_at(point)), np.asarray(space.prior_residuals(point))
        np.testing.assert_allclose(found.cost, 0.5 * residual**2, atol=1e-9, err_msg=f"{u}")
        np.testing.assert_allclose(found.gradient, slope * residual, atol=1e-9, err_msg=f"{u}")
        np.testing.assert_allclose(found.information, slope**2, rtol=1e-5, err_msg=f"{u}")


def test_a_threshold_that_varies_is_refused(space):
    problems = make_clips(space, np.tile(CENTRE, (2, 1)), 0)
    with pytest.raises(ValueError, match=r"start is a threshold: .* leave it shared"):
        fitted(problems, per_clip(2, 2))


def test_a_start_without_finite_residuals_is_refused(space):
    problems = make_clips(space, np.tile(CENTRE, (2, 1)), 0)
    broken = Problem(space, (jnp.full_like(problems[1].data[0], jnp.inf),), residuals)
    with pytest.raises(ValueError, match="not finite where the hierarchy begins"):
        fitted([problems[0], broken], per_clip(2, 1))
