"""The lowest cost with one parameter held at a value, the others following.

The cost has cliffs wherever a hard decision flips, along smooth parameters as well: a full
Gauss-Newton step often falls off one. Therefore many candidates compete for each value. In each of
them a random subset of the parameters that have slopes makes a Gauss-Newton step with the Jacobian
at the solution, some with an additional random move, since the places of cliffs depend on all
parameters; the best candidate is the base of the next ones. Far from the solution, where its
Jacobian does not hold, a descent by Levenberg–Marquardt follows.

A threshold has no derivative, but where it shifts a weight that fades in or out, the motion changes
in proportion all the same, and two such thresholds may form a ridge along which both must move. Its
slope is that of a secant, over a step that changes the residuals by about as much as noise does.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.inference.optimise import evolution, levenberg_marquardt
from fitting.inference.optimise.evolution import Slopes
from fitting.inference.optimise.levenberg_marquardt import HardModel
from fitting.inference.optimise.solution import Solution
from fitting.problem.problem import Problem
from fitting.problem.space import EDGE, to_fractions
from fitting.runtime.threads import on_all_cores

CANDIDATES = 12  # for each value in a generation
GENERATIONS = 3  # of candidates
STEPS = 3  # of Levenberg–Marquardt for each value, at most
MIN_GAIN = 0.02  # of the cost; less ends a descent
NEAR = 0.5  # of u: around the solution, its Jacobian still holds
MOVES = (0.05, 0.5)  # size of random moves, in standard deviations of Laplace's approximation
FURTHEST = 4.0  # of u: no parameter follows further than that in one step

SECANT_STEPS = 2.0 ** -np.arange(14)  # of u, each twice the next
CHANGE = 2.0  # of the residuals, half their square, that a step should cause
CHANGES = (0.3, 20.0)  # and may cause
GRADUAL = (0.15, 0.4)  # change in half a step over that in a whole one, a quarter if proportional


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
    """A problem, and the normal equations at a solution of its parameters that have slopes."""

    problem: Problem
    solution: Float[np.ndarray, " free"]
    """Its u."""
    slopes: Slopes
    """There; 0 for thresholds whose effect is not gradual."""
    spread: Float[np.ndarray, "free free"]
    """Turns standard normal numbers into draws from Laplace's approximation; 0 for the others."""
    random: np.random.Generator

    @classmethod
    def around(cls, problem: Problem, solution: Solution) -> "Conditional":
        """The normal equations at a solution."""
        smooth = np.asarray(problem.space.smooth)
        of_thresholds = slopes_of_thresholds(problem, np.asarray(solution.u))
        slopes = Slopes.of(np.where(smooth, solution.jacobian, of_thresholds))
        sloping = np.ix_(*[np.diag(slopes.gram) > 0] * 2)
        spread = np.zeros_like(slopes.gram)
        spread[sloping] = np.linalg.inv(np.linalg.cholesky(slopes.gram[sloping])).T
        return cls(problem, np.asarray(solution.u), slopes, spread, np.random.default_rng(0))

    @property
    def gram(self) -> Float[np.ndarray, "free free"]:
        """The matrix of the normal equations."""
        return self.slopes.gram

    @property
    def sloping(self) -> Bool[np.ndarray, " free"]:
        """Which parameters have a slope: smooth ones, and thresholds with a gradual effect."""
        return np.diag(self.gram) > 0

    def points(self, u: Float[np.ndarray, "points free"]) -> Points:
        """Points with their values and costs."""
        cost = evolution.evaluate(self.problem, u).cost
        return Points(u, self.problem.space.values(u), cost)

    def evaluate(self, u: Float[np.ndarray, "points free"]) -> tuple[Points, np.ndarray]:
        """Points, and the gradients of their costs by the solution's Jacobian."""
        evaluation = evolution.evaluate(self.problem, u, self.slopes)
        gradient = -(evaluation.stepped - u) @ self.gram
        return Points(u, self.problem.space.values(u), evaluation.cost), gradient

    def move(
        self,
        points: Points,
        gradient: Float[np.ndarray, "points free"],
        targets: Targets,
        following: Bool[np.ndarray, "points free"],
        besides: Float[np.ndarray, "points free"] | float = 0.0,
    ) -> Float[np.ndarray, "points free"]:
        """Points moved to a target each, some of the parameters with slopes following.

        Those that follow take the Gauss-Newton step that is best once the target is reached, and
        the move `besides`.
        """
        space, rows = self.problem.space, np.arange(len(points.u))
        fractions = [
            float(to_fractions(space.parameters[i], value))
            for i, value in zip(targets.index, targets.value, strict=True)
        ]
        fractions = np.clip(fractions, EDGE, 1 - EDGE)
        distance = np.log(fractions / (1 - fractions)) - points.u[rows, targets.index]
        following = following & self.sloping
        following[rows, targets.index] = False
        both = following[:, :, None] & following[:, None, :]
        matrix = np.where(both, self.gram, np.eye(space.size))
        force = gradient + distance[:, None] * self.gram[targets.index]
        steps = np.linalg.solve(matrix, np.where(following, -force, 0.0)[..., None])[..., 0]
        steps = np.clip(steps, -FURTHEST, FURTHEST) + besides
        moved = space.values(points.u + steps)
        values = np.where(following, moved, points.values)
        values[rows, targets.index] = targets.value
        return space.pack_values(values)

    def lowest(self, targets: Targets, starts: Sequence[Points]) -> Points:
        """The lowest point found at each target, from some starts for each.

        Where that is far from the solution, a descent follows.
        """
        base, owner = join(starts), np.repeat(np.arange(len(starts)), [len(s.cost) for s in starts])
        gradient = np.zeros_like(base.u)  # near their own optimum, the targets apart
        lowest: Points | None = None
        for _ in range(GENERATIONS):
            chosen, following, besides = self._choose(base.cost, owner, len(starts))
            here = targets[owner[chosen]]
            moved = self.move(base[chosen], gradient[chosen], here, following, besides)
            evaluated, slopes = self.evaluate(moved)
            # The starts, which are not at their targets, do not compete with the candidates.
            rivals = slice(0, 0) if lowest is None else slice(None)
            base = join([base[rivals], evaluated])
            gradient = np.concatenate([gradient[rivals], slopes])
            owner = np.concatenate([owner[rivals], owner[chosen]])
            best = _lowest_of(base.cost, owner, len(starts))
            base, gradient, owner = base[best], gradient[best], owner[best]
            lowest = base
        assert lowest is not None
        far = ~self._near(lowest.u) & np.isfinite(lowest.cost)
        return self.descend_each(lowest, targets, far)

    def _choose(
        self, cost: np.ndarray, owner: np.ndarray, targets: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bases of the candidates of each target, which parameters follow, and their random moves.

        In one candidate from each base all follow, in one none, in the others a random subset, half
        of them with a random move.
        """
        chosen = []
        for target in range(targets):
            mine = np.flatnonzero(owner == target)
            mine = mine[np.argsort(cost[mine], kind="stable")]
            chosen.append(np.resize(mine, max(CANDIDATES, 2 * len(mine))))
        rows = np.concatenate(chosen)
        share = self.random.random((len(rows), 1))
        following = self.random.random((len(rows), self.solution.size)) < share
        sizes = np.exp(self.random.uniform(np.log(MOVES[0]), np.log(MOVES[1]), (len(rows), 1)))
        sizes[self.random.random(len(rows)) < 0.5] = 0
        besides = sizes * (self.random.normal(size=following.shape) @ self.spread.T)
        first = 0
        for mine in chosen:
            count = len(np.unique(mine))
            following[first : first + count] = True
            following[first + count : first + 2 * count] = False
            besides[first : first + 2 * count] = 0
            first += len(mine)
        return rows, following, besides

    def _near(self, u: Float[np.ndarray, "points free"]) -> Bool[np.ndarray, " points"]:
        """Whether the smooth parameters are so near the solution that its Jacobian still holds."""
        distance = np.abs(u - self.solution)[:, np.asarray(self.problem.space.smooth)]
        return np.all(distance < NEAR, axis=1)

    def descend_each(
        self, points: Points, targets: Targets, chosen: Bool[np.ndarray, " points"]
    ) -> Points:
        """Points of which those chosen have descended, their targets held."""
        rows = np.flatnonzero(chosen)
        ends = self.descend_all([(points.u[row], int(targets.index[row])) for row in rows])
        u, cost = points.u.copy(), points.cost.copy()
        for row, end in zip(rows, ends, strict=True):
            u[row], cost[row] = end
        return Points(u, self.problem.space.values(u), cost)

    def descend_all(
        self, descents: Sequence[tuple[np.ndarray, int | None]], steps: int = STEPS
    ) -> list[tuple[np.ndarray, float]]:
        """The ends of several descents, each given by its start and the parameter held."""
        return on_all_cores([partial(self.descend, u, held, steps) for u, held in descents])

    def descend(
        self, u: Float[np.ndarray, " free"], held: int | None, steps: int = STEPS
    ) -> tuple[np.ndarray, float]:
        """The end of a short descent with at most one parameter held, and its cost."""
        start = jnp.asarray(u, self.problem.space.start.dtype)
        model = HardModel(self.problem, start, np.arange(len(u)) == (-1 if held is None else held))
        state = levenberg_marquardt.evaluate(model, start)
        for _ in range(steps):
            before, state = state, levenberg_marquardt.step(model, state)
            if float(before.cost) - float(state.cost) < MIN_GAIN:
                break
        cost = float(state.cost)
        return np.asarray(state.u), cost if np.isfinite(cost) else np.inf


def _lowest_of(cost: np.ndarray, owner: np.ndarray, targets: int) -> np.ndarray:
    """Index of the lowest candidate of each target."""
    candidates = [np.flatnonzero(owner == target) for target in range(targets)]
    return np.asarray([mine[np.argmin(cost[mine])] for mine in candidates])


def join(parts: Sequence[Points]) -> Points:
    """Several sets of points as one."""
    return Points(
        np.concatenate([part.u for part in parts]),
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.cost for part in parts]),
    )


def slopes_of_thresholds(
    problem: Problem, u: Float[np.ndarray, " free"]
) -> Float[np.ndarray, "residuals free"]:
    """Slopes of the residuals by each threshold; 0 where its effect is not gradual, or smooth."""
    here = evolution.residuals(problem, u[None])[0]
    slopes = np.zeros((len(here), len(u)))
    for i in np.flatnonzero(problem.space.thresholds):
        steps = np.outer([-1, 1], SECANT_STEPS)
        moved = u + np.outer(steps, np.arange(len(u)) == i)
        changes = (evolution.residuals(problem, moved) - here).reshape(*steps.shape, -1)
        chosen = [(side, k) for side in (0, 1) if (k := _secant(changes[side])) is not None]
        if chosen:
            first, last = chosen[0], chosen[-1]
            rise, run = changes[last], steps[last]
            if last != first:
                rise, run = rise - changes[first], run - steps[first]
            slopes[:, i] = rise / run
    return slopes


def _secant(changes: Float[np.ndarray, "steps residuals"]) -> int | None:
    """Index of the step to take, if the residuals change gradually along it."""
    size = 0.5 * np.sum(changes**2, axis=1)
    whole, half = size[:-1], size[1:]
    fits = np.isfinite(whole) & (whole > CHANGES[0]) & (whole < CHANGES[1])
    fits[fits] &= (half[fits] > GRADUAL[0] * whole[fits]) & (half[fits] < GRADUAL[1] * whole[fits])
    if not fits.any():
        return None
    return int(np.argmin(np.where(fits, np.abs(np.log(np.where(fits, whole, 1) / CHANGE)), np.inf)))
