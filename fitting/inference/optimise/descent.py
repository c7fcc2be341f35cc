"""Descents by Levenberg–Marquardt: short ones between other stages, and the polish at the end.

Each raises `StepsUsedUp` before a step that would exceed the `max_steps` of a start.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from . import levenberg_marquardt
from .levenberg_marquardt import HardModel, LMState, problem_jacobian
from .solution import Point, Search, SearchState


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
    small = rejected = 0  # steps in a row: accepted with next to no gain, and rejected
    for _ in range(max_steps):
        state = search.spend_step(state)
        before, lm = np.asarray(lm.cost), levenberg_marquardt.step(model, lm)
        if lm.accepted:
            is_small = before - np.asarray(lm.cost) <= search.settings.min_step_gain * before
            small, rejected = small + 1 if is_small else 0, 0
        else:
            rejected += 1
        finished = small >= search.settings.max_small_steps or rejected >= max_rejected
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
    """Of the problem's residuals; a candidate, or a point of a file, comes without one."""
    if point.jacobian is not None:
        return point.jacobian
    u = search.array(point.u)
    evaluated = levenberg_marquardt.evaluate(HardModel(search.problem, u), u)
    return problem_jacobian(evaluated.jacobian)
