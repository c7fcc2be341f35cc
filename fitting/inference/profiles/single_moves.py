"""Moves that slopes do not show: to other plateaus, along ridges, and across cliffs."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fitting.inference.optimisation import population
from fitting.problem.free_parameters import from_fractions, to_fractions

from .conditional import Conditional, Points, Targets, join
from .curves import Curves

CLOSE = 6.0  # rise of the cost up to which another plateau may matter
GENERATIONS = 2  # of combinations of thresholds
CHILDREN = 64  # in a generation
PLATEAUS = 5  # kept, besides the solution's
SAME_PLATEAU = 0.01  # of the cost
SMALLEST = 0.01  # move of a threshold in a round, a fraction of the largest
SIZES = 6  # of these moves
VARIANTS = 64  # of a point, with other parameters moved
WIDENED = 0.5  # of their intervals, to either side
DEVIATIONS = np.array([-2.0, -1.0, 1.0, 2.0])  # by which smooth parameters move


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
        values = np.repeat(curves.best.values, CHILDREN, axis=0)
        for i in thresholds:
            values[:, i] = random.choice(along[i].values[:, i], CHILDREN)
        evaluated, gradient = conditional.evaluate(space.pack_values(values))
        here = Targets(np.full(len(values), thresholds[0]), values[:, thresholds[0]])
        everything = np.ones(evaluated.u.shape, bool)
        found += [conditional.points(conditional.move(evaluated, gradient, here, everything))]
    together = join(found)
    data_cost = together.cost - space.prior_costs(together.u)[:, thresholds].sum(axis=1)
    order = np.argsort(together.cost, kind="stable")
    order = order[together.cost[order] < curves.best.cost[0] + CLOSE]
    _, first = np.unique(np.round(data_cost[order] / SAME_PLATEAU), return_index=True)
    distinct = order[np.sort(first)][1 : PLATEAUS + 1]  # the first is the solution's own
    ends = conditional.descend_all([(u, None) for u in together.u[distinct]])
    if not ends:
        return together[:0]
    return conditional.points(np.asarray([u for u, _ in ends]))


def settle(
    conditional: Conditional,
    u: Float[np.ndarray, "targets free"],
    targets: Targets,
    spans: Sequence[float],
) -> Float[np.ndarray, "targets free"]:
    """Points at their targets with other parameters moved to where the cost is lowest.

    One parameter moves at a time: a threshold by distances of all sizes, a smooth one by some
    standard deviations. That crosses cliffs, and follows ridges, along which thresholds must move
    together.

    Args:
        conditional: the problem.
        u: points at their targets.
        targets: what stays.
        spans: largest move of a threshold in each round, as fractions of the range; each round
            moves on from the best so far.
    """
    space = conditional.problem.space
    for span in spans:
        base = space.values(u)
        single = [_single_moves(conditional, row, span) for row in u]
        candidates = np.concatenate(single)
        owner = np.repeat(np.arange(len(u)), [len(rows) for rows in single])
        values = space.values(candidates)
        rows = np.arange(len(owner))
        held = targets.index[owner]
        values[rows, held] = base[owner, held]
        candidates = space.pack_values(values)
        cost = population.evaluate(conditional.problem, candidates).cost
        best = [np.flatnonzero(owner == k)[np.argmin(cost[owner == k])] for k in range(len(u))]
        u = candidates[best]
    return u


def vary(conditional: Conditional, curves: Curves, start: Points, held: int) -> Points:
    """A point, and this point with one or two other parameters drawn from widened intervals."""
    space, random = conditional.problem.space, conditional.random
    values = np.repeat(start.values, VARIANTS, axis=0)
    order = np.argsort(random.random(values.shape), axis=1)
    drawn = order < random.integers(1, 3, (VARIANTS, 1))
    drawn[0] = False
    for i, parameter in enumerate(space.parameters):
        own = curves.fractions(i)
        low = own[curves.rises(i) <= curves.highest(i)]
        reach = WIDENED * (low[-1] - low[0])
        places = np.clip(random.uniform(low[0] - reach, low[-1] + reach, VARIANTS), 0, 1)
        chosen = drawn[:, i] & (i != held)
        values[chosen, i] = from_fractions(parameter, places[chosen])
    u = space.pack_values(values)
    return Points(u, values, np.full(VARIANTS, start.cost[0]))


def _single_moves(
    conditional: Conditional, u: Float[np.ndarray, " free"], span: float
) -> Float[np.ndarray, "moves free"]:
    """A point, and this point with one parameter moved."""
    space = conditional.problem.space
    present = space.values(u[None])[0]
    sizes = span * np.geomspace(SMALLEST, 1, SIZES)
    steps = np.concatenate([-sizes, sizes])
    moved_values, moved_u = [present[None]], []
    for j, parameter in enumerate(space.parameters):
        if parameter.kind == "threshold":
            places = np.clip(to_fractions(parameter, present[j]) + steps, 0, 1)
            values = np.tile(present, (len(steps), 1))
            values[:, j] = from_fractions(parameter, places)
            moved_values.append(values)
        else:
            sd = 1 / np.sqrt(conditional.gram[j, j])
            moved_u.append(u + np.outer(sd * DEVIATIONS, np.arange(space.size) == j))
    of_values = space.pack_values(np.concatenate(moved_values))
    return np.concatenate([of_values, *moved_u])
