"""Many candidates at once: their costs, and the breeding of thresholds from the best of them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.problem.problem import Problem
from fitting.problem.space import EDGE, Space
from fitting.runtime.program_cache import cached

from .state import Point, Search, SearchState

BATCH = 64  # candidates in one call of a vmapped program, which is compiled for this number only


class Evaluation(NamedTuple):
    """Candidates and their costs."""

    cost: Float[np.ndarray, " candidates"]
    """Of the hard program; infinite where not finite."""
    stepped: Float[np.ndarray, "candidates free"]
    """After a Gauss-Newton step."""
    predicted: Float[np.ndarray, " candidates"]
    """Cost there if the Jacobian held."""


def from_values(
    space: Space, values: Float[np.ndarray, "candidates free"]
) -> Float[np.ndarray, "candidates free"]:
    """`u` of candidates that are given by their values."""
    return _in_batches(_from_values, space, values)


def to_values(
    space: Space, candidates: Float[np.ndarray, "candidates free"]
) -> Float[np.ndarray, "candidates free"]:
    """The parameters of candidates in their own units."""
    return _in_batches(_to_values, space, candidates)


def prior_costs(
    space: Space, candidates: Float[np.ndarray, "candidates free"]
) -> Float[np.ndarray, "candidates free"]:
    """The part of the cost that the prior of each parameter contributes."""
    return _in_batches(_prior_costs, space, candidates)


@cached
def _prior_costs(space: Space, candidates: Array) -> Array:
    return 0.5 * jax.vmap(space.prior_residuals)(candidates) ** 2


@cached
def _from_values(space: Space, values: Array) -> Array:
    return jax.vmap(lambda row: space.pack(dict(zip(space.names, row, strict=True))))(values)


@cached
def _to_values(space: Space, candidates: Array) -> Array:
    return jax.vmap(space.values)(candidates)


def _in_batches(
    convert: Callable[[Space, Array], Array], space: Space, rows: np.ndarray
) -> np.ndarray:
    """Converts any number of rows, BATCH at a time, the last batch filled up: one program."""
    parts = []
    for first in range(0, len(rows), BATCH):
        batch = rows[first : first + BATCH]
        filled = jnp.asarray(np.resize(batch, (BATCH, batch.shape[1])), space.u0.dtype)
        parts.append(np.asarray(convert(space, filled))[: len(batch)])
    return np.concatenate(parts)


@cached
def _evaluate(problem: Problem, candidates: Array) -> tuple[Array, Array]:
    residuals = jax.vmap(problem.residuals)(candidates)
    return 0.5 * jnp.sum(residuals**2, axis=1), residuals


def evaluate(
    problem: Problem,
    candidates: Float[np.ndarray, "candidates free"],
    jacobian: Float[np.ndarray, "residuals free"] | None = None,
) -> Evaluation:
    """Costs of any number of `u`, and where one Gauss-Newton step with this Jacobian takes them.

    Parameters whose column is zero, as those of thresholds are, stay where they are; without a
    Jacobian all do. Evaluated BATCH at a time, the last batch filled up, so that there is one
    program.
    """
    dtype = problem.space.u0.dtype
    # JAX multiplies: two threads of NumPy's library wait on each other, 0.3 s on a busy machine.
    matrix = None if jacobian is None else jnp.asarray(jacobian, dtype)
    costs, gradients = [], []
    for first in range(0, len(candidates), BATCH):
        batch = candidates[first : first + BATCH]
        filled = jnp.asarray(np.resize(batch, (BATCH, batch.shape[1])), dtype)
        cost, residuals = _evaluate(problem, filled)
        costs.append(np.asarray(cost)[: len(batch)])
        if matrix is not None:
            gradients.append(np.asarray(residuals @ matrix)[: len(batch)])
    cost = np.concatenate(costs)
    finite = np.isfinite(cost)
    cost = np.where(finite, cost, np.inf)
    if matrix is None:
        return Evaluation(cost, candidates, cost)
    gram = np.asarray(matrix.T @ matrix)
    zero = np.diag(gram) == 0
    gradient = np.concatenate(gradients)
    steps = -np.linalg.solve(gram + np.diag(zero), gradient.T).T
    stepped, predicted = candidates + steps, cost + 0.5 * np.sum(gradient * steps, axis=1)
    return Evaluation(
        cost,
        np.where(np.isfinite(stepped), stepped, candidates),
        np.where(finite, predicted, np.inf),
    )


def vary(
    space: Space,
    parents: Float[np.ndarray, "candidates free"],
    shifts: Float[np.ndarray, "candidates free"],
    redrawn: Bool[np.ndarray, "candidates free"],
    random: np.random.Generator,
) -> Float[np.ndarray, "candidates free"]:
    """`u` with some values shifted and some drawn anew from their range, the others kept.

    Values are kept, not `u`: a threshold that stays above another one would move with it, off the
    plateau it had reached. Shifts are in the log-odds of the fraction of the range; 0 keeps a
    value.
    """
    low, high = np.asarray(space.low), np.asarray(space.high)
    before = to_values(space, parents)
    fraction = np.clip((before - low) / (high - low), EDGE, 1 - EDGE)
    log_odds = np.log(fraction / (1 - fraction)) + shifts
    log_odds[redrawn] = random.logistic(size=int(redrawn.sum()))
    varied = low + (high - low) / (1 + np.exp(-log_odds))
    return from_values(space, np.where((shifts != 0) | redrawn, varied, before))


def breed(search: Search, state: SearchState, spread: float) -> SearchState:
    """The best of some generations bred from the state's point, which has a Jacobian.

    The most promising children of a generation come again after a Gauss-Newton step, since other
    thresholds need other smooth parameters.

    Args:
        search: the problem and the settings.
        state: where the breeding begins.
        spread: standard deviation of the threshold shifts in the first generation, in `u`.
    """
    settings, jacobian = search.settings, state.point.jacobian
    random = state.generator()
    elite, stepped = state.point.u[None], state.point.u[None][:0]
    costs = np.asarray([state.point.cost])
    for generation in range(settings.generations):
        count = settings.population - len(stepped)
        children = _children(
            search, elite, count, spread * settings.generation_decay**generation, random
        )
        children = np.concatenate([stepped, children])
        evaluation = evaluate(search.problem, children, jacobian)
        candidates = np.concatenate([elite, children])
        costs = np.concatenate([costs, evaluation.cost])
        order = np.argsort(costs, kind="stable")[: settings.elite]
        elite, costs = candidates[order], costs[order]
        promising = np.argsort(evaluation.predicted, kind="stable")
        stepped = evaluation.stepped[promising[: settings.gauss_newton_children]]
        state = search.move(state, "blocks", Point(elite[0], float(costs[0])))
    return dataclasses.replace(state, random=random)


def _children(
    search: Search, elite: np.ndarray, count: int, spread: float, random: np.random.Generator
) -> np.ndarray:
    """Children of randomly chosen parents, with some thresholds shifted.

    A fraction of them also have one parameter, of either kind, drawn anew from its range: a clamp
    that is never reached has no derivative, and this frees it.
    """
    thresholds, settings = search.thresholds, search.settings
    parents = elite[random.integers(len(elite), size=count)]
    rate = max(settings.shift_probability, 1 / max(1, thresholds.sum()))
    shifted = (random.random(parents.shape) < rate) & thresholds
    shifts = random.normal(0, spread, parents.shape) * shifted
    redrawn = np.zeros(parents.shape, bool)
    chosen = np.arange(count // settings.redrawn_one_in)
    redrawn[chosen, random.integers(thresholds.size, size=chosen.size)] = True
    return vary(search.problem.space, parents, shifts, redrawn, random)
