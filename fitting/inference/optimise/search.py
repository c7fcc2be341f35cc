"""The search for the best fit: derivatives where there are some, candidates where there are none.

The pipeline stays hard, and its cost has many local minima. Each start is independent of others:

1. The costs of some draws from the prior are computed; the best few descend by Levenberg–Marquardt
   (`descent`), with a `sweep` of each parameter over its range in between, which frees those that a
   clamp leaves without a derivative.
2. Where their ends do not agree, `evolution` combines and varies them, thresholds included.
3. The best point descends to the end (`descent.polish`).

Starts are made until as many of them agree as the settings ask for: a minimum that only one start
has found may well not be the lowest. Descents of one start that agree without evolution, as starts
have to, count as starts.

A search compiles two programs, whatever the number of starts and stages: a step of
Levenberg–Marquardt, and the population's costs.
"""

import dataclasses
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.problem.problem import Problem
from fitting.runtime import activity
from fitting.runtime.precision import for_other_thread, in_float64
from fitting.runtime.program_cache import committed

from . import checkpoints, levenberg_marquardt
from .descent import descend, jacobian_at, point_of, polish
from .evolution import evaluate, evolve, sweep_and_descend
from .levenberg_marquardt import HardModel
from .solution import (
    DEFAULTS,
    MAX_STARTS,
    Point,
    Search,
    SearchSettings,
    SearchState,
    Solution,
    StepsUsedUp,
)

MIN_DESCENTS = 2  # of a start


@in_float64
def find_best_fit(
    problem: Problem,
    settings: SearchSettings = DEFAULTS,
    *,
    starts: int = MAX_STARTS,
    first: Float[Array | np.ndarray, " free"] | None = None,
    seed: int = 0,
) -> Solution:
    """The free parameters of minimum cost.

    KeyboardInterrupt (Ctrl-C) ends the search at the best point so far, if there is one. The
    solution's `converged` and `message` say how far to trust it. Where `Checkpoints` are entered,
    the search continues after the stages that they have of it.

    Args:
        problem: what to fit.
        settings: how thoroughly to search.
        starts: how many starts to make at most.
        first: the `u` from which the first start makes its first descent; None is the space's.
        seed: of the random draws; the same seed gives the same solution.

    Raises:
        ValueError: for no start.
    """
    if starts < 1:
        raise ValueError(f"starts is {starts}, wanted at least 1")
    if not problem.space.size:
        return _nothing_free(problem)
    problem = committed(problem)
    first = problem.space.start if first is None else first
    latest = SearchState.at(np.asarray(first), seed=seed)
    current = checkpoints.current()
    search = current.attach(Search(problem, settings), latest, starts)
    before, used_up, interrupted = np.inf, False, False
    ends: list[float] = []
    try:
        with activity.announced("Preparing the programs of the search"):
            before, latest = _begin(search, latest, search.array(np.asarray(first)))
        with activity.announced(f"Searching from up to {starts} starts", starts) as searching:
            for start in range(starts):
                if agree(ends, settings):
                    break
                state = dataclasses.replace(latest, start=start, start_steps=0)
                try:
                    latest, costs = search_from(search, state, None if ends else first)
                except StepsUsedUp as error:
                    latest, costs, used_up = error.state, [error.state.point.cost], True
                ends += costs
                searching.advance()
    except KeyboardInterrupt:
        latest, interrupted = search.latest or latest, True
        if not np.isfinite(latest.best.cost):
            raise
    finally:
        current.flush()
    agreeing = count_agreeing(ends, settings)
    end = _End(latest, len(ends), agreeing, agree(ends, settings), interrupted, used_up)
    return _solution(search, end, before)


@in_float64
def refine(
    problem: Problem,
    solution: Solution,
    u: Float[np.ndarray, " free"],
    settings: SearchSettings = DEFAULTS,
) -> Solution:
    """A descent to the end from `u`, better than the solution so far, or for another noise.

    The starts of the solution and their agreement stay; effort and history add up.
    """
    latest = SearchState.at(np.asarray(u))
    current = checkpoints.current()
    search = current.attach(Search(problem, settings), latest, 0)
    used_up = interrupted = False
    try:
        with activity.announced("Descending from there"):
            latest = _polish(search, latest)
    except StepsUsedUp as error:
        latest, used_up = error.state, True
    except KeyboardInterrupt:
        latest, interrupted = search.latest or latest, True
    finally:
        current.flush()
    if not np.isfinite(latest.best.cost):
        return dataclasses.replace(solution, interrupted=interrupted)
    end = _End(latest, solution.starts, solution.agreeing, solution.agreed, interrupted, used_up)
    return _solution(search, end, solution.cost_before).following(solution)


@in_float64
def cost_before(problem: Problem) -> float:
    """Cost of the system as it is, with the problem's noise; infinite where it has none."""
    present = problem.space.pack({})
    cost = float(levenberg_marquardt.evaluate(HardModel(problem, present), present).cost)
    return cost if np.isfinite(cost) else np.inf


def _nothing_free(problem: Problem) -> Solution:
    """The system as it is, where there is nothing to search for."""
    u = np.zeros(0)
    cost = float(problem.cost(jnp.asarray(u)))
    return Solution(
        names=(),
        u=u,
        values=u,
        cost_before=cost,
        cost=cost,
        converged=bool(np.isfinite(cost)),
        message="Nothing is free: this is the system as it comes.",
        jacobian=np.zeros((0, 0)),
        history=(),
        steps=0,
        seconds=0.0,
        agreed=True,
    )


def count_agreeing(ends: Sequence[float], settings: SearchSettings) -> int:
    """How many of the starts ended at the lowest of these costs, or hardly above it."""
    return int(np.sum(np.asarray(ends) <= min(ends, default=np.inf) + settings.agreement))


