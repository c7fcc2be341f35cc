"""Gradients compared with finite differences, and draws from where gradients go wrong."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

STEPS = tuple(10.0**-exponent for exponent in range(3, 10))
TINY = 1e-5  # small compared with 1, yet many steps of the finest difference


@functools.partial(jax.jit, static_argnums=0)
def _derivatives(function: Callable, args: tuple) -> tuple[jax.Array, ...]:
    """Value (outputs), Jacobians (outputs, inputs) by forward and by reverse mode, and central
    differences (steps, outputs, inputs), one for each of `STEPS`.
    """
    flat, restore = ravel_pytree(args)
    flat_function = functools.partial(_flat, function, restore)
    moves = jnp.asarray(STEPS)[:, None, None] * jnp.eye(flat.size)
    # One batch for all steps and both sides: the function is compiled once instead of 14 times.
    points = (flat + jnp.stack([moves, -moves])).reshape(-1, flat.size)
    ahead, behind = jax.vmap(flat_function)(points).reshape(2, *moves.shape[:2], -1)
    quotients = (ahead - behind).swapaxes(1, 2) / (2 * jnp.asarray(STEPS)[:, None, None])
    forward, reverse = jax.jacfwd(flat_function)(flat), jax.jacrev(flat_function)(flat)
    return flat_function(flat), forward, reverse, quotients


def _flat(function: Callable, restore: Callable, flat: jax.Array) -> jax.Array:
    return ravel_pytree(function(*restore(flat)))[0]


def _checked(function: Callable, args: tuple) -> tuple[np.ndarray, np.ndarray]:
    """The Jacobian (outputs, inputs), finite and equal in both modes, and the differences."""
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError("finite differences need 64-bit floats: switch jax_enable_x64 on")
    args = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), args)
    value, forward, reverse, quotients = map(np.asarray, _derivatives(function, args))
    for name, x in {"value": value, "forward mode": forward, "reverse mode": reverse}.items():
        assert np.isfinite(x).all(), f"{name} {x} at {args}"
    scale = max(1.0, np.abs(forward).max())
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-9 * scale)
    return forward, quotients


def finite_jacobian(function: Callable, *args: Any) -> np.ndarray:
    """The Jacobian (outputs, inputs), checked to be finite and equal in forward and reverse mode.

    For points where a function jumps and differences say nothing. The arguments are trees of
    numbers, taken as 64-bit floats. Compiles once per function object: pass a function of a
    module, or one defined outside the hypothesis test.
    """
    return _checked(function, args)[0]


def assert_gradients_match(function: Callable, *args: Any, tolerance: float = 1e-6) -> None:
    """Asserts that forward mode, reverse mode and central differences agree and are finite.

    `tolerance` is relative to the largest derivative, or to 1 if that is larger. For each entry the
    step is used at which the quotient changes least from one step to the next, so that a function
    may bend on the scale of `TINY`. Arguments as for `finite_jacobian`.
    """
    forward, quotients = _checked(function, args)
    steadiest = np.abs(np.diff(quotients, axis=0)).argmin(axis=0)
    expected = np.take_along_axis(quotients[1:], steadiest[None], axis=0)[0]
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(
        forward, expected, rtol=0, atol=tolerance * scale, err_msg=f"gradients at {args}"
    )


def numbers(low: float = -2.0, high: float = 2.0) -> st.SearchStrategy[float]:
    """Numbers, none of them so small that it vanishes in a difference quotient."""
    return st.floats(low, high).map(lambda x: round(x, 3))


@st.composite
def vectors(draw: st.DrawFn, sizes: tuple[float, ...] = (1.0, TINY)) -> np.ndarray:
    """Vectors (3) with a length around one of `sizes`, often along an axis."""
    along_axis = st.sampled_from([*np.eye(3), *-np.eye(3)])
    anywhere = st.tuples(numbers(), numbers(), numbers()).map(np.array)
    v = draw(along_axis | anywhere.filter(lambda v: np.linalg.norm(v) > 0.1))
    return draw(st.sampled_from(sizes)) * v


def angles(small: float = TINY) -> st.SearchStrategy[float]:
    """Angles -pi..pi, rad, including zero, tiny and right angles and (nearly) half turns."""
    marked = [0.0, small, np.pi / 2, np.pi - small, np.pi]
    return st.sampled_from([sign * angle for angle in marked for sign in (1, -1)]) | numbers(-3, 3)


@st.composite
def directions(
    draw: st.DrawFn, small: float = TINY, opposed: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors `a` and `b`, and the unit `axis` at right angles to both.

    The angle between them is drawn from `angles`; it is never half a turn unless `opposed`.
    """
    a = draw(vectors(sizes=(1.0,)))
    a = a / np.linalg.norm(a)
    axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
    axis = axis / np.linalg.norm(axis)
    angle = draw(angles(small).filter(lambda x: opposed or abs(x) != np.pi))
    # A half turn to the last bit: the sine of the nearest float to pi is not quite zero.
    sin = 0.0 if abs(angle) == np.pi else np.sin(angle)
    b = np.cos(angle) * a + sin * np.cross(axis, a)
    return a, b, axis


@st.composite
def quaternions(draw: st.DrawFn, small: float = TINY) -> np.ndarray:
    """Unit quaternions wxyz by one of `angles` about any axis, of either sign."""
    axis, angle = draw(vectors(sizes=(1.0,))), draw(angles(small))
    axis = axis / np.linalg.norm(axis)
    q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    return draw(st.sampled_from([1.0, -1.0])) * q
