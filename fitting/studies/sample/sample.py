"""Sampling the posterior around a fit, and the sensitivity of it to the prior."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.inference.noise import draw_sigmas, measured, with_unknown_sigmas
from fitting.inference.sample.blocks import LeaveOneOut, leave_one_out
from fitting.inference.sample.posterior import (
    Posterior,
    WalkerStart,
    minus_cost,
    sample_posterior,
)
from fitting.inference.sample.prior_sensitivity import Reweighted, prior_sensitivity
from fitting.problem.problem import Problem
from fitting.problem.space import Space
from fitting.studies.fit.assess import MIN_IMPROVEMENT
from fitting.studies.fit.fit import FittedParameter, PriorSummary, summarise_priors

from .replay import Disagreement, Replay, disagreements

SEPARATION = 3.0  # widths of the walkers' ball between places where some of them start


@dataclasses.dataclass(frozen=True)
class SampledFit:
    """A fit with its posterior."""

    experiment: Experiment
    space: Space[jaxik.FootIK]
    parameters: Sequence[FittedParameter]
    """Of the fit, around which the posterior was sampled."""
    posterior: Posterior
    known_values: Mapping[str, float] | None = None
    """What made a synthetic reference, by name."""
    replay: Replay | None = None
    """The motion of some draws."""

    @cached_property
    def priors(self) -> dict[str, PriorSummary]:
        """By name of the parameter."""
        return summarise_priors(self.space)

    @cached_property
    def disagreements(self) -> list[Disagreement]:
        """Parameters of which chain and fit give clearly different intervals."""
        return disagreements(self.parameters, self.posterior)

    @property
    def has_lower_point(self) -> bool:
        """Whether the chain has met a point that is clearly better than the fit."""
        return self.posterior.improvement > MIN_IMPROVEMENT

    @cached_property
    def left_out(self) -> LeaveOneOut | None:
        """How well blocks of frames are predicted from the others, if that can be said."""
        return None if self.replay is None else leave_one_out(self.replay.blocks)

    @cached_property
    def prior_sensitivity(self) -> dict[str, list[Reweighted]]:
        """By name of the parameter, under priors half and twice as wide."""
        return prior_sensitivity(self.posterior, self.space.prior)


def sample_around(
    parameters: Sequence[FittedParameter],
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    chain: Path | None = None,
) -> Posterior:
    """Samples the posterior of a problem.

    Args:
        parameters: the fit, around which the walkers start.
        problem: the problem of the experiment. Sigmas that it has estimated are left open with
            squares as loss; with a robust loss, or with correlations, the estimated ones stay.
        experiment: its settings of the sampler.
        chain: file of the chain; an existing one is continued. None leaves it in memory.

    Raises:
        ValueError: the fit has other parameters than the problem, or the file holds another chain.
    """
    names = [row["name"] for row in parameters]
    if names != list(problem.space.names):
        raise ValueError(
            f"the fit has the parameters {names}, the experiment {list(problem.space.names)}"
        )
    if not names:
        raise ValueError("nothing was free in this fit, so there is no posterior to sample")
    start = walker_start(parameters, problem.space)
    problem = with_open_noise(problem, experiment)
    posterior = sample_posterior(
        problem, start, experiment.sample, seed=experiment.seed, path=chain
    )
    if problem.unknown_sigmas is None:
        return posterior
    return dataclasses.replace(
        posterior, sigmas=draw_sigmas(problem, posterior.draws_u, experiment.seed)
    )


def walker_start(parameters: Sequence[FittedParameter], space: Space) -> WalkerStart:
    """Around the fit, and around the other minima that profiles have met."""
    u = np.array([row["u"] for row in parameters])
    sd = np.array([row["start_sd"] for row in parameters])
    known = [u]
    minima = [minimum for row in parameters for minimum in row.get("valleys", ())]
    for minimum in sorted(minima, key=lambda minimum: minimum["rise"]):
        if "values" in minimum:
            place = np.asarray(space.pack(dict(zip(space.names, minimum["values"], strict=True))))
            if all(np.max(np.abs(place - other) / sd) > SEPARATION for other in known):
                known.append(place)
    return WalkerStart(u, sd, np.array(known[1:]).reshape(-1, u.size))


def minus_cost_at(
    problem: Problem[jaxik.FootIK], experiment: Experiment, u: Float[np.ndarray, " free"]
) -> float:
    """Minus the cost of a point, as a chain around a fit compares it."""
    problem = with_open_noise(problem, experiment)
    log_probability = problem.log_probability(jnp.asarray(u, problem.space.start.dtype))
    return float(minus_cost(problem, u, np.asarray(log_probability)))


def with_predictive_noise(
    problem: Problem[jaxik.FootIK], experiment: Experiment, u: Float[np.ndarray, " free"]
) -> Problem[jaxik.FootIK]:
    """The problem with the noise by which its motion is predicted.

    Where residuals are counted, sigmas only say what a difference weighs; the noise is then that of
    the residuals at the fit.
    """
    noise = experiment.noise
    if noise.correlation != "counted" or noise.moves_optimum or experiment.independent_every:
        return problem
    return measured(problem, u)


def with_open_noise(
    problem: Problem[jaxik.FootIK], experiment: Experiment
) -> Problem[jaxik.FootIK]:
    """The problem with estimated sigmas left open, where the loss allows it."""
    if experiment.noise.sigmas == "estimated" and problem.loss == "squares":
        return with_unknown_sigmas(problem)
    return problem
