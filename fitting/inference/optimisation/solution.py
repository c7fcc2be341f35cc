"""What a search reports while it runs, and its result."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Progress:
    """One report of a running search."""

    stage: str
    """Start, descent, sweep, evolution or polish."""
    start: int
    """Index of the starting point."""
    step: int
    """Levenberg–Marquardt steps so far, from this start."""
    cost: float
    """Of the point that the stage has reached."""
    best: float
    """Minimum cost of the hard program so far, over all starts."""
    seconds: float
    """Since the search began."""


@dataclasses.dataclass(frozen=True)
class Report(Progress):
    """A report with the best point so far, which the history does not keep."""

    best_u: Float[np.ndarray, " free"]


@dataclasses.dataclass(frozen=True)
class Solution:
    """The best point of a search, and how the search ended."""

    names: tuple[str, ...]
    u: Float[np.ndarray, " free"]
    values: Float[np.ndarray, " free"]
    """In the parameters' units."""
    cost_before: float
    """Of the system's values before the fit."""
    cost: float
    converged: bool
    message: str
    """One sentence."""
    jacobian: Float[np.ndarray, "residuals free"]
    """Of `Problem.residuals`; 0 for thresholds."""
    history: tuple[Progress, ...]
    steps: int
    """Of Levenberg–Marquardt, all starts together."""
    seconds: float
    starts: int = 1
    """That were finished."""
    agreeing: int = 1
    """Of them, those that ended at this cost, or hardly above it."""
    agreed: bool = False
    """Whether these were enough."""
    interrupted: bool = False

    def weighted(self, weight: float) -> "Solution":
        """The solution of the same problem with a weight; its own is 1."""
        return dataclasses.replace(
            self,
            cost_before=weight * self.cost_before,
            cost=weight * self.cost,
            jacobian=weight**0.5 * self.jacobian,
        )

    def following(self, before: "Solution") -> "Solution":
        """The solution with the history and the effort of an earlier one added to its own."""
        later = (
            dataclasses.replace(
                line, step=line.step + before.steps, seconds=line.seconds + before.seconds
            )
            for line in self.history
        )
        return dataclasses.replace(
            self,
            cost_before=before.cost_before,
            history=(*before.history, *later),
            steps=before.steps + self.steps,
            seconds=before.seconds + self.seconds,
        )
