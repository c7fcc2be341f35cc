"""The joint maximum over the parameters and their noise."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

import jaxik
from fitting.inference.optimisation.search import Starts
from fitting.inference.optimisation.solution import Solution
from fitting.problem.problem import Problem

from .model import likeliest_noise, noise_of, with_noise
from .settings import NoiseOptions

MAX_ROUNDS = 20
TOLERANCE = 1e-3  # relative change of the noise that ends the rounds; sampling moves it by 1e-2

Find = Callable[[Problem[jaxik.FootIK], Starts | None], Solution]
"""A search for the best fit of a problem, from `u` of shape (starts, free) if any are given."""


def fit_with_noise(
    problem: Problem[jaxik.FootIK], options: NoiseOptions, find: Find
) -> tuple[Problem[jaxik.FootIK], Solution]:
    """The best fit with the noise that is likeliest there, and the problem with this noise.

    In turn, the parameters are found for the noise and the noise for the parameters: each raises
    the joint likelihood, which all of it together maximises where neither moves any more. The
    solution's history and effort are those of all rounds.
    """
    solution = find(problem, None)
    if not options.estimates_any:
        return problem, solution
    for _ in range(MAX_ROUNDS):
        if solution.interrupted:
            break
        noise = likeliest_noise(problem, solution.u, options)
        if noise.change_from(noise_of(problem)) < TOLERANCE:
            return problem, solution
        problem = with_noise(problem, noise)
        solution = _continued(solution, find(problem, _one_start(solution)))
    return problem, solution


def _one_start(solution: Solution) -> Float[np.ndarray, "1 free"]:
    return np.asarray(solution.u)[None]


def _continued(before: Solution, after: Solution) -> Solution:
    """The later of two solutions, with the history and effort of both."""
    later = (
        dataclasses.replace(
            step, step=step.step + before.steps, seconds=step.seconds + before.seconds
        )
        for step in after.history
    )
    return dataclasses.replace(
        after,
        history=(*before.history, *later),
        steps=before.steps + after.steps,
        seconds=before.seconds + after.seconds,
    )
