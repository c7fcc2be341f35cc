"""A space of systems together with the data they are fitted to, and the losses.

All losses but the squares limit how far a few bad frames can pull a fit. A loss replaces the square
`z` of a residual in sigmas by `rho(z)`, which is minus twice the logarithm of a density, up to a
constant:

    squares    z                               normal
    huber      z up to HUBER², and 2 HUBER sqrt(z) - HUBER² beyond
    cauchy     CAUCHY² log(1 + z / CAUCHY²)
    student    (nu + 1) log(1 + z / nu)        Student's t with nu degrees of freedom

Arrays are JAX's, or NumPy's where `library` says so.
"""

import dataclasses
import hashlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, Generic, Literal, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from fitting.runtime.precision import in_float64
from jaxik import lanes

from .space import Space, System, Vector, library_of

HUBER = 1.345  # sigmas; 95 % efficient for normal errors (Holland and Welsch 1977)
CAUCHY = 2.385  # sigmas; 95 % efficient, too

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


def rho(z: Squares, loss: Loss, tails: Number = TAILS) -> Squares:
    """The loss of squared residuals `z`, in sigmas."""
    return z * _factor_and_slope(z, loss, tails, library_of(z))[0]


def slope_of_rho(z: Squares, loss: Loss, tails: Number = TAILS) -> Squares:
    """Derivative of `rho` by `z`: how much a residual counts, compared with squares."""
    return _factor_and_slope(z, loss, tails, library_of(z))[1]


def _factor_and_slope(
    z: Any, loss: Loss, tails: Number, library: ModuleType
) -> tuple[Squares, Squares]:
    """`rho(z) / z`, finite at 0, and the derivative of `rho`: all in which losses differ."""
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


