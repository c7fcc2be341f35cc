"""What was found for each parameter: in each clip alone, pooled, and as a population."""

from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from jaxtyping import Float

from fitting.inference.hierarchy.grouping import Grouping
from fitting.inference.hierarchy.likelihoods import expand
from fitting.inference.hierarchy.mixed_model import Draws
from fitting.inference.hierarchy.population_fit import PopulationFit, model_around
from fitting.problem.problem import Problem
from fitting.problem.space import INTERVAL, Space
from fitting.runtime.precision import in_float64
from jaxik.maths import parameter_tree

DRAWS = 2000  # from the hierarchy
NORMAL = 1.96  # standard deviations in half a 95 % interval


class Estimate(TypedDict):
    """A value with its 95 % interval; a threshold has none."""

    value: float
    interval: list[float] | None


class ParameterEstimates(TypedDict):
    """What was found for a parameter, in its unit, as `population.json` holds it."""

    name: str
    unit: str
    level: str
    """What has a value of its own: `clip` or `subject`; else it is `shared`."""
    alone: list[Estimate]
    """Of each clip, by itself."""
    pooled: Estimate
    """Of all clips together, with one value."""
    clips: list[Estimate]
    """Of each clip in the population."""
    centre: Estimate
    """Of the population."""
    spread: Estimate | None
    """Standard deviation in the population, of u; None where shared."""
    range: list[float] | None
    """In which another clip or subject is expected with 95 %; None where shared."""


@in_float64
def summarise(
    problems: Sequence[Problem],
    alone: Float[np.ndarray, "clips free"],
    pooled: Float[np.ndarray, " free"],
    fit: PopulationFit,
    levels: Sequence[str],
) -> list[ParameterEstimates]:
    """The estimates of all parameters, in the order of `u`.

    Args:
        problems: of one clip each.
        alone: the best fit of each clip, in u.
        pooled: that of all clips together.
        fit: of the population.
        levels: at which each parameter varies.
    """
    space = problems[0].space
    of_clips = [_laplace([problem], u[None]) for problem, u in zip(problems, alone, strict=True)]
    of_pooled = _laplace(problems, np.tile(pooled, (len(problems), 1)))
    random = np.random.default_rng(0)
    draws = fit.model.draw(random, DRAWS)
    new = draws.centre + draws.spread * random.normal(size=draws.centre.shape)
    centres = _quantiles(space, fit, draws.centre)
    expected = _quantiles(space, fit, new)
    members = [_quantiles(space, fit, draws.clips[:, c]) for c in range(len(problems))]
    at_centre, at_clips = _values(space, fit.centre[None])[0], _values(space, fit.clips)
    units = parameter_tree.declarations(space.system)
    rows: list[ParameterEstimates] = []
    for k, parameter in enumerate(space.parameters):
        smooth = bool(fit.smooth[k])

        def estimate(value: float, interval: np.ndarray, smooth: bool = smooth) -> Estimate:
            return {"value": float(value), "interval": interval.tolist() if smooth else None}

        varies = levels[k] != "shared"
        rows.append(
            {
                "name": parameter.name,
                "unit": units[parameter.leaf].unit,
                "level": levels[k],
                "alone": [estimate(value[k], interval[k]) for value, interval in of_clips],
                "pooled": estimate(of_pooled[0][k], of_pooled[1][k]),
                "clips": [
                    estimate(at_clips[c, k], interval[k]) for c, interval in enumerate(members)
                ],
                "centre": estimate(at_centre[k], centres[k]),
                "spread": _spread(fit, draws, k) if varies else None,
                "range": expected[k].tolist() if varies else None,
            }
        )
    return rows


def _spread(fit: PopulationFit, draws: Draws, k: int) -> Estimate:
    density = draws.spread_density[np.flatnonzero(fit.smooth).tolist().index(k)]
    return {"value": float(fit.spread[k]), "interval": list(density.interval())}


def _laplace(
    problems: Sequence[Problem], u: Float[np.ndarray, "clips free"]
) -> tuple[np.ndarray, np.ndarray]:
    """Values (free,) and 95 % intervals (free, 2) of clips that share everything."""
    space = problems[0].space
    grouping = Grouping.pooled(*u.shape)
    model = model_around(expand(problems, u), space, grouping, u[0])
    smooth = np.flatnonzero(space.smooth)
    estimate = model.estimate(np.zeros(len(smooth)))
    moves = np.zeros((space.size, space.size))
    moves[smooth, smooth] = NORMAL * estimate.centre_sd
    values = _values(space, np.concatenate([u[:1], u[0] - moves, u[0] + moves]))
    low, high = np.split(values[1:], 2)
    return values[0], np.stack([np.diag(low), np.diag(high)], axis=1)


def _quantiles(
    space: Space, fit: PopulationFit, draws: Float[np.ndarray, "draws smooth"]
) -> Float[np.ndarray, "free 2"]:
    """Central 95 % of draws of the smooth parameters, in the parameters' units."""
    u = np.tile(fit.centre, (len(draws), 1))
    u[:, fit.smooth] = draws
    return np.quantile(_values(space, u), INTERVAL, axis=0).T


def _values(space: Space, u: Float[np.ndarray, "rows free"]) -> Float[np.ndarray, "rows free"]:
    return np.asarray(space.values(u))
