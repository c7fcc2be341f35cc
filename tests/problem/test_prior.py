"""The prior of `u`: its two shapes against SciPy's distributions, its intervals, its mistakes."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from fitting.experiments import systems
from fitting.problem.free_parameters import free_parameter
from fitting.problem.prior import LOGISTIC_SD, SPREAD, ParameterPrior, Prior, Priors
from fitting.problem.prior_probability import prior_probability
from fitting.problem.space import INTERVAL, Space, make_space
from jaxik.maths import parameter_tree
from support import toy

PRIOR = Prior(jnp.asarray([0.7, 0.0]), jnp.asarray([1.3, 1.0]), jnp.asarray([False, True]))
DISTRIBUTIONS: tuple[Any, ...] = (stats.norm(0.7, 1.3), stats.logistic())
POINTS = np.array([-700.0, -40, -3, -2, -1.9, -1e-3, -1e-9, 0, 1e-200, 1e-5, 0.1, 1, 2.1, 30, 700])


def make(*names: str, priors: Priors | None = None) -> Space:
    ik = toy.Toy()
    space = make_space(ik, [free_parameter(ik, name) for name in names])
    return space.with_prior(Priors() if priors is None else priors)


def residuals_at(points: np.ndarray) -> np.ndarray:
    """(points, 2), both parameters at each point."""
    return np.asarray(jax.vmap(PRIOR.residuals)(jnp.asarray(np.stack([points] * 2, axis=1))))


def test_half_the_square_of_a_residual_is_minus_the_log_density():
    residuals = residuals_at(POINTS)
    for i, distribution in enumerate(DISTRIBUTIONS):
        expected = distribution.logpdf(distribution.median()) - distribution.logpdf(POINTS)
        np.testing.assert_allclose(0.5 * residuals[:, i] ** 2, expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(np.sign(residuals[:, 1]), np.sign(POINTS))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_residuals_and_their_slopes_are_finite_and_smooth_everywhere(dtype):
    points = np.concatenate([np.linspace(-5, 5, 1001), POINTS]).astype(dtype)
    prior = jax.tree.map(lambda x: x.astype(dtype) if x.dtype != bool else x, PRIOR)
    derivative = jax.vmap(jax.jacfwd(prior.residuals))
    slopes = np.asarray(derivative(jnp.asarray(np.stack([points] * 2, axis=1))))
    assert slopes.dtype == dtype
    assert np.isfinite(slopes).all()
    logistic = slopes[:, 1, 1]
    assert logistic.min() > 0
    assert logistic[points == 0] == pytest.approx(np.sqrt(0.5), rel=1e-6)
    assert np.abs(np.diff(logistic[:1001])).max() < 2e-3, "no step where one form takes over"


def test_quantiles_draws_and_the_standard_deviation_are_those_of_the_distributions():
    probability = np.array([0.001, 0.4, 0.975])
    draws = PRIOR.draw(np.random.default_rng(0), 20_000)
    for i, distribution in enumerate(DISTRIBUTIONS):
        quantile = PRIOR.quantile(probability[:, None])[:, i]
        np.testing.assert_allclose(quantile, distribution.ppf(probability))
        assert float(PRIOR.sd[i]) == pytest.approx(distribution.std())
        assert stats.kstest(draws[:, i], distribution.cdf).pvalue > 0.01
    assert pytest.approx(stats.logistic.std()) == LOGISTIC_SD


def test_the_ends_of_a_rise_are_where_the_residuals_say():
    ends = PRIOR.ends(1.92)
    for end in ends:
        residuals = np.asarray(PRIOR.residuals(jnp.asarray(end)))
        np.testing.assert_allclose(0.5 * residuals**2, 1.92)
    assert (ends[0] < ends[1]).all()


def test_the_interval_of_a_uniform_prior_leaves_out_a_fortieth_of_the_range_on_either_side():
    priors = Priors(ParameterPrior("uniform"))
    (low, high), (short, long) = make("foot.share", "lock.release", priors=priors).prior_interval()
    assert (low, high) == pytest.approx((0.025 * 1.2, 0.975 * 1.2))
    logarithms = np.log(0.01) + np.array([0.025, 0.975]) * np.log(0.5 / 0.01)
    np.testing.assert_allclose([short, long], np.exp(logarithms))


def test_the_interval_of_a_normal_prior_is_that_of_its_u():
    named = {"foot.share": ParameterPrior(centre=0.3, spread=0.4)}
    space = make("foot.share", priors=Priors(named=named))
    centre = np.log(0.25 / 0.75)  # 0.3 of 1.2
    expected = 1.2 / (1 + np.exp(-(centre + 0.4 * stats.norm.ppf([0.025, 0.975]))))
    np.testing.assert_allclose(space.prior_interval(), [expected])


SYSTEMS = [*((name, False) for name in systems.preset_names()), ("record", True), ("mec", True)]


@pytest.mark.parametrize(("preset", "faithful"), SYSTEMS)
def test_the_prior_of_every_parameter_of_every_preset_allows_most_of_its_range(preset, faithful):
    """On its scale, and also where the preset's value is at a bound, as a half-life of 0 is."""
    ik = systems.preset_system(preset, faithful=faithful)
    parameters = [free_parameter(ik, name) for name in parameter_tree.declarations(ik)]
    prior = make_space(ik, [replace(parameter, above=None) for parameter in parameters]).prior
    low, high = special.expit(prior.quantile(np.array(INTERVAL)[:, None]))
    for name, fraction in zip((p.name for p in parameters), high - low, strict=True):
        assert fraction > 0.8, name


