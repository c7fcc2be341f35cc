"""The lowest cost with one parameter held at a value, the others following.

Several starting points compete for each value: all are evaluated in batches, the best of them take
two Gauss-Newton steps with the Jacobian at the solution, and unless that was enough, the best one
then descends by Levenberg–Marquardt, with thresholds and the parameter itself frozen.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.inference.optimisation import levenberg_marquardt, population
from fitting.inference.optimisation.models import HardModel
from fitting.inference.optimisation.solution import Solution
from fitting.problem.problem import Problem
from fitting.problem.space import to_fractions

FOLLOWING = 2  # starting points of each value that take two Gauss-Newton steps
STEPS = 4  # of Levenberg–Marquardt for each value, at most
MIN_GAIN = 0.02  # of the cost; less ends a descent
NEAR = 0.25  # of u: around the solution, its Jacobian still holds
FURTHEST = 4.0  # of u: no parameter follows further than that in one step


@dataclasses.dataclass(frozen=True)
class Points:
    """Points of the search space, all arrays of the same length."""

    u: Float[np.ndarray, "points free"]
    values: Float[np.ndarray, "points free"]
    """In the parameters' units."""
    cost: Float[np.ndarray, " points"]

    def __getitem__(self, chosen: np.ndarray | slice) -> "Points":
        return Points(self.u[chosen], self.values[chosen], self.cost[chosen])


@dataclasses.dataclass(frozen=True)
class Targets:
    """Values at which parameters are held, one parameter at a time."""

    index: Int[np.ndarray, " targets"]
    """Of the parameter that is held."""
    value: Float[np.ndarray, " targets"]
    """In its unit."""

    def __getitem__(self, chosen: np.ndarray | slice) -> "Targets":
        return Targets(self.index[chosen], self.value[chosen])


