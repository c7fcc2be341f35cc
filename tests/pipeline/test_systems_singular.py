"""Reverse mode where formulas are singular: gradients are finite, and those of forward mode."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from support import cases, singular
from support.cases import QUICK, RIG, Either
from support.clips import at, to_rig

COUNT = 8  # frames
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("record", "ozz", "mec", "stride")]


@functools.partial(jax.jit, compiler_options=QUICK)
@jax.vmap
def both_modes(inputs: Any, tangents: Any, present: jax.Array, blurred: jax.Array) -> Any:
    """The derivative of a sum of all outputs along a way, and its gradient, rig included."""
    rig = dataclasses.replace(to_rig(RIG), present=present)
    floats, rest = eqx.partition((*inputs, rig), eqx.is_inexact_array)

    def everything(floats: Any) -> jax.Array:
        ik, ground, frames, rig = eqx.combine(floats, rest)
        start = jaxik.init(ik, rig)
        result = jaxik.resume(ik, rig, ground, start, frames, Either(blurred))[1]
        return cases.measures(result, frames)["everything"]

    along = jax.linearize(everything, floats)[1]
    still = jax.tree.map(jnp.zeros_like, floats[-1])
    gradient = jax.linear_transpose(along, floats)(jnp.ones(()))[0]
    return along((*tangents, still)), gradient


@pytest.mark.parametrize("system", ["unreal", *SLOW])
def test_gradients_are_finite_and_equal_in_forward_and_reverse_mode(system: str):
    rows = [row for row in singular.singular_rows(system)]
    tangents = cases.stacked([row.tangents for row in rows])
    inputs = cases.stacked([row.inputs for row in rows])
    frames = lambda tree: (*tree[:2], at(tree[2], (slice(None), slice(COUNT))))  # noqa: E731
    modes = [np.array([getattr(row, name) for row in rows]) for name in ("present", "blurred")]
    slopes, gradients = jax.device_get(both_modes(frames(inputs), frames(tangents), *modes))
    for index, row in enumerate(rows):
        gradient, way = at(gradients, index), at(frames(tangents), index)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
            assert np.isfinite(leaf).all(), (str(row), jax.tree_util.keystr(path))
        pairs = zip(jax.tree.leaves(gradient[:-1]), jax.tree.leaves(way), strict=True)
        parts = [np.sum(leaf * tangent) for leaf, tangent in pairs]
        exact = {"rtol": 1e-9, "atol": 1e-9 * np.abs(parts).max()}
        np.testing.assert_allclose(sum(parts), slopes[index], err_msg=str(row), **exact)
