"""The search for the best fit: derivatives where there are some, candidates where there are none.

The pipeline stays hard. A threshold has no derivative through a hard decision, so thresholds are
moved in two ways, and the lower cost is kept (see `thresholds`). The smooth parameters follow
Levenberg–Marquardt (`descent`). A `sweep` of each parameter over its range frees those that a
clamp leaves without a derivative. From each start:

1. `thresholds.search_thresholds`, or without thresholds a descent;
2. `sweep.sweep_and_descend`;
3. `descent.polish`.

A search compiles three programs, whatever the number of starts and stages: a step of
Levenberg–Marquardt on the hard problem, one on the ensemble's, and the population's costs.
"""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from fitting.problem.problem import Problem
from fitting.runtime.precision import for_other_thread, in_float64

from . import levenberg_marquardt
from .descent import descend, polish
from .models import HardModel, problem_jacobian
from .population import evaluate
from .settings import DEFAULTS, SearchSettings
from .solution import Progress, Solution
from .state import Point, Search, SearchState, StepsUsedUp
from .sweep import sweep_and_descend
from .thresholds import search_thresholds

Starts = int | Float[np.ndarray, "starts free"]


@in_float64
def find_best_fit(
    problem: Problem,
    settings: SearchSettings = DEFAULTS,
    *,
    starts: Starts = 1,
    seed: int = 0,
    progress: Callable[[Progress], None] | None = None,
) -> Solution:
    """The free parameters of minimum cost.

    KeyboardInterrupt (Ctrl-C) ends the search and keeps the best point so far, if there is one. The
    solution's `converged` and `message` say how far to trust it.

    Args:
        problem: what to fit.
        settings: how thoroughly to search.
        starts: how many starting points, the first at the space's start and the others the best of
            some draws around it; or the `u` to start from.
        seed: of the random draws; the same seed gives the same solution.
        progress: called with every report.

    Raises:
        ValueError: for no start.
    """
    if (starts if isinstance(starts, int) else len(starts)) < 1:
        raise ValueError(f"starts is {starts}, wanted at least 1")
    latest = SearchState.at(np.asarray(problem.space.start), seed=seed)

    def observe(state: SearchState) -> None:
        nonlocal latest
        latest = state
        if progress is not None:
            progress(state.history[-1])

    search = Search(problem, settings, observe)
    cost_before, used_up, interrupted = np.inf, False, False
    try:
        points, latest, cost_before = starting_points(search, latest, starts)
        for number, point in enumerate(points):
            beginning = dataclasses.replace(latest, start=number, start_steps=0)
            try:
                latest = search_from(search, beginning, point)
            except StepsUsedUp as error:
                latest, used_up = error.state, True
    except KeyboardInterrupt:
        if not np.isfinite(latest.best.cost):
            raise
        interrupted = True
    converged = latest.converged and not interrupted
    u = search.array(latest.best.u)
    return Solution(
        names=problem.space.names,
        u=latest.best.u,
        values=np.asarray(problem.space.values(u)),
        cost_before=cost_before,
        cost=latest.best.cost,
        converged=converged,
        message=_message(settings, latest, interrupted=interrupted, used_up=used_up),
        jacobian=_jacobian(search, latest.best),
        history=latest.history,
        steps=latest.steps,
        seconds=time.perf_counter() - search.began,
        interrupted=interrupted,
    )


def search_from(search: Search, state: SearchState, point: Point) -> SearchState:
    """All stages from one starting point.

    Raises:
        StepsUsedUp: when the start has no steps left; carries the state it ended in.
    """
    state = search.move(state, "start", point)
    if search.thresholds.any():
        state = search_thresholds(search, state)
    else:
        state = descend(search, state, "slopes")
    state = sweep_and_descend(search, state, search.settings.final_sweeps)
    return polish(search, state)


def starting_points(
    search: Search, state: SearchState, starts: Starts
) -> tuple[list[Point], SearchState, float]:
    """Points of finite cost to start from, the state after choosing them, and the cost before.

    The first is the space's start, or the first of those that are passed in; the others follow
    with rising cost. The cost before is that of the system's values as they are.
    """
    space, settings = search.problem.space, search.settings
    start, random = np.asarray(space.start), state.generator()
    if isinstance(starts, int):
        draws = random.normal(size=(settings.population - 2, space.size))
        drawn = start + settings.start_spread * np.asarray(space.prior.sd) * draws
        count, candidates = starts, np.concatenate([start[None], drawn]).astype(start.dtype)
    else:
        count, candidates = len(starts), starts
    first = search.array(candidates[0])
    evaluate_first = for_other_thread(levenberg_marquardt.evaluate)
    with ThreadPoolExecutor(1) as thread:  # the two programs compile side by side
        evaluated = thread.submit(evaluate_first, HardModel(search.problem, first), first)
        present = np.asarray(space.pack({}))[None]
        before, *costs = evaluate(search.problem, np.concatenate([present, candidates])).cost
    state = dataclasses.replace(state, random=random, evaluated=evaluated.result())
    order = [0, *(1 + np.argsort(costs[1:], kind="stable"))]
    points = [Point(candidates[i], float(costs[i])) for i in order if np.isfinite(costs[i])]
    return points[:count], state, float(before)


def _jacobian(search: Search, best: Point) -> Float[np.ndarray, "residuals free"]:
    """Of the problem's residuals at the best point, which may come from a population."""
    if best.jacobian is not None:
        return best.jacobian
    u = search.array(best.u)
    evaluated = levenberg_marquardt.evaluate(HardModel(search.problem, u), u)
    return problem_jacobian(evaluated.jacobian)


def _message(
    settings: SearchSettings, end: SearchState, *, interrupted: bool, used_up: bool
) -> str:
    """How the search ended, in one sentence."""
    if interrupted:
        return f"Interrupted after {end.steps} steps; this is the best point so far."
    if not np.isfinite(end.best.cost):
        return "Not converged: no residuals are finite at any starting point."
    if end.converged:
        gain = settings.min_step_gain
        return f"Converged: no further step lowers the cost by more than {gain:g} of itself."
    if used_up:
        return f"Not converged: the {settings.max_steps} steps allowed for a start were used up."
    return (
        "Not converged: the steps ended in a region where residuals or derivatives are not finite."
    )
