"""The costs of many candidates at once.

Costs are computed with 32-bit floats, side by side in the lanes of vector registers: a quarter of
the time that 64 bits take under `jax.vmap`. They differ by about a millionth of themselves, which
ranks candidates well enough; where one is adopted, a descent computes its cost anew.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.problem.problem import Problem
from fitting.runtime.precision import with_floats
from fitting.runtime.program_cache import cached
from fitting.runtime.threads import on_all_cores
from jaxik import lanes

BATCH = 32  # candidates in one call of a program, which is compiled for this number only
ROUNDING = 1e-5  # relative, of costs: several times what 32-bit floats leave


class Evaluation(NamedTuple):
    """Candidates and their costs."""

    cost: Float[np.ndarray, " candidates"]
    """Of the hard program; infinite where not finite."""
    stepped: Float[np.ndarray, "candidates free"]
    """After a Gauss-Newton step."""
    predicted: Float[np.ndarray, " candidates"]
    """Cost there if the Jacobian held."""


class Slopes(NamedTuple):
    """A Jacobian, as the Gauss-Newton steps of many candidates use it."""

    matrix: Float[Array, "residuals free"]
    """With 32-bit floats."""
    gram: Float[np.ndarray, "free free"]
    """The Jacobian times itself."""

    @classmethod
    def of(cls, jacobian: Float[np.ndarray, "residuals free"]) -> "Slopes":
        """Slopes by a Jacobian, in which a parameter without a slope has a column of zeros."""
        # JAX multiplies: two threads of NumPy's library wait on each other, 0.3 s when busy.
        full = jnp.asarray(jacobian, float)
        return cls(full.astype(jnp.float32), np.asarray(full.T @ full))


@cached
def _evaluate(problem: Problem, candidates: Array) -> tuple[Array, Array]:
    single = with_floats(problem, jnp.float32)
    residuals = lanes(single.residuals)(candidates)
    # Summed with 64 bits: profiles compare costs of a million that differ by less than one.
    return 0.5 * jnp.sum(residuals.astype(float) ** 2, axis=1), residuals


def residuals(
    problem: Problem, candidates: Float[np.ndarray, "candidates free"]
) -> Float[np.ndarray, "candidates residuals"]:
    """Residuals of any number of `u`, of the hard program, with 32-bit floats."""
    (rows,) = _of_batches(lambda filled: _evaluate(problem, filled)[1:], candidates)
    return rows


def _of_batches(
    call: Callable[[Array], Sequence[Array]], candidates: np.ndarray
) -> list[np.ndarray]:
    """What a call gives of all candidates, computed BATCH at a time; 64-bit floats.

    The last batch is filled up, so that there is one program. It runs on one core, so batches share
    the cores out among themselves.
    """
    batches = [candidates[first : first + BATCH] for first in range(0, len(candidates), BATCH)]

    def parts(batch: np.ndarray) -> list[np.ndarray]:
        filled = jnp.asarray(np.resize(batch, (BATCH, batch.shape[1])), jnp.float32)
        return [np.asarray(output, float)[: len(batch)] for output in call(filled)]

    outputs = on_all_cores([partial(parts, batch) for batch in batches])
    return [np.concatenate(output) for output in zip(*outputs, strict=True)]


def evaluate(
    problem: Problem, candidates: Float[np.ndarray, "candidates free"], slopes: Slopes | None = None
) -> Evaluation:
    """Costs of any number of `u`, and where one Gauss-Newton step with these slopes takes them.

    Parameters without a slope, as thresholds are, stay where they are; without slopes all do.
    """

    def call(filled: Array) -> tuple[Array, ...]:
        cost, residuals = _evaluate(problem, filled)
        return (cost,) if slopes is None else (cost, residuals @ slopes.matrix)

    cost, *gradients = _of_batches(call, candidates)
    finite = np.isfinite(cost)
    cost = np.where(finite, cost, np.inf)
    if slopes is None:
        return Evaluation(cost, candidates, cost)
    (gradient,) = gradients
    zero = np.diag(slopes.gram) == 0
    steps = -np.linalg.solve(slopes.gram + np.diag(zero), gradient.T).T
    stepped, predicted = candidates + steps, cost + 0.5 * np.sum(gradient * steps, axis=1)
    return Evaluation(
        cost,
        np.where(np.isfinite(stepped), stepped, candidates),
        np.where(finite, predicted, np.inf),
    )
