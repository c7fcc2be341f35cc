"""Levenberg–Marquardt, one step at a time: optimistix's descent and search, put together here.

The descent solves for a step of a given size, on the few rows of a `Compressed` model. The search
accepts or rejects the point where it leads, and gives the size of the next one.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from fitting.problem.problem import Problem
from fitting.runtime.program_cache import cached

BLOCK = 128  # rows of a QR decomposition that fit into a core's cache

DESCENT: optx.AbstractDescent = optx.DampedNewtonDescent()
SEARCH: optx.AbstractSearch = optx.ClassicalTrustRegion()


class HardModel(eqx.Module):
    """The problem itself, its thresholds and what else is frozen held at `frozen_u`.

    One more residual for each frozen parameter, `u - frozen_u`, keeps its column from being all
    zero.
    """

    problem: Problem
    frozen_u: Float[Array, " free"]
    frozen: Bool[Array, " free"]

    def __init__(
        self,
        problem: Problem,
        frozen_u: Float[Array, " free"],
        frozen: Bool[np.ndarray, " free"] | None = None,
    ):
        thresholds = np.asarray(problem.space.thresholds)
        self.problem = problem
        self.frozen_u = frozen_u
        self.frozen = jax.device_put(thresholds if frozen is None else thresholds | frozen)

    def residuals_and_jacobian(
        self, u: Float[Array, " free"], max_cost: Float[Array, ""]
    ) -> tuple[Float[Array, " residuals"], Float[Array, "residuals free"]]:
        """Both at `u`; the Jacobian is 0 where the cost exceeds `max_cost`."""
        frozen = self.frozen
        residuals, jacobian = self.problem.residuals_and_jacobian(
            jnp.where(frozen, self.frozen_u, u), max_cost
        )
        identity = jnp.diag(frozen.astype(u.dtype))
        residuals = jnp.concatenate([residuals, jnp.where(frozen, u - self.frozen_u, 0)])
        return residuals, jnp.concatenate([jnp.where(frozen, 0, jacobian), identity])


def problem_jacobian(jacobian: Array) -> Float[np.ndarray, "residuals free"]:
    """The part of a `HardModel`'s Jacobian that belongs to the problem's own residuals."""
    return np.asarray(jacobian)[: -jacobian.shape[1]]


class Compressed(eqx.Module):
    """Residuals and Jacobian at one point, rotated into one row more than there are parameters.

    A least-squares step and its cost depend only on the triangle that an orthogonal transformation
    makes of both: it keeps |J du + r| for every du. The full Jacobian travels along.
    """

    residuals: Float[Array, " rotated"]
    jacobian: Float[Array, "rotated free"]
    full_jacobian: Float[Array, "residuals free"]


@eqx.filter_jit  # traced once for all programs around it
def compress(model: HardModel, u: Float[Array, " free"], max_cost: Float[Array, ""]) -> Compressed:
    """Residuals and Jacobian at `u`, as few rows."""
    residuals, jacobian = model.residuals_and_jacobian(u, max_cost)
    triangle = triangular_factor(jnp.concatenate([jacobian, residuals[:, None]], axis=1))
    return Compressed(triangle[:, -1], triangle[:, :-1], jacobian)


def triangular_factor(tall: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    """The R of a QR decomposition, taken of blocks of rows and then of what these leave.

    A single call for all rows streams the whole matrix through memory for every column, and the
    library's threads wait on each other: 124 ms for 19,000 rows of 21 columns, against 3 ms. After
    Demmel, Grigori, Hoemmen and Langou, Communication-optimal Parallel and Sequential QR (2012).

    Blocks are decomposed one after the other. For several at once, jaxlib 0.10 occupies a thread of
    XLA's pool while it waits for the others, so that calls from as many threads of Python wait for
    ever.
    """
    columns = tall.shape[1]
    block = max(BLOCK, 2 * columns)
    while len(tall) > block:
        blocks = -(-len(tall) // block)
        padded = jnp.pad(tall, ((0, blocks * block - len(tall)), (0, 0)))
        tall = jax.lax.map(_triangle, padded.reshape(blocks, block, columns)).reshape(-1, columns)
    return _triangle(jnp.pad(tall, ((0, max(columns - len(tall), 0)), (0, 0))))


def _triangle(block: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    return jnp.linalg.qr(block, mode="r")


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
    """The memory of the search, which only the search itself reads."""

    @property
    def jacobian(self) -> Float[Array, "residuals free"]:
        """Of the model's residuals, at `u`."""
        return self.compressed.full_jacobian


@cached
def begin(model: HardModel, u: Float[Array, " free"]) -> LMState:
    """The state of a descent before anything is evaluated."""
    infinite, no = jnp.asarray(jnp.inf, u.dtype), jnp.zeros((), bool)
    shapes = eqx.filter_eval_shape(compress, model, u, infinite)
    empty = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    search = SEARCH.init(u, jax.eval_shape(_function_info, empty))
    search = jax.tree.map(lambda leaf: leaf.astype(u.dtype), search)  # from JAX's default type
    return LMState(u, infinite, no, empty, no, u, search)


@cached
def step(model: HardModel, state: LMState) -> LMState:
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
    """A model at a point, as optimistix has it."""
    jacobian = lx.MatrixLinearOperator(compressed.jacobian)
    return optx.FunctionInfo.ResidualJac(compressed.residuals, jacobian)


def evaluate(model: HardModel, u: Float[Array, " free"]) -> LMState:
    """The beginning of a descent, with cost and Jacobian at `u`."""
    return step(model, begin(model, u))
