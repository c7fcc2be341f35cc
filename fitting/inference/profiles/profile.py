"""The profile of one parameter, and its reading: minima, interval and verdict.

Near its lowest point a profile is a parabola, and half a quantile of chi-square is right for how
far it rises within an interval (1.92 for 95 %). The profile of a limit that a clip hardly reaches
is not: beside a plateau, where the limit does nothing, a narrow minimum lies where it happens to
suit the noise of some frames. That is the lowest of many that noise might have made, so
chi-square excludes the plateau too often. The profile is therefore also read as a density of the
parameter's probability, prior included, and an interval reaches as high as the smallest region with
enough of it.
"""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.special import chdtr

from fitting.problem.problem import Problem
from fitting.problem.space import EDGE, FreeParameter, from_fractions, to_fractions

from .conditional import Points, Targets, join

BARRIER = 2.0  # times that rise, at least, lies between two minima
SEPARATION = 0.05  # fraction of the range between two minima, at least: hard decisions make cliffs

Verdict = Literal["two-sided", "at least", "at most", "flat", "several valleys"]

SAME_PLACE = 1e-9  # fraction of the range

LEVEL = 0.95
# Rise of the cost at the ends of a 95 % interval. A smooth parameter: half the quantile of the
# chi-square distribution with one degree of freedom. A threshold, whose cost is a walk of random
# steps to either side: half of 7.35 (Hansen, Sample splitting and threshold estimation, 2000).
RISE_OF_SMOOTH = 1.92
RISE_OF_THRESHOLD = 3.68
CELLS = 16  # between two points of a profile


@dataclasses.dataclass(frozen=True)
class Minimum:
    """A part of the range in which the cost is low."""

    value: float
    """Where the cost is lowest, in the parameter's unit."""
    rise: float
    """There, above the lowest cost of all."""
    interval: tuple[float, float]
    """Where the cost stays low, in the parameter's unit."""


@dataclasses.dataclass(frozen=True)
class Profile:
    """Lowest cost for each value of one parameter, all other parameters following.

    The interval is where the rise stays below `max_rise`, usually as the likelihood ratio has it.
    The verdict leaves the parameter's own prior out: a side is bounded only if the data raise the
    cost there.
    """

    values: Float[np.ndarray, " points"]
    """In the parameter's unit, rising."""
    rises: Float[np.ndarray, " points"]
    """Of the cost, above the lowest."""
    data_rises: Float[np.ndarray, " points"]
    """The same of the cost without the parameter's own prior."""
    prior_rises: Float[np.ndarray, " points"]
    """Of this prior's part of the cost, above its lowest."""
    path: Float[np.ndarray, "points free"]
    """Values of all parameters at these points, in their units."""
    max_rise: float
    """Within a 95 % interval."""
    minima: tuple[Minimum, ...]
    """From low values to high ones."""
    verdict: Verdict
    """Which sides the data bound."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, in the parameter's unit; from the first minimum to the last."""
        return self.minima[0].interval[0], self.minima[-1].interval[1]


def make_profile(
    parameter: FreeParameter,
    path: Float[np.ndarray, "points free"],
    own: Float[np.ndarray, " points"],
    costs: Float[np.ndarray, " points"],
    own_prior: Float[np.ndarray, " points"],
) -> Profile:
    """The profile of a parameter through some points, in any order.

    Args:
        parameter: whose profile it is.
        path: values of all parameters.
        own: values of this one.
        costs: prior included.
        own_prior: this parameter's part of the cost.
    """
    order = np.argsort(own, kind="stable")
    own, costs, own_prior = own[order], costs[order], own_prior[order]
    data_costs = costs - own_prior
    rises, data_rises = costs - costs.min(), data_costs - data_costs.min()
    highest = max_rise(parameter, own, rises)
    parts = low_parts(to_fractions(parameter, own), rises, highest)
    minima = tuple(_minimum(parameter, own, rises, part, highest) for part in parts)
    free_below = bool((data_rises[: parts[0].start] <= highest).all())
    free_above = bool((data_rises[parts[-1].stop :] <= highest).all())
    return Profile(
        values=own,
        rises=rises,
        data_rises=data_rises,
        prior_rises=own_prior - own_prior.min(),
        path=path[order],
        max_rise=highest,
        minima=minima,
        verdict=_verdict(len(parts), free_below, free_above),
    )


