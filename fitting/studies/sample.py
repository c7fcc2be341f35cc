"""Sampling the posterior around a fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

import jaxik
from fitting.experiments.experiment import Experiment
from fitting.inference.sampling.posterior import (
    Posterior,
    SamplingProgress,
    WalkerStart,
    sample_posterior,
)
from fitting.inference.sampling.settings import SamplerSettings
from fitting.problem.problem import Problem

from .fit import FittedParameter


@dataclass(frozen=True)
class SamplingStart:
    """The ball around a fit in which the walkers start."""

    names: tuple[str, ...]
    u: Float[np.ndarray, " free"]
    sd: Float[np.ndarray, " free"]

    @classmethod
    def around(cls, parameters: Sequence[FittedParameter]) -> "SamplingStart":
        """The ball around fitted parameters."""
        return cls(
            tuple(row["name"] for row in parameters),
            np.array([row["u"] for row in parameters]),
            np.array([row["start_sd"] for row in parameters]),
        )


def sample_around(
    start: SamplingStart,
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    chain: Path | None = None,
    progress: Callable[[SamplingProgress], None] | None = None,
) -> Posterior:
    """Samples the posterior of a problem.

    Args:
        start: where the walkers start.
        problem: the problem of the experiment.
        experiment: its settings of the sampler.
        chain: file that keeps the chain; one that is there is continued. None keeps it in memory.
        progress: called as the sampling goes on; KeyboardInterrupt keeps the chain so far.

    Raises:
        ValueError: the start is that of other parameters, or the file holds another chain.
    """
    if start.names != problem.space.names:
        raise ValueError(
            f"the fit has the parameters {list(start.names)}, the experiment "
            f"{list(problem.space.names)}"
        )
    options = experiment.sample
    return sample_posterior(
        problem,
        WalkerStart(start.u, start.sd),
        SamplerSettings(
            walkers=options.walkers,
            max_steps=options.max_steps,
            thin_by=options.thin_by,
            stop_at=options.stop_at,
        ),
        seed=experiment.seed,
        path=chain,
        progress=progress,
    )
