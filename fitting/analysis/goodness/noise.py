"""Size and autocorrelation of a series of residuals, each with its significance.

Residuals come in standard deviations, frames first and a column for each leg and component. Columns
are taken as independent of one another and are pooled. The expected mean is zero and is not
subtracted: a constant offset is a misfit, and shows as correlation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

LAGS = 10  # of the Ljung-Box test
INSIGNIFICANT = 2.0  # standard errors, below which an autocorrelation ends the sums over lags
MIN_SPACING = 1e-3  # frames; the sum over lags may come out below zero
MEDIAN = float(special.ndtri(0.75))  # median size of a standard normal
MEDIAN_EFFICIENCY = 0.3675  # of the median of sizes as an estimate of scale (Huber 1981, 5.1)
FAR = 3.0  # sigmas; beyond it a residual is taken as this large where outliers are expected


@dataclass(frozen=True)
class Noise:
    """Size and autocorrelation of residuals, in units of their sigma."""

    count: int
    """Active residuals."""
    degrees: float
    """Of freedom: independent values in the mean of the squares, less what the fit used up."""
    mean_square: float
    """Reduced chi-square: 1 where the sigma is right."""
    autocorrelation: float
    """From one frame to the next."""
    ljung_box: float
    """Statistic of Ljung and Box (1978); chi-square with `lags` degrees of freedom for noise."""
    lags: int
    spacing: float
    """Frames from one independent residual to the next: 1 + 2 * sum of autocorrelations."""

    @property
    def scale(self) -> float:
        """Size in sigmas, root mean square."""
        return math.sqrt(self.mean_square)

    @property
    def p(self) -> float:
        """Probability of a mean square at least as far from 1, to either side; 1 without data."""
        if not self.degrees > 0:
            return 1.0
        return two_sided(float(special.chdtr(self.degrees, self.degrees * self.mean_square)))

    @property
    def autocorrelation_p(self) -> float:
        """Probability of a Ljung-Box statistic at least as large; 1 without data."""
        return float(special.chdtrc(self.lags, self.ljung_box)) if self.lags else 1.0


def measure(
    residuals: Float[np.ndarray, "frames columns"],
    active: Bool[np.ndarray, "frames columns"],
    median: float | None = None,
    used: float = 0.0,
) -> Noise:
    """Size and autocorrelation of residuals.

    The mean of the squares of correlated values has `count / (1 + 2 * sum of r_k²)` degrees of
    freedom, `r_k` their autocorrelations (Bartlett 1946).

    Args:
        residuals: in sigmas.
        active: which of them count.
        median: takes the size from the median, which should be this large, and residuals beyond
            `FAR` as that large in the autocorrelation, so that a few outliers do not matter.
        used: fraction of the degrees of freedom that the fit has used up.
    """
    count = int(active.sum())
    if not count:
        return Noise(0, 0.0, 0.0, 0.0, 0.0, 0, 1.0)
    r, pairs = autocorrelations(tamed(residuals, active) if median else residuals, active)
    small = np.abs(r) < INSIGNIFICANT / np.sqrt(np.maximum(pairs, 1))
    end = int(np.argmax(small)) if small.any() else len(r)
    lags = min(LAGS, len(r))
    spread = 1.0 + 2.0 * float(np.sum(r[:end] ** 2))
    free = 1.0 - used
    if median:
        size = _median_size(residuals, active) / median
    else:
        size = float(np.mean(residuals[active] ** 2) ** 0.5)
    return Noise(
        count=count,
        degrees=count / spread * free * (MEDIAN_EFFICIENCY if median else 1.0),
        mean_square=size**2 / free,
        autocorrelation=float(r[0]) if lags else 0.0,
        ljung_box=float(np.sum(pairs[:lags] * r[:lags] ** 2)),
        lags=lags,
        spacing=max(1.0 + 2.0 * float(np.sum(r[:end])), MIN_SPACING),
    )


def pooled(noises: Sequence[Noise]) -> Noise:
    """Several series as one; means are weighted by their counts."""
    count = sum(noise.count for noise in noises)

    def mean(name: str) -> float:
        return sum(noise.count * getattr(noise, name) for noise in noises) / max(count, 1)

    return Noise(
        count=count,
        degrees=sum(noise.degrees for noise in noises),
        mean_square=mean("mean_square"),
        autocorrelation=mean("autocorrelation"),
        ljung_box=sum(noise.ljung_box for noise in noises),
        lags=sum(noise.lags for noise in noises),
        spacing=mean("spacing"),
    )


def autocorrelations(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> tuple[Float[np.ndarray, " lags"], Float[np.ndarray, " lags"]]:
    """Autocorrelations at lags 1, 2, ..., and from how many pairs each comes.

    There are lags up to half of the frames; no autocorrelation where all residuals are zero.
    """
    values, seen = np.where(active, residuals, 0.0), active.astype(float)
    size = 2 * len(values)  # padded, so that the last frames do not meet the first ones

    def products(series: np.ndarray) -> np.ndarray:
        spectrum = np.abs(np.fft.rfft(series, size, axis=0)) ** 2
        return np.fft.irfft(spectrum.sum(axis=1), size)[: len(series) // 2 + 1]

    of_values, pairs = products(values), np.round(products(seen))
    variance = of_values[0] / max(pairs[0], 1.0)
    if not variance > 0:
        return np.zeros(len(pairs) - 1), pairs[1:]
    return of_values[1:] / np.maximum(pairs[1:], 1.0) / variance, pairs[1:]


def scale_by_median(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> float:
    """Standard deviation of normal residuals from the medians of their sizes; 0 without any."""
    return _median_size(residuals, active) / MEDIAN


def _median_size(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> float:
    """Root mean square over the columns, by their counts, of the median size of each.

    Not the median of all columns together: under an animation that has the captured paths seen from
    above, positions err in height only, and a median over all three axes would be zero.
    """
    if not active.any():
        return 0.0
    columns = zip(np.abs(residuals).T, active.T, strict=True)
    medians = [np.median(sizes[seen]) if seen.any() else 0.0 for sizes, seen in columns]
    return math.sqrt(np.average(np.square(medians), weights=active.sum(axis=0)))


def tamed(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> Float[np.ndarray, "frames columns"]:
    """Residuals with those that are far out drawn in to `FAR` times their median-based scale."""
    limit = FAR * scale_by_median(residuals, active)
    return np.clip(residuals, -limit, limit)


def two_sided(below: float) -> float:
    """The two-sided p-value of a statistic, given the probability of a smaller one."""
    return min(1.0, 2.0 * min(below, 1.0 - below))
