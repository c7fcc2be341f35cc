"""The fit: Levenberg–Marquardt for what has slopes, sampling for what decides.

The pipeline stays hard. A threshold has no slope through a hard decision, so thresholds are moved
by two ways, and the lower cost is kept (each wins where the other fails):

- `blocks`: a population is evaluated in one vmapped call, the elite breeds the next one, and
  Levenberg–Marquardt follows on the smooth columns; a few rounds of it.
- `ensemble`: Levenberg–Marquardt on the mean residual over random shifts of the thresholds, whose
  columns come from a regression on the shifts; the shifts shrink; then blocks.

Where the two end apart, a third go starts from the better one. Without thresholds neither is
needed. A sweep of each parameter through its range frees what a clamp had taken the slope from. A
fit compiles three programs, whatever the number of starts and stages: a step of
Levenberg–Marquardt on the hard rows, one on the ensemble's, and the population.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.problem.problem import Problem

from .jacobian import ensemble, hard, rows_of_problem
from .levenberg_marquardt import TOLERANCE, Position, evaluated, step
from .population import POPULATION, evaluate, offsets, sweep, vary
from .solution import Progress, Solution

MARCH = 8  # steps of Levenberg–Marquardt between two turns of the population
STALLS = 5  # rejected steps in a row that end a march: each shrinks the step to a quarter
LAST_STALLS = 12  # that end the last one
ROUNDING = 1e-9  # relative: two programs do not sum a cost alike
AGREED = 1e-3  # relative: two ways that end further apart call for a third go
ROUNDS = 5  # of blocks
SWEEPS = 8  # of all parameters before the last march, at most
WORTH = 1e-5  # relative fall of the cost for which a sweep's find is taken
GENERATIONS = 5  # of a population per round
ELITE = 8
REPEATED = 16  # children that come again after a Gauss-Newton step
SPREADS = (0.8, 0.4, 0.2, 0.1)  # of the ensemble's shifts, in u
PAIRS = 16  # antithetic shifts of the ensemble
START_SPREAD = 0.5  # of a further start, in prior standard deviations


class _Spent(Exception):
    """The steps allowed for a start are used up."""


class _Fit:
    """A running fit: what it costs, the best point, and who is told."""

    def __init__(self, problem: Problem, seed: int, max_steps: int, progress: Any) -> None:
        self.problem = problem
        self.random = np.random.default_rng(seed)
        self.max_steps = max_steps
        self.progress = progress
        self.began = time.perf_counter()
        self.thresholds = np.asarray(problem.space.thresholds)
        self.offsets = offsets()  # of sweeps
        self.cost_before = np.inf  # of the base's values
        self.start = 0
        self.steps = 0  # of this start
        self.total = 0
        self.best = np.asarray(problem.space.u0)
        self.best_cost = np.inf
        self.settled = False  # the best point is the end of a finished march
        self.history: list[Progress] = []

    def keep(self, stage: str, u: np.ndarray, cost: float, settled: bool = False) -> None:
        """Remembers a point of the hard program if it is the best, and reports."""
        if cost < self.best_cost or (settled and cost <= self.best_cost * (1 + ROUNDING)):
            self.best, self.best_cost, self.settled = u, cost, settled
        self.report(stage, cost)

    def report(self, stage: str, cost: float) -> None:
        elapsed = time.perf_counter() - self.began
        report = Progress(stage, self.start, self.steps, cost, self.best_cost, elapsed)
        self.history.append(report)
        if self.progress is not None:
            self.progress(report)

    def descend(self, stage: str, u: np.ndarray, limit: int, shifts: Array | None = None) -> Any:
        """Levenberg–Marquardt from `u`: the point it came to, the cost and the slopes there.

        Without shifts the thresholds are frozen and the rows are the hard ones; only these slopes
        are the problem's.
        """
        here = jnp.asarray(u, self.problem.space.u0.dtype)
        model, second = (hard, here) if shifts is None else (ensemble, shifts)
        args = (self.problem, second)
        known = shifts is None and np.array_equal(here, self.first.u)
        at = self.first if known else evaluated(model, here, args)
        last = stage == "polish"
        stalls = LAST_STALLS if last else STALLS
        while not at.done(stalls) and int(at.steps) < limit:
            if self.steps >= self.max_steps:
                raise _Spent
            at = step(model, at, args)
            self.steps += 1
            self.total += 1
            if shifts is None:
                settled = last and at.done(stalls)
                self.keep(stage, np.asarray(at.u), float(at.cost), settled)
            else:
                self.report(stage, float(at.cost))
        cost = float(at.cost) if np.isfinite(at.cost) else float("inf")
        return np.asarray(at.u), cost, rows_of_problem(at.slopes)

    def breed(self, u: np.ndarray, cost: float, slopes: Any, spread: float) -> Any:
        """The best of some generations bred from `u`.

        A child is a parent with some thresholds shifted; a third of them also have one parameter,
        of either kind, drawn anew from its range, which frees a clamp that had no slope because it
        was never reached. Other thresholds want other smooth columns, so the most promising
        children come again after a Gauss-Newton step.
        """
        elite, moved, costs = u[None], u[None][:0], np.asarray([cost])
        rate = max(0.3, 1 / max(1, self.thresholds.sum()))
        for generation in range(GENERATIONS):
            count = POPULATION - len(moved)
            parents = elite[self.random.integers(len(elite), size=count)]
            changed = (self.random.random(parents.shape) < rate) & self.thresholds
            shifts = self.random.normal(0, spread * 0.6**generation, parents.shape) * changed
            renewed = np.zeros(parents.shape, bool)
            some = np.arange(count // 3)
            renewed[some, self.random.integers(u.size, size=some.size)] = True
            children = vary(self.problem.space, parents, shifts, renewed, self.random)
            children = np.concatenate([moved, children])
            born = evaluate(self.problem, children, slopes)
            every = np.concatenate([elite, children])
            costs = np.concatenate([costs, born.cost])
            order = np.argsort(costs, kind="stable")[:ELITE]
            elite, costs = every[order], costs[order]
            moved = born.moved[np.argsort(born.promised, kind="stable")[:REPEATED]]
            self.keep("blocks", elite[0], float(costs[0]))
        return elite[0], float(costs[0])

    def blocks(self, u: np.ndarray, spread: float) -> Any:
        """Turns of thresholds by population and smooth columns by Levenberg–Marquardt."""
        u, cost, _ = self.descend("blocks", u, MARCH)
        u, cost = self.sweep(u, cost, 2)
        u, cost, slopes = self.descend("blocks", u, MARCH)
        for number in range(ROUNDS):
            before = cost
            u, cost = self.breed(u, cost, slopes, spread * 0.7**number)
            u, cost, slopes = self.descend("blocks", u, MARCH)
            if number > 1 and before - cost < 1e-4 * before:
                break
        return u, cost

    def slopes(self, u: np.ndarray) -> np.ndarray:
        """Slopes of the problem's rows at `u`."""
        here = jnp.asarray(u, self.problem.space.u0.dtype)
        return rows_of_problem(evaluated(hard, here, (self.problem, here)).slopes)

    def blur(self, u: np.ndarray) -> Any:
        """Levenberg–Marquardt on the mean residual over shifts that shrink."""
        draws = np.zeros((PAIRS, u.size))
        draws[:, self.thresholds] = self.random.normal(size=(PAIRS, int(self.thresholds.sum())))
        both = np.stack([draws, -draws], axis=1).reshape(2 * PAIRS, u.size)
        for spread in SPREADS:
            shifts = jnp.asarray(spread * both, self.problem.space.u0.dtype)
            u, _, _ = self.descend("ensemble", u, MARCH, shifts)
        return u

    def run_start(self, number: int, u: np.ndarray, cost: float) -> None:
        """Both ways from one start, then the smooth columns to their end."""
        self.start, self.steps = number, 0
        self.keep("start", u, cost)
        u, cost = self.decide(u) if self.thresholds.any() else self.descend("slopes", u, MARCH)[:2]
        u, _ = self.sweep(u, cost, SWEEPS)
        self.descend("polish", u, self.max_steps)

    def decide(self, u: np.ndarray) -> Any:
        """The better of two ways to move thresholds."""
        ends = [self.blocks(u, 1.2), self.blocks(self.blur(u), 0.4)]
        ends.sort(key=lambda end: end[1])
        if ends[-1][1] - ends[0][1] > AGREED * ends[0][1]:
            ends.insert(0, self.blocks(ends[0][0], 1.2))
        return ends[0]

    def sweep(self, u: np.ndarray, cost: float, rounds: int) -> Any:
        """Out of the valleys of single parameters: a clamp never reached has no slope to follow."""
        for _ in range(rounds):
            if (found := sweep(self.problem, u, cost, WORTH, self.offsets)) is None:
                break
            self.keep("sweep", *found)
            u, cost, _ = self.descend("sweep", found[0], MARCH)
        return u, cost

    def starting_points(self, given: int | np.ndarray) -> list[tuple[np.ndarray, float]]:
        """Points of finite cost: the prior's centre, then the lowest of a population of draws."""
        space = self.problem.space
        u0 = np.asarray(space.u0)
        if isinstance(given, int):
            draws = self.random.normal(size=(POPULATION - 2, space.size))
            drawn = u0 + START_SPREAD * np.asarray(space.prior_sd) * draws
            count, candidates = given, np.concatenate([u0[None], drawn]).astype(u0.dtype)
        else:
            count, candidates = len(given), given
        first = jnp.asarray(candidates[0], u0.dtype)
        wide = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]

        def begun() -> Position:
            with jax.enable_x64(wide):  # a thread knows nothing of what is set around its caller
                return evaluated(hard, first, (self.problem, first))

        with ThreadPoolExecutor(1) as beside:  # the two programs compile side by side
            coming = beside.submit(begun)
            costs = evaluate(
                self.problem, np.concatenate([np.asarray(space.pack({}))[None], candidates])
            ).cost
        self.first = coming.result()
        self.cost_before, costs = float(costs[0]), costs[1:]
        order = [0, *(1 + np.argsort(costs[1:], kind="stable"))]
        finite = [(candidates[i], float(costs[i])) for i in order if np.isfinite(costs[i])]
        return finite[:count]


