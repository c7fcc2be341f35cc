"""Evolution and sweeps, which cross the cliffs and leave the minima where descents end.

A hard decision makes the cost jump wherever it flips, whether a threshold or a smooth parameter
flipped it. Candidates therefore vary all parameters, each in one or more of four ways:

crossover  some values of another candidate, which may have got them right
shift      thresholds a little or a lot further, on the scale of their ranges
redrawn    one or two values from anywhere in their ranges
jitter     one or two smooth parameters, up to 30 times as far as the data leave them uncertain, the
           others following so that the cost rises least

The most promising come again after a Gauss-Newton step, since other decisions need other smooth
parameters. After some generations the best one descends; rounds of both go on while they gain.

Costs of candidates are computed with 32-bit floats, side by side in the lanes of vector registers:
a quarter of the time that 64 bits take under `jax.vmap`. They differ by about a millionth of
themselves, which ranks candidates; where one is adopted, a descent computes its cost anew.

A sweep carries each parameter over its whole range: a clamp that is never reached has no derivative
to follow, and neither has a threshold.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.problem.problem import Problem
from fitting.problem.space import EDGE, Space
from fitting.runtime.precision import with_floats
from fitting.runtime.program_cache import cached
from fitting.runtime.threads import on_all_cores
from jaxik import lanes

from .descent import descend, jacobian_at
from .solution import Elite, Point, Search, SearchState

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

BATCH = 32  # candidates in one call of a program, which is compiled for this number only
ROUNDING = 1e-5  # relative, of costs: several times what 32-bit floats leave

GOLDEN = (5**0.5 - 1) / 2


def evolve(search: Search, state: SearchState, ends: list[Point]) -> SearchState:
    """The state at the best point that evolution reaches from the ends of several descents.

    The state is at the best of the ends, whose values stay available to later generations.
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

    Values stay, not `u`: a threshold that stays above another one would move with it, off the
    plateau it had reached. Shifts are in the log-odds of the fraction of the range.
    """
    low, high = np.asarray(space.low), np.asarray(space.high)
    fraction = np.clip((values - low) / (high - low), EDGE, 1 - EDGE)
    log_odds = np.log(fraction / (1 - fraction)) + shifts
    log_odds[redrawn] = random.logistic(size=int(redrawn.sum()))
    varied = low + (high - low) / (1 + np.exp(-log_odds))
    return space.pack_values(np.where((shifts != 0) | redrawn, varied, values))


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
    """The outputs of a call for all candidates, computed BATCH at a time; 64-bit floats.

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
        if slopes is None:
            return (cost,)
        # In full precision: a GPU would round to fewer bits.
        return cost, jnp.matmul(residuals, slopes.matrix, precision=jax.lax.Precision.HIGHEST)

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

    Each parameter in turn goes through all values while the others stay. Then the best values
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
