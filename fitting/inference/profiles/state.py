"""The profiles while they are being found, and how a file holds them between two stages."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fitting.inference.optimisation.kept_stages import StoredPoints, StoredProfiles
from fitting.inference.optimisation.solution import Solution
from fitting.problem.problem import Problem
from fitting.problem.space import Space

from .conditional import Conditional, Points
from .curves import Curves


@dataclasses.dataclass
class Profiling:
    """What the stages share; they add to the curves."""

    conditional: Conditional
    solution: Points
    curves: Curves
    plateaus: Points
    cliffs: set[tuple[int, float]] = dataclasses.field(default_factory=set)
    """At which nothing is tried again: index of the parameter and fraction of its range."""
    crossed: bool = False
    """Whether no further cliff can be crossed."""
    stages: int = 0
    """Finished ones."""

    @classmethod
    def around(cls, problem: Problem, solution: Solution) -> "Profiling":
        """No profile yet, only the solution."""
        conditional = Conditional.around(problem, solution)
        start = conditional.points(np.asarray(solution.u)[None])
        return cls(conditional, start, Curves(problem, start), start[:0])

    @property
    def space(self) -> Space:
        """Of the free parameters."""
        return self.conditional.problem.space

    def stored(self) -> StoredProfiles:
        """All that stages change."""
        return {
            "stages": self.stages,
            "curves": [_stored_points(curve) for curve in self.curves.curves],
            "plateaus": _stored_points(self.plateaus),
            "cliffs": [[i, place] for i, place in sorted(self.cliffs)],
            "crossed": self.crossed,
            "random": dict(self.conditional.random.bit_generator.state),
        }

    def restore(self, stored: StoredProfiles) -> None:
        """Takes over what stages have changed.

        Raises:
            ValueError, TypeError, KeyError, OverflowError: it is not of these parameters.
        """
        size = self.space.size
        curves = [_points(points, size) for points in stored["curves"]]
        if len(curves) != size:
            raise ValueError(f"there are {len(curves)} profiles of {size} parameters")
        if not all(len(curve.cost) and np.isfinite(curve.cost).all() for curve in curves):
            raise ValueError("a profile has a point without a cost, or no point")
        plateaus = _points(stored["plateaus"], size)
        np.random.default_rng().bit_generator.state = stored["random"]  # raises where it is none
        self.conditional.random.bit_generator.state = stored["random"]
        self.curves.curves, self.plateaus = curves, plateaus
        self.cliffs = {(int(i), place) for i, place in stored["cliffs"]}
        self.crossed, self.stages = stored["crossed"], stored["stages"]


def _stored_points(points: Points) -> StoredPoints:
    return {
        "u": points.u.tolist(),
        "values": points.values.tolist(),
        "cost": points.cost.tolist(),
    }


def _points(stored: StoredPoints, size: int) -> Points:
    """Points of so many parameters."""

    def array(rows: Sequence[Sequence[float]]) -> np.ndarray:
        return np.array(rows, np.float64).reshape(len(stored["cost"]), size)

    return Points(array(stored["u"]), array(stored["values"]), np.array(stored["cost"]))
