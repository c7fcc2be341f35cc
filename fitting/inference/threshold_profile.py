"""The cost over the range of one threshold, and the interval that follows from it.

A cost of plateaus and cliffs has an interval, and no standard deviation.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from fitting.problem.problem import Problem
from fitting.runtime.precision import in_float64

from .optimisation import population
from .optimisation.solution import Solution

MAX_RISE = 1.92  # of the cost within a 95 % interval (chi-square of one parameter, halved)
NUDGE = 0.1  # fraction of the range by which a threshold is moved to see what changes
REFINEMENTS = 2  # of the grid, where the interval ends
FOLLOWING_STEPS = 2  # Gauss-Newton steps by which the smooth parameters follow


@dataclasses.dataclass(frozen=True)
class Profile:
    """Cost over one threshold, the smooth parameters following."""

    values: Float[np.ndarray, " points"]
    """In the parameter's unit, rising."""
    rises: Float[np.ndarray, " points"]
    """Of the cost, above the solution's."""
    interval: tuple[float, float]
    """95 %: where the rise above the minimum stays below 1.92."""
    nudged: tuple[float, float]
    """Rise if it alone moves down or up by a tenth of its range."""


@in_float64
def profile(problem: Problem, solution: Solution, name: str) -> Profile:
    """Cost over the range of one threshold, the other thresholds keeping their values.

    The smooth parameters follow by two Gauss-Newton steps with the Jacobian at the solution. The
    grid covers the whole range, then what is around the ends of the interval again and finer. The
    interval reaches to the first point outside, since a cliff may lie anywhere between two points.

    Raises:
        ValueError: for a name that is not free.
    """
    space = problem.space
    if name not in space.names:
        raise ValueError(f"not free: {name!r}; free are {list(space.names)}")
    i = space.names.index(name)
    low, high = float(space.low[i]), float(space.high[i])
    present = float(solution.values[i])
    values = np.sort(np.append(np.linspace(low, high, population.BATCH - 1), present))
    rises = _rises(problem, solution, i, values, FOLLOWING_STEPS)
    for _ in range(REFINEMENTS):
        finer = np.concatenate(
            [np.linspace(*ends, population.BATCH // 2) for ends in _ends(values, rises)]
        )
        finer_rises = _rises(problem, solution, i, finer, FOLLOWING_STEPS)
        values, order = np.unique(np.concatenate([values, finer]), return_index=True)
        rises = np.concatenate([rises, finer_rises])[order]
    (outside_low, _), (_, outside_high) = _ends(values, rises)
    sides = np.clip([present - NUDGE * (high - low), present + NUDGE * (high - low)], low, high)
    down, up = _rises(problem, solution, i, sides, 0)
    return Profile(values, rises, (outside_low, outside_high), (float(down), float(up)))


def _ends(values: np.ndarray, rises: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """The two steps of the grid in which the interval begins and ends, each from low to high."""
    inside = np.flatnonzero(rises <= rises.min() + MAX_RISE)
    first, last = inside[0], inside[-1]
    before, after = max(first - 1, 0), min(last + 1, len(values) - 1)
    return (
        (float(values[before]), float(values[first])),
        (float(values[last]), float(values[after])),
    )


def _rises(
    problem: Problem, solution: Solution, i: int, values: np.ndarray, following_steps: int
) -> np.ndarray:
    """Cost above the solution's for each value of the i-th parameter, the other values kept."""
    table = np.tile(solution.values, (len(values), 1))
    table[:, i] = values
    candidates = population.from_values(problem.space, table)
    cost = np.full(len(values), np.inf)
    for _ in range(1 + following_steps):
        evaluation = population.evaluate(problem, candidates, solution.jacobian)
        cost = np.minimum(cost, evaluation.cost)
        candidates = evaluation.stepped
    return cost - solution.cost
