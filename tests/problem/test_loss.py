"""Losses: against their formulas, and their slopes against derivatives."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.problem.loss import (
    CAUCHY,
    HUBER,
    TAILS,
    _factor_and_slope,
    apply_loss,
    rho,
    slope_of_rho,
)

LOSSES = {
    "squares": lambda z: z,
    "huber": lambda z: np.where(z > HUBER**2, 2 * HUBER * np.sqrt(z) - HUBER**2, z),
    "cauchy": lambda z: CAUCHY**2 * np.log1p(z / CAUCHY**2),
    "student": lambda z: (TAILS + 1) * np.log1p(z / TAILS),
}
RESIDUALS = jnp.asarray(
    [0.0, 1e-200, 1e-30, 1e-9, 1e-3, 0.5, 1.0, 1.345, 3.0, 1e3, 1e9, -1e-9, -2.0]
)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_square_of_a_robust_residual_is_the_loss(loss):
    robust = apply_loss(RESIDUALS, loss)
    np.testing.assert_allclose(robust**2, LOSSES[loss](np.asarray(RESIDUALS) ** 2), rtol=1e-9)
    np.testing.assert_array_equal(jnp.sign(robust), jnp.sign(RESIDUALS))


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_are_the_slopes_of_the_loss_with_either_library(loss):
    squares = np.asarray(RESIDUALS)[3:] ** 2
    slopes = jax.vmap(jax.grad(lambda z: rho(z, loss)))(jnp.asarray(squares))
    np.testing.assert_allclose(slope_of_rho(squares, loss, library=np), slopes, rtol=1e-9)
    np.testing.assert_allclose(rho(squares, loss, library=np), LOSSES[loss](squares), rtol=1e-9)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_derivative_of_a_robust_residual_at_zero_is_known_and_finite_everywhere(loss, dtype):
    residuals = RESIDUALS.astype(dtype)
    derivative = jax.grad(lambda residual: apply_loss(residual[None], loss)[0])
    derivatives = jax.vmap(derivative)(residuals)
    assert derivatives.dtype == dtype
    assert jnp.isfinite(derivatives).all()
    steepest = np.sqrt((TAILS + 1) / TAILS) if loss == "student" else 1
    np.testing.assert_allclose(derivatives[:4], steepest, rtol=1e-6)


def test_an_unknown_loss_is_refused():
    with pytest.raises(ValueError, match="loss is 'absolute', wanted one of"):
        # before any check of types
        inspect.unwrap(_factor_and_slope)(RESIDUALS**2, "absolute", TAILS, jnp)