def solve(
    problem: Problem,
    *,
    starts: int | Float[np.ndarray, "starts free"] = 1,
    seed: int = 0,
    max_steps: int = 1000,
    progress: Callable[[Progress], None] | None = None,
) -> Solution:
    """The free parameters of least cost.

    An interrupt (Ctrl-C) ends the search and keeps the best point so far, if there is one. The
    solution's `converged` and `message` say how far to trust it.

    Args:
        problem: what to fit.
        starts: how many, the first at the prior's centre and the others the lowest of some draws
            from the prior; or the `u` to start from.
        seed: of the draws; the same seed gives the same solution.
        max_steps: of Levenberg–Marquardt, for each start.
        progress: called with every report.

    Raises:
        ValueError: for no start or no step.
    """
    if max_steps < 1 or (starts if isinstance(starts, int) else len(starts)) < 1:
        raise ValueError(f"starts is {starts} and max_steps {max_steps}, wanted at least 1 of each")
    fit = _Fit(problem, seed, max_steps, progress)
    spent = interrupted = False
    try:
        for number, (u, cost) in enumerate(fit.starting_points(starts)):
            try:
                fit.run_start(number, u, cost)
            except _Spent:
                spent = True
    except KeyboardInterrupt:
        if not np.isfinite(fit.best_cost):
            raise
        interrupted = True
    converged = fit.settled and not interrupted
    return Solution(
        names=problem.space.names,
        u=fit.best,
        values=np.asarray(problem.space.values(jnp.asarray(fit.best, problem.space.u0.dtype))),
        cost_before=fit.cost_before,
        cost=fit.best_cost,
        converged=converged,
        message=_sentence(fit, converged, interrupted, spent),
        jacobian=fit.slopes(fit.best),
        history=tuple(fit.history),
        steps=fit.total,
        seconds=time.perf_counter() - fit.began,
        interrupted=interrupted,
    )


def _sentence(fit: _Fit, converged: bool, interrupted: bool, spent: bool) -> str:
    """How the fit ended."""
    if interrupted:
        return f"Interrupted after {fit.total} steps; this is the best point so far."
    if not np.isfinite(fit.best_cost):
        return "Not converged: no residuals are finite at any starting point."
    if converged:
        return f"Converged: no further step lowers the cost by more than {TOLERANCE:g} of itself."
    if spent:
        return f"Not converged: the {fit.max_steps} steps allowed for a start were used up."
    return "Not converged: the steps ended in a region where slopes or residuals are not finite."
