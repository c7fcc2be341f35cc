"""Descents by Levenberg–Marquardt: short ones between other stages, and the polish at the end.

Each raises `StepsUsedUp` before a step that would exceed the `max_steps` of a start.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from . import levenberg_marquardt
from .levenberg_marquardt import HardModel, LMState, problem_jacobian
from .solution import Point, Search, SearchSettings, SearchState


def descend(search: Search, state: SearchState, stage: str) -> SearchState:
    """A short descent of the smooth parameters from the state's point, thresholds frozen."""
    settings = search.settings
    return _descend(search, state, stage, settings.descent_steps, settings.max_rejected_steps)


def polish(search: Search, state: SearchState) -> SearchState:
    """A descent of the smooth parameters to its end; `converged` if that is the best point."""
    settings = search.settings
    patience = settings.polish_max_rejected_steps
    return _descend(search, state, "polish", settings.max_steps, patience)


def _descend(
    search: Search, state: SearchState, stage: str, max_steps: int, max_rejected: int
) -> SearchState:
    u = search.array(state.point.u)
    model = HardModel(search.problem, u)
    lm = state.evaluated
    if lm is None or not np.array_equal(u, lm.u):
        lm = levenberg_marquardt.evaluate(model, u)
    state = dataclasses.replace(state, point=point_of(lm))
    streaks = Streaks()
    for _ in range(max_steps):
        state = search.spend_step(state)
        before, lm = lm, levenberg_marquardt.step(model, lm)
        streaks = streaks.after(before, lm, search.settings)
        finished = streaks.finished(search.settings, max_rejected)
        converged = stage == "polish" and finished
        state = search.move(state, stage, point_of(lm), converged=converged)
        if finished:
            break
    return state


def point_of(lm: LMState) -> Point:
    """Where a descent on the hard model stands."""
    cost = float(lm.cost)
    return Point(
        np.asarray(lm.u), cost if np.isfinite(cost) else np.inf, problem_jacobian(lm.jacobian)
    )


def jacobian_at(search: Search, point: Point) -> Float[np.ndarray, "residuals free"]:
    """Of the problem's residuals; a point of a population, or of a file, comes without one."""
    if point.jacobian is not None:
        return point.jacobian
    u = search.array(point.u)
    evaluated = levenberg_marquardt.evaluate(HardModel(search.problem, u), u)
    return problem_jacobian(evaluated.jacobian)


@dataclasses.dataclass(frozen=True)
class Streaks:
    """Steps in a row without progress."""

    small: int = 0
    """Accepted, but with next to no gain."""
    rejected: int = 0

    def after(self, before: LMState, after: LMState, settings: SearchSettings) -> "Streaks":
        """The streaks after one more step."""
        if not after.accepted:
            return Streaks(self.small, self.rejected + 1)
        cost = np.asarray(before.cost)
        small = cost - np.asarray(after.cost) <= settings.min_step_gain * cost
        return Streaks(self.small + 1 if small else 0)

    def finished(self, settings: SearchSettings, max_rejected: int) -> bool:
        """Whether further steps are not worth it."""
        return self.small >= settings.max_small_steps or self.rejected >= max_rejected
