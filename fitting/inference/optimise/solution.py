"""The settings and the state of a search, its reports while it runs, and its result.

Every stage is a function `(search, state, ...) -> state`. A `Search` is what stays the same, a
`SearchState` what changes. Stages change neither: called again with the same state they do the
same.
"""

import copy
import dataclasses
import time
from collections.abc import Callable
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.problem.problem import Problem
from fitting.runtime import activity
from fitting.runtime.declarations import Table, key

from .levenberg_marquardt import LMState

MAX_STARTS = 6  # independent ones, where the user names no other number

ROUNDING = 1e-9  # relative: two programs sum the same cost in different orders


@dataclasses.dataclass(frozen=True)
class Progress:
    """One report of a running search."""

    stage: str
    """Start, descent, sweep, evolution or polish."""
    start: int
    """Index of the starting point."""
    step: int
    """Levenberg–Marquardt steps so far, from this start."""
    cost: float
    """Of the point that the stage has reached."""
    best: float
    """Minimum cost of the hard program so far, over all starts."""
    seconds: float
    """Since the search began."""

    def __str__(self) -> str:
        return (
            f"start {self.start + 1}  {self.stage:<9} step {self.step:<4} "
            f"cost {self.cost:.6g}  best {self.best:.6g}"
        )


@dataclasses.dataclass(frozen=True)
class Report(Progress):
    """A report with the best point so far, which the history leaves out."""

    best_u: Float[np.ndarray, " free"]


@dataclasses.dataclass(frozen=True)
class Solution:
    """The best point of a search, and how the search ended."""

    names: tuple[str, ...]
    u: Float[np.ndarray, " free"]
    values: Float[np.ndarray, " free"]
    """In the parameters' units."""
    cost_before: float
    """Of the system's values before the fit."""
    cost: float
    converged: bool
    message: str
    """One sentence."""
    jacobian: Float[np.ndarray, "residuals free"]
    """Of `Problem.residuals`; 0 for thresholds."""
    history: tuple[Progress, ...]
    steps: int
    """Of Levenberg–Marquardt, all starts together."""
    seconds: float
    starts: int = 1
    """Finished ones."""
    agreeing: int = 1
    """Of them, those that ended at this cost, or hardly above it."""
    agreed: bool = False
    """Whether these were enough."""
    interrupted: bool = False

    def weighted(self, weight: float) -> "Solution":
        """The solution of the same problem with a weight; its own is 1."""
        return dataclasses.replace(
            self,
            cost_before=weight * self.cost_before,
            cost=weight * self.cost,
            jacobian=weight**0.5 * self.jacobian,
        )

    def following(self, before: "Solution") -> "Solution":
        """The solution with the history and the effort of an earlier one added to its own."""
        later = (
            dataclasses.replace(
                line, step=line.step + before.steps, seconds=line.seconds + before.seconds
            )
            for line in self.history
        )
        return dataclasses.replace(
            self,
            cost_before=before.cost_before,
            history=(*before.history, *later),
            steps=before.steps + self.steps,
            seconds=before.seconds + self.seconds,
        )


