"""How probable the prior makes values of the parameters, in their own units."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached

from .space import Space, values_of_rows

MIXTURE = 200  # draws of the others, where a parameter stays above another free one


@in_float64
def prior_probability(
    space: Space, values: Float[np.ndarray, "points free"]
) -> Float[np.ndarray, "points free"]:
    """The probability, by the prior alone, that each parameter is at most each of these values.

    Exact, except for a parameter that stays above another free one: the mean over draws of that
    one. Values outside the bounds have probability 0 or 1.
    """
    probability = _probability(space, values)
    for i in space.dependent:
        draws = space.prior.draw(np.random.default_rng(0), MIXTURE)
        rows = np.asarray(values_of_rows(space, jnp.asarray(draws, space.start.dtype)))
        table = np.repeat(rows[:, None], len(values), axis=1)
        table[..., i] = values[:, i]
        mixed = _probability(space, table.reshape(-1, space.size))[:, i]
        probability[:, i] = mixed.reshape(MIXTURE, -1).mean(axis=0)
    return probability


def _probability(space: Space, rows: np.ndarray) -> np.ndarray:
    """Of the last moved parameter given the others of its row, (rows, free)."""
    u = np.asarray(_u(space, jnp.asarray(rows, space.start.dtype)))
    below, above = rows <= np.asarray(space.low), rows >= np.asarray(space.high)
    return np.where(below, 0.0, np.where(above, 1.0, space.prior.cumulative(u)))


@cached
def _u(space: Space, rows: Array) -> Array:
    return jax.vmap(lambda row: space.pack(dict(zip(space.names, row, strict=True))))(rows)
