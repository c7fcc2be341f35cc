"""Restarts: from a teleport on, a clip is what it would be if it began there."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from support.cases import QUICK
from support.clips import make_rig, planes, to_frames, to_rig, to_terrain, wandering

pytestmark = pytest.mark.slow

COUNT = 20
RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
run = jax.jit(jaxik.run, compiler_options=QUICK)


@functools.cache
def parts() -> tuple[jaxik.Frame, jaxik.Frame]:
    """A clip, and another that has nothing to do with it."""
    first, second = (
        to_frames(wandering(make_rig(), np.random.default_rng(seed), COUNT)) for seed in (2, 5)
    )
    return first, second


def joined(restart: bool = True) -> jaxik.Frame:
    """One after the other."""
    frames = jax.tree.map(lambda *x: jnp.concatenate(x), *parts())
    at = jnp.arange(2 * COUNT) == COUNT
    return dataclasses.replace(frames, restart=at if restart else None)


@pytest.mark.parametrize("preset", ["record", "mec"])
def test_after_a_restart_nothing_is_remembered(preset: str):
    ik = getattr(jaxik.presets, preset)()
    expected = [run(ik, RIG, GROUND, part) for part in parts()]
    expected = jax.tree.map(lambda *x: jnp.concatenate(x), *expected)
    for got, wanted in zip(
        jax.tree.leaves(run(ik, RIG, GROUND, joined())), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(got, wanted, atol=1e-9)
    remembered = run(ik, RIG, GROUND, joined(restart=False)).pose.ankle.pos
    assert np.abs(remembered - expected.pose.ankle.pos).max() > 1e-3


def test_a_step_restarts_as_a_clip_does():
    ik, step = jaxik.presets.record(), jax.jit(jaxik.step, compiler_options=QUICK)
    frames = joined()
    expected = run(ik, RIG, GROUND, frames).pose.ankle.pos[COUNT]
    state = jaxik.init(ik, RIG)
    for i in range(COUNT + 1):
        state, result = step(ik, RIG, GROUND, state, jax.tree.map(lambda x, i=i: x[i], frames))
    np.testing.assert_allclose(result.pose.ankle.pos, expected, atol=1e-9)


def test_gradients_through_a_restart_are_finite_and_stop_there():
    ik = jaxik.presets.record(faithful=True)

    @functools.partial(jax.jit, compiler_options=QUICK)
    @jax.grad
    def slopes(pos: jax.Array) -> jax.Array:
        frames = joined()
        moved = dataclasses.replace(frames.world_from_model, pos=pos)
        frames = dataclasses.replace(frames, world_from_model=moved)
        result = jaxik.run(ik, RIG, GROUND, frames, jaxik.Smooth(1.0))
        leaves = jax.tree.leaves(eqx.filter((result.pose, result.body), eqx.is_inexact_array))
        return jnp.sum(jnp.stack([jnp.sum(leaf[COUNT:]) for leaf in leaves]))

    gradient = np.asarray(slopes(joined().world_from_model.pos))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient[COUNT:]).max() > 0.01
    np.testing.assert_array_equal(gradient[:COUNT], 0.0)
