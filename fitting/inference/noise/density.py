"""The distribution of noise that a loss stands for: minus twice its log-density is the loss."""

import dataclasses
from functools import cached_property

import numpy as np
from jaxtyping import Float

from fitting.problem.loss import Loss

from .series import log_density

FARTHEST = 20.0  # inverse hyperbolic sine of the residual, in sigmas, at which the tails end
POINTS = 8001


@dataclasses.dataclass(frozen=True)
class NoiseDensity:
    """The distribution of one independent residual, in sigmas."""

    loss: Loss
    tails: float
    """Degrees of freedom of Student's t, under this loss."""

    @cached_property
    def _cumulative(self) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Integrals of the unnormalised density up to the hyperbolic sines of the second array.

        These are fine in the middle and coarse in the tails.
        """
        t = np.linspace(-FARTHEST, FARTHEST, POINTS)
        density = np.exp(log_density(np.sinh(t), self.loss, self.tails)) * np.cosh(t)
        steps = 0.5 * (density[1:] + density[:-1]) * np.diff(t)
        return np.concatenate([[0.0], np.cumsum(steps)]), t

    def log_density(self, residuals: Float[np.ndarray, "*values"]) -> Float[np.ndarray, "*values"]:
        """Log-density of residuals in sigmas, constants included."""
        return log_density(residuals, self.loss, self.tails) - np.log(self._cumulative[0][-1])

    def draw(
        self, random: np.random.Generator, shape: tuple[int, ...]
    ) -> Float[np.ndarray, "*values"]:
        """Independent residuals, in sigmas."""
        if self.loss == "squares":
            return random.normal(size=shape)
        integrals, t = self._cumulative
        return np.sinh(np.interp(integrals[-1] * random.random(shape), integrals, t))
