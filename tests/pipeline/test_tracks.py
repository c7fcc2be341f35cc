"""Tracks: parameters that change along a clip act as another system in each frame would."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.stages.contact import SpeedContact
from support.cases import QUICK
from support.clips import make_rig, planes, to_frames, to_rig, to_terrain, wandering

COUNT = 24
RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
SYSTEM = dataclasses.replace(
    jaxik.presets.record(), contact=SpeedContact(planted_speed=5.0, raised_speed=9.0)
)


@functools.cache
def frames() -> jaxik.Frame:
    return to_frames(wandering(make_rig(), np.random.default_rng(2), COUNT))


@functools.cache
def tracks() -> dict[str, jax.Array]:
    """A parameter of the contact, of the body and of the pose, the last for each leg."""
    time = jnp.arange(COUNT) / COUNT
    return {
        "contact.raised_height": 0.02 + 0.2 * time,
        "pelvis.limit": 0.2 * time,
        "lean.spring": time > 0.5,
        "foot.max_pitch": jnp.stack([0.5 * time, 0.4 - 0.4 * time], axis=-1),
    }


@functools.partial(jax.jit, static_argnames="block", compiler_options=QUICK)
def ankles(tracks: dict[str, jax.Array], block: int | None = None) -> jax.Array:
    return jaxik.run(SYSTEM, RIG, GROUND, frames(), block=block, tracks=tracks).pose.ankle.rot


@pytest.mark.slow
def test_a_track_is_another_system_in_each_frame():
    step = jax.jit(jaxik.step, compiler_options=QUICK)
    state, expected = jaxik.init(SYSTEM, RIG), []
    for i in range(COUNT):
        ik = parameter_tree.replace(SYSTEM, {name: x[i] for name, x in tracks().items()})
        frame = jax.tree.map(lambda x, i=i: x[i], frames())
        state, result = step(ik, RIG, GROUND, state, frame)
        expected.append(result.pose.ankle.rot)
    moved = np.asarray(ankles(tracks()))
    np.testing.assert_allclose(moved, np.stack(expected), atol=1e-9)
    constant = {name: jnp.repeat(x[:1], COUNT, axis=0) for name, x in tracks().items()}
    assert np.abs(moved - ankles(constant)).max() > 0.01
    np.testing.assert_allclose(ankles(tracks(), block=7), moved, atol=1e-9)


@pytest.mark.slow
def test_the_gradient_by_a_track_is_that_of_its_value_in_each_frame():
    def height(limits: jax.Array) -> jax.Array:
        result = jaxik.run(SYSTEM, RIG, GROUND, frames(), tracks={"pelvis.limit": limits})
        return result.body.pos[:, 1].sum()

    limits = jnp.linspace(0.01, 0.03, COUNT)
    program = jax.jit(jax.value_and_grad(height), compiler_options=QUICK)
    middle, gradient = program(limits)
    direction = jnp.cos(jnp.arange(COUNT))
    ahead = program(limits + 1e-6 * direction)[0]
    assert np.abs(gradient).max() > 0.1
    np.testing.assert_allclose((ahead - middle) / 1e-6, gradient @ direction, rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("pelvis.limits", (COUNT,), "no parameter named 'pelvis.limits'; nearest is 'pelvis.limit"),
        ("pelvis.limit", (COUNT - 1,), r"shape \(23,\), wanted \(24,\): 24 frames"),
        ("pelvis.limit", (COUNT, 2), r"shape \(24, 2\), wanted \(24,\)"),
        ("foot.max_pitch", (COUNT, 3), r"wanted \(24,\) or \(24, 2\)"),
        ("pelvis.limit", (), r"shape \(\), wanted \(24,\)"),
    ],
)
def test_a_wrong_track_is_refused_by_name(name, shape, message):
    with pytest.raises(ValueError, match=message):
        jaxik.run(SYSTEM, RIG, GROUND, frames(), tracks={name: jnp.ones(shape)})
