"""How far a profile rises within an interval.

Near its lowest point a profile is a parabola, and half a quantile of chi-square is right (1.92 for
95 %). The profile of a limit that a clip hardly reaches is not: beside a plateau, where the limit
does nothing, a narrow valley lies where it happens to suit the noise of some frames. That valley is
the deepest of many that noise might have made, so chi-square excludes the plateau too often. The
profile is therefore also read as a density of the parameter's probability, prior included, and an
interval reaches as high as the smallest region with enough of it.
"""

import numpy as np
from jaxtyping import Float
from scipy.special import chdtr

from fitting.problem.free_parameters import FreeParameter, to_fractions
from fitting.problem.space import EDGE

LEVEL = 0.95
# Rise of the cost at the ends of a 95 % interval. A smooth parameter: half the quantile of the
# chi-square distribution with one degree of freedom. A threshold, whose cost is a walk of random
# steps to either side: half of 7.35 (Hansen, Sample splitting and threshold estimation, 2000).
RISE_OF_SMOOTH = 1.92
RISE_OF_THRESHOLD = 3.68
CELLS = 16  # between two points of a profile


def usual_rise(parameter: FreeParameter) -> float:
    """Rise of the cost at the ends of a 95 % interval, where the profile has its usual shape."""
    return RISE_OF_THRESHOLD if parameter.kind == "threshold" else RISE_OF_SMOOTH


def max_rise(
    parameter: FreeParameter,
    values: Float[np.ndarray, " points"],
    rises: Float[np.ndarray, " points"],
) -> float:
    """Rise of the cost within a 95 % interval of a profile through these points.

    Args:
        parameter: whose profile it is.
        values: of the parameter, rising.
        rises: of the cost, prior included.
    """
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
    """Level, 0..1, of the interval of a smooth parameter whose ends rise as far as this.

    Args:
        parameter: whose profile it is.
        values: of the parameter, rising.
        rises: of the cost, prior included.
        rise: at the ends of the interval.
    """
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
