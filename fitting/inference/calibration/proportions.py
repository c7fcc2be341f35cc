"""How often something holds in many replicates, with bounds of the probability behind it."""

import dataclasses

import numpy as np
from jaxtyping import Bool
from scipy import special


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
    sizes, found = counted.sum(axis=1), (hits & counted).sum(axis=1)
    total, hit = int(sizes.sum()), int(found.sum())
    cases = float(total)
    if hits.shape[1] > 1 and total:
        cases = min(cases, _independent_cases(found, sizes, level))
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


def _independent_cases(found: np.ndarray, sizes: np.ndarray, level: float) -> float:
    """Number of independent cases whose fraction varies as much as that of these replicates."""
    replicates, total = len(sizes), sizes.sum()
    if replicates < 2:
        return float(replicates)
    fraction = found.sum() / total
    scatter = np.sum((found - fraction * sizes) ** 2) / total**2
    variance = scatter * replicates / (replicates - 1)
    if not variance > 0:  # every replicate has the same fraction
        return float(total)
    quantile = (1 + level) / 2  # the variance is itself estimated, from few replicates
    ratio = special.stdtrit(max(total - 1, 1), quantile) / special.stdtrit(replicates - 1, quantile)
    return float(fraction * (1 - fraction) / variance * ratio**2)