@dataclasses.dataclass(frozen=True)
class Conditional:
    """A problem, and how its smooth parameters respond near a solution when one is moved."""

    problem: Problem
    solution: Float[np.ndarray, " free"]
    """Its u."""
    jacobian: Float[np.ndarray, "residuals free"]
    """There; 0 for thresholds."""
    response: Float[np.ndarray, "free free"]
    """Row i: move of all parameters for each unit by which the i-th one moves, in u."""

    @classmethod
    def around(cls, problem: Problem, solution: Solution) -> "Conditional":
        """The responses of the normal distribution that the Jacobian at a solution gives."""
        smooth = np.asarray(problem.space.smooth)
        of_smooth = solution.jacobian[:, smooth]
        covariance = np.linalg.inv(of_smooth.T @ of_smooth)  # regular: the prior has rows as well
        response = np.eye(problem.space.size)
        response[np.ix_(smooth, smooth)] = covariance / np.diag(covariance)[:, None]
        return cls(problem, np.asarray(solution.u), solution.jacobian, response)

    def sd(self) -> Float[np.ndarray, " free"]:
        """Laplace's standard deviation of u, NaN for thresholds."""
        smooth = np.asarray(self.problem.space.smooth)
        of_smooth = self.jacobian[:, smooth]
        sd = np.full(smooth.size, np.nan)
        sd[smooth] = np.sqrt(np.diag(np.linalg.inv(of_smooth.T @ of_smooth)))
        return sd

    def points(self, u: Float[np.ndarray, "points free"]) -> Points:
        """Points with their values and costs."""
        cost = population.evaluate(self.problem, u).cost
        return Points(u, population.to_values(self.problem.space, u), cost)

    def carry(
        self, u: Float[np.ndarray, "points free"], targets: Targets, *, alone: bool = False
    ) -> Float[np.ndarray, "points free"]:
        """Points moved to one target each, the smooth parameters responding unless it is alone."""
        space, rows = self.problem.space, np.arange(len(u))
        fractions = [
            float(to_fractions(space.parameters[i], value))
            for i, value in zip(targets.index, targets.value, strict=True)
        ]
        fractions = np.clip(fractions, population.EDGE, 1 - population.EDGE)
        values = population.to_values(space, u)
        if not alone:
            distance = np.log(fractions / (1 - fractions)) - u[rows, targets.index]
            moves = distance[:, None] * self.response[targets.index]
            moved = population.to_values(space, u + np.clip(moves, -FURTHEST, FURTHEST))
            values = np.where(space.thresholds, values, moved)
        values[rows, targets.index] = targets.value
        return population.from_values(space, values)

    def follow(
        self, u: Float[np.ndarray, "points free"], targets: Targets
    ) -> tuple[Points, Points]:
        """Points at their targets with their costs, and the same after a Gauss-Newton step."""
        evaluation = population.evaluate(self.problem, u, self.jacobian)
        before = Points(u, population.to_values(self.problem.space, u), evaluation.cost)
        return before, self.points(self.carry(evaluation.stepped, targets))

    def lowest(
        self,
        targets: Targets,
        starts: Sequence[Float[np.ndarray, "starts free"]],
        highest: float = np.inf,
    ) -> Points:
        """The lowest point found at each target; `starts` has some points to begin with for each.

        Where even the best of them costs more than `highest`, there is no descent.
        """
        counts = [len(of_target) for of_target in starts]
        owner = np.repeat(np.arange(len(counts)), counts)
        points = self.points(self.carry(np.concatenate(list(starts)), targets[owner]))
        best = np.concatenate([_lowest_of(points.cost, owner, i) for i in range(len(counts))])
        once = self.follow(points[best].u, targets[owner[best]])[1]
        twice = self.follow(once.u, targets[owner[best]])[1]
        still = (once.cost - twice.cost < MIN_GAIN) & self._near(twice.u)
        owner = np.concatenate([owner, owner[best], owner[best]])
        done = np.concatenate([np.zeros(len(points.cost) + len(best), bool), still])
        points = join([points, once, twice])
        best = np.concatenate([_lowest_of(points.cost, owner, i)[:1] for i in range(len(counts))])
        return self.descend_each(points[best], targets, done[best] | (points.cost[best] > highest))

    def _near(self, u: Float[np.ndarray, "points free"]) -> Bool[np.ndarray, " points"]:
        """Whether the smooth parameters are so near the solution that its Jacobian still holds."""
        distance = np.abs(u - self.solution)[:, np.asarray(self.problem.space.smooth)]
        return np.all(distance < NEAR, axis=1)

    def descend_each(
        self, points: Points, targets: Targets, done: Bool[np.ndarray, " points"] | None = None
    ) -> Points:
        """Points after a descent each, their targets held; those that are done stay."""
        done = np.zeros(len(points.cost), bool) if done is None else done
        ends = [
            (u, cost) if stays else self.descend(u, int(i))
            for u, cost, i, stays in zip(points.u, points.cost, targets.index, done, strict=True)
        ]
        u, cost = map(np.asarray, zip(*ends, strict=True))
        return Points(u, population.to_values(self.problem.space, u), cost)

    def descend(
        self, u: Float[np.ndarray, " free"], held: int | None, steps: int = STEPS
    ) -> tuple[np.ndarray, float]:
        """The end of a short descent with at most one parameter held, and its cost."""
        start = jnp.asarray(u, self.problem.space.u0.dtype)
        model = HardModel(self.problem, start, np.arange(len(u)) == (-1 if held is None else held))
        state = levenberg_marquardt.evaluate(model, start)
        for _ in range(steps):
            before, state = state, levenberg_marquardt.step(model, state)
            if state.accepted and float(before.cost) - float(state.cost) < MIN_GAIN:
                break
        cost = float(state.cost)
        return np.asarray(state.u), cost if np.isfinite(cost) else np.inf


def _lowest_of(cost: np.ndarray, owner: np.ndarray, target: int) -> np.ndarray:
    """Indices of the lowest starts of one target."""
    mine = np.flatnonzero(owner == target)
    return mine[np.argsort(cost[mine], kind="stable")[:FOLLOWING]]


def join(parts: Sequence[Points]) -> Points:
    """Several sets of points as one."""
    return Points(
        np.concatenate([part.u for part in parts]),
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.cost for part in parts]),
    )
