"""How often something holds in many replicates, with bounds of the probability behind it.

Simulation-based calibration (Talts et al. 2018, arXiv 1804.06788) ranks truths among independent
draws of their posteriors: with truths drawn from the prior and data simulated from them, ranks are
uniform. The band of their empirical distribution function (ECDF) is that of Säilynoja, Bürkner and
Vehtari (2022, Statistics and Computing 32:32): the pointwise binomial intervals, widened until
whole curves lie inside with the requested level, found by simulation.
"""

import dataclasses
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import special

SIMULATIONS = 20_000  # of uniform ranks, for the width of a band


@dataclasses.dataclass(frozen=True)
class Proportion:
    """How often something holds, and how often it should."""

    hits: int
    total: int
    """Number of cases."""
    low: float
    """Bounds of the probability, like high."""
    high: float
    wanted_low: float = 0.0
    """Where the probability should lie, like wanted_high."""
    wanted_high: float = 1.0

    @property
    def fraction(self) -> float:
        """Of the cases; NaN if there are none."""
        return self.hits / self.total if self.total else np.nan

    @property
    def inside(self) -> bool:
        """Whether the probability may be what it should be."""
        return self.low <= self.wanted_high and self.wanted_low <= self.high


def proportion(
    hits: Bool[np.ndarray, "replicates quantities"],
    counted: Bool[np.ndarray, "replicates quantities"] | None = None,
    *,
    level: float,
    wanted: tuple[float, float] = (0.0, 1.0),
) -> Proportion:
    """How often something holds for several quantities of independent replicates.

    For one quantity the bounds are those of Clopper and Pearson (1934). Several quantities of one
    replicate depend on each other; then the bounds are those for as many independent cases as would
    have the same variance (Korn and Graubard 1998, Survey Methodology 24:193).

    Args:
        hits: where it holds.
        counted: the cases; None for all.
        level: of the bounds, 0.95 for instance.
        wanted: range in which the probability should lie.
    """
    counted = np.ones_like(hits) if counted is None else counted
    sizes, successes = counted.sum(axis=1), (hits & counted).sum(axis=1)
    total, hit = int(sizes.sum()), int(successes.sum())
    cases = float(total)
    if hits.shape[1] > 1 and total:
        cases = min(cases, _independent_cases(successes, sizes, level))
    fraction = hit / total if total else 0.0
    low, high = clopper_pearson(fraction * cases, cases, level)
    return Proportion(hit, total, low, high, *wanted)


def clopper_pearson(hits: float, total: float, level: float) -> tuple[float, float]:
    """Bounds of a probability after `hits` of `total`, which need not be whole; 0 and 1 for none.

    Each is exceeded with a probability of `(1 - level) / 2` at most.
    """
    tail = (1 - level) / 2
    low = special.betaincinv(hits, total - hits + 1, tail) if hits > 0 else 0.0
    high = special.betaincinv(hits + 1, total - hits, 1 - tail) if hits < total else 1.0
    return float(low), float(high)


def _independent_cases(successes: np.ndarray, sizes: np.ndarray, level: float) -> float:
    """Number of independent cases whose fraction varies as much as that of these replicates."""
    replicates, total = len(sizes), sizes.sum()
    if replicates < 2:
        return float(replicates)
    fraction = successes.sum() / total
    scatter = np.sum((successes - fraction * sizes) ** 2) / total**2
    variance = scatter * replicates / (replicates - 1)
    if not variance > 0:  # every replicate has the same fraction
        return float(total)
    quantile = (1 + level) / 2  # the variance is itself estimated, from few replicates
    ratio = special.stdtrit(max(total - 1, 1), quantile) / special.stdtrit(replicates - 1, quantile)
    return float(fraction * (1 - fraction) / variance * ratio**2)


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
