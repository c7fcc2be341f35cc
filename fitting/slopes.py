"""Rows and slopes that Levenberg–Marquardt may follow: of the hard program, and of an ensemble."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .problem import Problem

Model = Callable[[Array, Problem, Array], tuple[Array, Array]]


def hard(u: Array, problem: Problem, pivot: Array) -> tuple[Array, Array]:
    """Rows and slopes with the thresholds of `pivot`.

    One row more for each threshold keeps its column from being all zero.
    """
    frozen = jnp.asarray(problem.space.thresholds)
    rows, slopes = problem.rows_and_jacobian(jnp.where(frozen, pivot, u))
    rows = jnp.concatenate([rows, jnp.where(frozen, u - pivot, 0)])
    return rows, jnp.concatenate([jnp.where(frozen, 0, slopes), jnp.diag(frozen.astype(u.dtype))])


def ensemble(u: Array, problem: Problem, shifts: Array) -> tuple[Array, Array]:
    """Mean rows over shifted thresholds, with the slopes that a regression on the shifts gives.

    The mean over shifts has a slope where one hard program has none. The smooth columns are those
    of the thresholds in the middle: a slope steers a step, and the cost judges it.
    """
    _, slopes = problem.rows_and_jacobian(u)
    every = jax.vmap(problem.rows)(u + shifts)
    mean = jnp.mean(every, axis=0)
    regressed = (jnp.linalg.pinv(shifts) @ (every - mean)).T
    decides = jnp.asarray(problem.space.thresholds)
    return mean, jnp.where(decides, regressed, slopes)


def with_slopes(model: Model) -> Callable[[Array, Any], tuple[Array, None]]:
    """The rows of a model as optimistix wants them, their derivative being the model's slopes.

    The Jacobian is then made once per step; linearising the rows themselves would run the tangent
    program once for the prediction and once more for the damped step.
    """

    @eqx.filter_custom_jvp
    def rows(u: Array, *, args: Any) -> Array:
        return model(u, *args)[0]

    @rows.def_jvp
    def _(primals: Any, tangents: Any, *, args: Any) -> Any:
        value, slopes = model(*primals, *args)
        return value, slopes @ tangents[0]

    return lambda u, args: (rows(u, args=args), None)
