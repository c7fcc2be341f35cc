"""Rows and slopes that Levenberg–Marquardt may follow: of the hard program, and of an ensemble."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.problem.problem import Problem

BLOCK = 128  # rows of a QR decomposition that a core's cache holds

Model = Callable[[Array, Problem, Array, Array], tuple[Array, Array]]


def hard(u: Array, problem: Problem, pivot: Array, below: Array) -> tuple[Array, Array]:
    """Rows and slopes with the thresholds of `pivot`; no slopes where the cost is not `below`.

    One row more for each threshold keeps its column from being all zero.
    """
    frozen = jnp.asarray(problem.space.thresholds)
    rows, slopes = problem.residuals_and_jacobian(jnp.where(frozen, pivot, u), below)
    rows = jnp.concatenate([rows, jnp.where(frozen, u - pivot, 0)])
    return rows, jnp.concatenate([jnp.where(frozen, 0, slopes), jnp.diag(frozen.astype(u.dtype))])


def rows_of_problem(slopes: Array) -> Float[np.ndarray, "rows free"]:
    """Of the slopes of `hard`, those of the problem's own rows."""
    return np.asarray(slopes)[: -slopes.shape[1]]


def ensemble(u: Array, problem: Problem, shifts: Array, _: Array) -> tuple[Array, Array]:
    """Mean rows over shifted thresholds, with the slopes that a regression on the shifts gives.

    The mean over shifts has a slope where one hard program has none. The smooth columns are those
    of the thresholds in the middle: a slope steers a step, and the cost judges it.
    """
    _, slopes = problem.residuals_and_jacobian(u)
    every = jax.vmap(problem.residuals)(u + shifts)
    mean = jnp.mean(every, axis=0)
    regressed = (jnp.linalg.pinv(shifts) @ (every - mean)).T
    decides = jnp.asarray(problem.space.thresholds)
    return mean, jnp.where(decides, regressed, slopes)


class Turned(eqx.Module):
    """Rows and slopes at one point, turned into one row more than there are parameters.

    For a step and its cost all that counts of rows and slopes is the triangle that an orthogonal
    turn makes of them: |J du + r| stays for every du. The slopes themselves are beside it.
    """

    rows: Float[Array, " turned"]
    steepness: Float[Array, "turned free"]
    slopes: Float[Array, "rows free"]

    def rows_at(self, u: Array, _: Any) -> tuple[Array, Array]:
        """Rows as optimistix wants them, a function with a derivative, for this one point.

        It knows its derivative, so that only a handful of products are differentiated and not the
        pipeline, which would be traced once more.
        """
        return _known(u, self.rows, self.steepness, self.slopes)


@jax.custom_jvp
def _known(u: Array, rows: Array, steepness: Array, slopes: Array) -> tuple[Array, Array]:
    return rows, slopes


@_known.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    _, rows, steepness, slopes = primals
    return (rows, slopes), (steepness @ tangents[0], jnp.zeros_like(slopes))


@eqx.filter_jit  # traced once for all programs around it
def turned(model: Model, u: Array, problem: Problem, second: Array, below: Array) -> Turned:
    """What a model's rows and slopes at `u` come to."""
    rows, slopes = model(u, problem, second, below)
    both = triangle(jnp.concatenate([slopes, rows[:, None]], axis=1))
    return Turned(both[:, -1], both[:, :-1], slopes)


def triangle(tall: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    """The R of a QR decomposition, block by block and then of what the blocks left.

    One call for all rows streams the whole matrix through memory for every column, and its library
    threads wait on each other: 124 ms for 19,000 rows of 21 columns, against 3 ms. After Demmel,
    Grigori, Hoemmen and Langou, Communication-optimal Parallel and Sequential QR (2012).
    """
    columns = tall.shape[1]
    block = max(BLOCK, 2 * columns)
    while len(tall) > block:
        blocks = -(-len(tall) // block)
        filled = jnp.pad(tall, ((0, blocks * block - len(tall)), (0, 0)))
        tall = jnp.linalg.qr(filled.reshape(blocks, block, columns), mode="r").reshape(-1, columns)
    filled = jnp.pad(tall, ((0, max(columns - len(tall), 0)), (0, 0)))
    return jnp.linalg.qr(filled, mode="r")
