"""64-bit floats where a fit needs them, whatever JAX is set to for everybody else.

JAX has 32-bit floats unless its 64-bit types are enabled, for a whole process or in a context. What
belongs to a fit enables them for its own calls only; arrays that come out stay at 64 bits.
"""

import functools
from collections.abc import Callable
from contextvars import copy_context
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

Inputs = ParamSpec("Inputs")
Output = TypeVar("Output")
Tree = TypeVar("Tree")


def in_float64(function: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """The function with JAX's 64-bit types enabled while it runs, and as they were afterwards.

    Arrays that go in keep their types: a problem of 32-bit floats is computed with these.
    """
    return _with_x64(function, enabled=True)


def for_other_thread(function: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """The function with the caller's context and types, neither of which a thread inherits."""
    enabled = jax.dtypes.canonicalize_dtype(np.float64) == np.float64
    return functools.partial(copy_context().run, _with_x64(function, enabled=enabled))


def _with_x64(function: Callable[Inputs, Output], *, enabled: bool) -> Callable[Inputs, Output]:
    @functools.wraps(function)
    def call(*args: Inputs.args, **named: Inputs.kwargs) -> Output:
        with jax.enable_x64(enabled):
            return function(*args, **named)

    return call


def with_floats(tree: Tree, dtype: DTypeLike) -> Tree:
    """The tree with all floats in its arrays of this type; for 64 bits, these must be enabled."""

    def convert(leaf: object) -> object:
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf.astype(dtype)
        return leaf

    return jax.tree.map(convert, tree)
