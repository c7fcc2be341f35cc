"""The points of all profiles while they are being found."""

import numpy as np
from jaxtyping import Float

from fitting.problem.free_parameters import to_fractions
from fitting.problem.problem import Problem

from .conditional import Points, Targets, join
from .heights import max_rise
from .profile import Profile, make_profile

SAME_PLACE = 1e-9  # fraction of the range


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
