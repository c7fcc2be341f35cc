"""What is known of the free parameters before any data: the prior of `u`.

Each parameter has a prior of its own, independent of the others. In `u`, the coordinate without
bounds of `space`, it has one of two shapes:

    normal     log density = -½ ((u - centre) / spread)²          up to a constant
    uniform    log density = -2 log cosh(u / 2)                   up to a constant

The second is the logistic distribution, whose image under the sigmoid is uniform: the value is
anywhere in its range with equal density, on the parameter's scale (linear, logarithmic or by way of
the half-life). The solver needs residuals, half of whose squares' sum is minus the log density; the
sampler takes the same function, and since both see densities of `u`, no Jacobian of the transform
enters.
"""

import dataclasses
import math
from collections.abc import Mapping
from types import ModuleType
from typing import Any, Literal, TypeVar, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import special

from .free_parameters import library_of

Points = TypeVar("Points", bound=Float[Array | np.ndarray, "*points free"])
Shape = Literal["normal", "uniform"]

SPREAD = 1.6  # of u: the logistic of a normal this wide is nearly uniform
SPREADS = (1e-3, 1e3)  # of u: from almost known to almost all at the bounds
LOGISTIC_SD = math.pi / math.sqrt(3)  # of the logistic distribution


@dataclasses.dataclass(frozen=True)
class ParameterPrior:
    """The prior of one parameter, as an experiment states it.

    Raises:
        ValueError: for an unknown shape, a spread outside `SPREADS`, or a uniform
            prior with a centre or a spread.
    """

    shape: Shape = "normal"
    centre: float | None = None
    """Median of a normal prior, in the parameter's unit; None is the system's value."""
    spread: float | None = None
    """Standard deviation of a normal prior, in u; None is `SPREAD`."""

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise ValueError(f"shape is {self.shape!r}, wanted one of {get_args(Shape)}")
        for name in ("centre", "spread"):
            if self.shape == "uniform" and getattr(self, name) is not None:
                raise ValueError(f"{name} is given, but a uniform prior has none: it is the range")
        low, high = SPREADS
        if self.spread is not None and not low <= self.spread <= high:
            raise ValueError(f"spread is {self.spread}, wanted a number from {low:g} to {high:g}")


@dataclasses.dataclass(frozen=True)
class Priors:
    """The priors of an experiment's free parameters."""

    default: ParameterPrior = ParameterPrior()
    """Of all parameters that have none of their own; without a centre."""
    named: Mapping[str, ParameterPrior] = dataclasses.field(default_factory=dict)
    """By dotted name."""

    def of(self, name: str) -> ParameterPrior:
        """The prior of the parameter with this name."""
        return self.named.get(name, self.default)


class Prior(eqx.Module):
    """The joint prior of `u`; the parameters are independent."""

    centre: Float[Array, " free"]
    """Of u; 0 where uniform."""
    spread: Float[Array, " free"]
    """Of u: a normal's standard deviation, or the scale of a logistic, 1 where uniform."""
    uniform: Bool[Array, " free"]
    """Where the prior is not a normal."""

    @property
    def sd(self) -> Float[Array, " free"]:
        """Standard deviation of u."""
        return self.spread * jnp.where(self.uniform, LOGISTIC_SD, 1.0).astype(self.spread.dtype)

    def residuals(self, u: Points) -> Points:
        """Half of each square is minus the log density, above its minimum.

        For a normal prior that is the distance from its centre in standard deviations.
        """
        library = library_of(u, self.centre)
        centre, spread = library.asarray(self.centre), library.asarray(self.spread)
        z = (u - centre) / spread
        return library.where(self.uniform, _logistic_residual(z, library), z)

    def quantile(self, probability: Float[np.ndarray, "*points #free"]) -> np.ndarray:
        """The `u` below which each parameter lies with this probability, (*points, free)."""
        normal, logistic = special.ndtri(probability), special.logit(probability)
        z = np.where(np.asarray(self.uniform), logistic, normal)
        return np.asarray(self.centre) + np.asarray(self.spread) * z

    def cumulative(self, u: Float[np.ndarray, "*points free"]) -> np.ndarray:
        """The probability that each parameter lies below its `u`, (*points, free)."""
        z = (u - np.asarray(self.centre)) / np.asarray(self.spread)
        return np.where(np.asarray(self.uniform), special.expit(z), special.ndtr(z))

    def widened(self, factor: float) -> "Prior":
        """The prior with all spreads multiplied; one that was uniform is so no more."""
        return eqx.tree_at(lambda prior: prior.spread, self, factor * self.spread)

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "count free"]:
        """Independent draws of `u`."""
        return self.quantile(random.random((count, self.centre.size)))

    def ends(self, rise: float | Float[np.ndarray, " free"]) -> Float[np.ndarray, "2 free"]:
        """The `u` on either side at which minus the log density exceeds its minimum by `rise`."""
        normal, logistic = np.sqrt(2 * rise), 2 * np.arccosh(np.exp(0.5 * rise))
        z = np.where(np.asarray(self.uniform), logistic, normal) * np.array([[-1.0], [1.0]])
        return np.asarray(self.centre) + np.asarray(self.spread) * z


def _logistic_residual(z: Any, library: ModuleType) -> Any:
    """`2 sign(z) sqrt(log cosh(z / 2))`, without the root of 0 and without overflow."""
    half = 0.5 * z
    near = library.abs(half) < 1
    sinh = library.sinh(library.where(near, half, 0.0))
    square = sinh**2  # log cosh² = log1p(sinh²)
    nonzero = square > library.finfo(z.dtype).eps  # below it the factor rounds to 1
    safe = library.where(nonzero, square, 1.0)
    at_near = sinh * library.sqrt(2.0 * library.where(nonzero, library.log1p(safe) / safe, 1.0))
    size = library.where(near, 1.0, library.abs(half))
    log_cosh = size + library.log1p(library.exp(-2.0 * size)) - math.log(2)
    return library.where(near, at_near, 2.0 * library.sign(z) * library.sqrt(log_cosh))
