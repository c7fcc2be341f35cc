"""Which parameters the data determine, and which they leave to the prior.

Every parameter is judged by its profile: the lowest cost for each of its values, all others
following. The Jacobian at the solution shows how parameters depend on each other.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.problem.problem import Problem
from fitting.problem.space import FreeParameter, scale_width, to_fractions
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import committed

from . import noise
from .optimise.solution import Solution
from .profiles.profile import Profile, usual_rise
from .profiles.profiling import find_curves

LONG = 0.15  # fraction of the range that a parameter covers along a ridge, at least
THIN = 0.05  # width of a ridge, as a fraction of its length, at most
SLIGHT = 0.1  # coefficient, as a fraction of the largest, below which a parameter does not belong
LARGEST = 3  # parameters of a ridge

UNDETERMINED = 0.5  # contraction below which a parameter counts as undetermined
CORRELATED = 0.9  # posterior correlation from which on a pair is named
AT_BOUND = 0.01  # fraction of the range that counts as being at its end
WEAK = 0.3  # component of the weakest direction from which on a parameter is named
NORMAL = 1.96  # standard deviations in half a 95 % interval

Bound = Literal["", "low", "high"]


@dataclasses.dataclass(frozen=True)
class Ridge:
    """A combination that is determined: a sum of coefficients times parameters on their scales."""

    names: tuple[str, ...]
    coefficients: tuple[float, ...]
    """Of the values on the parameters' scales; the first is 1."""

    def describe(self, parameters: Mapping[str, FreeParameter]) -> str:
        """The combination in words: a sum, or a product where all scales are logarithmic."""
        is_product = all(parameters[name].scale != "linear" for name in self.names)
        plus, minus = (" × ", " / ") if is_product else (" + ", " - ")
        words, first = "", 1.0
        for name, coefficient in zip(self.names, self.coefficients, strict=True):
            scale = parameters[name].scale
            term = f"`{name}`" if is_product or scale == "linear" else f"ln(`{name}`)"
            size = abs(coefficient)
            if not np.isclose(size, 1, atol=0.05):
                term = f"{term}^{size:.2g}" if is_product else f"{size:.2g} {term}"
            if words:
                words += (plus if coefficient * first > 0 else minus) + term
            else:
                words, first = term, coefficient
        return words


def find_ridges(
    parameters: Sequence[FreeParameter],
    profiles: Mapping[str, Profile],
    undetermined: Sequence[str],
) -> tuple[Ridge, ...]:
    """The ridges of two or three among the undetermined parameters.

    Along a ridge's profiles its parameters move together: the points that the data allow lie in a
    plane or on a line, in the parameters' fractions of their ranges. The direction across it is the
    combination that the data determine. The parameters are in the order of the paths' columns.
    """
    index = {parameter.name: i for i, parameter in enumerate(parameters)}
    ridges: list[Ridge] = []
    for size in range(2, LARGEST + 1):
        for names in itertools.combinations(undetermined, size):
            if any(set(ridge.names) <= set(names) for ridge in ridges):
                continue
            columns = [index[name] for name in names]
            chosen = [parameters[i] for i in columns]
            points = np.concatenate([_allowed(profiles[name])[:, columns] for name in names])
            across = _across(np.stack(list(map(to_fractions, chosen, points.T)), axis=1))
            if across is not None:
                coefficients = across / [scale_width(parameter) for parameter in chosen]
                ridges.append(Ridge(names, tuple(map(float, coefficients / coefficients[0]))))
    return tuple(ridges)


def _allowed(profile: Profile) -> Float[np.ndarray, "points free"]:
    """The path of a profile where the data allow it."""
    return profile.path[profile.data_rises <= profile.max_rise]


