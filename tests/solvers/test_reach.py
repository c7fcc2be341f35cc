"""Soft limits: where they start, where they end, and their gradients."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from numpy.testing import assert_allclose

from jaxik.solvers import reach
from support.gradients import assert_gradients_match, finite_jacobian, numbers

few = settings(max_examples=20, derandomize=True, deadline=None)


def test_the_quartic_curve_passes_its_start_and_rises_to_its_limit():
    x = np.linspace(0.0, 50.0, 5001)
    y = np.asarray(reach.quartic_limit(jnp.asarray(x), jnp.asarray(0.9), jnp.asarray(1.4)))
    assert_allclose(y[x <= 0.9], x[x <= 0.9], atol=0)
    assert (np.diff(y) > 0).all() and y[-1] < 1.4
    assert_allclose(y[-1], 1.4, atol=1e-6)
    assert_allclose((y - x).max(), 0.028 * 0.5, rtol=0.02)
    slope = finite_jacobian(reach.quartic_limit, 0.9 + 1e-9, 0.9, 1.4)[0, 0]
    assert_allclose(slope, 4 / 3, atol=1e-6)


def test_without_room_the_quartic_curve_limits_nothing():
    x = jnp.asarray([0.5, 1.0, 3.0])
    assert_allclose(reach.quartic_limit(x, jnp.asarray(1.0), jnp.asarray(1.0)), x, atol=0)


def test_the_exponential_curve_starts_with_slope_one_and_rises_to_its_limit():
    x = np.linspace(0.0, 5.0, 5001)
    y = np.asarray(reach.soft_limit(jnp.asarray(x), jnp.asarray(0.9), jnp.asarray(1.4)))
    assert_allclose(y[x <= 0.9], x[x <= 0.9], atol=0)
    assert (np.diff(y) > 0).all() and y[-1] < 1.4
    assert_allclose(y[-1], 1.4, atol=1e-3)
    slope = finite_jacobian(reach.soft_limit, 0.9 + 1e-9, 0.9, 1.4)[0, 0]
    assert_allclose(slope, 1.0, atol=1e-6)


@few
@given(numbers(0.1, 3.0), numbers(0.1, 1.0), numbers(1.1, 2.0))
def test_gradients_of_the_quartic_curve_match_finite_differences(x, free, limit):
    if abs(x - free) > 0.01:
        assert_gradients_match(reach.quartic_limit, x, free, limit)
