"""How much residuals tell that repeat one another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

from fitting.problem.free_parameters import free_parameter
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from support import toy

ROWS, CLIPS = 400, 400
CORRELATION = 0.9


def residuals(ik: toy.Toy, data: jax.Array) -> jax.Array:
    return ik.foot.share - data


def noise(rng: np.random.Generator) -> np.ndarray:
    """First-order autoregressions of unit variance, (clips, rows)."""
    steps = rng.normal(size=(CLIPS, ROWS)) * np.sqrt(1.0 - CORRELATION**2)
    steps[:, 0] /= np.sqrt(1.0 - CORRELATION**2)
    return lfilter([1.0], [1.0, -CORRELATION], steps)


def covered(independent: float) -> float:
    """How often the 95 % interval of a level covers it, noise of neighbours being correlated.

    The rows are linear in the parameter's value, so that estimate and width follow from the slope.
    """
    ik = toy.Toy()
    space = make_space(ik, [free_parameter(ik, "foot.share", prior_sd=50.0)])
    problem = Problem(
        space, jnp.zeros(ROWS), residuals, independent_fraction=jnp.asarray(independent)
    )
    u = jnp.zeros(1)
    of_u = jax.jacfwd(lambda u: space.values(u)[0])(u)[0]
    slopes = np.asarray(problem.jacobian(u))[:-1, 0] / float(of_u)  # of the rows, by value
    assert slopes == pytest.approx(np.sqrt(independent))
    width = 1.96 / np.sqrt(np.sum(slopes**2))
    means = noise(np.random.default_rng(0)).mean(axis=1)  # of which the truth is 0
    return float(np.mean(np.abs(means) < width))


def test_residuals_that_repeat_one_another_give_intervals_that_cover_their_share():
    share = (1.0 - CORRELATION) / (1.0 + CORRELATION)  # one over their autocorrelation time
    assert covered(1.0) < 0.5
    assert 0.92 < covered(share) < 0.98