class Problem(eqx.Module, Generic[System]):
    """The free parameters of a system, the data, and how far one is from the other.

    `residual_function(system, data)` returns residuals in standard deviations, 0 where a value is
    masked. It is static, so it must be a function of a module: a new lambda per call would compile
    anew.

    Residuals of neighbouring frames are correlated, and may be larger or smaller than their sigmas.
    `weight` scales the cost as a whole so that intervals get their nominal coverage (the magnitude
    adjustment of composite likelihoods; Pauli, Racugno and Ventura 2011). It does not move the
    lowest point.
    """

    space: Space[System]
    data: PyTree
    residual_function: Callable[[System, PyTree], Array] = eqx.field(static=True)
    loss: Loss = eqx.field(static=True, default="squares")
    weight: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)
    tails: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=TAILS)
    """Degrees of freedom of Student's t, under this loss."""
    unknown_sigmas: Float[Array, "sigmas residuals"] | None = None
    """For each sigma that the posterior leaves open, 1 at its residuals and 0 at others."""

    @in_float64
    @eqx.filter_jit  # traced once for all programs around it
    def residuals(self, u: Vector) -> Float[Array, " residuals"]:
        """Residuals after the loss, then those of the prior; half their squares' sum is the cost.

        The last `space.size` of them belong to the prior.
        """
        plain = self.residual_function(self.space.unpack(u), self.data)
        residuals = apply_loss(plain, self.loss, self.tails)
        residuals = jnp.concatenate([residuals, self.space.prior_residuals(u)])
        return residuals * jnp.sqrt(self.weight.astype(residuals.dtype))

    def prior_costs(self, u: Float[np.ndarray, "*rows free"]) -> Float[np.ndarray, "*rows free"]:
        """The part of the cost that the prior of each parameter contributes."""
        return float(self.weight) * self.space.prior_costs(u)

    @in_float64
    def with_weight(self, weight: float) -> "Problem[System]":
        """The same problem with another weight. Nothing recompiles."""
        return eqx.tree_at(lambda p: p.weight, self, jnp.full_like(self.weight, weight))

    @in_float64
    def cost(self, u: Vector) -> Float[Array, ""]:
        """Half the sum of the squared residuals; not finite where one is not."""
        return 0.5 * jnp.sum(self.residuals(u) ** 2)

    @in_float64
    def jacobian(self, u: Vector) -> Float[Array, "residuals free"]:
        """Derivatives of the residuals, by forward mode.

        The column of a threshold holds only its prior: the residuals jump with it, and between two
        jumps they do not change. Not `jax.jacfwd`, which followed the wrong branch of a minimum in
        a program of the pipeline's size.
        """
        return self.residuals_and_jacobian(u)[1]

    @in_float64
    def residuals_and_jacobian(
        self, u: Vector, max_cost: Float[Array, ""] | float = jnp.inf
    ) -> tuple[Float[Array, " residuals"], Float[Array, "residuals free"]]:
        """Both from one linearisation; the Jacobian is all 0 where the cost exceeds `max_cost`."""
        residuals, tangent = jax.linearize(lambda u: self.residuals(u), u)
        basis = jnp.eye(u.size, dtype=u.dtype)
        rounding = 1.0 + 64 * jnp.finfo(residuals.dtype).eps
        return residuals, jax.lax.cond(
            0.5 * jnp.sum(residuals**2) <= max_cost * rounding,
            lambda: lanes(tangent, out_axes=-1)(basis),
            lambda: jnp.zeros((residuals.size, u.size), residuals.dtype),
        )

    @in_float64
    def log_probability(self, u: Vector) -> Float[Array, ""]:
        """Unnormalised log-density of the posterior in `u`; -inf where a residual is not finite.

        The weight scales the likelihood, and not the prior. Unknown sigmas are integrated out.
        """
        squares = self.residuals(u) ** 2
        squares, of_prior = jnp.split(squares, [squares.size - self.space.size])
        of_prior = jnp.sum(of_prior) / self.weight.astype(squares.dtype)
        if self.unknown_sigmas is None:
            of_data = jnp.sum(squares)
        else:
            of_data = self._marginal(squares, self.unknown_sigmas)
        log_probability = -0.5 * (of_data + of_prior)
        return jnp.where(jnp.isfinite(log_probability), log_probability, -jnp.inf)

    def _marginal(
        self, squares: Float[Array, " residuals"], unknown: Float[Array, "sigmas residuals"]
    ) -> Float[Array, ""]:
        """Minus twice the log-likelihood with the unknown sigmas integrated out.

        Their logarithms have a flat prior. With `n` normal residuals of squares `S`, in units of
        any fixed sigma, the integral of `sigma^-n exp(-S / (2 sigma²))` over log sigma is
        proportional to `S^(-n / 2)`.
        """
        known = jnp.sum(squares * (1 - jnp.sum(unknown, axis=0)))
        counts = self.weight * jnp.sum(unknown, axis=1)
        return known + jnp.sum(counts * jnp.log(unknown @ squares))


def digest(problem: Problem) -> str:
    """64 characters that change with any number or name on which the log-probability depends."""
    problem = eqx.tree_at(lambda problem: problem.space.start, problem, replace=None)
    digested = hashlib.sha256()
    function = problem.residual_function
    names = (function.__module__, function.__qualname__, problem.loss)
    parameters = [dataclasses.astuple(parameter) for parameter in problem.space.parameters]
    digested.update(repr((names, parameters)).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(problem, eqx.is_array_like)):
        name = jax.tree_util.keystr(path)
        if ".place." in name:  # in a shared world, which changes no number
            continue
        array = np.asarray(leaf)
        digested.update(f"{name} {array.dtype} {array.shape}".encode())
        digested.update(array.tobytes())
    return digested.hexdigest()


def digest_with(problem: Problem, *settings: object) -> str:
    """64 characters that also change with anything else that a search follows from."""
    start = np.asarray(problem.space.start).tolist()
    return hashlib.sha256(f"{digest(problem)} {(*settings, start)}".encode()).hexdigest()
