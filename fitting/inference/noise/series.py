"""The likeliest sigma and correlation of errors, and the likeliest tails.

Errors of a kind are a first-order autoregression of stationary standard deviation sigma, so that
the innovations `(e_t - rho e_{t-1}) / sqrt(1 - rho²)` are independent with the same sigma. Their
density is that of the loss: normal, Student's t, or the one whose logarithm a robust loss is.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import integrate, optimize, special

from fitting.problem.loss import Loss, rho, slope_of_rho

MAX_CORRELATION = 0.999
TAIL_RANGE = (1.5, 100.0)  # degrees of freedom; from 100 on, Student's t is nearly normal
ITERATIONS = 100  # of the reweighting, at most
TOLERANCE = 1e-8  # relative change of a variance that ends it


class Errors(NamedTuple):
    """Errors of one kind in one clip."""

    values: Float[np.ndarray, "frames columns"]
    """m, rad, ..."""
    active: Bool[np.ndarray, "frames columns"]
    """Which of them count."""


class Estimate(NamedTuple):
    """The likeliest noise of one kind."""

    sigma: float
    correlation: float
    log_likelihood: float
    """Up to a constant."""


def likeliest(
    clips: Sequence[Errors], loss: Loss, tails: float, correlation: float | None
) -> Estimate:
    """Sigma and correlation of the errors of one kind in all clips.

    Args:
        clips: the errors; at least one of them counts.
        loss: of the fit.
        tails: degrees of freedom of Student's t.
        correlation: if it is given; None to estimate it.
    """

    def at(rho: float) -> Estimate:
        values = np.concatenate([innovations(errors, rho) for errors in clips])
        sigma = scale(values, loss, tails)
        following = sum(int(_follows(errors).sum()) for errors in clips)
        density = log_density(values / max(sigma, 1e-300), loss, tails).sum()
        density -= values.size * math.log(max(sigma, 1e-300))
        return Estimate(sigma, rho, float(density) - 0.5 * following * math.log(1 - rho**2))

    if correlation is not None:
        return at(correlation)
    found = optimize.minimize_scalar(
        lambda rho: -at(float(rho)).log_likelihood,
        bounds=(-MAX_CORRELATION, MAX_CORRELATION),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return at(float(found.x))  # pyright: ignore[reportAttributeAccessIssue]


def likeliest_tails(values: Float[np.ndarray, " values"]) -> float:
    """Degrees of freedom of Student's t for independent values in units of their sigma."""
    found = optimize.minimize_scalar(
        lambda log_nu: -log_density(values, "student", math.exp(log_nu)).sum(),
        bounds=[math.log(nu) for nu in TAIL_RANGE],
        method="bounded",
    )
    return math.exp(float(found.x))  # pyright: ignore[reportAttributeAccessIssue]


def information_of_slopes(loss: Loss, tails: float) -> float:
    """What a residual tells of the parameters, over what its squared slope after the loss says.

    1 for squares. Student's residual has the Fisher information `(nu + 1) / (nu + 3)` (Lange,
    Little and Taylor 1989), while the mean squared slope of its transformed one is larger. Losses
    that are no distribution count as 1.
    """
    if loss != "student":
        return 1.0

    def squared_slope(residual: float) -> float:
        transformed = (tails + 1) * math.log1p(residual**2 / tails)
        slope = (tails + 1) * residual / (tails + residual**2)
        density = math.exp(log_density(np.array(residual), loss, tails))
        return 2 * density * slope**2 / transformed if transformed > 0 else 0.0

    mean, _ = integrate.quad(squared_slope, 0.0, np.inf)
    return (tails + 1) / (tails + 3) / mean


def innovations(errors: Errors, correlation: float) -> Float[np.ndarray, " values"]:
    """What the previous frame does not predict, of the errors that count, in their unit."""
    return whitened(errors, correlation).values[errors.active]


def whitened(errors: Errors, correlation: float) -> Errors:
    """What the previous frame does not predict of errors, where there is one that counts."""
    values, follows = errors.values, _follows(errors)
    previous = np.concatenate([np.zeros_like(values[:1]), values[:-1]])
    innovation = (values - correlation * previous) / math.sqrt(1 - correlation**2)
    return errors._replace(values=np.where(follows, innovation, values))


def influence(
    residuals: Float[np.ndarray, "*values"], loss: Loss, tails: float
) -> Float[np.ndarray, "*values"]:
    """Derivative of half the loss by a residual, both in sigmas."""
    return residuals * slope_of_rho(residuals**2, loss, tails, np)


def scale(values: Float[np.ndarray, " values"], loss: Loss, tails: float) -> float:
    """The likeliest sigma of independent values: `sigma² = mean(weight * value²)`.

    Iteratively reweighted; a weight is the slope of the loss at the value in sigmas.
    """
    variance = float(np.mean(values**2))
    for _ in range(ITERATIONS if loss != "squares" else 0):
        if not variance > 0:
            break
        before, squares = variance, values**2
        weights = slope_of_rho(squares / variance, loss, tails, np)
        variance = float(np.mean(weights * squares))
        if abs(variance - before) <= TOLERANCE * before:
            break
    return math.sqrt(variance)


def log_density(
    residuals: Float[np.ndarray, "*values"], loss: Loss, tails: float
) -> Float[np.ndarray, "*values"]:
    """Log-density of residuals in sigmas; up to a constant, except for Student's t."""
    constant = 0.0
    if loss == "student":
        constant = special.gammaln((tails + 1) / 2) - special.gammaln(tails / 2)
        constant -= 0.5 * math.log(math.pi * tails)
    return np.asarray(constant - 0.5 * rho(residuals**2, loss, tails, np))


def _follows(errors: Errors) -> Bool[np.ndarray, "frames columns"]:
    """Which errors count and have one before them that counts."""
    active = errors.active
    return np.concatenate([np.zeros_like(active[:1]), active[1:] & active[:-1]])
