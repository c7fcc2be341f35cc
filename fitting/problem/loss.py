"""Losses. All but the squares limit how far a few bad frames can pull a fit.

A loss replaces the square `z` of a residual in sigmas by `rho(z)`, which is minus twice the
logarithm of a density, up to a constant:

    squares    z                               normal
    huber      z up to HUBER², and 2 HUBER sqrt(z) - HUBER² beyond
    cauchy     CAUCHY² log(1 + z / CAUCHY²)
    student    (nu + 1) log(1 + z / nu)        Student's t with nu degrees of freedom

Arrays are JAX's, or NumPy's where `library` says so.
"""

from types import ModuleType
from typing import Any, Literal, TypeAlias, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

HUBER = 1.345  # sigmas; 95 % efficient for normal errors (Holland and Welsch 1977)
CAUCHY = 2.385  # sigmas, likewise

TAILS = 4.0  # degrees of freedom of Student's t, where none are estimated

Loss = Literal["squares", "huber", "cauchy", "student"]

Squares: TypeAlias = Float[Array | np.ndarray, "*residuals"]
Number: TypeAlias = Float[Array, ""] | float


def apply_loss(
    residuals: Float[Array, " residuals"], loss: Loss, tails: Number = TAILS
) -> Float[Array, " residuals"]:
    """Residuals whose squares are `rho(residual²)`; derivatives are finite everywhere.

    The residual is scaled by `sqrt(rho(z) / z)`, since `sign sqrt(rho)` has no derivative at 0.
    There, the derivative is 1, and Student's `sqrt((nu + 1) / nu)`.

    Args:
        residuals: in sigmas.
        loss: its name.
        tails: Student's degrees of freedom, nu.

    Raises:
        ValueError: for an unknown loss.
    """
    factor, _ = _factor_and_slope(residuals**2, loss, jnp.asarray(tails, residuals.dtype), jnp)
    return residuals * jnp.sqrt(factor)


def rho(z: Squares, loss: Loss, tails: Number = TAILS, library: ModuleType = jnp) -> Squares:
    """What the loss makes of squared residuals `z`, in sigmas."""
    return z * _factor_and_slope(z, loss, tails, library)[0]


def slope_of_rho(
    z: Squares, loss: Loss, tails: Number = TAILS, library: ModuleType = jnp
) -> Squares:
    """Derivative of `rho` by `z`: how much a residual counts, compared with squares."""
    return _factor_and_slope(z, loss, tails, library)[1]


def _factor_and_slope(
    z: Any, loss: Loss, tails: Number, library: ModuleType
) -> tuple[Squares, Squares]:
    """`rho(z) / z`, finite at 0, and the derivative of `rho`: all that tells losses apart."""
    match loss:
        case "squares":
            return library.ones_like(z), library.ones_like(z)
        case "huber":
            slope = HUBER / library.sqrt(library.where(z > HUBER**2, z, HUBER**2))
            return slope * (2 - slope), slope
        case "cauchy":
            return _logarithmic(z / CAUCHY**2, library)
        case "student":
            factor, slope = _logarithmic(z / tails, library)
            return (tails + 1) / tails * factor, (tails + 1) / tails * slope
        case _:
            raise ValueError(f"loss is {loss!r}, wanted one of {get_args(Loss)}")


def _logarithmic(z: Any, library: ModuleType) -> tuple[Squares, Squares]:
    """`log(1 + z) / z` and the derivative of `log(1 + z)`."""
    nonzero = z > library.finfo(z.dtype).eps  # below it the quotient rounds to 1
    safe = library.where(nonzero, z, 1)
    return library.where(nonzero, library.log1p(safe) / safe, 1), 1 / (1 + z)
