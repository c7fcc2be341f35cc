"""The convergence of a chain and its summary. Plain NumPy; steps are stored steps."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from jaxtyping import Bool, Float

from .chain import autocorrelation_time
from .modes import MIN_EXCHANGES, Mode, log_mass, survey

ISOLATED = 5.0  # spreads of log-probability between a walker and the others
LAZY = 0.1  # of the median acceptance
STEADY = 0.05  # relative change of the autocorrelation time between two checks
SPACING = 0.1  # of the chain's length between two checks, so that 5 % means something
START = 0.1  # of the chain, not counted for the autocorrelation time
BURN_IN = 5.0  # autocorrelation times
MAX_ISOLATED = 0.1  # fraction of the walkers that may be left out
NEGLIGIBLE = 0.01  # of the posterior, that may be left out


def split_r_hat(chain: Float[np.ndarray, "steps walkers free"]) -> Float[np.ndarray, " free"]:
    """Potential scale reduction over the first and second halves of all walkers; 1 is perfect.

    Gelman et al., Bayesian Data Analysis (3rd edition), section 11.4. Infinite where nothing moves,
    NaN for fewer than four steps.
    """
    half = chain.shape[0] // 2
    if half < 2:
        return np.full(chain.shape[2], np.nan)
    parts = np.concatenate([chain[:half], chain[-half:]], axis=1)
    within = parts.var(axis=0, ddof=1).mean(axis=0)
    between = parts.mean(axis=0).var(axis=0, ddof=1)
    moves = within > 0
    ratio = between / np.where(moves, within, 1)
    return np.where(moves, np.sqrt((half - 1) / half + ratio), np.inf)


def isolated_walkers(
    log_probability: Float[np.ndarray, "steps walkers"],
) -> Bool[np.ndarray, " walkers"]:
    """Walkers that in the later half of the chain never come near the others' log-probability.

    Near is within five spreads (1.48 median absolute deviations) of the median. Such walkers sit on
    a mode of negligible weight: for a normal posterior in ten dimensions a healthy walker is
    that far out in one step of 2,000, and here none of half the chain's steps may be nearer.
    """
    later = log_probability[log_probability.shape[0] // 2 :]
    middle = np.median(later)
    spread = 1.4826 * np.median(np.abs(later - middle))
    return later.max(axis=0) < middle - ISOLATED * spread


def lazy_walkers(acceptance: Float[np.ndarray, " walkers"]) -> Bool[np.ndarray, " walkers"]:
    """Walkers that accept less than a tenth of the proposals that the median walker accepts."""
    return acceptance < LAZY * np.median(acceptance)


class ParameterSummary(TypedDict):
    """The posterior of one parameter, in its unit."""

    name: str
    mean: float
    sd: float
    median: float
    low68: float
    """Central intervals."""
    high68: float
    low95: float
    high95: float
    ess: float
    """Effective sample size."""
    r_hat: float


def summarise(
    names: Sequence[str],
    values: Float[np.ndarray, "steps walkers free"],
    times: Float[np.ndarray, " free"],
    r_hat: Float[np.ndarray, " free"],
) -> list[ParameterSummary]:
    """One row per parameter: moments, central intervals, effective sample size, R-hat.

    Values are without burn-in and isolated walkers, autocorrelation times in steps of these.
    """
    flat = values.reshape(-1, values.shape[-1])
    quantiles = np.quantile(flat, [0.025, 0.16, 0.5, 0.84, 0.975], axis=0)
    moments = flat.mean(axis=0), flat.std(axis=0, ddof=1)
    table = np.stack([*moments, *quantiles, len(flat) / times, r_hat], axis=1)
    summaries = []
    for name, row in zip(names, table.tolist(), strict=True):
        mean, sd, low95, low68, median, high68, high95, ess, r = row
        summary = ParameterSummary(
            name=name, mean=mean, sd=sd, median=median, low68=low68, high68=high68,
            low95=low95, high95=high95, ess=ess, r_hat=r,
        )  # fmt: skip
        summaries.append(summary)
    return summaries


@dataclasses.dataclass(frozen=True)
class Check:
    """The state of the first `length` steps of a chain."""

    length: int
    times: Float[np.ndarray, " free"]
    """Autocorrelation times, without isolated walkers."""
    isolated: Bool[np.ndarray, " walkers"]
    isolated_mass: float = 0.0
    """Estimate of the fraction of the posterior that is left out with them."""
    modes: tuple[Mode, ...] = ()
    """On which the other walkers are, in the later half; the heaviest first."""

    @property
    def slowest(self) -> float:
        """Longest autocorrelation time, in steps."""
        return float(self.times.max())

    @property
    def burn_in(self) -> int:
        """Steps to leave out: five autocorrelation times, from a tenth to a half of the chain."""
        steps = min(BURN_IN * self.slowest, self.length)  # the time may be infinite
        return min(self.length // 2, max(int(START * self.length), math.ceil(steps)))


def check(
    u: Float[np.ndarray, "steps walkers free"], log_probability: Float[np.ndarray, "steps walkers"]
) -> Check:
    """Isolated walkers, modes and autocorrelation times of a chain from its first step on.

    Walkers whose mode may have 1 % of the posterior are not isolated, however low they are.
    """
    later = slice(len(u) // 2, None)
    isolated = isolated_walkers(log_probability)
    mass = _mass(u[later], log_probability[later], isolated)
    if mass > NEGLIGIBLE:
        isolated, mass = np.zeros_like(isolated), 0.0
    counted = u[int(START * len(u)) :, ~isolated]
    modes = survey(u[later][:, ~isolated], log_probability[later][:, ~isolated])
    return Check(len(u), autocorrelation_time(counted), isolated, mass, modes)


def _mass(
    u: Float[np.ndarray, "steps walkers free"],
    log_probability: Float[np.ndarray, "steps walkers"],
    isolated: Bool[np.ndarray, " walkers"],
) -> float:
    """Fraction of the posterior where isolated walkers are, each in a mode of its own."""
    if not isolated.any():
        return 0.0
    rest = log_mass(u[:, ~isolated], log_probability[:, ~isolated])
    apart = [
        log_mass(u[:, walker : walker + 1], log_probability[:, walker : walker + 1]) - rest
        for walker in np.flatnonzero(isolated)
    ]
    odds = float(np.exp(min(np.logaddexp.reduce(apart), 100.0)))
    return odds / (1 + odds)


def check_lengths(stored: int, interval: int, limit: int) -> list[int]:
    """Lengths at which to check a chain, beginning with the last two before the `stored` steps.

    They depend on `stored` only in where they begin, so that a resumed run stops where the
    uninterrupted one does. Two are at least `interval` steps apart, and the last one is `limit`.
    """
    lengths = []
    length = 0
    while length < limit:
        gap = max(interval, math.ceil(SPACING * length))
        length = length + gap if length + 2 * gap <= limit else limit
        lengths.append(length)
    after_next = [*lengths[2:], limit + 1, limit + 1]
    return [length for length, later in zip(lengths, after_next, strict=False) if later > stored]


def verdict(
    before: Check | None, latest: Check, names: Sequence[str], thin_by: int, stop_at: float
) -> tuple[bool, str]:
    """Whether the chain is long enough, by its last two checks, and a sentence that says why.

    Its autocorrelation times count steps of the sampler, of which `thin_by` are one of the chain.
    `stop_at` is the required length in such times of the slowest parameter.
    """
    left_out = int(latest.isolated.sum())
    lengths = latest.length / latest.slowest
    facts = (
        f"{latest.length * thin_by} steps are {lengths:.1f} autocorrelation times of"
        f" {names[int(latest.times.argmax())]} ({latest.slowest * thin_by:.1f} steps)"
    )
    if left_out:
        facts += (
            f"; left out: {left_out} of {latest.isolated.size} walkers, which are isolated where"
            f" about {100 * latest.isolated_mass:.2g} % of the posterior lies"
        )
    if left_out > MAX_ISOLATED * latest.isolated.size:
        return False, f"Not converged, too many walkers are isolated: {facts}."
    if cut_off := sum(not mode.is_weighed for mode in latest.modes):
        return False, (
            f"Not converged, the weights of modes are out of reach: {facts}; {cut_off} of"
            f" {len(latest.modes)} modes have fewer than {MIN_EXCHANGES} exchanges of walkers."
        )
    if lengths < stop_at:
        return False, f"Not converged, too short: {facts}; wanted {stop_at:g}."
    if before is None or abs(before.slowest / latest.slowest - 1) > STEADY:
        return False, f"Not converged, the autocorrelation time still changes: {facts}."
    return True, f"Converged: {facts}."
