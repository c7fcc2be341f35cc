"""What the stages of a search hand on to each other.

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

from .levenberg_marquardt import LMState
from .settings import DEFAULTS, SearchSettings
from .solution import Progress

ROUNDING = 1e-9  # relative: two programs sum the same cost in different orders


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


@dataclasses.dataclass(frozen=True)
class Search:
    """What all stages of a search share."""

    problem: Problem
    settings: SearchSettings = DEFAULTS
    observe: Callable[[SearchState], None] = lambda state: None
    """Called with every report."""
    began: float = dataclasses.field(default_factory=time.perf_counter)
    """Seconds."""
    recall: Callable[["Search", str, SearchState, Stage], SearchState] | None = None
    """Gives the state in which a stage ended before the search was killed, or calls the stage."""

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
        state = dataclasses.replace(state, history=(*state.history, line))
        self.observe(state)
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