def test_a_parameter_above_a_free_one_has_the_interval_of_the_mixture():
    priors = Priors(ParameterPrior("uniform"))
    space = make("lock.height_off", "lock.height_on", priors=priors)
    random = np.random.default_rng(1)
    on = random.uniform(0.01, 0.12, 200_000)
    off = random.uniform(np.maximum(on, 0.02), 0.2)
    expected = np.quantile(off, [0.025, 0.975])
    np.testing.assert_allclose(space.prior_interval()[0], expected, atol=0.003 * 0.18)
    np.testing.assert_allclose(space.prior_interval()[1], [0.01275, 0.11725])


def test_the_probability_of_values_is_that_of_scipy_and_of_draws():
    named = {"foot.share": ParameterPrior(centre=0.3, spread=0.4)}
    priors = Priors(ParameterPrior("uniform"), named)
    space = make("lock.height_off", "lock.height_on", "foot.share", priors=priors)
    values = np.array([[0.0, 0.0, -1.0], [0.05, 0.065, 0.3], [0.15, 0.1, 0.5], [0.3, 0.2, 2.0]])
    probability = prior_probability(space, values)
    u = np.log(values[1:3, 2] / (1.2 - values[1:3, 2]))
    share = stats.norm(np.log(0.25 / 0.75), 0.4).cdf(u)
    np.testing.assert_allclose(probability[:, 2], [0, *share, 1], atol=1e-6)
    np.testing.assert_allclose(probability[:, 1], [0, 0.5, 9 / 11, 1], atol=1e-6)
    random = np.random.default_rng(1)
    off = random.uniform(np.maximum(random.uniform(0.01, 0.12, 200_000), 0.02), 0.2)
    expected = (off[:, None] <= values[:, 0]).mean(axis=0)
    np.testing.assert_allclose(probability[:, 0], expected, atol=0.02)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"spread": 0.0}, "spread is 0.0, wanted a number from 0.001 to 1000"),
        ({"spread": np.inf}, "spread is inf, wanted a number from 0.001 to 1000"),
        ({"shape": "uniform", "centre": 0.5}, "centre is given, but a uniform prior has none"),
        ({"shape": "uniform", "spread": 0.5}, "spread is given, but a uniform prior has none"),
    ],
)
def test_a_prior_that_makes_no_sense_is_refused(entry, message):
    with pytest.raises(ValueError, match=message):
        ParameterPrior(**entry)


def test_an_unknown_shape_is_refused():
    prior = ParameterPrior()
    object.__setattr__(prior, "shape", "flat")  # before any check of types
    with pytest.raises(ValueError, match=r"'flat', wanted one of \('normal', 'uniform'\)"):
        prior.__post_init__()


def test_a_parameter_without_a_prior_of_its_own_has_the_default():
    space = make(
        "foot.share", "body.rise", priors=Priors(named={"body.rise": ParameterPrior("uniform")})
    )
    np.testing.assert_array_equal(space.prior.uniform, [False, True])
    np.testing.assert_allclose(space.prior.spread, [SPREAD, 1.0])
    np.testing.assert_allclose(space.values(space.prior.centre), [0.6, 0.1])
