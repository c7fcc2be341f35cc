"""The search of an experiment, and the assessment of its solution, which may meet a lower point."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.problems import ClipData
from fitting.inference.identifiability import assess_identifiability
from fitting.inference.noise import counted, fit_with_noise
from fitting.inference.optimise.search import find_best_fit, refine
from fitting.inference.optimise.solution import Solution
from fitting.motion import playback
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem, digest_with
from fitting.problem.scene import MEASURED
from fitting.runtime import activity

from .fit import Fit
from .run_folder import save_solution

MAX_RETURNS = 3  # to the search from lower points
MIN_IMPROVEMENT = 0.1  # of the cost: a point that much lower is worth another search


def search(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    first: Float[np.ndarray, " free"] | None = None,
) -> Solution:
    """The best fit from `first`, in u, or the experiment's start; not how certain it is."""
    return find_best_fit(
        problem.with_weight(1.0),
        experiment.fit.search,
        starts=experiment.fit.starts,
        first=first,
        seed=experiment.seed,
    )


def search_with_noise(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
) -> tuple[Problem[jaxik.FootIK], Solution]:
    """The best fit with the noise that the experiment estimates, and the problem with this noise.

    Unless the experiment estimates noise that moves the best point, only the weight changes.
    """
    solution = search(problem, experiment)
    settings, noise = experiment.fit.search, experiment.noise
    problem, solution = fit_with_noise(problem, noise, solution, settings)
    return weighted(problem, experiment, solution), solution


def search_identity(problem: Problem[jaxik.FootIK], experiment: Experiment) -> str:
    """64 characters that change with anything that `search_with_noise` follows from."""
    return digest_with(problem, experiment.fit, experiment.seed, experiment.noise)


def weighted(
    problem: Problem[jaxik.FootIK], experiment: Experiment, solution: Solution
) -> Problem[jaxik.FootIK]:
    """The problem with the weight of residuals in intervals, as those at its solution imply."""
    if experiment.noise.correlation != "counted" or experiment.independent_every:
        return problem
    with activity.announced("Weighing the residuals"):
        return counted(problem, solution.u, played_errors(problem, solution.u))


def played_errors(
    problem: Problem[jaxik.FootIK], u: Float[np.ndarray, " free"]
) -> list[dict[str, Float[np.ndarray, "frames ..."]]]:
    """Errors of each measured kind, clip by clip, by programs that a report needs, too."""
    played = playback.play_all(*system_and_scenes(problem, u))
    return [{kind: np.asarray(play.errors[kind]) for kind in MEASURED} for play in played]


def assess_solution(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    solution: Solution,
    *,
    known_values: Mapping[str, float] | None = None,
    run: Path | None = None,
    has_noise: bool = True,
    clips: tuple[ClipData, ...] = (),
) -> Fit:
    """The fit: a solution and how certain it is, or the lower one that its profiles led to.

    Args:
        experiment: its settings of the search.
        problem: the problem of the experiment.
        solution: of the problem.
        known_values: as `Fit` has them, like what follows.
        run: the folder where each solution is written before its assessment, which may fail.
        has_noise: whether the reference is captured.
        clips: of the problem.

    Raises:
        ValueError: if the Jacobian at a solution is not finite.
    """
    left: list[float] = []
    while True:
        if run is not None:
            save_solution(run, experiment, problem, solution)
        of_weight = solution.weighted(float(problem.weight))
        identifiability = assess_identifiability(problem, of_weight)
        if identifiability.improvement <= MIN_IMPROVEMENT or solution.interrupted:
            break
        if len(left) == MAX_RETURNS:
            break
        first = identifiability.best_u
        lower = _search_lower(problem, experiment, solution, first)
        if not lower.cost < solution.cost:  # with 32-bit floats the point lay before a cliff
            solution = dataclasses.replace(solution, interrupted=lower.interrupted)
            break
        left.append(solution.cost)
        solution = lower
        problem = weighted(problem, experiment, solution)
    return Fit(
        experiment=experiment,
        problem=problem,
        solution=solution,
        identifiability=identifiability,
        known_values=known_values,
        run=run,
        has_noise=has_noise,
        left=tuple(left),
        clips=clips,
    )


def _search_lower(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    before: Solution,
    lower_u: Float[np.ndarray, " free"],
) -> Solution:
    """The best fit from a point that is lower than a solution; steps and time add to its own.

    Where it is lower than the starts' agreement allows, the search begins anew there.
    """
    settings = experiment.fit.search
    after = refine(problem.with_weight(1.0), before, lower_u, settings)
    if after.interrupted or before.cost - after.cost <= settings.agreement:
        return after
    return search(problem, experiment, after.u).following(after)
