"""Robust losses, which limit how far a few bad frames can pull a fit."""

from typing import Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

HUBER = 1.345  # sigmas; 95 % efficient for normal errors (Holland and Welsch 1977)
CAUCHY = 2.385  # sigmas, likewise

Loss = Literal["squares", "huber", "cauchy"]


def apply_loss(residuals: Float[Array, " residuals"], loss: Loss) -> Float[Array, " residuals"]:
    """Residuals whose squares are `rho(residual²)`; derivative 1 at zero and finite everywhere.

    Huber's rho is `z` up to HUBER sigmas and linear in the residual beyond; Cauchy's is
    `c² log(1 + z / c²)`. Both scale the residual, since `sign sqrt(rho)` has no derivative at 0.

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
            z = (residuals / CAUCHY) ** 2
            nonzero = z > jnp.finfo(residuals.dtype).eps  # below it the factor rounds to 1
            safe = jnp.where(nonzero, z, 1)
            return jnp.where(nonzero, residuals * jnp.sqrt(jnp.log1p(safe) / safe), residuals)
        case _:
            raise ValueError(f"loss is {loss!r}, wanted one of {get_args(Loss)}")
