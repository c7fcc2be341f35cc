"""What the data determine of a fit, and what they leave to the prior.

Smooth parameters are judged by the slopes at the solution (Laplace), thresholds by their profile on
the hard program: a cost of plateaus and cliffs has an interval, and no standard deviation.
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.problem.problem import Problem

from .optimisation import population
from .optimisation.solution import Solution

CONTRACTED = 0.5  # below it a parameter counts as undetermined
CORRELATED = 0.9  # correlations of the posterior from here on are named
BOUND = 0.01  # share of the range that counts as being at its end
RISE = 1.92  # of the cost, at the ends of a 95 % interval (chi-square of one parameter, halved)
NORMAL = 1.96  # standard deviations, likewise
PRIOR_WIDTH = 0.95  # share of the range within the prior's 95 % interval, which is nearly flat
NUDGE = 0.1  # share of the range by which a threshold is moved to see what it does


@dataclasses.dataclass(frozen=True)
class Profile:
    """Cost over one threshold, the smooth parameters following."""

    values: Float[np.ndarray, " points"]  # in its unit, rising
    rises: Float[np.ndarray, " points"]  # of the cost above the least of them
    interval: tuple[float, float]  # 95 %: where the rise stays below 1.92, and what lies between
    nudged: tuple[float, float]  # rise when moved alone by a tenth of the range, down and up


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """How well each free parameter is determined; arrays in the order of the names."""

    names: tuple[str, ...]
    contraction: Float[np.ndarray, " free"]  # 0: the prior is all there is, 1: the data decide
    interval: Float[np.ndarray, "free 2"]  # 95 %, in the parameter's unit
    sd: Float[np.ndarray, " free"]  # of u; NaN for thresholds
    at_bound: tuple[Literal["", "low", "high"], ...]
    eigenvalues: Float[np.ndarray, " smooth"]  # rising; information in units of the prior's
    weakest: tuple[str, ...]  # names that make up the direction of the least eigenvalue
    correlated: tuple[tuple[str, str, float], ...]
    profiles: dict[str, Profile]  # of thresholds
    improvement: float  # how far a profile went below the solution's cost; 0 at a minimum

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names that these data leave to the prior."""
        pairs = zip(self.names, self.contraction, strict=True)
        return tuple(name for name, contraction in pairs if contraction < CONTRACTED)


def identify(problem: Problem, solution: Solution) -> Identifiability:
    """What the data of a problem determine around its solution.

    The contraction of a smooth parameter is `1 - (posterior sd / prior sd)²` in `u`, the thresholds
    being held; of a threshold it is the same of the interval's share of the range.

    Raises:
        ValueError: if the slopes at the solution are not finite.
    """
    space = problem.space
    if not np.isfinite(solution.jacobian).all():
        raise ValueError(f"nothing can be said where the slopes are not finite: {solution.message}")
    chosen = np.flatnonzero(space.smooth)
    prior_sd = np.asarray(space.prior_sd)[chosen]
    scaled = solution.jacobian[: -space.size, chosen] * prior_sd
    information = scaled.T @ scaled
    eigenvalues, directions = np.linalg.eigh(information)
    covariance = np.linalg.inv(information + np.eye(chosen.size))  # in prior variances
    shares = np.diag(covariance)
    profiles = {
        name: profile(problem, solution, name)
        for name, decides in zip(space.names, space.thresholds, strict=True)
        if decides
    }
    contraction = np.zeros(space.size)
    contraction[chosen] = 1 - shares
    sd = np.full(space.size, np.nan)
    sd[chosen] = np.sqrt(shares) * prior_sd
    u, ends = jnp.asarray(solution.u), jnp.diag(jnp.nan_to_num(jnp.asarray(NORMAL * sd)))
    low, high = (np.diag(jax.vmap(space.values)(u + sign * ends)) for sign in (-1, 1))
    interval = np.stack([low, high], axis=1)
    for i, name in enumerate(space.names):
        if name in profiles:
            interval[i] = profiles[name].interval
            width = (interval[i, 1] - interval[i, 0]) / float(space.high[i] - space.low[i])
            contraction[i] = max(0.0, 1 - (width / PRIOR_WIDTH) ** 2)
    names = [space.names[i] for i in chosen]
    weights = np.abs(directions[:, :1])
    best = min([0.0, *(float(one.rises.min()) for one in profiles.values())])
    return Identifiability(
        names=space.names,
        contraction=contraction,
        interval=interval,
        sd=sd,
        at_bound=tuple(_bound_of(share) for share in jax.nn.sigmoid(u)),
        eigenvalues=eigenvalues,
        weakest=tuple(name for name, weight in zip(names, weights, strict=True) if weight > 0.3),
        correlated=_pairs(names, covariance),
        profiles=profiles,
        improvement=-best,
    )


