"""Posterior predictive checks: is the captured motion one that the posterior would make?

Replicates are the motions of some draws of the posterior, each with noise of its own (Gelman et
al., Bayesian Data Analysis, 3rd edition, 6.3). What is compared are the residuals from the draw's
own motion, so that a replicate's are its noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np
from jaxtyping import Bool, Float

from fitting.inference.noise import NoiseDensity
from fitting.inference.sample.posterior import Posterior
from fitting.problem.simulation import correlated
from fitting.studies.fit.fit import FittedParameter

SURPRISING = 0.005  # probability, to either side, of a capture that is unlike the replicates
BAND = (2.5, 50.0, 97.5)  # per cent

# Widths of the posterior's interval, in units of the fit's, that are clearly another answer. The
# interval of a threshold's profile is meant to be wide (Hansen 2000).
NARROW = {"smooth": 0.5, "threshold": 0.25}
WIDE = 2.0

Reason = Literal["leaves out the fit", "narrower", "wider"]


@dataclass(frozen=True)
class NoiseProcess:
    """Noise of one kind in one clip, in sigmas."""

    density: NoiseDensity
    correlation: float
    """From one frame to the next."""
    independent_fraction: float
    """Of the residuals."""

    def draw(
        self, random: np.random.Generator, shape: tuple[int, int]
    ) -> Float[np.ndarray, "frames columns"]:
        """A series of this noise."""
        draws = self.density.draw(random, shape)
        return correlated(draws, self.correlation, self.independent_fraction)


@dataclass(frozen=True)
class Statistic:
    """One statistic of the residuals, of the capture and of replicates."""

    captured: Float[np.ndarray, " draws"]
    """Each from the motion of its draw."""
    replicated: Float[np.ndarray, " draws"]

    @property
    def median(self) -> float:
        """Of the capture."""
        return float(np.median(self.captured))

    @property
    def replicated_interval(self) -> tuple[float, float]:
        """95 % of the replicates."""
        low, high = np.percentile(self.replicated, [2.5, 97.5])
        return float(low), float(high)

    @property
    def p(self) -> float:
        """Posterior predictive p-value: how often a replicate's is as large as the capture's."""
        larger = np.mean(self.replicated > self.captured)
        return float(larger + 0.5 * np.mean(self.replicated == self.captured))

    @property
    def is_surprising(self) -> bool:
        """Whether hardly any replicate is like the capture."""
        return not SURPRISING <= self.p <= 1 - SURPRISING


@dataclass(frozen=True)
class PredictiveCheck:
    """The residuals of one kind in one clip beside those of replicates."""

    clip: int
    """From 0."""
    kind: str
    rms: Statistic
    """Root mean square, sigmas."""
    autocorrelation: Statistic
    """From one frame to the next."""
    largest: Statistic
    """Largest size, sigmas."""

    @property
    def surprises(self) -> list[str]:
        """What of the capture is unlike the replicates."""
        named = {
            "size": self.rms,
            "autocorrelation": self.autocorrelation,
            "largest residual": self.largest,
        }
        return [name for name, statistic in named.items() if statistic.is_surprising]


@dataclass(frozen=True)
class Band:
    """One channel of the capture inside the band of its replicates; relative to their median."""

    clip: int
    """From 0."""
    kind: str
    channel: str
    """Which of them, in words."""
    time: Float[np.ndarray, " frames"]
    """s."""
    captured: Float[np.ndarray, " frames"]
    """m or rad; NaN where it was not observed."""
    low: Float[np.ndarray, " frames"]
    """2.5 % of the replicates, m or rad."""
    high: Float[np.ndarray, " frames"]
    """97.5 %."""

    @property
    def outside(self) -> float:
        """Fraction of the captured frames outside the band; 0.05 is expected."""
        seen = ~np.isnan(self.captured)
        beyond = (self.captured < self.low) | (self.captured > self.high)
        return float(beyond[seen].mean()) if seen.any() else 0.0


def statistics_of(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> tuple[float, float, float]:
    """Root mean square, autocorrelation from frame to frame, and largest size."""
    values = np.where(active, residuals, 0.0)
    squares = float(np.sum(values**2))
    if not squares > 0:
        return 0.0, 0.0, 0.0
    pairs = active[1:] & active[:-1]
    products = float(np.sum(values[1:] * values[:-1])) / max(int(pairs.sum()), 1)
    mean_square = squares / int(active.sum())
    return mean_square**0.5, products / mean_square, float(np.abs(values).max())


def make_band(
    place: tuple[int, str, str],
    time: Float[np.ndarray, " frames"],
    observed: Bool[np.ndarray, " frames"],
    errors: Float[np.ndarray, "draws frames"],
    noise: Float[np.ndarray, "draws frames"],
) -> Band:
    """The band of a channel.

    Args:
        place: clip, kind and channel.
        time: s.
        observed: where the capture counts.
        errors: motion of each draw minus the capture.
        noise: of each draw's replicate.
    """
    low, middle, high = np.percentile(errors + noise, BAND, axis=0)
    captured = np.where(observed, -middle, np.nan)
    return Band(*place, time, captured, low - middle, high - middle)


class Disagreement(TypedDict):
    """A parameter of which fit and chain give clearly different intervals."""

    name: str
    reason: Reason
    value: float
    """Of the fit, in the parameter's unit."""
    interval_of_fit: list[float]
    """95 %."""
    interval: list[float]
    """95 %, of the posterior."""


def disagreements(
    parameters: Sequence[FittedParameter], posterior: Posterior
) -> list[Disagreement]:
    """Parameters whose posterior leaves out the fit, or is clearly narrower or wider than it says.

    A chain that has not converged contradicts nothing.
    """
    if not posterior.converged:
        return []
    rows = []
    for fitted, sampled in zip(parameters, posterior.summary, strict=True):
        low, high = sampled["low95"], sampled["high95"]
        reason = _reason(fitted, low, high)
        if reason is not None:
            rows.append(
                Disagreement(
                    name=fitted["name"],
                    reason=reason,
                    value=fitted["value"],
                    interval_of_fit=fitted["interval"],
                    interval=[low, high],
                )
            )
    return rows


def _reason(fitted: FittedParameter, low: float, high: float) -> Reason | None:
    """Why an interval of the posterior contradicts the fit; None if it does not."""
    if not low <= fitted["value"] <= high:
        return "leaves out the fit"
    width = fitted["interval"][1] - fitted["interval"][0]
    if high - low < NARROW[fitted["kind"]] * width:
        return "narrower"
    return "wider" if high - low > WIDE * width else None
