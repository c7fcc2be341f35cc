"""Sampling the posterior around a fit."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxik
from fitting.experiments.experiment import Experiment
from fitting.inference.noise.marginal import draw_sigmas, with_unknown_sigmas
from fitting.inference.sampling.posterior import (
    Posterior,
    SamplingProgress,
    WalkerStart,
    sample_posterior,
)
from fitting.problem.problem import Problem

from .fit import FittedParameter


def sample_around(
    parameters: Sequence[FittedParameter],
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    chain: Path | None = None,
    progress: Callable[[SamplingProgress], None] | None = None,
) -> Posterior:
    """Samples the posterior of a problem.

    Args:
        parameters: the fit, around which the walkers start.
        problem: the problem of the experiment. Sigmas that it has estimated are left open with
            squares as loss; a robust loss, and correlations, keep the estimated ones.
        experiment: its settings of the sampler.
        chain: file that keeps the chain; one that is there is continued. None keeps it in memory.
        progress: called as the sampling goes on; KeyboardInterrupt keeps the chain so far.

    Raises:
        ValueError: the fit has other parameters than the problem, or the file holds another chain.
    """
    names = [row["name"] for row in parameters]
    if names != list(problem.space.names):
        raise ValueError(
            f"the fit has the parameters {names}, the experiment {list(problem.space.names)}"
        )
    start = WalkerStart(
        np.array([row["u"] for row in parameters]),
        np.array([row["start_sd"] for row in parameters]),
    )
    if experiment.noise.sigmas == "estimated" and problem.loss == "squares":
        problem = with_unknown_sigmas(problem)
    posterior = sample_posterior(
        problem, start, experiment.sample, seed=experiment.seed, path=chain, progress=progress
    )
    if problem.unknown_sigmas is None:
        return posterior
    return replace(posterior, sigmas=draw_sigmas(problem, posterior.kept_u, experiment.seed))
