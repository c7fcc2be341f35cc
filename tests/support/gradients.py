"""Gradients compared with finite differences, and arguments for which gradients go wrong.

The arguments are rows of arrays, for all of which one compiled program computes the gradients.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.spatial.transform import Rotation

STEPS = tuple(10.0**-exponent for exponent in range(3, 10))
TINY = 1e-5  # small compared with 1, yet many steps of the finest difference
ROWS = 40


@functools.partial(jax.jit, static_argnums=0)
def _derivatives(function: Callable, args: tuple) -> tuple[jax.Array, ...]:
    """Value (outputs), and Jacobians (outputs, inputs) by forward and by reverse mode."""
    flat, restore = ravel_pytree(args)
    # Traced and compiled once for the value and both modes, not once for each.
    value, along = jax.linearize(functools.partial(_flat, function, restore), flat)
    against = jax.linear_transpose(along, flat)
    forward = jax.vmap(along, out_axes=1)(jnp.eye(flat.size))
    (reverse,) = jax.vmap(against)(jnp.eye(value.size))
    return value, forward, reverse


@functools.partial(jax.jit, static_argnums=0)
def _quotients(function: Callable, args: tuple) -> jax.Array:
    """Central differences (steps, outputs, inputs), one for each of `STEPS`."""
    flat, restore = ravel_pytree(args)
    moves = jnp.asarray(STEPS)[:, None, None] * jnp.eye(flat.size)
    # One batch for all steps and both sides: the function is compiled once instead of 14 times.
    points = (flat + jnp.stack([moves, -moves])).reshape(-1, flat.size)
    values = jax.vmap(functools.partial(_flat, function, restore))(points)
    ahead, behind = values.reshape(2, *moves.shape[:2], -1)
    return (ahead - behind).swapaxes(1, 2) / (2 * jnp.asarray(STEPS)[:, None, None])


@functools.partial(jax.jit, static_argnums=(0, 1))
def _of_rows(way: Callable, function: Callable, rows: tuple) -> Any:
    """What one of both gives for each row of the arguments."""
    return jax.vmap(functools.partial(way, function))(rows)


def _flat(function: Callable, restore: Callable, flat: jax.Array) -> jax.Array:
    return ravel_pytree(function(*restore(flat)))[0]


def _floats(args: tuple) -> tuple:
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError("finite differences need 64-bit floats: switch jax_enable_x64 on")
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), args)


def _checked(derivatives: Sequence, args: tuple) -> np.ndarray:
    """The Jacobian (outputs, inputs), finite and equal in both modes."""
    value, forward, reverse = map(np.asarray, derivatives)
    for name, x in {"value": value, "forward mode": forward, "reverse mode": reverse}.items():
        assert np.isfinite(x).all(), f"{name} {x} at {args}"
    scale = max(1.0, np.abs(forward).max())
    np.testing.assert_allclose(
        reverse, forward, rtol=0, atol=1e-9 * scale, err_msg=f"both modes at {args}"
    )
    return forward


def _assert_differences_match(
    derivatives: Sequence, quotients: np.ndarray, args: tuple, tolerance: float
) -> None:
    forward = _checked(derivatives, args)
    steadiest = np.abs(np.diff(quotients, axis=0)).argmin(axis=0)
    expected = np.take_along_axis(quotients[1:], steadiest[None], axis=0)[0]
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(
        forward, expected, rtol=0, atol=tolerance * scale, err_msg=f"gradients at {args}"
    )


def finite_jacobian(function: Callable, *args: Any) -> np.ndarray:
    """The Jacobian (outputs, inputs), checked to be finite and equal in forward and reverse mode.

    For points where a function jumps and differences say nothing. The arguments are trees of
    numbers, taken as 64-bit floats. Compiles once per function object: pass a function of a module.
    """
    args = _floats(args)
    return _checked(_derivatives(function, args), args)


def assert_gradients_match(function: Callable, *args: Any, tolerance: float = 1e-6) -> None:
    """Asserts that forward mode, reverse mode and central differences agree and are finite.

    `tolerance` is relative to the largest derivative, or to 1 if that is larger. For each entry the
    step is used at which the quotient changes least from one step to the next, so that a function
    may bend on the scale of `TINY`. Arguments as for `finite_jacobian`.
    """
    args = _floats(args)
    quotients = np.asarray(_quotients(function, args))
    _assert_differences_match(_derivatives(function, args), quotients, args, tolerance)


def _each_row(way: Callable, function: Callable, rows: tuple) -> Iterator[tuple[Any, tuple]]:
    """What is computed of each row, and its arguments; single numbers are the same in all."""
    rows = _floats(rows)
    count = max(len(leaf) for leaf in jax.tree.leaves(rows) if leaf.ndim)
    # Repeated, so that fewer rows need no program of their own.
    size = max(count, ROWS)
    rows = jax.tree.map(lambda leaf: np.resize(leaf, (size, *leaf.shape[1:])), rows)
    results = jax.device_get(_of_rows(way, function, rows))
    for row in range(count):
        yield jax.tree.map(lambda leaf, row=row: leaf[row], (results, rows))


def finite_jacobians(function: Callable, *rows: Any) -> np.ndarray:
    """`finite_jacobian` of each row of the arguments: (rows, outputs, inputs)."""
    return np.stack([_checked(*row) for row in _each_row(_derivatives, function, rows)])


def assert_all_gradients_match(function: Callable, *rows: Any, tolerance: float = 1e-6) -> None:
    """`assert_gradients_match` of each row of the arguments."""
    ways = (_each_row(way, function, rows) for way in (_derivatives, _quotients))
    for (derivatives, args), (quotients, _) in zip(*ways, strict=True):
        _assert_differences_match(derivatives, quotients, args, tolerance)


def assert_finite_in_single_precision(function: Callable, *rows: np.ndarray) -> None:
    """Asserts that results and gradients of all rows stay finite, and stay 32 bits wide."""

    @jax.jit
    def results_and_gradients(rows):
        results, vjp = jax.vjp(jax.vmap(function), *rows)
        # A gradient that is not finite makes a sum of gradients not finite either.
        return results, vjp(jax.tree.map(jnp.ones_like, results))

    for leaf in jax.tree.leaves(results_and_gradients([jnp.float32(x) for x in rows])):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def vectors(rng: np.random.Generator, *sizes: float) -> np.ndarray:
    """Vectors (rows, 3), some of them along an axis, with lengths around one of `sizes`."""
    v = np.concatenate([np.eye(3), -np.eye(3), rng.uniform(-2, 2, (ROWS - 6, 3))])
    return rng.permutation(v) * rng.permutation(np.resize(sizes, (ROWS, 1)))


def angles(rng: np.random.Generator, small: float = TINY) -> np.ndarray:
    """Angles -pi..pi, rad, including zero, tiny and right angles and (nearly) half turns."""
    marked = np.array([0.0, small, np.pi / 2, np.pi - small, np.pi])
    return rng.permutation([*marked, *-marked, *rng.uniform(-3, 3, ROWS - 10)])


def directions(rng: np.random.Generator, small: float = TINY) -> tuple[np.ndarray, ...]:
    """Unit vectors `a` and `b`, `angles` apart, and the unit `axis` at right angles to both."""
    a, angle = unit(vectors(rng, 1.0)), angles(rng, small)[:, None]
    axis = unit(np.cross(a, np.eye(3)[np.abs(a).argmin(axis=-1)]))
    # A half turn to the last bit: the sine of the nearest float to pi is not quite zero.
    sin = np.where(np.abs(angle) == np.pi, 0.0, np.sin(angle))
    return a, np.cos(angle) * a + sin * np.cross(axis, a), axis


def quaternions(rng: np.random.Generator, small: float = TINY) -> np.ndarray:
    """Unit quaternions wxyz by one of `angles` about any axis, of either sign."""
    axis, half = unit(vectors(rng, 1.0)), 0.5 * angles(rng, small)[:, None]
    return np.hstack([np.cos(half), np.sin(half) * axis]) * rng.choice([1.0, -1.0], (ROWS, 1))


def limbs(rng: np.random.Generator, angle: np.ndarray) -> tuple[np.ndarray, ...]:
    """To hip and to ankle, m, and the unit hinge of limbs in any attitude.

    The interior angle of the knee is `angle`, rad; a negative one is a limb bent backwards.
    """
    thigh, shin = rng.uniform(0.2, 0.6, (2, ROWS, 1))
    across = [np.cos(angle), np.sin(angle), np.zeros(ROWS)]
    attitude = Rotation.from_quat(quaternions(rng), scalar_first=True)
    to_hip, to_ankle = thigh * np.eye(3)[0], shin * np.stack(across, axis=-1)
    return attitude.apply(to_hip), attitude.apply(to_ankle), attitude.apply(np.eye(3)[2])
