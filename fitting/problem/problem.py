"""A space of systems together with the data they are fitted to."""

from collections.abc import Callable
from typing import Generic

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from fitting.runtime.precision import in_float64
from jaxik import lanes

from .loss import TAILS, Loss, apply_loss
from .space import Space, System, Vector


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
        jumps they do not change. Not `jax.jacfwd`, which took the wrong branch of a minimum in a
        program of the pipeline's size.
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
