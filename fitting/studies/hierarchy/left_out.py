"""How well each clip is predicted from the others, beside how well it can be fitted."""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxik
from fitting.analysis.position_error import position_error
from fitting.inference.hierarchy.grouping import Grouping
from fitting.inference.hierarchy.population_fit import PopulationFit, fit_population
from fitting.problem.problem import Problem


@dataclasses.dataclass(frozen=True)
class ClipErrors:
    """Distance of a clip's joints from the captured ones, m, rms; see `position_error`."""

    clip: str
    alone: float
    """Fitted to this clip."""
    pooled: float
    """Fitted to all clips with one value of each parameter."""
    population: float
    """With the clip's own parameters in the population."""
    left_out_pooled: float
    """Fitted to all other clips."""
    left_out_population: float
    """As expected from the population of all others, and of the clip's subject if they show it."""


def without_clip(problem: Problem[jaxik.FootIK], clip: int) -> Problem[jaxik.FootIK]:
    """The problem in which a clip has no say: none of its frames was observed.

    The clip is still played, so that the programs of the whole problem serve.
    """
    observed = problem.data[clip].reference.observed
    return eqx.tree_at(lambda p: p.data[clip].reference.observed, problem, jnp.zeros_like(observed))


def predict(
    problems: Sequence[Problem[jaxik.FootIK]],
    grouping: Grouping,
    fit: PopulationFit,
    pooled: Float[np.ndarray, " free"],
    clip: int,
    progress: Callable[[int, float], None],
) -> Float[np.ndarray, " free"]:
    """The parameters of a clip, in u, as the population of the others expects them.

    Args:
        problems: of one clip each.
        grouping: of all clips.
        fit: of all clips, where the search begins.
        pooled: the best fit of all clips but this one, where it begins too; in u.
        clip: the one that is left out.
        progress: as for `fit_population`.
    """
    rest = [problem for c, problem in enumerate(problems) if c != clip]
    starts = [np.tile(pooled, (len(rest), 1)), np.delete(fit.clips, clip, axis=0)]
    return fit_population(rest, grouping.without(clip), starts, progress).predict(grouping, clip)


def error_at(problem: Problem[jaxik.FootIK], u: Float[np.ndarray, " free"]) -> float:
    """The error of a problem's only clip with these parameters, m."""
    (scene,) = problem.data
    return position_error(problem.space.unpack(jnp.asarray(u)), scene)