def low_parts(
    places: Float[np.ndarray, " points"], rises: Float[np.ndarray, " points"], highest: float
) -> list[slice]:
    """The minima of a curve, as runs of points that rise no higher than `highest` in between.

    Places are fractions of the range, rising.
    """
    low = rises <= highest
    edges = np.flatnonzero(np.diff(np.concatenate([[False], low, [False]])))
    parts: list[slice] = []
    for start, stop in edges.reshape(-1, 2):
        last = parts[-1].stop if parts else 0
        if parts and (
            rises[last:start].max() < BARRIER * highest
            or places[start] - places[last - 1] < SEPARATION
        ):
            parts[-1] = slice(parts[-1].start, int(stop))
        else:
            parts.append(slice(int(start), int(stop)))
    return parts


def crossing(inside: tuple[float, float], outside: tuple[float, float], highest: float) -> float:
    """Where a curve crosses a height between two points (place, rise), as a parabola would.

    The square root of the rise over a parabola's minimum is linear in the distance from it.
    """
    (a, low), (b, high) = inside, outside
    near, far = np.sqrt(max(low, 0.0)), np.sqrt(high)
    return a + (b - a) * float(np.clip((np.sqrt(highest) - near) / (far - near), 0, 1))


def _minimum(
    parameter: FreeParameter, own: np.ndarray, rises: np.ndarray, part: slice, highest: float
) -> Minimum:
    lowest = part.start + int(np.argmin(rises[part]))
    ends = (
        _end(parameter, own, rises, (part.start, part.start - 1), highest),
        _end(parameter, own, rises, (part.stop - 1, part.stop), highest),
    )
    return Minimum(float(own[lowest]), float(rises[lowest]), ends)


def _end(
    parameter: FreeParameter,
    own: np.ndarray,
    rises: np.ndarray,
    edge: tuple[int, int],
    highest: float,
) -> float:
    """Value at which a minimum ends, between its outermost point and the next.

    The interval of a threshold reaches to that next point: a cliff may lie anywhere between them.
    """
    inside, outside = edge
    if not 0 <= outside < len(own):
        return parameter.low if outside < 0 else parameter.high
    if parameter.kind == "threshold":
        return float(own[outside])
    places = to_fractions(parameter, own[[inside, outside]])
    place = crossing((places[0], rises[inside]), (places[1], rises[outside]), highest)
    return float(from_fractions(parameter, np.asarray(place)))


def _verdict(minima: int, free_below: bool, free_above: bool) -> Verdict:
    if minima > 1:
        return "several valleys"
    if free_below and free_above:
        return "flat"
    return "at most" if free_below else "at least" if free_above else "two-sided"


