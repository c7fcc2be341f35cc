"""The linear mixed model, against exact answers, and fits of known populations."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy import linalg, stats

from fitting.inference.mixed_model import (
    Grouping,
    MixedModel,
    PopulationFit,
    SpreadDensity,
    approximate_prior,
    expand,
    fit_population,
)
from fitting.problem.problem import Problem
from fitting.problem.space import ParameterPrior, Priors, Space
from fitting.studies.population import summarise
from support.problems import parameter, problem_of

# The linear mixed model


def labels(count: int) -> list[str]:
    return [f"clip {i}" for i in range(count)]


def measured(
    values: np.ndarray, variance: float = 0.01, scale: float = 1e4, prior: float = 1e-9
) -> MixedModel:
    """Clips of which each measures its own parameter, with this variance.

    Neither the prior of spreads, of this scale, nor that of the centre, with this information, says
    anything by default.
    """
    clips = len(values)
    return MixedModel(
        grouping=Grouping.of_labels([labels(clips)]),
        information=np.full((clips, 1, 1), 1 / variance),
        vector=values[:, None] / variance,
        prior_information=np.array([prior]),
        prior_vector=np.zeros(1),
        spread_scale=np.array([scale]),
    )


def log_marginal(model: MixedModel, spreads: np.ndarray) -> float:
    """Log-probability of spreads, up to a constant, all else integrated out."""
    precision, vector, _ = model._posterior(spreads)
    return 0.5 * float(vector @ np.linalg.solve(precision, vector)) + model.log_volume(spreads)


def correlated(seed: int = 0) -> MixedModel:
    """Four clips of two subjects, with information that ties their three parameters together."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(4, 3, 3))
    return MixedModel(
        grouping=Grouping.of_labels([None, ["a", "a", "b", "b"], labels(4)]),
        information=root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3),
        vector=random.normal(size=(4, 3)),
        prior_information=np.array([0.5, 1.0, 2.0]),
        prior_vector=np.array([0.3, -0.2, 0.1]),
        spread_scale=np.array([1.0, 1.5, 0.8]),
    )


def dense_covariance(model: MixedModel, spreads: np.ndarray) -> np.ndarray:
    """Prior covariance of all clips' parameters, written out clip by clip."""
    group = model.grouping.group
    clips, size = group.shape
    covariance = np.zeros((clips * size, clips * size))
    for c, d, k in np.ndindex(clips, clips, size):
        own = spreads[k] ** 2 * (group[c, k] == group[d, k]) if group[c, k] >= 0 else 0.0
        covariance[c * size + k, d * size + k] = 1 / model.prior_information[k] + own
    return covariance


def test_the_marginal_density_is_that_of_the_dense_normal():
    model = correlated()
    information = np.asarray(linalg.block_diag(*model.information))
    measured_at = np.linalg.solve(information, model.vector.ravel())
    mean = np.tile(model.prior_vector / model.prior_information, len(model.vector))
    of_centres = np.tile(np.diag(1 / model.prior_information), len(model.vector))
    densities, exact = [], []
    for spreads in np.array([[0, 0.4, 0.9], [0, 0.0, 0.0], [0, 2.0, 0.1]]):
        covariance = dense_covariance(model, spreads)
        total = covariance + np.linalg.inv(information)
        prior = -0.5 * np.sum((spreads / model.spread_scale) ** 2)
        normal = stats.multivariate_normal(mean, total)  # type: ignore[arg-type]
        exact.append(normal.logpdf(measured_at) + prior)
        densities.append(log_marginal(model, spreads))
        estimate = model.estimate(spreads)
        gain = covariance @ np.linalg.inv(total)
        expected = mean + gain @ (measured_at - mean)
        np.testing.assert_allclose(estimate.clips.ravel(), expected, atol=1e-9)
        variance = np.diag(covariance - gain @ covariance)
        np.testing.assert_allclose(estimate.clip_sd.ravel() ** 2, variance, atol=1e-9)
        gain = of_centres @ np.linalg.inv(total)
        np.testing.assert_allclose(estimate.centre, mean[:3] + gain @ (measured_at - mean))
        variance = 1 / model.prior_information - np.diag(gain @ of_centres.T)
        np.testing.assert_allclose(estimate.centre_sd**2, variance, atol=1e-9)
    np.testing.assert_allclose(np.diff(densities), np.diff(exact), atol=1e-9)


