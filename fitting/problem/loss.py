"""Losses that a few wrong frames cannot pull far."""

from typing import Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

HUBER = 1.345  # sigmas, 95 % efficient at the normal (Holland and Welsch 1977)
CAUCHY = 2.385  # sigmas, likewise

Loss = Literal["squares", "huber", "cauchy"]


def apply_loss(rows: Float[Array, " rows"], loss: Loss) -> Float[Array, " rows"]:
    """Rows whose squares are `rho(row²)`; slope 1 at zero and finite everywhere.

    Huber's rho is `z` up to HUBER sigmas and linear in the residual beyond; Cauchy's is
    `c² log(1 + z / c²)`. Written as a factor on the row: `sign sqrt(rho)` has no slope at 0.
    """
    match loss:
        case "squares":
            return rows
        case "huber":
            size = jnp.abs(rows)
            beyond = size > HUBER
            far = jnp.where(beyond, size, HUBER)
            return jnp.where(beyond, jnp.sign(rows) * jnp.sqrt(HUBER * (2 * far - HUBER)), rows)
        case "cauchy":
            z = (rows / CAUCHY) ** 2
            known = z > jnp.finfo(rows.dtype).eps  # below it the factor is 1 to the last digit
            safe = jnp.where(known, z, 1)
            return jnp.where(known, rows * jnp.sqrt(jnp.log1p(safe) / safe), rows)
        case _:
            raise ValueError(f"loss is {loss!r}, wanted one of {get_args(Loss)}")
