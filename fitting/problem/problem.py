"""What a fit minimises and a sampler draws from: a space of systems, held against data."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik import lanes

from .loss import Loss, apply_loss
from .space import Space


class Problem(eqx.Module):
    """A space and what its systems are held against.

    `residuals(ik, data)` gives the residuals in sigmas, a masked row being 0. It is static, so it
    must be a function of a module: a new lambda per call would compile anew.

    Residuals of frames near in time repeat one another. `independent` takes that much of their
    log-likelihood, so that intervals are as wide as what is told anew (the magnitude adjustment of
    composite likelihoods; Pauli, Racugno and Ventura 2011).
    """

    space: Space
    data: PyTree
    residuals: Callable[[Any, Any], Array] = eqx.field(static=True)
    loss: Loss = eqx.field(static=True, default="squares")
    independent: Float[Array, ""] = eqx.field(  # share of the residuals that tell something new
        converter=jnp.asarray, default=1.0
    )

    @eqx.filter_jit  # traced once for all programs around it
    def rows(self, u: Float[Array, " free"]) -> Float[Array, " rows"]:
        """Robust residuals and prior rows; half their sum of squares is the cost."""
        residuals = apply_loss(self.residuals(self.space.unpack(u), self.data), self.loss)
        residuals *= jnp.sqrt(self.independent.astype(residuals.dtype))
        return jnp.concatenate([residuals, self.space.prior_residuals(u)])

    def cost(self, u: Float[Array, " free"]) -> Float[Array, ""]:
        """Minus the log-probability where that is finite, NaN or infinite where residuals are."""
        return 0.5 * jnp.sum(self.rows(u) ** 2)

    def jacobian(self, u: Float[Array, " free"]) -> Float[Array, "rows free"]:
        """Slopes of the rows, by forward mode; zero where a threshold moves hard decisions only.

        Not `jax.jacfwd`, which took the wrong branch of a minimum in a pipeline-sized program.
        """
        return self.residuals_and_jacobian(u)[1]

    def residuals_and_jacobian(
        self, u: Float[Array, " free"], below: Float[Array, ""] | float = jnp.inf
    ) -> tuple[Array, Array]:
        """Both from one linearisation; the slopes are 0 where the cost is not at most `below`."""
        rows, slope = jax.linearize(lambda u: self.rows(u), u)
        basis = jnp.eye(u.size, dtype=u.dtype)
        rounding = 1.0 + 64 * jnp.finfo(rows.dtype).eps
        return rows, jax.lax.cond(
            0.5 * jnp.sum(rows**2) <= below * rounding,
            lambda: lanes(slope, out_axes=-1)(basis),
            lambda: jnp.zeros((rows.size, u.size), rows.dtype),
        )

    def log_probability(self, u: Float[Array, " free"]) -> Float[Array, ""]:
        """Unnormalised log-density of the posterior in `u`; -inf where a residual is not finite."""
        cost = self.cost(u)
        return jnp.where(jnp.isfinite(cost), -cost, -jnp.inf)
