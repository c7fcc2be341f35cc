"""The profile of one parameter, and what it says: valleys, interval and verdict."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float

from fitting.problem.free_parameters import FreeParameter, from_fractions, to_fractions

from .heights import max_rise

BARRIER = 2.0  # times that rise, at least, lies between two valleys
SEPARATION = 0.05  # fraction of the range, at least, likewise: hard decisions make small cliffs

Verdict = Literal["two-sided", "at least", "at most", "flat", "several valleys"]


@dataclasses.dataclass(frozen=True)
class Valley:
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
    valleys: tuple[Valley, ...]
    """From low values to high ones."""
    verdict: Verdict
    """Which sides the data bound."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, in the parameter's unit; from the first valley to the last."""
        return self.valleys[0].interval[0], self.valleys[-1].interval[1]


def make_profile(
    parameter: FreeParameter,
    path: Float[np.ndarray, "points free"],
    own: Float[np.ndarray, " points"],
    costs: Float[np.ndarray, " points"],
    own_prior: Float[np.ndarray, " points"],
) -> Profile:
    """The profile through some points, in any order.

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
    valleys = tuple(_valley(parameter, own, rises, part, highest) for part in parts)
    free_below = bool((data_rises[: parts[0].start] <= highest).all())
    free_above = bool((data_rises[parts[-1].stop :] <= highest).all())
    return Profile(
        values=own,
        rises=rises,
        data_rises=data_rises,
        prior_rises=own_prior - own_prior.min(),
        path=path[order],
        max_rise=highest,
        valleys=valleys,
        verdict=_verdict(len(parts), free_below, free_above),
    )


def low_parts(
    places: Float[np.ndarray, " points"], rises: Float[np.ndarray, " points"], highest: float
) -> list[slice]:
    """The valleys of a curve, as runs of points that rise no higher than this in between.

    Args:
        places: fractions of the range, rising.
        rises: of the cost.
        highest: rise up to which a point is low.
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


def _valley(
    parameter: FreeParameter, own: np.ndarray, rises: np.ndarray, part: slice, highest: float
) -> Valley:
    lowest = part.start + int(np.argmin(rises[part]))
    ends = (
        _end(parameter, own, rises, (part.start, part.start - 1), highest),
        _end(parameter, own, rises, (part.stop - 1, part.stop), highest),
    )
    return Valley(float(own[lowest]), float(rises[lowest]), ends)


def _end(
    parameter: FreeParameter,
    own: np.ndarray,
    rises: np.ndarray,
    edge: tuple[int, int],
    highest: float,
) -> float:
    """Value at which a valley ends, between its outermost point and the next.

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


def _verdict(valleys: int, free_below: bool, free_above: bool) -> Verdict:
    if valleys > 1:
        return "several valleys"
    if free_below and free_above:
        return "flat"
    return "at most" if free_below else "at least" if free_above else "two-sided"
