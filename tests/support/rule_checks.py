"""What must hold of every rule: it is the same in single precision, and in `lanes`."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxik


def assert_single_precision_agrees(function: Callable, *args: Any, atol: float = 2e-6) -> None:
    """Asserts that a function of 32-bit floats gives such floats, nearly those of 64 bits."""
    floats, rest = eqx.partition(jax.tree.map(jnp.asarray, args), eqx.is_inexact_array)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), floats)
    rounded, exact = (jax.tree.leaves(function(*eqx.combine(x, rest))) for x in (single, floats))
    for actual, expected in zip(rounded, exact, strict=True):
        assert actual.dtype == jnp.float32
        np.testing.assert_allclose(actual, expected, rtol=0, atol=atol)


def assert_lanes_agree(function: Callable, *args: Any) -> None:
    """Asserts that `lanes` of a function is its `vmap`."""
    in_lanes, expected = (jax.jit(f(function))(*args) for f in (jaxik.lanes, jax.vmap))
    for a, b in zip(jax.tree.leaves(in_lanes), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
