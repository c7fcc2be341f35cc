"""Levenberg–Marquardt, one step at a time. The only module that touches optimistix's state.

The step itself is optimistix's, on the few rows of a `Compressed` model. Which fields of
optimistix's state it reads is in `LMState`, `begin` and `step`, and nowhere else.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from fitting.runtime.program_cache import cached

from .models import Model, compress

SOLVER = optx.LevenbergMarquardt(rtol=0.0, atol=0.0)
# Jacobians as arrays: linearised programs in the solver's state would compile anew in each call.
OPTIONS = {"options": {"jac": "bwd"}, "tags": frozenset()}


class LMState(eqx.Module):
    """Where a descent stands; all of it arrays."""

    u: Float[Array, " free"]
    cost: Float[Array, ""]
    """Infinite before the first evaluation."""
    accepted: Bool[Array, ""]
    """Whether the last step lowered the cost."""
    solver: PyTree
    """Optimistix's own state: Jacobian, step size, the point to evaluate next."""

    @property
    def jacobian(self) -> Float[Array, "residuals free"]:
        """Of the model's residuals, at `u`."""
        return self.solver.aux


@cached
def begin(model: Model, u: Float[Array, " free"]) -> LMState:
    """The state of a descent before anything is evaluated."""
    infinite = jnp.asarray(jnp.inf, u.dtype)
    shapes = eqx.filter_eval_shape(compress, model, u, infinite)
    empty = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    shape, aux_shape = jax.eval_shape(empty.as_function, u, None)
    solver = SOLVER.init(
        empty.as_function, u, None, f_struct=shape, aux_struct=aux_shape, **OPTIONS
    )
    full_step = jnp.ones((), u.dtype)  # optimistix's own has JAX's default type
    solver = eqx.tree_at(lambda solver: solver.search_state.step_size, solver, full_step)
    return LMState(u, infinite, jnp.zeros((), bool), solver)


@cached
def step(model: Model, state: LMState) -> LMState:
    """One step of Levenberg–Marquardt; the first only evaluates the point where it stands."""
    before = state.solver
    # A trial that does not lower the cost is rejected, and its Jacobian is never used.
    compressed = compress(model, before.y_eval, state.cost)
    u, after, _ = SOLVER.step(compressed.as_function, state.u, None, state=before, **OPTIONS)
    accepted = after.num_accepted_steps > before.num_accepted_steps
    # As a strong type like that of `begin`, or the next step would be another program.
    return LMState(u, after.f_info.as_min(), jnp.asarray(accepted, bool), after)


def evaluate(model: Model, u: Float[Array, " free"]) -> LMState:
    """The beginning of a descent, with cost and Jacobian at `u`."""
    return step(model, begin(model, u))
