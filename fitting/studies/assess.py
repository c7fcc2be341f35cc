"""The assessment of a solution, from which the search goes on where it meets a lower point."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

import jaxik
from fitting.experiments.experiment import Experiment
from fitting.inference.identifiability import assess_identifiability
from fitting.inference.optimisation.kept_stages import KeptStages
from fitting.inference.optimisation.search import refine
from fitting.inference.optimisation.solution import Progress, Solution
from fitting.problem.problem import Problem

from .fit import Fit, search, weighted

MAX_RETURNS = 3  # to the search from lower points
MIN_IMPROVEMENT = 0.1  # of the cost: a point that much lower is worth another search


def assess_solution(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    solution: Solution,
    progress: Callable[[Progress], None] | None = None,
    on_solution: Callable[[Solution], object] = lambda solution: None,
    kept: KeptStages | None = None,
) -> Fit:
    """The fit: a solution and how certain it is, or the lower one that its profiles led to.

    Args:
        experiment: its settings of the search.
        problem: the problem of the experiment.
        solution: of the problem.
        progress: called as a search goes on.
        on_solution: called with each solution before its assessment, which may fail.
        kept: the stages of searches and profiles that were killed.

    Raises:
        ValueError: if the Jacobian at a solution is not finite.
    """
    left: list[float] = []
    while True:
        on_solution(solution)
        of_weight = solution.weighted(float(problem.weight))
        identifiability = assess_identifiability(problem, of_weight, kept)
        found_lower = identifiability.improvement > MIN_IMPROVEMENT
        fit = Fit(experiment, problem, solution, identifiability, left=tuple(left))
        if not found_lower or solution.interrupted or len(left) == MAX_RETURNS:
            return fit
        first = identifiability.best_u
        lower = _search_lower(problem, experiment, solution, first, progress, kept)
        if not lower.cost < solution.cost:  # with 32-bit floats the point lay before a cliff
            unmoved = dataclasses.replace(solution, interrupted=lower.interrupted)
            return dataclasses.replace(fit, solution=unmoved)
        left.append(solution.cost)
        solution = lower
        problem = weighted(problem, experiment, solution)


def _search_lower(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    before: Solution,
    lower_u: Float[np.ndarray, " free"],
    progress: Callable[[Progress], None] | None = None,
    kept: KeptStages | None = None,
) -> Solution:
    """The best fit from a point that is lower than a solution; steps and time add to its own.

    Where it is lower than the starts' agreement allows, the search begins anew there.

    Args:
        problem: the problem of the experiment.
        experiment: its settings of the search.
        before: the solution that is left.
        lower_u: the lower point, in u.
        progress: called as the search goes on.
        kept: the stages of searches that were killed.
    """
    settings = experiment.fit.search
    after = refine(problem.with_weight(1.0), before, lower_u, settings, progress, kept)
    if after.interrupted or before.cost - after.cost <= settings.agreement:
        return after
    return search(problem, experiment, progress, after.u, kept).following(after)
