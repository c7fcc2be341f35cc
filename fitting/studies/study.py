"""The two jobs: `fit` an experiment, then `sample` its posterior."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxik
from fitting.experiments.experiment import Experiment, load_experiment, make_problem
from fitting.inference.identifiability import Identifiability, identify
from fitting.inference.optimisation.search import find_best_fit
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.optimisation.solution import Progress, Solution
from fitting.inference.sampling.posterior import Posterior, SamplingProgress, sample_posterior
from fitting.problem.problem import Problem

THRESHOLD_SD = 0.05  # of u, around the fit: a Laplace ball at a threshold has the prior's width
LEAST_SD, MOST_SD = 1e-3, 0.5  # of u


@dataclass(frozen=True)
class Fit:
    """A fitted experiment."""

    experiment: Experiment
    problem: Problem
    solution: Solution
    identifiability: Identifiability

    @property
    def ik(self) -> jaxik.FootIK:
        """The fitted system."""
        return self.problem.space.unpack(jnp.asarray(self.solution.u))

    @property
    def start_sd(self) -> Float[np.ndarray, " free"]:
        """Width, in u, of the ball in which walkers start."""
        sd = np.where(np.isfinite(self.identifiability.sd), self.identifiability.sd, THRESHOLD_SD)
        return np.clip(sd, LEAST_SD, MOST_SD)


def fit(
    experiment: Experiment | str | Path, *, progress: Callable[[Progress], None] | None = None
) -> Fit:
    """Fits the free parameters of an experiment to its clips.

    Args:
        experiment: or the path of its file.
        progress: called as the solver goes on. KeyboardInterrupt keeps the best point so far.

    Raises:
        ValueError: for an experiment that does not fit its clips or its preset.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    return fit_problem(make_problem(experiment), experiment, progress)


def fit_problem(
    problem: Problem,
    experiment: Experiment,
    progress: Callable[[Progress], None] | None = None,
    starts: Float[np.ndarray, "starts free"] | None = None,
) -> Fit:
    """Fits a problem that is made already, as that of a translation is."""
    solution = search(problem, experiment, progress, starts)
    return Fit(experiment, problem, solution, identify(problem, solution))


def search(
    problem: Problem,
    experiment: Experiment,
    progress: Callable[[Progress], None] | None,
    starts: Float[np.ndarray, "starts free"] | None = None,
) -> Solution:
    """The first half of `fit`: the parameters, before anything is said of how sure they are.

    Starts in `u` take the place of those that the experiment asks for.
    """
    return find_best_fit(
        problem,
        SearchSettings(max_steps=experiment.fit.max_steps),
        starts=experiment.fit.starts if starts is None else starts,
        seed=experiment.seed,
        progress=progress,
    )


def sample(
    fitted: Fit,
    *,
    path: Path | None = None,
    progress: Callable[[SamplingProgress], None] | None = None,
) -> Posterior:
    """Samples the posterior around a fit; `path` keeps the chain and goes on with one there."""
    return sample_start(
        fitted.problem, fitted.experiment, fitted.solution.u, fitted.start_sd, path, progress
    )


def sample_start(
    problem: Problem,
    experiment: Experiment,
    start_u: Float[np.ndarray, " free"],
    start_sd: Float[np.ndarray, " free"],
    path: Path | None,
    progress: Callable[[SamplingProgress], None] | None,
) -> Posterior:
    """Samples from a start that was stored."""
    options = experiment.sample
    return sample_posterior(
        problem,
        start_u,
        start_sd,
        path=path,
        walkers=options.walkers,
        max_steps=options.max_steps,
        thin_by=options.thin_by,
        stop_at=options.stop_at,
        seed=experiment.seed,
        progress=progress,
    )
