"""Slopes of thresholds whose effect is gradual.

A threshold has no derivative, but where it shifts a weight that fades in or out, the motion changes
in proportion all the same, and two such thresholds may form a ridge along which both must move. Its
slope is that of a secant, over a step that changes the residuals by about as much as noise does.
"""

import numpy as np
from jaxtyping import Float

from fitting.inference.optimisation import population
from fitting.problem.problem import Problem

STEPS = 2.0 ** -np.arange(14)  # of u, each twice the next
CHANGE = 2.0  # of the residuals, half their square: what a step should bring
CHANGES = (0.3, 20.0)  # and may bring
GRADUAL = (0.15, 0.4)  # change in half a step over that in a whole one, a quarter if proportional


def slopes_of_thresholds(
    problem: Problem, u: Float[np.ndarray, " free"]
) -> Float[np.ndarray, "residuals free"]:
    """Slopes of the residuals by each threshold; 0 where its effect is not gradual, or smooth."""
    here = population.residuals(problem, u[None])[0]
    slopes = np.zeros((len(here), len(u)))
    for i in np.flatnonzero(problem.space.thresholds):
        steps = np.outer([-1, 1], STEPS)
        moved = u + np.outer(steps, np.arange(len(u)) == i)
        changes = (population.residuals(problem, moved) - here).reshape(*steps.shape, -1)
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
