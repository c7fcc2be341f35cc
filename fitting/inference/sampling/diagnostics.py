"""How far a chain can be trusted, and what it says. Plain NumPy; steps are stored steps."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

WINDOW = 5.0  # autocorrelation times to sum over (Sokal 1997, Monte Carlo methods, p. 16)
APART = 5.0  # spreads of log-probability between a walker and the rest
LAZY = 0.1  # of the median acceptance
STEADY = 0.05  # relative change of the autocorrelation time between two checks
SPACING = 0.1  # of the chain's length between two checks, so that 5 % means something
START = 0.1  # of the chain, not counted for the autocorrelation time
BURN_IN = 5.0  # autocorrelation times
MOST_APART = 0.1  # of the walkers may be left out


def autocorrelation_time(
    chain: Float[np.ndarray, "steps walkers free"],
) -> Float[np.ndarray, " free"]:
    """Integrated autocorrelation time of every parameter, in steps, at least 1.

    Sokal's window on the walkers' summed autocovariance about their common mean. emcee takes each
    walker about its own mean: a walker that never moves then adds nothing, and the time looks
    healthy. About the common mean its offset never decays, and the time grows with the chain.
    Infinite for a parameter that never changes.
    """
    steps, _, free = chain.shape
    length = 1 << (2 * steps - 1).bit_length()  # padded, so that the end does not meet the start
    times = np.empty(free)
    for i in range(free):
        centred = chain[..., i] - chain[..., i].mean()
        power = (np.abs(np.fft.rfft(centred, length, axis=0)) ** 2).sum(axis=1)
        covariance = np.fft.irfft(power, length)[:steps]
        if not covariance[0] > 0:
            times[i] = np.inf
            continue
        sums = 2 * np.cumsum(covariance / covariance[0]) - 1
        inside = np.arange(steps) < WINDOW * sums
        window = np.argmin(inside) if not inside.all() else steps - 1
        times[i] = max(1.0, sums[window])
    return times


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


def walkers_apart(
    log_probability: Float[np.ndarray, "steps walkers"],
) -> Bool[np.ndarray, " walkers"]:
    """Walkers that in the later half of the chain never came near the others' log-probability.

    Near is within five spreads (1.48 median absolute deviations) of the median. They sit on an
    island whose weight is negligible: for a normal posterior in ten dimensions a healthy walker is
    that far out in one step of 2,000, and here none of half the chain's steps may be nearer.
    """
    later = log_probability[log_probability.shape[0] // 2 :]
    middle = np.median(later)
    spread = 1.4826 * np.median(np.abs(later - middle))
    return later.max(axis=0) < middle - APART * spread


def lazy_walkers(acceptance: Float[np.ndarray, " walkers"]) -> Bool[np.ndarray, " walkers"]:
    """Walkers that accept less than a tenth of what the median walker accepts."""
    return acceptance < LAZY * np.median(acceptance)


def summarise(
    names: Sequence[str],
    values: Float[np.ndarray, "steps walkers free"],
    times: Float[np.ndarray, " free"],
    r_hat: Float[np.ndarray, " free"],
) -> list[dict[str, Any]]:
    """One row a parameter: moments, central intervals, effective sample size, R-hat.

    Args:
        names: of the parameters.
        values: of the kept steps and walkers, in the parameters' units.
        times: autocorrelation times, in steps of `values`.
        r_hat: of the same steps.
    """
    flat = values.reshape(-1, values.shape[-1])
    low95, low68, median, high68, high95 = np.quantile(
        flat, [0.025, 0.16, 0.5, 0.84, 0.975], axis=0
    )
    columns = {
        "mean": flat.mean(axis=0),
        "sd": flat.std(axis=0, ddof=1),
        "median": median,
        "low68": low68,
        "high68": high68,
        "low95": low95,
        "high95": high95,
        "ess": flat.shape[0] / times,
        "r_hat": r_hat,
    }
    return [
        {"name": name} | {key: float(column[i]) for key, column in columns.items()}
        for i, name in enumerate(names)
    ]


@dataclasses.dataclass(frozen=True)
class Check:
    """What the first `length` steps of a chain look like."""

    length: int
    times: Float[np.ndarray, " free"]  # autocorrelation times of the walkers that are not apart
    apart: Bool[np.ndarray, " walkers"]

    @property
    def slowest(self) -> float:
        """Longest autocorrelation time, in steps."""
        return float(self.times.max())

    @property
    def burn_in(self) -> int:
        """Steps to leave out: five autocorrelation times, from a tenth to a half of the chain."""
        lost = min(BURN_IN * self.slowest, self.length)  # the time may be infinite
        return min(self.length // 2, max(int(START * self.length), math.ceil(lost)))


def check(
    u: Float[np.ndarray, "steps walkers free"], log_probability: Float[np.ndarray, "steps walkers"]
) -> Check:
    """Looks at a chain from its start."""
    apart = walkers_apart(log_probability)
    counted = u[int(START * len(u)) :, ~apart]
    return Check(len(u), autocorrelation_time(counted), apart)


def check_lengths(stored: int, every: int, limit: int) -> list[int]:
    """Lengths at which to check a chain, beginning with the last two that are already behind.

    They depend on `stored` only in where they begin, so that a resumed run stops where the unbroken
    one does. The last one is `limit`.
    """
    lengths = []
    length = 0
    while length < limit:
        gap = max(every, math.ceil(SPACING * length))
        length = length + gap if length + 2 * gap <= limit else limit
        lengths.append(length)
    after_next = [*lengths[2:], limit + 1, limit + 1]
    return [now for now, later in zip(lengths, after_next, strict=False) if later > stored]


def verdict(
    before: Check | None, latest: Check, names: Sequence[str], thin_by: int, stop_at: float
) -> tuple[bool, str]:
    """Whether the chain is long enough, and a sentence that says why.

    Args:
        before: the check before the latest.
        latest: the latest check.
        names: of the parameters.
        thin_by: steps of the sampler per step of the chain; the sentence counts the sampler's.
        stop_at: wanted length in autocorrelation times of the slowest parameter.
    """
    left_out = int(latest.apart.sum())
    lengths = latest.length / latest.slowest
    seen = (
        f"{latest.length * thin_by} steps are {lengths:.1f} autocorrelation times of"
        f" {names[int(latest.times.argmax())]} ({latest.slowest * thin_by:.1f} steps)"
    )
    if left_out:
        seen += f"; left out: {left_out} of {latest.apart.size} walkers, which sit apart"
    if left_out > MOST_APART * latest.apart.size:
        return False, f"Not converged, too many walkers sit apart: {seen}."
    if lengths < stop_at:
        return False, f"Not converged, too short: {seen}; wanted {stop_at:g}."
    if before is None or abs(before.slowest / latest.slowest - 1) > STEADY:
        return False, f"Not converged, the autocorrelation time still changes: {seen}."
    return True, f"Converged: {seen}."
