"""Ranks of truths among draws of their posteriors, and the band in which their ECDF should lie.

Simulation-based calibration (Talts et al. 2018, arXiv 1804.06788): with truths drawn from the prior
and data simulated from them, the rank of a truth among independent draws of its posterior is
uniform. The band is that of Säilynoja, Bürkner and Vehtari (2022, Statistics and Computing 32:32):
the pointwise binomial intervals of the empirical distribution function (ECDF), widened until whole
curves lie inside with the level that is asked for. It is found by simulation.
"""

import dataclasses
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy import special

SIMULATIONS = 20_000  # of uniform ranks, for the width of a band


@dataclasses.dataclass(frozen=True)
class RankTest:
    """The ranks of one quantity in all replicates, beside what uniform ranks would be like."""

    ranks: Int[np.ndarray, " replicates"]
    """Number of draws below the truth, from 0 to `draws`."""
    draws: int
    """Of each posterior."""
    level: float
    """Probability with which the ECDF of uniform ranks lies in the band as a whole."""

    @property
    def places(self) -> Float[np.ndarray, " draws"]:
        """The probabilities that a uniform rank is at most 0, 1, ..., `draws` - 1."""
        return np.arange(1, self.draws + 1) / (self.draws + 1)

    @property
    def ecdf(self) -> Float[np.ndarray, " draws"]:
        """The fraction of the ranks that is at most 0, 1, ..., `draws` - 1."""
        return cumulative_counts(self.ranks, self.draws) / len(self.ranks)

    @property
    def band(self) -> Float[np.ndarray, "2 draws"]:
        """Lower and upper limits of the ECDF."""
        return np.stack(count_band(len(self.ranks), self.draws, self.level)) / len(self.ranks)

    @property
    def inside(self) -> bool:
        """Whether the whole ECDF is in its band."""
        low, high = count_band(len(self.ranks), self.draws, self.level)
        counts = cumulative_counts(self.ranks, self.draws)
        return bool(((low <= counts) & (counts <= high)).all())

    def histogram(self, bins: int) -> Int[np.ndarray, " bins"]:
        """Number of ranks in bins of equal width; `bins` should divide `draws` + 1."""
        return np.histogram(self.ranks, bins, range=(0, self.draws + 1))[0]


def cumulative_counts(ranks: Int[np.ndarray, " replicates"], draws: int) -> np.ndarray:
    """How many ranks are at most 0, 1, ..., `draws` - 1."""
    return np.bincount(ranks, minlength=draws + 1).cumsum()[:-1]


@lru_cache
def count_band(
    replicates: int, draws: int, level: float
) -> tuple[Int[np.ndarray, " draws"], Int[np.ndarray, " draws"]]:
    """The fewest and the most uniform ranks that may be at most 0, 1, ..., `draws` - 1.

    Of all curves of uniform ranks, a fraction of `level` or more lies inside everywhere.
    """
    tails = _tails(replicates, draws)
    uniform = np.full(draws + 1, 1 / (draws + 1))
    simulated = np.random.default_rng(0).multinomial(replicates, uniform, size=SIMULATIONS)
    counts = simulated.cumsum(axis=1)[:, :-1]
    rarest = tails[counts, np.arange(draws)].min(axis=1)
    allowed = tails >= np.quantile(rarest, 1 - level, method="lower")
    return allowed.argmax(axis=0), replicates - allowed[::-1].argmax(axis=0)


def _tails(replicates: int, draws: int) -> Float[np.ndarray, "counts draws"]:
    """Probability of each count, or one farther out on its side, at each place."""
    counts = np.arange(replicates + 1)[:, None]
    places = np.arange(1, draws + 1) / (draws + 1)
    at_most = special.bdtr(counts, replicates, places)
    at_least = special.bdtr(replicates - counts, replicates, 1 - places)
    return np.minimum(at_most, at_least)