def test_the_most_probable_spreads_are_a_maximum():
    model = correlated(2)
    best = model.most_probable_spreads
    highest = log_marginal(model, best)
    assert best[0] == 0.0, "it is shared"
    for k in (1, 2):
        for factor in (0.5, 0.9, 1.1, 2.0):
            moved = best.copy()
            moved[k] = factor * best[k] if best[k] > 0 else 0.1 * factor
            assert log_marginal(model, moved) < highest


def test_clips_that_are_alike_have_no_spread():
    errors = 0.1 * np.random.default_rng(1).normal(size=6)
    errors *= 0.09 / errors.std(ddof=1)  # a little less than the noise says
    alike = measured(1.0 + errors)
    assert alike.most_probable_spreads == 0.0
    np.testing.assert_allclose(alike.estimate(np.zeros(1)).clips, 1.0 + errors.mean(), atol=1e-9)
    errors *= 0.1 / errors.std(ddof=1)  # just what the noise says: only rounding tells 0 from 1e-5
    assert measured(errors).most_probable_spreads == 0.0
    assert measured((1 + 1e-9) * np.array([-1, 0, 1]) / 10).most_probable_spreads == 0.0


def test_a_clip_that_says_nothing_takes_the_centre_with_its_spread():
    model = measured(np.array([0.0, 2.0, 1.0, 3.0, 9.0]))
    says = np.array([1.0, 1.0, 1.0, 1.0, 0.0])[:, None]
    information, vector = model.information * says[..., None], model.vector * says
    silent = dataclasses.replace(model, information=information, vector=vector)
    spreads = silent.most_probable_spreads
    estimate = silent.estimate(spreads)
    assert estimate.clips[4] == pytest.approx(1.5) and estimate.centre[0] == pytest.approx(1.5)
    assert estimate.clip_sd[4] ** 2 == pytest.approx(spreads[0] ** 2 + estimate.centre_sd[0] ** 2)


def test_draws_have_the_moments_of_the_exact_distribution():
    model = measured(np.array([0.0, 1.0, 2.5, 1.2]), 0.2, scale=1.0, prior=0.1)
    grid = np.linspace(0.0, 5.0, 4001)
    density = np.exp([log_marginal(model, np.array([spread])) for spread in grid])
    density /= density.sum()
    estimates = [model.estimate(np.array([spread])) for spread in grid[::40]]
    coarse = density[::40] / density[::40].sum()
    draws = model.draw(np.random.default_rng(3), 4000)
    assert draws.spread.mean() == pytest.approx(density @ grid, rel=0.03)
    quantiles = np.interp([0.1, 0.9], np.cumsum(density), grid)
    np.testing.assert_allclose(np.quantile(draws.spread, [0.1, 0.9]), quantiles, rtol=0.07)
    exact = [(e.centre[0], e.centre_sd[0], e.clips[0, 0], e.clip_sd[0, 0]) for e in estimates]
    for draw, first in ((draws.centre[:, 0], 0), (draws.clips[:, 0, 0], 2)):
        means, sds = np.array(exact).T[first : first + 2]
        mean = coarse @ means
        assert draw.mean() == pytest.approx(mean, abs=0.04)
        assert draw.var() == pytest.approx(coarse @ (sds**2 + (means - mean) ** 2), rel=0.1)


def test_the_density_of_a_spread_is_fine_where_its_prior_is_a_hundred_times_wider():
    model = measured(np.array([0.0, 1.0, 2.5, 1.2]), 0.2, scale=100.0)
    edges, probability = model.draw(np.random.default_rng(3), 1).spread_density[0]
    found = np.interp([0.3, 0.6, 1.0, 3.0], edges[1:], np.cumsum(probability))
    grid = np.linspace(0.005, 99.995, 10_000)
    density = np.exp([log_marginal(model, np.array([spread])) for spread in grid])
    exact = np.interp([0.3, 0.6, 1.0, 3.0], grid + 0.005, np.cumsum(density) / density.sum())
    np.testing.assert_allclose(found, exact, atol=0.01)


def test_the_shortest_interval_begins_at_0_where_the_density_is_high_there():
    edges = np.linspace(0.0, 12.0, 2401)

    def interval(centre: float) -> tuple[float, float]:
        probability = np.diff(stats.norm(centre).cdf(edges))
        return SpreadDensity(edges, probability / probability.sum()).interval()

    assert interval(0.0) == pytest.approx((0.0, 1.96), abs=0.01)
    assert interval(0.5)[0] == 0.0
    assert interval(6.0) == pytest.approx((6 - 1.96, 6 + 1.96), abs=0.02)


