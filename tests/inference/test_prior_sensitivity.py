"""Posteriors under other priors, by weighting draws, against the answers in closed form."""

from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from fitting.inference.sampling import prior_sensitivity
from fitting.problem.prior import Prior
from support.problems import posterior_of

DRAWS = (4000, 10)


def sensitivity(u: np.ndarray, prior: Prior) -> list[list[dict[str, Any]]]:
    """Of each parameter, for independent draws, (steps, walkers, free), whose values are `u`."""
    names = tuple(f"p{i}" for i in range(u.shape[-1]))
    rows = prior_sensitivity.prior_sensitivity(posterior_of(names, u, u), prior)
    return [cast(Any, rows[name]) for name in names]


def normal_prior(centre: float, spread: float) -> Prior:
    return Prior(jnp.asarray([centre]), jnp.asarray([spread]), jnp.asarray([False]))


def product(centre: float, spread: float, observed: float, error: float) -> Any:
    """The posterior of a normal prior and a normal likelihood."""
    precision = 1 / spread**2 + 1 / error**2
    mean = (centre / spread**2 + observed / error**2) / precision
    return stats.norm(mean, precision**-0.5)


def test_weighted_draws_have_the_posterior_of_the_other_prior():
    centre, spread, observed, error = 0.5, 1.6, 1.8, 1.0
    random = np.random.default_rng(0)
    u = product(centre, spread, observed, error).rvs((*DRAWS, 1), random_state=random)
    (rows,) = sensitivity(u, normal_prior(centre, spread))
    assert [row["factor"] for row in rows] == [0.5, 2.0]
    for row in rows:
        exact = product(centre, row["factor"] * spread, observed, error)
        assert row["median"] == pytest.approx(exact.median(), abs=0.03)
        assert row["interval"] is not None
        np.testing.assert_allclose(row["interval"], exact.ppf([0.025, 0.975]), atol=0.08)
        assert row["pareto_k"] < prior_sensitivity.MAX_K
    assert [row["sensitive"] for row in rows] == [True, False]


def test_a_parameter_that_the_clips_determine_is_not_sensitive_and_one_without_effect_is():
    random = np.random.default_rng(1)
    u = np.stack([random.normal(0.3, 0.1, DRAWS), random.logistic(size=DRAWS)], axis=-1)
    prior = Prior(jnp.zeros(2), jnp.asarray([1.6, 1.0]), jnp.asarray([False, True]))
    determined, idle = sensitivity(u, prior)
    assert [row["sensitive"] for row in determined] == [False, False]
    for row in idle:  # the posterior is the prior, a logistic of the scale that it is given
        assert row["interval"] is not None
        expected = stats.logistic(scale=row["factor"]).ppf([0.025, 0.975])
        np.testing.assert_allclose(row["interval"], expected, rtol=0.1)
        assert row["sensitive"]


def test_a_prior_that_a_few_draws_would_decide_gets_no_figures():
    random = np.random.default_rng(2)
    u = random.normal(8.0, 1.0, (*DRAWS, 1))
    ((half, twice),) = sensitivity(u, normal_prior(0.0, 1.0))
    assert half["pareto_k"] > prior_sensitivity.MAX_K
    assert half["median"] is half["interval"] is half["sensitive"] is None
    assert twice["factor"] == 2.0


@pytest.mark.parametrize("shape", [-0.5, 0.3, 0.9])
def test_the_pareto_shape_of_weights_is_found(shape):
    weights = stats.genpareto(shape).rvs(40_000, random_state=3)
    assert prior_sensitivity.pareto_k(weights, 40_000.0) == pytest.approx(shape, abs=0.15)


def test_equal_weights_are_reliable_and_a_handful_is_not():
    assert prior_sensitivity.pareto_k(np.ones(1000), 1000.0) == -np.inf
    assert prior_sensitivity.pareto_k(np.arange(10.0), 10.0) == np.inf