def _across(places: Float[np.ndarray, "points n"]) -> Float[np.ndarray, " n"] | None:
    """The unit vector across points that lie on a thin ridge; None if they do not."""
    if len(places) <= places.shape[1] or (np.ptp(places, axis=0) < LONG).any():
        return None
    centred = places - places.mean(axis=0)
    _, spreads, directions = np.linalg.svd(centred, full_matrices=False)
    across = directions[-1]
    thin = spreads[-1] < THIN * spreads[-2]
    return across if thin and (np.abs(across) > SLIGHT * np.abs(across).max()).all() else None


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """How well each free parameter is determined; arrays in the order of the names."""

    names: tuple[str, ...]
    profiles: Mapping[str, Profile]
    """Of every parameter, with its interval and verdict."""
    contraction: Float[np.ndarray, " free"]
    """0: only the prior is known, 1: the data decide."""
    sd: Float[np.ndarray, " free"]
    """Of u, by Laplace's approximation with the thresholds held; NaN for thresholds."""
    at_bound: tuple[Bound, ...]
    eigenvalues: Float[np.ndarray, " smooth"]
    """Rising; information in units of the prior's."""
    weakest: tuple[str, ...]
    """Parameters in the direction of the smallest eigenvalue."""
    correlated: tuple[tuple[str, str, float], ...]
    """Strongest first."""
    ridges: tuple[Ridge, ...]
    """Combinations that are determined, of parameters that are not."""
    best_u: Float[np.ndarray, " free"]
    """The lowest point that a profile met, the solution included."""
    best_cost: float
    improvement: float
    """How far the cost there is below the solution's."""

    @property
    def interval(self) -> Float[np.ndarray, "free 2"]:
        """95 %, in the parameters' units."""
        return np.asarray([self.profiles[name].interval for name in self.names])

    @property
    def determined(self) -> tuple[str, ...]:
        """Parameters that the data bound on both sides, at one local minimum, and well enough."""
        return tuple(
            name
            for name, contraction in zip(self.names, self.contraction, strict=True)
            if is_determined(self.profiles[name], contraction)
        )

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The others."""
        return tuple(name for name in self.names if name not in self.determined)


def is_determined(profile: Profile, contraction: float) -> bool:
    """Whether the data bound a parameter on both sides, at one local minimum, and well enough."""
    return profile.verdict == "two-sided" and contraction >= UNDETERMINED


@in_float64
def assess_identifiability(problem: Problem, solution: Solution) -> Identifiability:
    """How well the data of a problem determine its parameters around the solution.

    The contraction of a parameter is `1 - (posterior width / prior width)²`, of 95 % intervals, on
    the scale on which its range is divided evenly.

    Raises:
        ValueError: if the Jacobian at the solution is not finite.
    """
    problem = committed(problem)
    space = problem.space
    if not space.size:
        none = np.zeros(0)
        return Identifiability(
            (), {}, none, none, (), none, (), (), (), none, best_cost=solution.cost, improvement=0.0
        )
    if not np.isfinite(solution.jacobian).all():
        raise ValueError(
            f"the Jacobian at the solution is not finite, so nothing is known of how well the"
            f" parameters are determined: {solution.message}"
        )
    laplace = _Laplace.around(problem, solution)
    curves = find_curves(problem, solution)
    profiles = curves.profiles()
    names = [space.names[i] for i in laplace.smooth]
    fractions = jax.nn.sigmoid(jnp.asarray(solution.u))
    best = curves.best
    contraction = _contraction(problem, solution, profiles)
    undetermined = [
        name
        for name, c in zip(space.names, contraction, strict=True)
        if not is_determined(profiles[name], c)
    ]
    return Identifiability(
        names=space.names,
        profiles=profiles,
        contraction=contraction,
        sd=laplace.sd(problem),
        at_bound=tuple(_bound(float(fraction)) for fraction in fractions),
        eigenvalues=laplace.eigenvalues,
        weakest=tuple(n for n, x in zip(names, laplace.weakest, strict=True) if abs(x) > WEAK),
        correlated=_correlated(names, laplace.covariance),
        ridges=find_ridges(space.parameters, profiles, undetermined),
        best_u=best.u[0],
        best_cost=float(best.cost[0]),
        improvement=float(solution.cost - best.cost[0]),
    )


@dataclasses.dataclass(frozen=True)
class _Laplace:
    """The normal approximation of the smooth parameters' posterior, in prior units.

    The prior, too, is approximated by a normal with the slope of its residual at the solution.
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
        root = float(problem.weight) ** 0.5
        prior_sd = root / np.diag(solution.jacobian[-space.size :])[smooth]
        scaled = solution.jacobian[: -space.size, smooth] * prior_sd
        information = scaled.T @ scaled
        information *= noise.information_of_slopes(problem.loss, float(problem.tails))
        eigenvalues, directions = np.linalg.eigh(information)
        covariance = np.linalg.inv(information + np.eye(smooth.size))
        return cls(smooth, prior_sd, covariance, eigenvalues, directions[:, :1].ravel())

    def sd(self, problem: Problem) -> np.ndarray:
        """Standard deviation of `u`, NaN for thresholds."""
        sd = np.full(problem.space.size, np.nan)
        sd[self.smooth] = np.sqrt(np.diag(self.covariance)) * self.prior_sd
        return sd


def _contraction(
    problem: Problem, solution: Solution, profiles: Mapping[str, Profile]
) -> np.ndarray:
    """Of each parameter: 1 less the square of its interval's width over that of its prior's."""
    contraction, prior = [], _prior_interval(problem, solution)
    for parameter, ends in zip(problem.space.parameters, prior, strict=True):
        interval = np.asarray(profiles[parameter.name].interval)
        posterior_width, prior_width = (
            np.ptp(to_fractions(parameter, values)) for values in (interval, ends)
        )
        contraction.append(max(0.0, 1 - float(posterior_width / prior_width) ** 2))
    return np.asarray(contraction)


def _prior_interval(problem: Problem, solution: Solution) -> np.ndarray:
    """Values at the ends of each parameter's interval from its prior alone, (free, 2).

    By the usual rise of a profile; the other parameters are as fitted.
    """
    space, u = problem.space, np.asarray(solution.u)
    rises = np.array([usual_rise(parameter) for parameter in space.parameters])
    moved = [np.where(np.eye(space.size, dtype=bool), end, u) for end in space.prior.ends(rises)]
    return np.stack([np.diag(space.values(rows)) for rows in moved], axis=1)


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
