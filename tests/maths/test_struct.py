"""Structs: how JAX flattens, maps and prints them, and that they are frozen."""

import dataclasses
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxik.maths import quat
from jaxik.world.skeleton import LegPose, Rig, Transform

POSITIONS = np.arange(12.0).reshape(4, 3)


def transforms() -> Transform:
    return Transform(jnp.asarray(POSITIONS), jnp.asarray(np.tile([1.0, 0, 0, 0], (4, 1))))


def test_jax_flattens_a_struct_in_field_order_and_rebuilds_it():
    pose = LegPose(*(Transform(jnp.full(3, float(i)), quat.identity()) for i in range(4)))
    leaves, structure = jax.tree.flatten(pose)
    assert [leaf.shape for leaf in leaves] == [(3,), (4,)] * 4
    assert [float(leaf[0]) for leaf in leaves[::2]] == [0, 1, 2, 3]
    rebuilt = jax.tree.unflatten(structure, leaves)
    assert isinstance(rebuilt, LegPose) and isinstance(rebuilt.toe, Transform)
    assert eqx.tree_equal(rebuilt, pose)


def test_a_struct_is_mapped_over_and_compiled_like_any_pytree():
    squared = jax.jit(jax.vmap(lambda transform: transform @ transform))(transforms())
    np.testing.assert_allclose(squared.pos, 2 * POSITIONS)


def test_tree_paths_name_the_fields():
    paths = [
        jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(transforms())
    ]
    assert paths == [".pos", ".rot"]


def test_static_fields_belong_to_the_structure():
    one = jnp.ones(1)
    rigs = [
        Rig(
            knee_axis_ls=jnp.ones((1, 3)),
            ankle_from_foot=jnp.ones((1, 4)),
            thigh=one,
            shin=one,
            foot=one,
            ankle_height=one,
            ball_height=one,
            side=one,
            present=jnp.ones(1, bool),
            names=(name,),
            joints=((0, 1, 2, 3),),
            pelvis=0,
        )
        for name in ("left", "right")
    ]
    assert len(jax.tree.leaves(rigs[0])) == 9
    assert jax.tree.structure(rigs[0]) != jax.tree.structure(rigs[1])
    assert jax.tree.map(lambda x: x + 1, rigs[1]).names == ("right",)


def test_a_struct_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Transform.identity().pos = jnp.ones(3)  # pyright: ignore[reportAttributeAccessIssue]
    replaced = dataclasses.replace(Transform.identity(), pos=jnp.ones(3))
    np.testing.assert_array_equal(replaced.pos, 1.0)


def test_a_struct_prints_shapes_and_can_be_pickled():
    assert "Transform(pos=f64[4,3]" in repr(transforms())
    assert eqx.tree_equal(pickle.loads(pickle.dumps(transforms())), transforms())
