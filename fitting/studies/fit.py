"""One fit: the search, what it found, and its numbers as `fit.json` holds them."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Literal, NotRequired, TypedDict

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxik
from fitting.analysis import playback
from fitting.experiments.experiment import Experiment
from fitting.inference.identifiability import Identifiability
from fitting.inference.optimisation.search import Starts, find_best_fit
from fitting.inference.optimisation.solution import Progress, Solution
from fitting.inference.profiles.profile import Verdict
from fitting.problem.problem import Problem
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree, smoothing

# Walkers start in a ball around the fit. Its width, in u, is the Laplace standard deviation, which
# for a threshold would be the prior's: walkers that start far from a threshold's value get stuck.
THRESHOLD_SD = 0.05
MIN_START_SD, MAX_START_SD = 1e-3, 0.5
MIN_IMPROVEMENT = 0.1  # of the cost: a point that much lower is worth another search
TICK_RATES = (30.0, 60.0)  # Hz, at which a gain per tick is reported


class FittedValley(TypedDict):
    """A part of a parameter's range in which the cost is low."""

    value: float
    """Where it is lowest."""
    rise: float
    """There, above the lowest of all."""
    interval: list[float]


class FittedParameter(TypedDict):
    """A free parameter after a fit, as `fit.json` holds it."""

    name: str
    kind: str
    """Smooth or threshold."""
    unit: str
    u: float
    start_sd: float
    """Of u, where walkers start."""
    value: float
    before: float
    """The value before the fit."""
    low: float
    high: float
    interval: list[float]
    """95 %."""
    verdict: Verdict
    """Which sides the clips bound."""
    valleys: list[FittedValley]
    """From low values to high ones; one unless the verdict says several."""
    contraction: float
    """0 where only the prior is known, 1 where the clips decide."""
    at_bound: Literal["", "low", "high"]
    determined: bool
    half_life: NotRequired[float]
    """s, of a gain."""
    gain_at_30_hz: NotRequired[float]
    gain_at_60_hz: NotRequired[float]


class FitSummary(TypedDict):
    """The content of `fit.json`."""

    experiment: str
    converged: bool
    message: str
    cost_before: float
    cost: float
    steps: int
    seconds: float
    parameters: list[FittedParameter]
    correlated: list[list[str | float]]
    """Two names and their correlation."""
    weakest: list[str]
    history: list[Content]
    left: list[float]
    """Costs of solutions that were left because their profiles met a lower point."""
    improvement: float
    """How far below the cost the lowest point of the last profiles is."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted experiment."""

    experiment: Experiment
    problem: Problem[jaxik.FootIK]
    solution: Solution
    identifiability: Identifiability
    known_values: Mapping[str, float] | None = None
    """What made a synthetic reference."""
    run: Path | None = None
    """The folder where it is written."""
    left: tuple[float, ...] = ()
    """Costs of solutions that were left because their profiles met a lower point."""

    @cached_property
    def ik(self) -> jaxik.FootIK:
        """The fitted system."""
        return self.problem.space.unpack(self.solution.u)

    @cached_property
    def results(self) -> tuple[jaxik.Result, ...]:
        """What the fitted system makes of each clip."""
        return tuple(playback.run(self.ik, scene) for scene in self.problem.data)

    @property
    def start_sd(self) -> Float[np.ndarray, " free"]:
        """Width, in u, of the ball in which walkers start."""
        sd = np.where(np.isfinite(self.identifiability.sd), self.identifiability.sd, THRESHOLD_SD)
        return np.clip(sd, MIN_START_SD, MAX_START_SD)

    @cached_property
    @in_float64
    def summary(self) -> FitSummary:
        """The numbers of the fit as JSON holds them."""
        solution = self.solution
        return {
            "experiment": self.experiment.name,
            "converged": solution.converged,
            "message": solution.message,
            "cost_before": solution.cost_before,
            "cost": solution.cost,
            "steps": solution.steps,
            "seconds": solution.seconds,
            "parameters": _fitted_parameters(self),
            "correlated": [list(pair) for pair in self.identifiability.correlated],
            "weakest": list(self.identifiability.weakest),
            "history": [dataclasses.asdict(step) for step in solution.history],
            "left": list(self.left),
            "improvement": self.identifiability.improvement,
        }


def search(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    progress: Callable[[Progress], None] | None = None,
    starts: Starts | None = None,
) -> Solution:
    """The best fit, without any estimate of how certain it is.

    Args:
        problem: the problem of the experiment.
        experiment: its settings of the search.
        progress: called as the search goes on; KeyboardInterrupt keeps the best point so far.
        starts: starting points in u, instead of those that the experiment asks for.
    """
    return find_best_fit(
        problem,
        experiment.fit.search,
        starts=experiment.fit.starts if starts is None else starts,
        seed=experiment.seed,
        progress=progress,
    )


def search_lower(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    before: Solution,
    lower_u: Float[np.ndarray, " free"],
    progress: Callable[[Progress], None] | None = None,
) -> Solution:
    """The best fit from a point that is lower than a solution; steps and time add to its own.

    Args:
        problem: the problem of the experiment.
        experiment: its settings of the search.
        before: the solution that is left.
        lower_u: the lower point, in u.
        progress: called as the search goes on.
    """
    after = search(problem, experiment, progress, lower_u[None])
    later = [
        dataclasses.replace(
            line, step=before.steps + line.step, seconds=before.seconds + line.seconds
        )
        for line in after.history
    ]
    return dataclasses.replace(
        after,
        cost_before=before.cost_before,
        history=(*before.history, *later),
        steps=before.steps + after.steps,
        seconds=before.seconds + after.seconds,
    )


def _fitted_parameters(fitted: Fit) -> list[FittedParameter]:
    solution, space, known = fitted.solution, fitted.problem.space, fitted.identifiability
    declared = parameter_tree.declarations(space.system)
    before = np.asarray(space.values(space.u0))
    rows = []
    for i, parameter in enumerate(space.parameters):
        profile = known.profiles[parameter.name]
        row: FittedParameter = {
            "name": parameter.name,
            "kind": parameter.kind,
            "unit": declared[parameter.leaf].unit,
            "u": float(solution.u[i]),
            "start_sd": float(fitted.start_sd[i]),
            "value": float(solution.values[i]),
            "before": float(before[i]),
            "low": parameter.low,
            "high": parameter.high,
            "interval": list(profile.interval),
            "verdict": profile.verdict,
            "valleys": [
                {"value": v.value, "rise": v.rise, "interval": list(v.interval)}
                for v in profile.valleys
            ],
            "contraction": float(known.contraction[i]),
            "at_bound": known.at_bound[i],
            "determined": parameter.name in known.determined,
        }
        if parameter.scale == "gain":
            row |= gain_readings(row["value"])  # type: ignore[operator]
        rows.append(row)
    return rows


def gain_readings(gain: float, tick_hz: float = 30.0) -> dict[str, float]:
    """The half-life, s, of a gain per tick, and the gains with the same half-life at other rates.

    Args:
        gain: fraction of the distance to its target that a value moves in each tick.
        tick_hz: ticks per second.
    """
    per_tick, rate = jnp.asarray(gain), jnp.asarray(tick_hz)
    readings = {"half_life": float(smoothing.half_life_of_gain(per_tick, rate))}
    for hz in TICK_RATES:
        fraction = smoothing.fraction_of_gain(per_tick, jnp.asarray(1.0 / hz), rate)
        readings[f"gain_at_{hz:.0f}_hz"] = float(fraction)
    return readings
