"""How a posterior would change if a parameter's prior were narrower or wider.

The chain is not sampled again: its draws are weighted by the ratio of the two priors, which is
exact but for the number of draws. How far to trust the weights is said by the shape `k` of the
generalised Pareto distribution of the largest (Vehtari, Simpson, Gelman, Yao and Gabry, Pareto
smoothed importance sampling, 2024): above 0.7 a few draws decide the answer, and none is given.
"""

import math
from typing import TypedDict

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.problem.space import Prior
from fitting.runtime.precision import in_float64

from .posterior import Posterior

FACTORS = (0.5, 2.0)  # of each prior's spread in u
MAX_K = 0.7  # beyond it weights are not to be trusted
SENSITIVE = 0.25  # of an interval's width by which one of its ends moves
DRAWS = 50_000  # at most
LEVELS = (0.025, 0.5, 0.975)


class Reweighted(TypedDict):
    """One parameter's posterior under another prior of its own, the other priors as they are."""

    factor: float
    """On the spread of its prior in u."""
    pareto_k: float
    """Of the weights; above 0.7 all that follows is None."""
    median: float | None
    """In the parameter's unit."""
    interval: list[float] | None
    """95 %, in the parameter's unit."""
    sensitive: bool | None
    """Whether an end of the interval moves by more than a quarter of its width."""


@in_float64
def prior_sensitivity(posterior: Posterior, prior: Prior) -> dict[str, list[Reweighted]]:
    """Each parameter's median and interval under priors half and twice as wide, by name.

    The spread in `u` of its own prior changes; a uniform prior becomes a logistic one of half or
    twice the scale, denser in the middle of the range or at its bounds.
    """
    every = max(1, posterior.draws[..., 0].size // DRAWS)
    u, values = (
        draws.reshape(-1, len(posterior.names))[::every]
        for draws in (posterior.draws_u, posterior.draws)
    )
    ess = np.array([row["ess"] for row in posterior.summary])
    present = np.asarray(prior.residuals(jnp.asarray(u)))
    result: dict[str, list[Reweighted]] = {name: [] for name in posterior.names}
    for factor in FACTORS:
        changed = np.asarray(prior.widened(factor).residuals(jnp.asarray(u)))
        log_weights = 0.5 * (present**2 - changed**2)
        for i, name in enumerate(posterior.names):
            result[name].append(_reweighted(factor, values[:, i], log_weights[:, i], ess[i]))
    return result


def _reweighted(
    factor: float, values: np.ndarray, log_weights: np.ndarray, ess: float
) -> Reweighted:
    weights = np.exp(log_weights - log_weights.max())
    k = pareto_k(weights, ess)
    if k > MAX_K:
        return Reweighted(factor=factor, pareto_k=k, median=None, interval=None, sensitive=None)
    before = np.quantile(values, LEVELS, method="inverted_cdf")
    low, median, high = np.quantile(values, LEVELS, method="inverted_cdf", weights=weights)
    moved = max(abs(low - before[0]), abs(high - before[2]))
    return Reweighted(
        factor=factor,
        pareto_k=k,
        median=float(median),
        interval=[float(low), float(high)],
        sensitive=bool(moved > SENSITIVE * (before[2] - before[0])),
    )


def pareto_k(weights: Float[np.ndarray, " draws"], ess: float) -> float:
    """Shape of the generalised Pareto distribution of the largest of these weights.

    As many are the largest as Vehtari et al. say: three times the root of the number of independent
    draws, in units of draws, and at most a fifth of them. Minus infinity where all weights are
    alike; infinite for too few draws.
    """
    from scipy import stats  # here, for it takes half a second to import

    count = len(weights)
    independent = min(1.0, ess / count)
    tail = int(min(0.2 * count, 3 * math.sqrt(count / independent)))
    if tail < 5:
        return math.inf
    ordered = np.sort(weights)
    excess = ordered[-tail:] - ordered[-tail - 1]
    if excess[-1] <= np.finfo(float).eps * ordered[-1]:
        return -math.inf
    return float(stats.genpareto.fit(excess / excess.mean(), floc=0)[0])
