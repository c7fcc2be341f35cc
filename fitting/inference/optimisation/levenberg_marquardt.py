"""Levenberg–Marquardt by optimistix, a step at a time, on few rows turned out of many."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from fitting.problem.problem import Problem
from fitting.runtime.program_cache import cached

from .jacobian import Model, turned

TOLERANCE = 1e-6  # relative fall of the cost below which a step counts as none
CALM = 2  # such steps in a row that end a march
SOLVER = optx.LevenbergMarquardt(rtol=0.0, atol=0.0)
# Slopes as an array: linearised programs in the solver's state would compile anew in each call.
COMMON = {"options": {"jac": "bwd"}, "tags": frozenset()}


class Position(eqx.Module):
    """Where a march of Levenberg–Marquardt stands; all of it data."""

    u: Array
    cost: Array  # infinite before the first evaluation
    calm: Array  # accepted steps in a row that gained next to nothing
    stalls: Array  # rejected steps in a row
    steps: Array
    solver: Any  # optimistix's own state: slopes, step size and where it looks next

    def done(self, stalls: int) -> bool:
        """Whether steps are not worth it: next to nothing gained, or so many rejected in a row."""
        return int(self.calm) >= CALM or int(self.stalls) >= stalls

    @property
    def slopes(self) -> Array:
        """Of the model's rows, at `u`."""
        return self.solver.aux


@cached
def begin(model: Model, u: Array, args: tuple[Problem, Array]) -> Position:
    """A march that has not evaluated anything yet."""
    zero, endless = jnp.zeros((), int), jnp.asarray(jnp.inf, u.dtype)
    shapes = eqx.filter_eval_shape(turned, model, u, *args, endless)
    empty = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    shape, aux_shape = jax.eval_shape(empty.rows_at, u, None)
    state = SOLVER.init(empty.rows_at, u, None, f_struct=shape, aux_struct=aux_shape, **COMMON)
    whole = jnp.ones((), u.dtype)  # optimistix's own is of JAX's default type
    state = eqx.tree_at(lambda state: state.search_state.step_size, state, whole)
    return Position(u, endless, zero, zero, zero, state)


@cached
def step(model: Model, at: Position, args: tuple[Problem, Array]) -> Position:
    """One step of Levenberg–Marquardt; the first only evaluates where it stands."""
    before = at.solver
    # A trial that lowers no cost is rejected, whatever its slopes, and need not have any.
    here = turned(model, before.y_eval, *args, at.cost)
    u, state, _ = SOLVER.step(here.rows_at, at.u, None, state=before, **COMMON)
    first = before.first_step
    accepted = state.num_accepted_steps > before.num_accepted_steps
    cost = state.f_info.as_min()
    little = accepted & (at.cost - cost <= TOLERANCE * at.cost)
    calm = jnp.where(little, at.calm + 1, jnp.where(accepted, 0, at.calm))
    return Position(
        u=u,
        cost=cost,
        calm=jnp.where(first, at.calm, calm),
        stalls=jnp.where(first | accepted, 0, at.stalls + 1),
        steps=at.steps + jnp.where(first, 0, 1),
        solver=state,
    )


def evaluated(model: Model, u: Array, args: tuple[Problem, Array]) -> Position:
    """Where a march begins, with its cost and slopes."""
    return step(model, begin(model, u, args), args)
