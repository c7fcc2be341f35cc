"""A live character gives what `step` gives, one call after another."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.pipeline import character, packing
from support.clips import at, make_rig, planes, to_frames, to_rig, to_terrain, wandering

COUNT = 6
IK, RIG = jaxik.presets.record(), to_rig(make_rig())
GROUND = to_terrain(planes((0.06, 0.04, 0.1)))


def floats_as(dtype: Any, tree: Any) -> Any:
    return jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


@functools.cache
def frames() -> list[jaxik.Frame]:
    """With floats of 32 bits, while characters compute with the 64 of their rig."""
    clip = to_frames(wandering(make_rig(), np.random.default_rng(3), COUNT))
    clip = floats_as(np.float32, jax.tree.map(np.asarray, clip))
    return [at(clip, n) for n in range(COUNT)]


@functools.cache
def stepped() -> tuple[list[jaxik.State], list[jaxik.Result]]:
    """Memory before each frame and after the last, and the results."""
    states, results = [jaxik.init(IK, RIG)], []
    for frame in frames():
        state, result = jaxik.step(IK, RIG, GROUND, states[-1], floats_as(np.float64, frame))
        states.append(state)
        results.append(result)
    return states, results


def assert_same(ours, theirs) -> None:
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-12)


@pytest.mark.parametrize("start", [None, 3])
def test_a_character_moves_as_steps_do_and_keeps_their_memory(start):
    states, results = stepped()
    memory = None if start is None else states[start]
    walker = jaxik.Character(IK, RIG, GROUND, state=memory)
    for frame, expected in list(zip(frames(), results, strict=True))[start:]:
        assert_same(walker.step(frame), expected)
    assert_same(walker.state, states[-1])


def test_results_are_numpy_arrays_that_later_steps_leave_alone_and_frames_may_be_jax_arrays():
    walker = jaxik.Character(IK, RIG, GROUND)
    first = walker.step(jax.tree.map(jnp.asarray, frames()[0]))
    walker.step(frames()[3])
    assert_same(first, stepped()[1][0])
    leaves = jax.tree.leaves(first)
    assert all(isinstance(x, np.ndarray) and not x.flags.writeable for x in leaves)


def test_characters_with_other_numbers_share_a_program():
    result = jaxik.Character(IK, RIG, GROUND).step(frames()[0])
    compiled = character._step._cache_size()  # pyright: ignore[reportAttributeAccessIssue]
    steep = to_terrain(planes((0.3, 0.0, 0.0)))
    other = jaxik.Character(IK, RIG, steep).step(frames()[0])
    assert character._step._cache_size() == compiled  # pyright: ignore[reportAttributeAccessIssue]
    assert np.abs(result.pose.ankle.pos - other.pose.ankle.pos).max() > 0.01


def test_a_frame_of_another_shape_is_refused_by_name():
    walker = jaxik.Character(IK, RIG, GROUND)
    walker.step(frames()[0])
    with pytest.raises(ValueError, match=r"frame\.weight has shape \(3,\), wanted \(2,\)"):
        walker.step(dataclasses.replace(frames()[0], weight=np.ones(3)))
    assert_same(walker.step(frames()[1]), stepped()[1][1])


def test_packing_keeps_types_and_leaves_large_arrays_as_they_are():
    large = jnp.arange(packing.LARGE + 1, dtype=jnp.float32)
    tree = {
        "flag": jnp.asarray(True),
        "large": large.reshape(-1, 1),
        "number": jnp.asarray(3, jnp.uint32),
        "none": None,
        "empty": jnp.zeros((0, 3)),
        "vectors": [jnp.arange(6.0).reshape(2, 3), jnp.asarray(2.0)],
    }
    packed = packing.pack(tree)
    assert len(packed.vectors) == 4
    assert any(vector is tree["large"] for vector in packed.vectors)
    assert_same(packed.unpack(), tree)
    assert_same(jax.jit(lambda x: packing.pack(x.unpack()))(packed).unpack(), tree)
    assert packing.pack(tree).layout is packed.layout