class Curves:
    """For each parameter the lowest points known, sorted by its value."""

    def __init__(self, problem: Problem, solution: Points):
        self.problem, self.space = problem, problem.space
        self.curves = [solution for _ in range(problem.space.size)]

    def add(self, targets: Targets, points: Points) -> None:
        """Adds a point to the curve of each target's parameter; of two in a place, the lower."""
        for i in np.unique(targets.index):
            both = join([self.curves[i], points[targets.index == i]])
            both = both[np.isfinite(both.cost)]
            own = to_fractions(self.space.parameters[i], both.values[:, i])
            order = np.lexsort((both.cost, np.round(own / SAME_PLACE)))
            own = own[order]
            first = np.concatenate([[True], np.diff(own) > SAME_PLACE])
            self.curves[i] = both[order[first]]

    def fractions(self, i: int) -> Float[np.ndarray, " points"]:
        """Where the points of a curve lie in the parameter's range, 0..1, rising."""
        return to_fractions(self.space.parameters[i], self.curves[i].values[:, i])

    def nearest(self, i: int, place: float) -> Points:
        """The point of a curve that is nearest to a fraction of the range, alone."""
        k = int(np.argmin(np.abs(self.fractions(i) - place)))
        return self.curves[i][k : k + 1]

    def rises(self, i: int) -> Float[np.ndarray, " points"]:
        """Cost of a curve's points above its lowest."""
        return self.curves[i].cost - self.curves[i].cost.min()

    def data_rises(self, i: int) -> Float[np.ndarray, " points"]:
        """The same of the cost without the parameter's own prior."""
        curve = self.curves[i]
        cost = curve.cost - self.problem.prior_costs(curve.u)[:, i]
        return cost - cost.min()

    def highest(self, i: int) -> float:
        """Rise of the cost within the 95 % interval of a parameter."""
        return max_rise(self.space.parameters[i], self.curves[i].values[:, i], self.rises(i))

    @property
    def best(self) -> Points:
        """The lowest point of all, alone."""
        together = join(self.curves)
        lowest = int(np.argmin(together.cost))
        return together[lowest : lowest + 1]

    def share(self) -> None:
        """Gives every curve the points of the others that lie below it."""
        together = join(
            [curve[self.rises(i) < 4 * self.highest(i)] for i, curve in enumerate(self.curves)]
        )
        for i, parameter in enumerate(self.space.parameters):
            own = to_fractions(parameter, together.values[:, i])
            known = np.interp(own, self.fractions(i), self.curves[i].cost)
            lower = together[together.cost < known - 0.01]
            self.add(Targets(np.full(len(lower.cost), i), lower.values[:, i]), lower)

    def profiles(self) -> dict[str, Profile]:
        """The profile of each parameter, by name."""
        return {
            parameter.name: make_profile(
                parameter,
                curve.values,
                curve.values[:, i],
                curve.cost,
                self.problem.prior_costs(curve.u)[:, i],
            )
            for i, (parameter, curve) in enumerate(
                zip(self.space.parameters, self.curves, strict=True)
            )
        }


def usual_rise(parameter: FreeParameter) -> float:
    """Rise of the cost at the ends of a 95 % interval, where the profile has its usual shape."""
    return RISE_OF_THRESHOLD if parameter.kind == "threshold" else RISE_OF_SMOOTH


def max_rise(
    parameter: FreeParameter,
    values: Float[np.ndarray, " points"],
    rises: Float[np.ndarray, " points"],
) -> float:
    """Rise of the cost within a 95 % interval of the profile through points, values rising."""
    usual = usual_rise(parameter)
    cells, mass = _density(parameter, values, rises)
    if not len(cells):
        return usual
    order = np.argsort(cells, kind="stable")
    inside = np.searchsorted(np.cumsum(mass[order]), LEVEL * mass.sum())
    return max(usual, float(cells[order[min(inside, len(order) - 1)]]))


def level_of(
    parameter: FreeParameter,
    values: Float[np.ndarray, " points"],
    rises: Float[np.ndarray, " points"],
    rise: float,
) -> float:
    """Level, 0..1, of the interval of a smooth parameter at whose ends the cost has this rise."""
    cells, mass = _density(parameter, values, rises)
    by_mass = float(mass[cells <= rise].sum() / mass.sum()) if len(cells) else 1.0
    return min(float(chdtr(1, 2 * rise)), by_mass)


def _density(
    parameter: FreeParameter,
    values: Float[np.ndarray, " points"],
    rises: Float[np.ndarray, " points"],
) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, " cells"]]:
    """Rise and probability of small cells along a profile, up to a factor."""
    fractions = np.clip(to_fractions(parameter, values), EDGE, 1 - EDGE)
    u = np.log(fractions / (1 - fractions))  # in which the prior is a density
    middles = (np.arange(CELLS) + 0.5) / CELLS
    roots = np.sqrt(np.maximum(rises, 0.0))  # linear along a parabola
    between = roots[:-1, None] + np.diff(roots)[:, None] * middles
    cells = between.ravel() ** 2
    return cells, np.exp(-cells) * np.repeat(np.diff(u) / CELLS, CELLS)
