"""How much information correlated residuals carry."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

from fitting.problem.prior import ParameterPrior, Priors
from support import toy
from support.problems import problem_of

RESIDUALS, CLIPS = 400, 400
CORRELATION = 0.9


def residuals(ik: toy.Toy, data: jax.Array) -> jax.Array:
    return ik.foot.share - data


def noise(rng: np.random.Generator) -> np.ndarray:
    """First-order autoregressions of unit variance, (clips, residuals)."""
    steps = rng.normal(size=(CLIPS, RESIDUALS)) * np.sqrt(1.0 - CORRELATION**2)
    steps[:, 0] /= np.sqrt(1.0 - CORRELATION**2)
    return np.asarray(lfilter([1.0], [1.0, -CORRELATION], steps))


def coverage(independent_fraction: float) -> float:
    """How often the 95 % interval of a level covers it although the noise is correlated.

    The residuals are linear in the parameter's value, so that estimate and width follow from the
    Jacobian.
    """
    fraction = jnp.asarray(independent_fraction)
    problem = problem_of(
        toy.Toy(), ["foot.share"], jnp.zeros(RESIDUALS), residuals, independent_fraction=fraction
    )
    space = problem.space.with_prior(Priors(ParameterPrior(spread=50.0)))
    problem = dataclasses.replace(problem, space=space)
    u = jnp.zeros(1)
    value_by_u = jax.jacfwd(lambda u: space.values(u)[0])(u)[0]
    by_value = np.asarray(problem.jacobian(u))[:-1, 0] / float(value_by_u)
    assert by_value == pytest.approx(np.sqrt(independent_fraction))
    width = 1.96 / np.sqrt(np.sum(by_value**2))
    means = noise(np.random.default_rng(0)).mean(axis=1)  # the truth is 0
    return float(np.mean(np.abs(means) < width))


def test_the_independent_fraction_restores_the_coverage_of_correlated_residuals():
    fraction = (1.0 - CORRELATION) / (1.0 + CORRELATION)  # one over their autocorrelation time
    assert coverage(1.0) < 0.5
    assert 0.92 < coverage(fraction) < 0.98
