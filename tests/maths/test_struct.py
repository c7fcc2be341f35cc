"""Data that stages hand to each other: what JAX does with it, and what nobody may do."""

import dataclasses
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxik.world.skeleton import LegPose, Rig, Transform, still

PLACES = np.arange(12.0).reshape(4, 3)


def places() -> Transform:
    return Transform(jnp.asarray(PLACES), jnp.asarray(np.tile([1.0, 0, 0, 0], (4, 1))))


def test_jax_takes_it_apart_in_the_order_of_its_fields_and_puts_it_together():
    pose = LegPose(*(Transform(still().pos + i, still().rot) for i in range(4)))
    leaves, structure = jax.tree.flatten(pose)
    assert [leaf.shape for leaf in leaves] == [(3,), (4,)] * 4
    assert [float(leaf[0]) for leaf in leaves[::2]] == [0, 1, 2, 3]
    again = jax.tree.unflatten(structure, leaves)
    assert isinstance(again, LegPose) and isinstance(again.toe, Transform)
    assert eqx.tree_equal(again, pose)


def test_it_is_mapped_over_and_compiled_like_any_tree():
    turned = jax.jit(jax.vmap(lambda one: one @ one))(places())
    np.testing.assert_allclose(turned.pos, 2 * PLACES)


def test_paths_name_fields():
    paths = [
        jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(places())
    ]
    assert paths == [".pos", ".rot"]


def test_static_fields_are_structure():
    one, legs = jnp.ones(1), (((0, 1, 2, 3),), 0)
    rigs = [
        Rig(
            jnp.ones((1, 3)),
            jnp.ones((1, 4)),
            one,
            one,
            one,
            one,
            jnp.ones(1, bool),
            (name,),
            *legs,
        )
        for name in ("left", "right")
    ]
    assert len(jax.tree.leaves(rigs[0])) == 7
    assert jax.tree.structure(rigs[0]) != jax.tree.structure(rigs[1])
    assert jax.tree.map(lambda x: x + 1, rigs[1]).names == ("right",)


def test_it_stays_as_it_is():
    with pytest.raises(dataclasses.FrozenInstanceError):
        still().pos = jnp.ones(3)
    moved = dataclasses.replace(still(), pos=jnp.ones(3))
    np.testing.assert_array_equal(moved.pos, 1.0)


def test_it_is_printed_by_shapes_and_may_be_kept():
    assert "Transform(pos=f64[4,3]" in repr(places())
    assert eqx.tree_equal(pickle.loads(pickle.dumps(places())), places())
