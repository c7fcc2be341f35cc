"""How probable the prior makes values of the parameters, in their own units."""

import numpy as np
from jaxtyping import Float

from fitting.runtime.precision import in_float64

from .space import Space

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
        rows = np.asarray(space.values(draws))
        table = np.repeat(rows[:, None], len(values), axis=1)
        table[..., i] = values[:, i]
        mixed = _probability(space, table.reshape(-1, space.size))[:, i]
        probability[:, i] = mixed.reshape(MIXTURE, -1).mean(axis=0)
    return probability


def _probability(space: Space, rows: np.ndarray) -> np.ndarray:
    """Of the last moved parameter given the others of its row, (rows, free)."""
    u = space.pack_values(rows)
    below, above = rows <= np.asarray(space.low), rows >= np.asarray(space.high)
    return np.where(below, 0.0, np.where(above, 1.0, space.prior.cumulative(u)))
