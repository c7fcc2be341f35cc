"""Thresholds for the profiles to begin with: other plateaus, and moves that follow a ridge."""

import numpy as np
from jaxtyping import Float

from fitting.inference.optimisation import population
from fitting.problem.space import from_fractions, to_fractions

from .conditional import Conditional, Points, Targets, join
from .curves import Curves

CLOSE = 6.0  # rise of the cost up to which another plateau may matter
GENERATIONS = 2  # of combinations of thresholds
PLATEAUS = 5  # kept, besides the solution's
SAME_PLATEAU = 0.01  # of the cost
SPANS = (1.0, 0.2, 0.04)  # of the moves in each round of `settle`, fractions of the range
SMALLEST = 0.01  # move in a round, a fraction of the largest


def other_plateaus(conditional: Conditional, curves: Curves, seed: int = 0) -> Points:
    """The best points on other plateaus of the thresholds, near in cost to the solution.

    The thresholds of children are drawn from those along the thresholds' curves, independently of
    each other; what the curves say of single thresholds is so tried together.
    """
    space = conditional.problem.space
    thresholds = [int(i) for i in np.flatnonzero(space.thresholds)]
    random = np.random.default_rng(seed)
    along = {i: curves.curves[i][curves.rises(i) < CLOSE] for i in thresholds}
    found = [along[i] for i in thresholds]
    for _ in range(GENERATIONS if len(thresholds) > 1 else 0):
        values = np.repeat(curves.best.values, population.BATCH, axis=0)
        for i in thresholds:
            values[:, i] = random.choice(along[i].values[:, i], population.BATCH)
        evaluation = population.evaluate(
            conditional.problem, population.from_values(space, values), conditional.jacobian
        )
        found += [conditional.points(evaluation.stepped)]
    together = join(found)
    data_cost = together.cost - population.prior_costs(space, together.u)[:, thresholds].sum(axis=1)
    order = np.argsort(together.cost, kind="stable")
    order = order[together.cost[order] < curves.best.cost[0] + CLOSE]
    _, first = np.unique(np.round(data_cost[order] / SAME_PLATEAU), return_index=True)
    distinct = order[np.sort(first)][1 : PLATEAUS + 1]  # the first is the solution's own
    ends = [conditional.descend(u, None) for u in together.u[distinct]]
    if not ends:
        return together[:0]
    return conditional.points(np.asarray([u for u, _ in ends]))


def settle(
    conditional: Conditional, u: Float[np.ndarray, "targets free"], targets: Targets
) -> Float[np.ndarray, "targets free"]:
    """Points at their targets with the other thresholds moved to where the cost is lowest.

    One threshold moves at a time, by distances of all sizes; each round tries smaller ones around
    the best so far. That follows ridges, along which thresholds must move together.
    """
    space = conditional.problem.space
    thresholds = np.flatnonzero(space.thresholds)
    each = (population.BATCH - 1) // max(1, len(thresholds) - 1) // 2
    for span in SPANS:
        sizes = span * np.geomspace(SMALLEST, 1, each)
        steps = np.concatenate([-sizes, sizes])
        values, owner = [], []
        for row, (held, base) in enumerate(
            zip(targets.index, population.to_values(space, u), strict=True)
        ):
            values.append(base[None])
            for j in thresholds[thresholds != held]:
                parameter = space.parameters[j]
                places = np.clip(to_fractions(parameter, base[j]) + steps, 0, 1)
                moved = np.tile(base, (len(steps), 1))
                moved[:, j] = from_fractions(parameter, places)
                values.append(moved)
            owner += [row] * (sum(map(len, values)) - len(owner))
        candidates = population.from_values(space, np.concatenate(values))
        cost = population.evaluate(conditional.problem, candidates).cost
        rows = np.asarray(owner)
        best = [np.flatnonzero(rows == row)[np.argmin(cost[rows == row])] for row in range(len(u))]
        u = candidates[best]
    return u
