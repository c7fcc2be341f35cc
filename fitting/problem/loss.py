"""Losses. All but the squares limit how far a few bad frames can pull a fit."""

from typing import Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

HUBER = 1.345  # sigmas; 95 % efficient for normal errors (Holland and Welsch 1977)
CAUCHY = 2.385  # sigmas, likewise

TAILS = 4.0  # degrees of freedom of Student's t, where none are estimated

Loss = Literal["squares", "huber", "cauchy", "student"]


def apply_loss(
    residuals: Float[Array, " residuals"], loss: Loss, tails: Float[Array, ""] | float = TAILS
) -> Float[Array, " residuals"]:
    """Residuals whose squares are `rho(residual²)`; derivatives are finite everywhere.

    Huber's rho is `z` up to HUBER sigmas and linear in the residual beyond; Cauchy's is
    `c² log(1 + z / c²)`; Student's is minus twice the log-density of the t distribution, up to a
    constant, `(nu + 1) log(1 + z / nu)`. All scale the residual, since `sign sqrt(rho)` has no
    derivative at 0. There, the derivative is 1, and Student's `sqrt((nu + 1) / nu)`.

    Args:
        residuals: in sigmas.
        loss: its name.
        tails: Student's degrees of freedom, nu.

    Raises:
        ValueError: for an unknown loss.
    """
    match loss:
        case "squares":
            return residuals
        case "huber":
            size = jnp.abs(residuals)
            outside = size > HUBER
            safe = jnp.where(outside, size, HUBER)
            scaled = jnp.sign(residuals) * jnp.sqrt(HUBER * (2 * safe - HUBER))
            return jnp.where(outside, scaled, residuals)
        case "cauchy":
            return _logarithmic(residuals, jnp.asarray(CAUCHY**2, residuals.dtype))
        case "student":
            nu = jnp.asarray(tails, residuals.dtype)
            return jnp.sqrt((nu + 1) / nu) * _logarithmic(residuals, nu)
        case _:
            raise ValueError(f"loss is {loss!r}, wanted one of {get_args(Loss)}")


def _logarithmic(
    residuals: Float[Array, " residuals"], c_squared: Float[Array, ""]
) -> Float[Array, " residuals"]:
    """Residuals whose squares are `c² log(1 + residual² / c²)`."""
    z = residuals**2 / c_squared
    nonzero = z > jnp.finfo(residuals.dtype).eps  # below it the factor rounds to 1
    safe = jnp.where(nonzero, z, 1)
    return jnp.where(nonzero, residuals * jnp.sqrt(jnp.log1p(safe) / safe), residuals)
