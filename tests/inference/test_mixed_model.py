"""The linear mixed model, against exact answers: REML, dense normals, known populations."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from fitting.inference.hierarchy.grouping import Grouping
from fitting.inference.hierarchy.mixed_model import MixedModel, SpreadDensity

FLAT = 1e-9  # information of a prior that says nothing
WIDE = 1e4  # scale of a prior of spreads that says nothing


def labels(count: int) -> list[str]:
    return [f"clip {i}" for i in range(count)]


def measured(
    values: np.ndarray, variance: float, scale: float = WIDE, prior: float = FLAT
) -> MixedModel:
    """Clips of which each measures its own parameters, (clips, parameters), with this variance."""
    clips, size = values.shape
    return MixedModel(
        grouping=Grouping.of_labels([labels(clips)] * size),
        information=np.tile(np.eye(size) / variance, (clips, 1, 1)),
        vector=values / variance,
        prior_information=np.full(size, prior),
        prior_vector=np.zeros(size),
        spread_scale=np.full(size, scale),
    )


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


def dense_covariance(model: MixedModel, spreads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Prior mean and covariance of all clips' parameters, written out clip by clip."""
    group = model.grouping.group
    clips, size = group.shape
    mean = np.tile(model.prior_vector / model.prior_information, clips)
    covariance = np.zeros((clips * size, clips * size))
    for c in range(clips):
        for d in range(clips):
            for k in range(size):
                own = spreads[k] ** 2 * (group[c, k] == group[d, k]) if group[c, k] >= 0 else 0.0
                covariance[c * size + k, d * size + k] = 1 / model.prior_information[k] + own
    return mean, covariance


def test_the_marginal_density_is_that_of_the_dense_normal():
    model = correlated()
    size = model.information.shape[0] * 3
    information = np.zeros((size, size))
    for c, block in enumerate(model.information):
        information[3 * c : 3 * c + 3, 3 * c : 3 * c + 3] = block
    measured_at = np.linalg.solve(information, model.vector.ravel())
    densities, exact = [], []
    for spreads in np.array([[0, 0.4, 0.9], [0, 0.0, 0.0], [0, 2.0, 0.1]]):
        mean, covariance = dense_covariance(model, spreads)
        total = covariance + np.linalg.inv(information)
        prior = -0.5 * np.sum((spreads / model.spread_scale) ** 2)
        normal = stats.multivariate_normal(mean, total)  # type: ignore[arg-type]
        exact.append(normal.logpdf(measured_at) + prior)
        densities.append(model.log_marginal(spreads))
        gain = covariance @ np.linalg.inv(total)
        expected = mean + gain @ (measured_at - mean)
        estimate = model.estimate(spreads)
        np.testing.assert_allclose(estimate.clips.ravel(), expected, atol=1e-9)
        variance = np.diag(covariance - gain @ covariance)
        np.testing.assert_allclose(estimate.clip_sd.ravel() ** 2, variance, atol=1e-9)
        of_centres = np.tile(np.diag(1 / model.prior_information), len(model.vector))
        gain = of_centres @ np.linalg.inv(total)
        np.testing.assert_allclose(estimate.centre, mean[:3] + gain @ (measured_at - mean))
        variance = 1 / model.prior_information - np.diag(gain @ of_centres.T)
        np.testing.assert_allclose(estimate.centre_sd**2, variance, atol=1e-9)
    np.testing.assert_allclose(np.diff(densities), np.diff(exact), atol=1e-9)


def test_the_most_probable_spreads_are_a_maximum():
    model = correlated(2)
    best = model.most_probable_spreads
    highest = model.log_marginal(best)
    assert best[0] == 0.0, "it is shared"
    for k in (1, 2):
        for factor in (0.5, 0.9, 1.1, 2.0):
            moved = best.copy()
            moved[k] = factor * best[k] if best[k] > 0 else 0.1 * factor
            assert model.log_marginal(moved) < highest


def test_clips_that_are_alike_have_no_spread_and_those_that_differ_keep_their_values():
    random = np.random.default_rng(1)
    errors = 0.1 * random.normal(size=(6, 1))
    errors *= 0.09 / errors.std(ddof=1)  # a little less than the noise says
    alike = measured(1.0 + errors, 0.01)
    assert alike.most_probable_spreads == 0.0
    np.testing.assert_allclose(alike.estimate(np.zeros(1)).clips, 1.0 + errors.mean(), atol=1e-9)
    apart = np.arange(6.0)[:, None]
    estimate = measured(apart, 0.01).estimate(measured(apart, 0.01).most_probable_spreads)
    np.testing.assert_allclose(estimate.clips, apart, atol=0.01)
    assert (np.abs(estimate.clips - 2.5) < np.abs(apart - 2.5)).all(), "towards the centre"


def test_a_clip_that_says_nothing_takes_the_centre_with_its_spread():
    model = measured(np.array([[0.0], [2.0], [1.0], [3.0], [9.0]]), 0.01)
    says = np.array([1.0, 1.0, 1.0, 1.0, 0.0])
    silent = dataclasses.replace(
        model,
        information=model.information * says[:, None, None],
        vector=model.vector * says[:, None],
    )
    spreads = silent.most_probable_spreads
    estimate = silent.estimate(spreads)
    assert estimate.clips[4] == pytest.approx(1.5) and estimate.centre[0] == pytest.approx(1.5)
    assert estimate.clip_sd[4] ** 2 == pytest.approx(spreads[0] ** 2 + estimate.centre_sd[0] ** 2)


def test_draws_have_the_moments_of_the_exact_distribution():
    random = np.random.default_rng(3)
    values = np.array([[0.0], [1.0], [2.5], [1.2]])
    model = measured(values, 0.2, scale=1.0, prior=0.1)
    grid = np.linspace(0.0, 5.0, 4001)
    density = np.exp([model.log_marginal(np.array([spread])) for spread in grid])
    density /= density.sum()
    estimates = [model.estimate(np.array([spread])) for spread in grid[::40]]
    coarse = density[::40] / density[::40].sum()
    draws = model.draw(random, 4000)
    assert draws.spread.mean() == pytest.approx(density @ grid, rel=0.03)
    quantiles = np.interp([0.1, 0.9], np.cumsum(density), grid)
    np.testing.assert_allclose(np.quantile(draws.spread, [0.1, 0.9]), quantiles, rtol=0.07)
    exact = [(e.centre[0], e.centre_sd[0], e.clips[0, 0], e.clip_sd[0, 0]) for e in estimates]
    for draw, first in ((draws.centre[:, 0], 0), (draws.clips[:, 0, 0], 2)):
        means, sds = np.array(exact).T[first : first + 2]
        mean = coarse @ means
        assert draw.mean() == pytest.approx(mean, abs=0.04)
        assert draw.var() == pytest.approx(coarse @ (sds**2 + (means - mean) ** 2), rel=0.1)


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
        [[model.log_marginal(np.array([0, one, other])) for other in grid] for one in grid]
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
