"""What the data determine of a fit, and what they leave to the prior.

Smooth parameters are judged by the Jacobian at the solution (Laplace's approximation), thresholds
by their profile on the hard program.
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.problem.problem import Problem
from fitting.runtime.precision import in_float64

from .noise import series
from .optimisation.solution import Solution
from .threshold_profile import MAX_RISE, Profile, profile

UNDETERMINED = 0.5  # contraction below which a parameter counts as undetermined
CORRELATED = 0.9  # posterior correlation from which on a pair is named
AT_BOUND = 0.01  # fraction of the range that counts as being at its end
WEAK = 0.3  # component of the weakest direction from which on a parameter is named
NORMAL = 1.96  # standard deviations in half a 95 % interval

Bound = Literal["", "low", "high"]


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """How well each free parameter is determined; arrays in the order of the names."""

    names: tuple[str, ...]
    contraction: Float[np.ndarray, " free"]
    """0: only the prior is known, 1: the data decide."""
    interval: Float[np.ndarray, "free 2"]
    """95 %, in the parameter's unit."""
    sd: Float[np.ndarray, " free"]
    """Of u; NaN for thresholds."""
    at_bound: tuple[Bound, ...]
    eigenvalues: Float[np.ndarray, " smooth"]
    """Rising; information in units of the prior's."""
    weakest: tuple[str, ...]
    """Parameters in the direction of the smallest eigenvalue."""
    correlated: tuple[tuple[str, str, float], ...]
    """Strongest first."""
    profiles: dict[str, Profile]
    """Of thresholds."""
    improvement: float
    """How far a profile fell below the solution's cost; 0 at a minimum."""

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters that these data leave to the prior."""
        pairs = zip(self.names, self.contraction, strict=True)
        return tuple(name for name, contraction in pairs if contraction < UNDETERMINED)


@in_float64
def assess_identifiability(problem: Problem, solution: Solution) -> Identifiability:
    """What the data of a problem determine around its solution.

    The contraction of a smooth parameter is `1 - (posterior sd / prior sd)²` in `u`, with the
    thresholds fixed. That of a threshold compares intervals instead: its own with the one that it
    would have if it had no effect, by the same rule from the prior alone.

    Raises:
        ValueError: if the Jacobian at the solution is not finite.
    """
    space = problem.space
    if not np.isfinite(solution.jacobian).all():
        raise ValueError(
            f"the Jacobian at the solution is not finite, so nothing is known of how well the"
            f" parameters are determined: {solution.message}"
        )
    laplace = _Laplace.around(problem, solution)
    profiles = {
        name: profile(problem, solution, name)
        for name, threshold in zip(space.names, space.thresholds, strict=True)
        if threshold
    }
    contraction = np.zeros(space.size)
    contraction[laplace.smooth] = 1 - np.diag(laplace.covariance)
    sd = laplace.sd(problem)
    u = np.asarray(solution.u)
    interval = _interval(problem, u, u + np.nan_to_num(np.outer([-NORMAL, NORMAL], sd)))
    prior_interval = _interval(problem, u, space.prior.ends(MAX_RISE))
    for i, name in enumerate(space.names):
        if name in profiles:
            interval[i] = profiles[name].interval
            width, prior_width = np.diff(interval[i])[0], np.diff(prior_interval[i])[0]
            contraction[i] = max(0.0, 1 - (width / prior_width) ** 2)
    names = [space.names[i] for i in laplace.smooth]
    fractions = jax.nn.sigmoid(jnp.asarray(solution.u))
    return Identifiability(
        names=space.names,
        contraction=contraction,
        interval=interval,
        sd=sd,
        at_bound=tuple(_bound(float(fraction)) for fraction in fractions),
        eigenvalues=laplace.eigenvalues,
        weakest=tuple(n for n, x in zip(names, laplace.weakest, strict=True) if abs(x) > WEAK),
        correlated=_correlated(names, laplace.covariance),
        profiles=profiles,
        improvement=-min([0.0, *(float(profile.rises.min()) for profile in profiles.values())]),
    )


@dataclasses.dataclass(frozen=True)
class _Laplace:
    """The normal approximation of the smooth parameters' posterior, in prior units.

    The prior is approximated likewise: by a normal with the slope of its residual at the solution.
    """

    smooth: np.ndarray  # indices among the free parameters
    prior_sd: np.ndarray  # of u
    covariance: np.ndarray  # in prior variances
    eigenvalues: np.ndarray  # of the information, rising
    weakest: np.ndarray  # eigenvector of the smallest one

    @classmethod
    def around(cls, problem: Problem, solution: Solution) -> "_Laplace":
        space = problem.space
        smooth = np.flatnonzero(space.smooth)
        prior_sd = 1 / np.diag(solution.jacobian[-space.size :])[smooth]
        scaled = solution.jacobian[: -space.size, smooth] * prior_sd
        information = scaled.T @ scaled
        information *= series.information_of_slopes(problem.loss, float(problem.tails))
        eigenvalues, directions = np.linalg.eigh(information)
        covariance = np.linalg.inv(information + np.eye(smooth.size))
        return cls(smooth, prior_sd, covariance, eigenvalues, directions[:, :1].ravel())

    def sd(self, problem: Problem) -> np.ndarray:
        """Standard deviation of `u`, NaN for thresholds."""
        sd = np.full(problem.space.size, np.nan)
        sd[self.smooth] = np.sqrt(np.diag(self.covariance)) * self.prior_sd
        return sd


def _interval(problem: Problem, u: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Values, (free, 2), as each parameter alone moves from its `u` to either of its ends."""
    moved = [np.where(np.eye(u.size, dtype=bool), end, u) for end in ends]
    values = [jax.vmap(problem.space.values)(jnp.asarray(rows, u.dtype)) for rows in moved]
    return np.stack([np.diag(rows) for rows in values], axis=1)


def _bound(fraction: float) -> Bound:
    return "low" if fraction < AT_BOUND else "high" if fraction > 1 - AT_BOUND else ""


def _correlated(names: list[str], covariance: np.ndarray) -> tuple[tuple[str, str, float], ...]:
    """Pairs of strong correlation, the strongest first."""
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) >= CORRELATED
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))
