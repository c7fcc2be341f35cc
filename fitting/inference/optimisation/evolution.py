"""Evolution: a population that crosses the cliffs and the valleys where descents end.

A hard decision makes the cost jump wherever it flips, whether a threshold or a smooth parameter
flipped it. Candidates therefore vary all parameters, each in one or more of four ways:

crossover  some values of another candidate, which may have got them right
shift      thresholds a little or a lot further, on the scale of their ranges
redrawn    one or two values from anywhere in their ranges
jitter     one or two smooth parameters, up to 30 times as far as the data leave them uncertain, the
           others following so that the cost rises least

The most promising come again after a Gauss-Newton step, since other decisions need other smooth
parameters. After some generations the best one descends; rounds of both go on while they gain.
"""

import dataclasses
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from fitting.problem.space import EDGE, Space

from .descent import descend, jacobian_at
from .population import ROUNDING, Slopes, evaluate
from .state import Elite, Point, Search, SearchState

CROSSED = 0.6  # fraction of the candidates
CROSSED_VALUES = (0.1, 0.3, 0.5)  # fraction of their values that come from the other candidate
SHIFTED = 0.5
SHIFTED_VALUES = 0.3  # of their thresholds; on average at least one
SHIFTS = (-1.5, 0.2)  # of log10, spreads of the shifts in log-odds of the range
REDRAWN = 0.33  # for each of two values
JITTERED = 0.4
JITTERS = (0.3, 1.0, 3.0, 10.0, 30.0)  # standard deviations of Laplace's approximation
PARENT_RANK = 0.35  # probability that the best is the parent; of the rest, that the next one is

Candidates = Float[np.ndarray, "_ free"]


def evolve(search: Search, state: SearchState, ends: list[Point]) -> SearchState:
    """The state at the best point that evolution reaches from the ends of several descents.

    Args:
        search: the problem and the settings.
        state: at the best of the ends.
        ends: points with costs and Jacobians; their values stay available to later generations.
    """
    settings = search.settings
    donors = np.stack([end.u for end in ends])
    elite = Elite.best_of(donors, np.array([end.cost for end in ends]), settings.elite)
    state = dataclasses.replace(state, elite=elite)
    idle = 0
    for _ in range(settings.max_rounds):
        before = state
        state = search.run("evolution", before, partial(_round, search, before, donors))
        gain = before.point.cost - state.point.cost
        idle = 0 if gain > settings.min_round_gain else idle + 1
        if idle >= settings.patience:
            break
    return dataclasses.replace(state, elite=None)


def _round(search: Search, state: SearchState, donors: Candidates) -> SearchState:
    """The state after some generations and a descent of the best candidate, if it is new."""
    before, size = state.point, search.settings.elite
    state, elite = _breed(search, state, donors)
    if elite.cost[0] < before.cost * (1 - ROUNDING):
        state = dataclasses.replace(state, point=Point(elite.u[0]))
        state = descend(search, state, "evolution")
        if state.point.cost > before.cost:  # the two precisions do not agree
            state = dataclasses.replace(state, point=before)
    else:
        state = search.report(state, "evolution", before.cost)
    end = state.point
    return dataclasses.replace(state, elite=elite.joined(end.u[None], np.array([end.cost]), size))


def _breed(search: Search, state: SearchState, donors: Candidates) -> tuple[SearchState, Elite]:
    """The elite after some generations, bred around the state's point."""
    settings, jacobian = search.settings, jacobian_at(search, state.point)
    assert state.elite is not None
    elite, random = state.elite, state.generator()
    slopes, uncertainty = Slopes.of(jacobian), _uncertainty(search, jacobian)
    stepped = np.empty((0, donors.shape[1]))
    for _ in range(settings.generations):
        count = settings.population - len(stepped)
        children = _children(search, elite, donors, count, uncertainty, random)
        candidates = np.concatenate([stepped, children])
        evaluation = evaluate(search.problem, candidates, slopes)
        elite = elite.joined(candidates, evaluation.cost, settings.elite)
        promising = np.argsort(evaluation.predicted, kind="stable")
        stepped = evaluation.stepped[promising[: settings.gauss_newton_children]]
    return dataclasses.replace(state, random=random), elite


def _uncertainty(search: Search, jacobian: np.ndarray) -> Float[np.ndarray, "smooth smooth"]:
    """How the smooth parameters move when one of them, a row each, moves by a standard deviation.

    By Laplace's approximation, thresholds held: along these directions the cost rises least.
    """
    smooth = np.asarray(jacobian, float)[:, ~search.thresholds]
    covariance = np.linalg.inv(smooth.T @ smooth)  # the prior's rows are in it
    return covariance / np.sqrt(np.diag(covariance))[:, None]


def _children(
    search: Search,
    elite: Elite,
    donors: Candidates,
    count: int,
    uncertainty: np.ndarray,
    random: np.random.Generator,
) -> Candidates:
    """Variations of the elite, better parents more often."""
    space, thresholds = search.problem.space, search.thresholds
    shape = (count, space.size)
    parents = np.minimum(random.geometric(PARENT_RANK, count) - 1, len(elite.u) - 1)
    values = space.values(np.concatenate([elite.u, donors]))
    crossed = random.random(shape) < random.choice(CROSSED_VALUES, (count, 1))
    crossed &= random.random((count, 1)) < CROSSED
    others = random.integers(len(values), size=count)
    child_values = np.where(crossed, values[others], values[parents])

    rate = max(SHIFTED_VALUES, 1 / max(1, thresholds.sum()))
    shifted = (random.random(shape) < rate) & thresholds & (random.random((count, 1)) < SHIFTED)
    spreads = 10 ** random.uniform(*SHIFTS, (count, 1))
    redrawn = np.zeros(shape, bool)
    for _ in range(2):
        chosen = np.flatnonzero(random.random(count) < REDRAWN)
        redrawn[chosen, random.integers(space.size, size=chosen.size)] = True
    shifts = shifted * spreads * random.normal(size=shape)
    children = vary(space, child_values, shifts, redrawn, random)

    jittered = np.flatnonzero(random.random(count) < JITTERED)
    if uncertainty.size:
        directions = random.random((len(jittered), len(uncertainty))) < 1.5 / len(uncertainty)
        moves = (directions * random.normal(size=directions.shape)) @ uncertainty
        moves *= random.choice(JITTERS, (len(jittered), 1))
        children[np.ix_(jittered, ~thresholds)] += moves
    return children


def vary(
    space: Space,
    values: Candidates,
    shifts: Candidates,
    redrawn: Bool[np.ndarray, "candidates free"],
    random: np.random.Generator,
) -> Candidates:
    """`u` of values of which some are shifted and some drawn anew from their range.

    Values are kept, not `u`: a threshold that stays above another one would move with it, off the
    plateau it had reached. Shifts are in the log-odds of the fraction of the range; 0 keeps a
    value.
    """
    low, high = np.asarray(space.low), np.asarray(space.high)
    fraction = np.clip((values - low) / (high - low), EDGE, 1 - EDGE)
    log_odds = np.log(fraction / (1 - fraction)) + shifts
    log_odds[redrawn] = random.logistic(size=int(redrawn.sum()))
    varied = low + (high - low) / (1 + np.exp(-log_odds))
    return space.pack_values(np.where((shifts != 0) | redrawn, varied, values))