def agree(ends: Sequence[float], settings: SearchSettings) -> bool:
    """Whether enough starts ended at the lowest minimum: a number of them, and half of all."""
    return count_agreeing(ends, settings) >= max(settings.agreeing_starts, len(ends) / 2)


def search_from(
    search: Search, state: SearchState, first: Float[Array | np.ndarray, " free"] | None = None
) -> tuple[SearchState, list[float]]:
    """All stages of one start; the state's point is its end.

    Also the costs of its ends: one, or those of all descents where these agree by themselves.

    Args:
        search: the problem and the settings.
        state: of the search so far; only its random generator and its records matter.
        first: from where the first descent begins; None leaves all to the draws.

    Raises:
        StepsUsedUp: when the start has no steps left; carries the state it ended in.
    """
    settings = search.settings
    points, state = starting_points(search, state, first)
    ends = []
    for point in points:
        state = search.run("descent", state, partial(_descend_from, search, state, point))
        ends.append(state.point)
    ends = [end for end in ends if np.isfinite(end.cost)]
    if not ends:
        return state, [np.inf]
    state = dataclasses.replace(state, point=min(ends, key=lambda end: end.cost))
    costs = [end.cost for end in ends]
    if not agree(costs, settings):
        state = _polish(search, evolve(search, state, ends))
        return state, [state.point.cost]
    agreeing = count_agreeing(costs, settings)
    state = _polish(search, state)
    return state, [state.point.cost] * agreeing + sorted(costs)[agreeing:]


def _descend_from(search: Search, state: SearchState, point: Point) -> SearchState:
    state = descend(search, search.jump(state, "start", point), "descent")
    return sweep_and_descend(search, state, search.settings.sweeps)


def _polish(search: Search, state: SearchState) -> SearchState:
    return search.run("polish", state, partial(polish, search, state))


def starting_points(
    search: Search, state: SearchState, first: Float[Array | np.ndarray, " free"] | None = None
) -> tuple[list[Point], SearchState]:
    """Where the descents of a start begin, and the state after drawing: `first`, the best draws."""
    space, settings = search.problem.space, search.settings
    random = state.generator()
    drawn = space.prior.draw(random, settings.draws)
    candidates = drawn if first is None else np.concatenate([np.asarray(first)[None], drawn])
    candidates = candidates.astype(space.start.dtype)
    costs = evaluate(search.problem, candidates).cost
    order = np.argsort(costs, kind="stable")
    if first is not None:
        order = np.concatenate([[0], order[order != 0]])
    finite = [i for i in order if np.isfinite(costs[i])] or [order[0]]
    points = [Point(candidates[i], float(costs[i])) for i in finite]
    count = min(settings.descents, max(MIN_DESCENTS, space.size // 2))
    return points[:count], dataclasses.replace(state, random=random)


def _begin(
    search: Search, state: SearchState, first: Float[Array, " free"]
) -> tuple[float, SearchState]:
    """Cost of the system as it is, and the state with the first point evaluated."""
    problem = search.problem
    with ThreadPoolExecutor(1) as thread:  # the two programs compile side by side
        before = thread.submit(for_other_thread(cost_before), problem)
        evaluate(problem, np.asarray(problem.space.pack({}))[None])
    lm = levenberg_marquardt.evaluate(HardModel(problem, first), first)
    return before.result(), dataclasses.replace(state, evaluated=lm, best=point_of(lm))


@dataclasses.dataclass(frozen=True)
class _End:
    """How a search ended."""

    state: SearchState
    starts: int
    agreeing: int
    agreed: bool
    """Enough of them."""
    interrupted: bool
    used_up: bool
    """A start had no steps left."""

    @property
    def converged(self) -> bool:
        """Whether the best point is the end of a descent, and starts agree on it."""
        return self.state.converged and self.agreed and not self.interrupted


def _solution(search: Search, end: _End, before: float) -> Solution:
    """The solution of a search that has ended."""
    state = end.state
    u = search.array(state.best.u)
    return Solution(
        names=search.problem.space.names,
        u=state.best.u,
        values=np.asarray(search.problem.space.values(u)),
        cost_before=before,
        cost=state.best.cost,
        converged=end.converged,
        message=_message(search.settings, end),
        jacobian=jacobian_at(search, state.best),
        history=state.history,
        steps=state.steps,
        starts=end.starts,
        agreeing=end.agreeing,
        agreed=end.agreed,
        seconds=time.perf_counter() - search.began,
        interrupted=end.interrupted,
    )


def _message(settings: SearchSettings, end: _End) -> str:
    """How the search ended, in one sentence."""
    best, starts = end.state.best, "start" if end.starts == 1 else "starts"
    agreement = f"{end.agreeing} of {end.starts} {starts} agree{'s' * (end.agreeing == 1)}"
    if end.interrupted:
        return f"Interrupted after {end.state.steps} steps; this is the best point so far."
    if not np.isfinite(best.cost):
        return "Not converged: no residuals are finite at any starting point."
    if end.converged:
        gain = settings.min_step_gain
        return (
            f"Converged: {agreement}, and no further step lowers the cost by more than {gain:g} "
            "of itself."
        )
    if end.state.converged and end.starts == 1:
        return "Not converged: stopped at a local minimum, where the only start led."
    if end.state.converged:
        return f"Not converged: stopped at a local minimum; {agreement}."
    if end.used_up:
        return f"Not converged: the {settings.max_steps} steps allowed for a start were used up."
    return (
        "Not converged: the steps ended in a region where residuals or derivatives are not finite."
    )