@dataclasses.dataclass(frozen=True)
class SearchSettings(Table):
    """Settings of `search.find_best_fit`.

    Spreads are standard deviations of `u`, gains are relative falls of the cost.

    Raises:
        ValueError: for a setting out of its range.
    """

    max_steps: int = key(
        1000, "Levenberg–Marquardt steps allowed for each start.", "steps", 1, 100_000
    )
    # Starts
    draws: int = key(
        126, "Draws from the prior of which the best descend.", "candidates", 2, 100_000
    )
    descents: int = key(
        6,
        "Descents of a start, at most; half the number of parameters if that is less.",
        "",
        1,
        1000,
    )
    agreement: float = key(
        3.0, "Two ends whose costs differ by no more than this agree.", "cost", 0, 1e6
    )
    agreeing_starts: int = key(
        2, "Starts that must agree; they must also be half of those made.", "starts", 1, 1000
    )
    # Levenberg–Marquardt
    descent_steps: int = key(
        8, "Steps of a descent, between two changes of the decisions.", "steps", 1, 1000
    )
    min_step_gain: float = key(
        1e-6, "A step that lowers the cost by less than this is a small one.", "", 0, 1.0
    )
    max_small_steps: int = key(2, "Small steps in a row that end a descent.", "steps", 1, 1000)
    max_rejected_steps: int = key(
        5,
        "Rejected steps in a row that end a descent; each shrinks the step to a quarter.",
        "steps",
        1,
        1000,
    )
    polish_max_rejected_steps: int = key(
        12, "Rejected steps in a row that end the last descent of a start.", "steps", 1, 1000
    )
    # Evolution
    population: int = key(64, "Candidates in a generation.", "candidates", 4, 100_000)
    generations: int = key(10, "Generations between two descents.", "generations", 1, 1000)
    elite: int = key(24, "Candidates that parent the next generation.", "", 1, 100_000)
    gauss_newton_children: int = key(
        16, "Candidates of a generation that come again after a Gauss-Newton step.", "", 0, 100_000
    )
    max_rounds: int = key(40, "Rounds of an evolution, at most.", "rounds", 1, 1000)
    min_round_gain: float = key(
        0.5, "A round that lowers the cost by less than this is an idle one.", "cost", 0, 1e6
    )
    patience: int = key(4, "Idle rounds in a row that end an evolution.", "rounds", 1, 1000)
    # Sweeps
    sweep_values: int = key(6, "Values that a sweep tries for each parameter.", "values", 1, 1000)
    sweep_tries: int = key(
        2, "Sweeps without a sufficient gain that end the sweeping.", "sweeps", 1, 1000
    )
    min_sweep_gain: float = key(1e-5, "Gain that makes a sweep's result worth taking.", "", 0, 1.0)
    sweeps: int = key(
        1, "Sweeps of a descent, at most, each with another descent after it.", "sweeps", 0, 1000
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gauss_newton_children >= self.population:
            raise ValueError(
                f"gauss_newton_children is {self.gauss_newton_children},"
                f" wanted less than the population, which is {self.population}"
            )


DEFAULTS = SearchSettings()


@dataclasses.dataclass(frozen=True)
class Point:
    """A point of the search space."""

    u: Float[np.ndarray, " free"]
    cost: float = np.inf
    """Of the hard program; infinite where not finite, or not evaluated."""
    jacobian: Float[np.ndarray, "residuals free"] | None = None
    """Of `Problem.residuals`."""


@dataclasses.dataclass(frozen=True)
class Elite:
    """The best candidates of an evolution so far, the best one first."""

    u: Float[np.ndarray, "candidates free"]
    cost: Float[np.ndarray, " candidates"]

    @classmethod
    def best_of(cls, u: np.ndarray, cost: np.ndarray, size: int) -> "Elite":
        """As many of them as it has room for."""
        order = np.argsort(cost, kind="stable")[:size]
        return cls(u[order], cost[order])

    def joined(self, u: np.ndarray, cost: np.ndarray, size: int) -> "Elite":
        """The best of these and others."""
        return Elite.best_of(np.concatenate([self.u, u]), np.append(self.cost, cost), size)


@dataclasses.dataclass(frozen=True)
class SearchState:
    """Where a search stands."""

    point: Point
    """Where the next stage begins."""
    best: Point
    """Of the whole search."""
    random: np.random.Generator
    """Use `generator`, never this one itself."""
    converged: bool = False
    """The best point is the end of a finished polish."""
    start: int = 0
    """Index of the starting point."""
    start_steps: int = 0
    """Levenberg–Marquardt steps from this start."""
    steps: int = 0
    """And from all starts."""
    sweeps: int = 0
    """So far; the next one looks between the values of these."""
    evaluated: LMState | None = None
    """First starting point, evaluated while programs compiled."""
    elite: Elite | None = None
    """Of the evolution that is going on."""
    history: tuple[Progress, ...] = ()

    @classmethod
    def at(
        cls, u: Float[np.ndarray, " free"], cost: float = np.inf, seed: int = 0
    ) -> "SearchState":
        """The beginning of a search at a point."""
        return cls(Point(u, cost), Point(u, cost), np.random.default_rng(seed))

    def generator(self) -> np.random.Generator:
        """A copy of the random generator, to draw from and to put into the next state."""
        return copy.deepcopy(self.random)


class StepsUsedUp(Exception):
    """Raised by a stage when the steps allowed for a start are used up."""

    def __init__(self, state: SearchState) -> None:
        super().__init__()
        self.state = state  # as it was then


Stage: TypeAlias = Callable[[], SearchState]


@dataclasses.dataclass
class Search:
    """A problem, settings and callbacks, which all stages of a search share."""

    problem: Problem
    settings: SearchSettings = DEFAULTS
    began: float = dataclasses.field(default_factory=time.perf_counter)
    """Seconds."""
    recall: Callable[["Search", str, SearchState, Stage], SearchState] | None = None
    """Gives the state in which a stage ended before the search was killed, or calls the stage."""
    latest: SearchState | None = None
    """The last reported state; an interrupted search ends there."""

    @property
    def thresholds(self) -> np.ndarray:
        """Which parameters only move hard decisions."""
        return np.asarray(self.problem.space.thresholds)

    def array(self, u: Float[np.ndarray, "*n free"]) -> Float[Array, "*n free"]:
        """`u` as the problem's programs take it."""
        return jnp.asarray(u, self.problem.space.start.dtype)

    def run(self, name: str, state: SearchState, stage: Stage) -> SearchState:
        """The state after a stage that follows from this state, and from nothing else that changes.

        Raises:
            StepsUsedUp: by the stage.
        """
        return stage() if self.recall is None else self.recall(self, name, state, stage)

    def spend_step(self, state: SearchState) -> SearchState:
        """The state with one more step of Levenberg–Marquardt counted.

        Raises:
            StepsUsedUp: if the start has none left.
        """
        if state.start_steps >= self.settings.max_steps:
            raise StepsUsedUp(state)
        return dataclasses.replace(state, start_steps=state.start_steps + 1, steps=state.steps + 1)

    def report(self, state: SearchState, stage: str, cost: float) -> SearchState:
        """The state with one more line of history, which is reported."""
        elapsed = time.perf_counter() - self.began
        line = Progress(stage, state.start, state.start_steps, cost, state.best.cost, elapsed)
        return self.reached(dataclasses.replace(state, history=(*state.history, line)))

    def reached(self, state: SearchState) -> SearchState:
        """Reports a state by the last line of its history."""
        self.latest = state
        line = Report(**vars(state.history[-1]), best_u=state.best.u)
        activity.report(line, str(line))
        return state

    def move(
        self, state: SearchState, stage: str, point: Point, *, converged: bool = False
    ) -> SearchState:
        """The state at a point of a descent, remembered if it is the best one, and reported."""
        state = dataclasses.replace(state, point=point)
        as_good = converged and point.cost <= state.best.cost * (1 + ROUNDING)
        if point.cost < state.best.cost or as_good:
            state = dataclasses.replace(state, best=point, converged=converged)
        return self.report(state, stage, point.cost)

    def jump(self, state: SearchState, stage: str, point: Point) -> SearchState:
        """The state at a candidate, and reported; its cost is too rough to be called the best."""
        return self.report(dataclasses.replace(state, point=point), stage, point.cost)
