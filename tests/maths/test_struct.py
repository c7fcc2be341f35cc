"""Structs: how JAX flattens, maps and prints them, and that they are frozen."""

import dataclasses
import pickle
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxik.maths.struct import struct
from jaxik.world.skeleton import Transform

TRANSFORMS = Transform(jnp.zeros((4, 3)), jnp.ones((4, 4)))


@struct
class Named:
    inner: Any
    name: str = eqx.field(static=True)
    size: Any


def test_jax_flattens_a_struct_in_field_order_and_rebuilds_it():
    named = Named(TRANSFORMS, "left", jnp.ones(2))
    paths, structure = jax.tree_util.tree_flatten_with_path(named)
    leaves = {jax.tree_util.keystr(path): leaf.shape for path, leaf in paths}
    expected = {".inner.pos": (4, 3), ".inner.rot": (4, 4), ".size": (2,)}
    assert list(leaves.items()) == list(expected.items())
    rebuilt = jax.tree.unflatten(structure, jax.tree.leaves(named))
    assert isinstance(rebuilt, Named) and isinstance(rebuilt.inner, Transform)
    assert eqx.tree_equal(rebuilt, named)


def test_static_fields_belong_to_the_structure():
    left, right = (Named(jnp.ones(1), name, None) for name in ("left", "right"))
    assert len(jax.tree.leaves(left)) == 1
    assert jax.tree.structure(left) != jax.tree.structure(right)
    assert jax.jit(jax.vmap(lambda named: named))(right).name == "right"


def test_a_struct_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Transform.identity().pos = jnp.ones(3)  # pyright: ignore[reportAttributeAccessIssue]
    replaced = dataclasses.replace(Transform.identity(), pos=jnp.ones(3))
    np.testing.assert_array_equal(replaced.pos, 1.0)


def test_a_struct_prints_shapes_and_can_be_pickled():
    assert "Transform(pos=f64[4,3]" in repr(TRANSFORMS)
    assert eqx.tree_equal(pickle.loads(pickle.dumps(TRANSFORMS)), TRANSFORMS)
