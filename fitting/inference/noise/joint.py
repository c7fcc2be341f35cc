"""The joint maximum over the parameters and their noise."""

import dataclasses
from collections.abc import Callable

import jaxik
from fitting.inference.optimisation.kept_stages import KeptStages
from fitting.inference.optimisation.search import cost_before, refine
from fitting.inference.optimisation.settings import DEFAULTS, SearchSettings
from fitting.inference.optimisation.solution import Progress, Solution
from fitting.problem.problem import Problem
from fitting.runtime import activity

from .model import likeliest_noise, noise_of, with_noise
from .settings import NoiseOptions

MAX_ROUNDS = 20
TOLERANCE = 1e-3  # relative change of the noise that ends the rounds; sampling moves it by 1e-2


def fit_with_noise(
    problem: Problem[jaxik.FootIK],
    options: NoiseOptions,
    solution: Solution,
    settings: SearchSettings = DEFAULTS,
    progress: Callable[[Progress], None] | None = None,
    kept: KeptStages | None = None,
) -> tuple[Problem[jaxik.FootIK], Solution]:
    """The best fit with the noise that is likeliest there, and the problem with this noise.

    In turn, the noise is found for the parameters and the parameters for the noise: each raises
    the joint likelihood, which all of it together maximises where neither moves any more. The
    solution's history and effort are those of all rounds; its cost before the fit is with the
    noise of the last.

    Args:
        problem: with the noise to begin with.
        options: what of it is estimated; nothing leaves the solution as it is.
        solution: of the problem.
        settings: of the descents.
        progress: called as they go on.
        kept: the stages of searches that were killed.
    """
    if not options.moves_optimum:
        return problem, solution
    for _ in range(MAX_ROUNDS):
        if solution.interrupted:
            break
        with activity.announced("Estimating the noise"):
            noise = likeliest_noise(problem, solution.u, options)
        if noise.change_from(noise_of(problem)) < TOLERANCE:
            break
        problem = with_noise(problem, noise)
        solution = refine(problem, solution, solution.u, settings, progress, kept)
        solution = dataclasses.replace(solution, cost_before=cost_before(problem))
    return problem, solution
