"""Sweeps: each parameter carried over its whole range, to leave the valleys of single parameters.

A clamp that is never reached has no derivative to follow, and neither has a threshold.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from fitting.problem.problem import Problem

from .descent import descend
from .population import evaluate
from .state import Point, Search, SearchState

GOLDEN = (5**0.5 - 1) / 2


def sweep_and_descend(search: Search, state: SearchState, max_sweeps: int) -> SearchState:
    """Sweeps, each followed by a short descent, until one brings no sufficient gain."""
    for _ in range(max_sweeps):
        before = state.point
        state = sweep(search, state)
        if state.point is before:
            break
        state = descend(search, state, "sweep")
    return state


def sweep(search: Search, state: SearchState) -> SearchState:
    """The state at a point with some parameters carried elsewhere, or where it was.

    The first of `sweep_tries` sweeps whose gain is at least `min_sweep_gain` counts.
    """
    settings, point = search.settings, state.point
    for _ in range(settings.sweep_tries):
        fractions = (
            np.arange(settings.sweep_values) + offset(state.sweeps)
        ) / settings.sweep_values
        state = dataclasses.replace(state, sweeps=state.sweeps + 1)
        swept = best_of_sweep(search.problem, point.u, fractions)
        if swept.cost <= point.cost * (1 - settings.min_sweep_gain):
            return search.jump(state, "sweep", swept)
    return state


def offset(number: int) -> float:
    """Where the values of a sweep lie, 0..1 between those of a plain grid.

    Each sweep lies in the widest gap that the sweeps before it have left.
    """
    return (0.5 + GOLDEN * number) % 1.0


def best_of_sweep(
    problem: Problem, u: Float[np.ndarray, " free"], fractions: Float[np.ndarray, " values"]
) -> Point:
    """The best point when parameters take their values at these fractions of their ranges.

    Each parameter in turn takes all the values while the others keep theirs. Then the best values
    of the parameters are combined, best parameter first, as many of them as lower the cost most.
    """
    space = problem.space
    log_odds = np.tile(np.log(fractions / (1 - fractions))[:, None], space.size)
    start, *grid = space.values(np.concatenate([u[None], log_odds]))
    grid = np.asarray(grid)
    alone = np.tile(start, (space.size, len(fractions), 1))
    for i in range(space.size):
        alone[i, :, i] = grid[:, i]
    candidates = space.pack_values(alone.reshape(-1, space.size))
    costs = evaluate(problem, candidates).cost.reshape(space.size, -1)

    combined = np.tile(start, (space.size, 1))
    for rank, i in enumerate(np.argsort(costs.min(axis=1), kind="stable")):
        combined[rank:, i] = grid[np.argmin(costs[i]), i]
    together = space.pack_values(combined)
    candidates = np.concatenate([candidates, together])
    costs = np.concatenate([costs.ravel(), evaluate(problem, together).cost])
    best = int(np.argmin(costs))
    return Point(candidates[best], float(costs[best]))
