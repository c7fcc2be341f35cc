"""Quadratic approximations: of a clip's likelihood around a point, and of the prior.

Of the likelihood it is that of Gauss and Newton, with the Fisher information where the loss has
one, as for Laplace's approximation of a single fit. It takes no program that a search has not
compiled already.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.inference.noise.series import information_of_slopes
from fitting.inference.optimisation import levenberg_marquardt
from fitting.inference.optimisation.models import HardModel
from fitting.problem.prior import Prior
from fitting.problem.problem import Problem
from fitting.problem.space import Vector


class Likelihoods(NamedTuple):
    """Clips at one point each, with thresholds held there; minus the log-likelihood is the cost."""

    u: Float[np.ndarray, "clips free"]
    cost: Float[np.ndarray, " clips"]
    gradient: Float[np.ndarray, "clips free"]
    """0 for thresholds."""
    information: Float[np.ndarray, "clips free free"]
    """0 for thresholds."""

    @property
    def vector(self) -> Float[np.ndarray, "clips free"]:
        """The information times where each approximation is lowest."""
        return np.einsum("cij,cj->ci", self.information, self.u) - self.gradient


def expand(problems: Sequence[Problem], u: Float[np.ndarray, "clips free"]) -> Likelihoods:
    """The likelihoods of clips around a point each.

    Args:
        problems: of one clip each, with the same free parameters; their priors do not count.
        u: the points.
    """
    each = [_expand(problem, row) for problem, row in zip(problems, u, strict=True)]
    return Likelihoods(u, *(np.stack(column) for column in zip(*each, strict=True)))


def _expand(problem: Problem, u: Vector) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cost, gradient and information of the likelihood of one clip."""
    space = problem.space
    point = jnp.asarray(u, space.start.dtype)
    lm = levenberg_marquardt.evaluate(HardModel(problem, point), point)
    # Few rows with the same squares as all residuals, those of the prior and of thresholds too.
    residuals, jacobian = np.asarray(lm.compressed.residuals), np.asarray(lm.compressed.jacobian)
    weight = float(problem.weight)
    at_prior = PriorApproximation(
        *(weight * part for part in approximate_prior(space.prior, np.asarray(u)))
    )
    smooth = np.asarray(space.smooth)
    gradient = np.where(smooth, jacobian.T @ residuals - at_prior.gradient, 0.0)
    information = jacobian.T @ jacobian - np.diag(at_prior.information)
    information *= np.outer(smooth, smooth)
    factor = information_of_slopes(problem.loss, float(problem.tails))
    return np.asarray(lm.cost - at_prior.cost.sum(), float), gradient, factor * information


class PriorApproximation(NamedTuple):
    """Minus the log density of the prior around a point; of each parameter."""

    cost: Float[np.ndarray, " free"]
    gradient: Float[np.ndarray, " free"]
    information: Float[np.ndarray, " free"]
    """Slope of the residual, squared; always above 0."""


def approximate_prior(prior: Prior, u: Float[np.ndarray, " free"]) -> PriorApproximation:
    """The prior around a point; exact where it is normal."""
    spread, uniform = np.asarray(prior.spread), np.asarray(prior.uniform)
    z = (u - np.asarray(prior.centre)) / spread
    cost = np.where(uniform, 2 * (np.logaddexp(z / 2, -z / 2) - np.log(2)), 0.5 * z**2)
    gradient = np.where(uniform, np.tanh(z / 2), z) / spread
    near = np.abs(z) < 1e-4  # where both vanish; there the information is that of the limit
    limit = np.where(uniform, 0.5, 1.0) / spread**2
    information = np.where(near, limit, gradient**2 / (2 * np.where(near, 1.0, cost)))
    return PriorApproximation(cost, gradient, information)