def _bound_of(share: Array) -> Literal["", "low", "high"]:
    return "low" if share < BOUND else "high" if share > 1 - BOUND else ""


def _pairs(names: list[str], covariance: np.ndarray) -> tuple[tuple[str, str, float], ...]:
    """Pairs of strong correlation, the strongest first."""
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    found = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) >= CORRELATED
    ]
    return tuple(sorted(found, key=lambda pair: -abs(pair[2])))


def profile(problem: Problem, solution: Solution, name: str) -> Profile:
    """Cost over the range of one threshold, the others keeping their values.

    The smooth parameters follow by two Gauss-Newton steps with the slopes at the solution. First
    the whole range, then again where the interval ends; it reaches out to the first point beyond,
    since a cliff may lie anywhere between two points.

    Raises:
        ValueError: for a name that is not free.
    """
    space = problem.space
    if name not in space.names:
        raise ValueError(f"not free: {name!r}; free are {list(space.names)}")
    i = space.names.index(name)
    low, high = float(space.low[i]), float(space.high[i])
    here = float(solution.values[i])
    half = population.BATCH // 2
    values = np.sort(np.append(np.linspace(low, high, population.BATCH - 1), here))
    rises = _rises(problem, solution, i, values, follow=True)
    for _ in range(2):
        start, end = _hull(values, rises)
        first = np.linspace(values[max(start - 1, 0)], values[start], half)
        last = np.linspace(values[end], values[min(end + 1, len(values) - 1)], half)
        finer = np.concatenate([first, last])
        values, order = np.unique(np.concatenate([values, finer]), return_index=True)
        rises = np.concatenate([rises, _rises(problem, solution, i, finer, follow=True)])[order]
    start, end = _hull(values, rises)
    nudge = NUDGE * (high - low)
    sides = np.clip([here - nudge, here + nudge], low, high)
    down, up = _rises(problem, solution, i, sides, follow=False)
    interval = (values[max(start - 1, 0)], values[min(end + 1, len(values) - 1)])
    return Profile(
        values, rises, (float(interval[0]), float(interval[1])), (float(down), float(up))
    )


def _hull(values: np.ndarray, rises: np.ndarray) -> tuple[int, int]:
    """First and last point within the interval."""
    within = np.flatnonzero(rises <= rises.min() + RISE)
    return int(within[0]), int(within[-1])


def _rises(
    problem: Problem, solution: Solution, i: int, values: np.ndarray, *, follow: bool
) -> np.ndarray:
    """Cost above the solution's with the i-th value exchanged, the other values being kept."""
    space = problem.space
    table = np.tile(solution.values, (len(values), 1))
    table[:, i] = values
    candidates = population.from_values(space, table)
    cost = np.full(len(values), np.inf)
    for _ in range(3 if follow else 1):
        born = population.evaluate(problem, candidates, solution.jacobian)
        cost = np.minimum(cost, born.cost)
        candidates = born.stepped
    return cost - solution.cost
