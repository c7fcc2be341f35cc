"""Levenberg–Marquardt, one step at a time: optimistix's descent and search, put together here.

The descent solves for a step of a given size, on the few rows of a `Compressed` model. The search
accepts or rejects the point where it leads, and gives the size of the next one.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from fitting.runtime.program_cache import cached

from .models import Compressed, Model, compress

DESCENT: optx.AbstractDescent = optx.DampedNewtonDescent()
SEARCH: optx.AbstractSearch = optx.ClassicalTrustRegion()


class LMState(eqx.Module):
    """Where a descent stands; all of it arrays."""

    u: Float[Array, " free"]
    cost: Float[Array, ""]
    """Infinite before the first evaluation."""
    accepted: Bool[Array, ""]
    """Whether the last step lowered the cost."""
    compressed: Compressed
    """Residuals and Jacobian at `u`; 0 before the first evaluation."""
    evaluated: Bool[Array, ""]
    """Whether there has been one."""
    trial: Float[Array, " free"]
    """The point that the next step evaluates."""
    search: PyTree
    """What the search remembers, which only the search itself reads."""

    @property
    def jacobian(self) -> Float[Array, "residuals free"]:
        """Of the model's residuals, at `u`."""
        return self.compressed.full_jacobian


@cached
def begin(model: Model, u: Float[Array, " free"]) -> LMState:
    """The state of a descent before anything is evaluated."""
    infinite, no = jnp.asarray(jnp.inf, u.dtype), jnp.zeros((), bool)
    shapes = eqx.filter_eval_shape(compress, model, u, infinite)
    empty = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    search = SEARCH.init(u, jax.eval_shape(_function_info, empty))
    search = jax.tree.map(lambda leaf: leaf.astype(u.dtype), search)  # from JAX's default type
    return LMState(u, infinite, no, empty, no, u, search)


@cached
def step(model: Model, state: LMState) -> LMState:
    """One step of Levenberg–Marquardt; the first only evaluates the point where it stands."""
    # A trial that does not lower the cost is rejected, and its Jacobian is never used.
    at_trial = compress(model, state.trial, state.cost)
    step_size, accepted, _, search = SEARCH.step(
        jnp.logical_not(state.evaluated),
        state.u,
        state.trial,
        _function_info(state.compressed),
        _function_info(at_trial),
        state.search,
    )
    u, compressed = jax.tree.map(
        functools.partial(jnp.where, accepted),
        (state.trial, at_trial),
        (state.u, state.compressed),
    )
    info = _function_info(compressed)
    descent = DESCENT.query(u, info, DESCENT.init(u, jax.eval_shape(lambda: info)))
    move, _ = DESCENT.step(step_size, descent)
    return LMState(
        u=u,
        cost=info.as_min(),
        accepted=accepted,
        compressed=compressed,
        evaluated=jnp.ones((), bool),
        trial=u + move,
        search=search,
    )


def _function_info(compressed: Compressed) -> optx.FunctionInfo:
    """A model at a point, as optimistix takes it."""
    jacobian = lx.MatrixLinearOperator(compressed.jacobian)
    return optx.FunctionInfo.ResidualJac(compressed.residuals, jacobian)


def evaluate(model: Model, u: Float[Array, " free"]) -> LMState:
    """The beginning of a descent, with cost and Jacobian at `u`."""
    return step(model, begin(model, u))