def test_densities_of_spreads_that_depend_on_each_other_are_their_marginals():
    model = correlated(3)
    grid = np.linspace(0.02, 6.0, 60)
    joint = np.array(
        [[log_marginal(model, np.array([0, one, other])) for other in grid] for one in grid]
    )
    joint = np.exp(joint - joint.max())
    draws = model.draw(np.random.default_rng(0), 600)
    for k, axis in ((1, 1), (2, 0)):
        marginal = joint.sum(axis=axis) / joint.sum()
        edges, probability = draws.spread_density[k]
        found = np.interp([0.5, 1.0, 2.0], edges[1:], np.cumsum(probability))
        exact = np.interp([0.5, 1.0, 2.0], grid + 0.05, np.cumsum(marginal))
        np.testing.assert_allclose(found, exact, atol=0.03)


def test_groups_are_those_of_equal_labels():
    grouping = Grouping.of_labels([None, ["b", "a", "b"], ["x", "y", "z"]])
    np.testing.assert_array_equal(grouping.group, [[-1, 0, 0], [-1, 1, 1], [-1, 0, 2]])
    assert grouping.varying == (1, 2)
    np.testing.assert_array_equal(grouping.counts, [0, 2, 3])
    np.testing.assert_array_equal(grouping.companions(0, 1), [2])
    assert grouping.companions(1, 1).size == 0
    np.testing.assert_array_equal(grouping.without(1).group, [[-1, 0, 0], [-1, 0, 1]])
    np.testing.assert_array_equal(grouping.of([1]).group, [[0], [1], [0]])
    assert Grouping.pooled(3, 2).varying == ()
    with pytest.raises(ValueError, match="wanted a label for each clip"):
        Grouping.of_labels([["a"], ["a", "b"]])


# Populations

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
    return jnp.concatenate([(heights(ik) - seen) / SIGMA for seen in clips])


@pytest.fixture(scope="module")
def space() -> Space:
    """Priors that are wide, and for one parameter uniform over its range."""
    wide = problem_of(Swing(), NAMES, None, residuals).space
    return wide.with_prior(Priors(named={"height": ParameterPrior("uniform")}))


@eqx.filter_jit
def heights_at(space: Space, u: Array) -> Array:
    return jax.vmap(lambda row: heights(space.unpack(row)))(u)


def make_clips(space: Space, u: np.ndarray, seed: int) -> list[Problem]:
    """A problem for each row of `u`, the truth of a clip."""
    noise = SIGMA * np.random.default_rng(seed).normal(size=(len(u), TIMES.size))
    seen = np.asarray(heights_at(space, jnp.asarray(u))) + noise
    return [Problem(space, (jnp.asarray(row),), residuals) for row in seen]


def population(clips: int, seed: int, *, height: float = 0.0, decay: float = 0.0) -> np.ndarray:
    """The truths of clips that differ with these spreads."""
    draws = np.random.default_rng(seed).normal(size=(clips, len(CENTRE)))
    return CENTRE + draws * [height, decay, 0.0]


def fitted(problems: list[Problem], grouping: Grouping) -> PopulationFit:
    return fit_population(problems, grouping, [np.tile(CENTRE, (len(problems), 1))])


def per_clip(clips: int, *parameters: int) -> Grouping:
    own = [labels(clips) if k in parameters else None for k in range(len(NAMES))]
    return Grouping.of_labels(own)


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


def test_steps_that_overshoot_are_shortened():
    """Residuals grow as roots of their distances: a step leads almost as far to the other side."""

    def roots(ik: Swing, seen: Array) -> Array:
        away = (ik.height - seen) / SIGMA
        return away / (away**2 + 1e-4) ** 0.24

    space = problem_of(Swing(), ("height",), None, roots).space
    u = np.asarray(space.pack({"height": 0.5}))
    problems = [Problem(space, jnp.full(100, 0.53), roots) for _ in range(2)]
    fit = fit_population(problems, Grouping.pooled(2, 1), [np.tile(u, (2, 1))])
    assert fit.converged and fit.rounds < 30
    assert float(space.values(jnp.asarray(fit.centre))[0]) == pytest.approx(0.53, abs=1e-3)


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


def test_a_threshold_that_varies_and_a_start_without_finite_residuals_are_refused(space):
    whole, other = make_clips(space, np.tile(CENTRE, (2, 1)), 0)
    with pytest.raises(ValueError, match=r"start is a threshold: .* leave it shared"):
        fitted([whole, other], per_clip(2, 2))
    broken = Problem(space, (jnp.full_like(other.data[0], jnp.inf),), residuals)
    with pytest.raises(ValueError, match="not finite where the mixed model begins"):
        fitted([whole, broken], per_clip(2, 1))
