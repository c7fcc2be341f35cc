"""Soft limits: where they start, where they end, and their gradients."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxik.solvers.reach import quartic_limit, soft_limit
from support.gradients import ROWS, assert_all_gradients_match, finite_jacobian


@pytest.mark.parametrize(
    ("curve", "first_slope", "end", "left"),
    [(quartic_limit, 4 / 3, 50.0, 1e-6), (soft_limit, 1.0, 5.0, 1e-3)],
)
def test_a_curve_starts_with_its_slope_and_rises_to_its_limit(curve, first_slope, end, left):
    x = np.linspace(0.0, end, 5001)
    y = np.asarray(curve(jnp.asarray(x), jnp.asarray(0.9), jnp.asarray(1.4)))
    assert_allclose(y[x <= 0.9], x[x <= 0.9], atol=0)
    assert (np.diff(y) > 0).all() and y[-1] < 1.4
    assert_allclose(y[-1], 1.4, atol=left)
    assert_allclose(finite_jacobian(curve, 0.9 + 1e-9, 0.9, 1.4)[0, 0], first_slope, atol=1e-6)
    if curve is quartic_limit:
        assert_allclose((y - x).max(), 0.028 * 0.5, rtol=0.02)


def test_without_room_the_quartic_curve_limits_nothing():
    x = jnp.asarray([0.5, 1.0, 3.0])
    assert_allclose(quartic_limit(x, jnp.asarray(1.0), jnp.asarray(1.0)), x, atol=0)


def test_gradients_of_the_quartic_curve_match_finite_differences():
    x, free, limit = np.random.default_rng(0).uniform(0.1, [[3.0], [1.0], [2.0]], (3, ROWS))
    off = np.abs(x - free) > 0.01
    assert_all_gradients_match(quartic_limit, x[off], free[off], free[off] + limit[off])
