"""Many candidates at once: what they cost, and where they would go."""

import itertools
from collections.abc import Callable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.problem.problem import Problem
from fitting.problem.space import EDGE, Space
from fitting.runtime.program_cache import cached

POPULATION = 64  # candidates in one vmapped call
SWEEP = 6  # values of one parameter, spread over its range
TRIES = 2  # sweeps in a row that find nothing and end a search
GOLDEN = (5**0.5 - 1) / 2


class Population(eqx.Module):
    """Many `u` evaluated at once."""

    cost: Float[np.ndarray, " population"]  # hard; infinite where a row is not finite
    moved: Float[np.ndarray, "population free"]  # after one Gauss-Newton step of smooth columns
    promised: Float[np.ndarray, " population"]  # cost there if the given slopes held


def from_values(
    space: Space, values: Float[np.ndarray, "candidates free"]
) -> Float[np.ndarray, "candidates free"]:
    """`u` of many rows of values."""
    return _in_parts(_from_values, space, values)


@cached
def _from_values(space: Space, values: Array) -> Array:
    return jax.vmap(lambda row: space.pack(dict(zip(space.names, row, strict=True))))(values)


@cached
def _values_of(space: Space, candidates: Array) -> Array:
    return jax.vmap(space.values)(candidates)


def _in_parts(
    convert: Callable[[Space, Array], Array], space: Space, rows: np.ndarray
) -> np.ndarray:
    """Any number of rows converted, POPULATION at a time, the last part filled up: one program."""
    parts = []
    for first in range(0, len(rows), POPULATION):
        some = rows[first : first + POPULATION]
        filled = jnp.asarray(np.resize(some, (POPULATION, some.shape[1])), space.u0.dtype)
        parts.append(np.asarray(convert(space, filled))[: len(some)])
    return np.concatenate(parts)


@cached
def _evaluate(problem: Problem, candidates: Array) -> tuple[Array, Array]:
    rows = jax.vmap(problem.residuals)(candidates)
    return 0.5 * jnp.sum(rows**2, axis=1), rows


def evaluate(
    problem: Problem,
    candidates: Float[np.ndarray, "candidates free"],
    slopes: Float[np.ndarray, "rows free"] | None = None,
) -> Population:
    """Costs of any number of `u`, and where one Gauss-Newton step of these slopes takes them.

    Evaluated POPULATION at a time, the last call filled up, so that there is one program. Without
    slopes nothing moves.
    """
    dtype = problem.space.u0.dtype
    # JAX multiplies: two threads of NumPy's library wait on each other, 0.3 s on a busy machine.
    steep = None if slopes is None else jnp.asarray(slopes, dtype)
    costs, pulls = [], []
    for first in range(0, len(candidates), POPULATION):
        some = candidates[first : first + POPULATION]
        filled = jnp.asarray(np.resize(some, (POPULATION, some.shape[1])), dtype)
        cost, rows = _evaluate(problem, filled)
        costs.append(np.asarray(cost)[: len(some)])
        if steep is not None:
            pulls.append(np.asarray(rows @ steep)[: len(some)])
    cost = np.concatenate(costs)
    finite = np.isfinite(cost)
    cost = np.where(finite, cost, np.inf)
    if steep is None:
        return Population(cost, candidates, cost)
    gram = np.asarray(steep.T @ steep)
    empty = np.diag(gram) == 0  # such a column does not move
    pull = np.concatenate(pulls)
    steps = -np.linalg.solve(gram + np.diag(empty), pull.T).T
    moved, promised = candidates + steps, cost + 0.5 * np.sum(pull * steps, axis=1)
    return Population(
        cost,
        np.where(np.isfinite(moved), moved, candidates),
        np.where(finite, promised, np.inf),
    )


def vary(
    space: Space,
    parents: Float[np.ndarray, "candidates free"],
    shifts: Float[np.ndarray, "candidates free"],
    renewed: Bool[np.ndarray, "candidates free"],
    random: np.random.Generator,
) -> Float[np.ndarray, "candidates free"]:
    """`u` with some values shifted and some drawn anew from their range, the others being kept.

    Values and not `u` are kept: a threshold above another one would move with it, off the plateau
    that it had found. Shifts are in the log-odds of the share of the range; 0 keeps a value.
    """
    low, high = np.asarray(space.low), np.asarray(space.high)
    before = _in_parts(_values_of, space, parents)
    share = np.clip((before - low) / (high - low), EDGE, 1 - EDGE)
    odds = np.log(share / (1 - share)) + shifts
    odds[renewed] = random.logistic(size=int(renewed.sum()))
    varied = low + (high - low) / (1 + np.exp(-odds))
    values = np.where((shifts != 0) | renewed, varied, before)
    return from_values(space, values)


def offsets() -> Iterator[float]:
    """Where the values of sweeps lie, one sweep's between all those of the sweeps before it."""
    return ((0.5 + GOLDEN * number) % 1.0 for number in itertools.count())


def sweep(
    problem: Problem,
    u: Float[np.ndarray, " free"],
    cost: float,
    gain: float,
    places: Iterator[float],
) -> tuple[np.ndarray, float] | None:
    """A `u`, and its cost, with some parameters carried elsewhere in their range.

    The first of TRIES sweeps that lowers the cost by `gain` of itself; None where none does.
    """
    for offset in itertools.islice(places, TRIES):
        carried, lower = _swept(problem, u, (np.arange(SWEEP) + offset) / SWEEP)
        if lower <= cost * (1 - gain):
            return carried, lower
    return None


def _swept(
    problem: Problem, u: Float[np.ndarray, " free"], shares: Float[np.ndarray, " values"]
) -> tuple[np.ndarray, float]:
    """The best `u`, and its cost, that these shares of the parameters' ranges make.

    Each parameter in turn takes all the values, the others keeping theirs; then the best of each
    are taken over together, as many of them, the best first, as make the lowest cost.
    """
    space = problem.space
    size = space.size
    odds = np.tile(np.log(shares / (1 - shares))[:, None], size)
    at, *grid = _in_parts(_values_of, space, np.concatenate([u[None], odds]))
    grid = np.asarray(grid)
    alone = np.tile(at, (size, len(shares), 1))
    for i in range(size):
        alone[i, :, i] = grid[:, i]
    candidates = from_values(space, alone.reshape(-1, size))
    costs = evaluate(problem, candidates).cost.reshape(size, -1)

    together = np.tile(at, (size, 1))
    for rank, i in enumerate(np.argsort(costs.min(axis=1), kind="stable")):
        together[rank:, i] = grid[np.argmin(costs[i]), i]
    joined = from_values(space, together)
    every = np.concatenate([candidates, joined])
    costs = np.concatenate([costs.ravel(), evaluate(problem, joined).cost])
    best = int(np.argmin(costs))
    return every[best], float(costs[best])
