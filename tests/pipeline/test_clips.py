"""A clip gives what one step after another gives, whatever happens along it.

Legs and frames that cannot be used, pauses, teleports, parameters that change (tracks), and clips
that are computed in blocks.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.pipeline.tracks import Tracks
from jaxik.stages.root import GroundRoot
from support.cases import QUICK
from support.clips import (
    assert_close,
    at,
    make_rig,
    planes,
    to_frames,
    to_rig,
    to_terrain,
    wandering,
)

HALF = 12
COUNT = 2 * HALF
EXACT = 1e-9
RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
SYSTEM = parameter_tree.replace(
    dataclasses.replace(jaxik.presets.record(), root=GroundRoot()),
    {"contact.planted_speed": 5.0, "contact.raised_speed": 9.0},
)


@functools.cache
def parts() -> list[jaxik.Frame]:
    """Two clips that have nothing to do with each other."""
    seeds = (2, 5)
    return [to_frames(wandering(make_rig(), np.random.default_rng(n), HALF)) for n in seeds]


def joined(first: int, second: int, restart: bool = True) -> jaxik.Frame:
    """One of the clips after another, with a teleport between them."""
    pair = parts()[first], parts()[second]
    frames = jax.tree.map(lambda *x: jnp.concatenate(x), *pair)
    return dataclasses.replace(frames, restart=restart & (jnp.arange(COUNT) == HALF))


def eventful() -> jaxik.Frame:
    """A clip with a teleport, a frame that cannot be used, a leg likewise, and a pause."""
    frames = joined(0, 1)
    spoilt = frames.world_from_model.pos.at[5, 0].set(jnp.nan)
    world = jaxik.Transform(spoilt, frames.world_from_model.rot)
    weight = frames.weight.at[-3, 0].set(jnp.inf)
    dt = frames.dt.at[8].set(0.0)
    return dataclasses.replace(frames, world_from_model=world, weight=weight, dt=dt)


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


def constant() -> dict[str, jax.Array]:
    """The same parameters, as they are in the middle of the clip."""
    return {name: jnp.repeat(x[HALF:][:1], COUNT, axis=0) for name, x in tracks().items()}


@functools.partial(jax.jit, compiler_options=QUICK)
def resumed(frames: jaxik.Frame, tracks: Tracks) -> tuple[jaxik.State, jaxik.Result]:
    start = jaxik.init(SYSTEM, RIG)
    return jaxik.resume(SYSTEM, RIG, GROUND, start, frames, tracks=tracks)


@functools.partial(jax.jit, compiler_options=QUICK)
def stepped(frames: jaxik.Frame, tracks: Tracks) -> tuple[jaxik.State, jaxik.Result]:
    """The clip step by step, each with the system that the tracks make of ours."""

    def step(state: jaxik.State, now: tuple[jaxik.Frame, Tracks]) -> tuple[Any, jaxik.Result]:
        frame, values = now
        ik = parameter_tree.replace(SYSTEM, values)
        return jaxik.step(ik, RIG, GROUND, state, frame, trace=True)

    return jax.lax.scan(step, jaxik.init(SYSTEM, RIG), (frames, tracks))


@functools.partial(jax.jit, compiler_options=QUICK)
def slopes(ik: Any, pos: jax.Array, limits: jax.Array, weights: jax.Array) -> tuple[Any, Any]:
    """A sum over the eventful clip with a weight for each frame, and its derivatives.

    The derivatives are those by the system's numbers, by the way of the root, and by a track.
    """

    def total(floats: tuple[Any, jax.Array, jax.Array]) -> jax.Array:
        numbers, pos, limits = floats
        frames = eventful()
        moved = dataclasses.replace(frames.world_from_model, pos=pos)
        frames = dataclasses.replace(frames, world_from_model=moved)
        system = eqx.combine(numbers, ik)
        values = {"pelvis.limit": limits}
        result = jaxik.run(system, RIG, GROUND, frames, jaxik.Smooth(1.0), tracks=values)
        leaves = jax.tree.leaves(eqx.filter((result.pose, result.body), eqx.is_inexact_array))
        sums = [(weights @ leaf.reshape(COUNT, -1)).sum() for leaf in leaves]
        return jnp.sum(jnp.stack(sums))

    return jax.value_and_grad(total)((eqx.filter(ik, eqx.is_inexact_array), pos, limits))


def gradients(limits: jax.Array, weights: Any = 1.0) -> tuple[Any, Any]:
    weights = jnp.broadcast_to(jnp.asarray(weights, float), COUNT)
    return slopes(
        jaxik.presets.record(faithful=True), eventful().world_from_model.pos, limits, weights
    )


def test_steps_are_the_clip_through_faults_teleports_and_changing_parameters():
    frames = eventful()
    state, result = resumed(frames, tracks())
    assert result.faulty.sum() == 3
    after, steps = stepped(frames, tracks())
    assert_close(steps, result, EXACT)
    assert_close(after, state, EXACT)
    assert (
        np.abs(resumed(frames, constant())[1].pose.ankle.rot - result.pose.ankle.rot).max() > 0.01
    )


def test_a_step_leaves_memory_of_the_kind_it_found_so_that_the_next_needs_no_new_program():
    step = functools.partial(jaxik.step, SYSTEM, RIG, GROUND)
    before = jaxik.init(SYSTEM, RIG)
    after, _ = jax.eval_shape(step, before, at(parts()[0], 0))
    old, new = (jax.tree.leaves(state) for state in (before, after))
    kinds = [[(x.shape, x.dtype, x.weak_type) for x in leaves] for leaves in (old, new)]
    assert kinds[0] == kinds[1]


def test_after_a_restart_nothing_is_remembered():
    first, second = joined(0, 1), joined(1, 0)
    there = at(resumed(first, constant())[1], slice(HALF, None))
    begun = at(resumed(second, constant())[1], slice(HALF))
    assert_close(there, begun, EXACT)
    remembered = resumed(joined(0, 1, restart=False), constant())[1].pose.ankle.pos[HALF:]
    assert np.abs(remembered - there.pose.ankle.pos).max() > 1e-3


@pytest.mark.slow
def test_gradients_stay_finite_through_faults_and_stop_at_a_restart():
    weights = np.arange(COUNT) >= HALF
    _, (of_system, of_root, _) = gradients(jnp.asarray(np.full(COUNT, 0.3)), weights)
    numbers = [np.asarray(leaf) for leaf in jax.tree.leaves(of_system)]
    assert all(np.isfinite(leaf).all() for leaf in numbers) and any(x.any() for x in numbers)
    of_root = np.asarray(of_root)
    assert np.isfinite(of_root).all() and np.abs(of_root[HALF:]).max() > 0.01
    np.testing.assert_array_equal(of_root[:HALF], 0.0)


@pytest.mark.slow
def test_the_gradient_by_a_track_is_that_of_its_value_in_each_frame():
    limits, step = jnp.linspace(0.01, 0.03, COUNT), 1e-6
    _, (_, _, gradient) = gradients(limits)
    direction = jnp.cos(jnp.arange(COUNT))
    ahead, behind = (gradients(limits + s * step * direction)[0] for s in (1, -1))
    assert np.abs(gradient).max() > 0.1
    np.testing.assert_allclose((ahead - behind) / (2 * step), gradient @ direction, rtol=1e-4)


def test_a_clip_in_blocks_equals_the_clip_as_a_whole():
    frames, expected = eventful(), resumed(eventful(), tracks())[1]
    run = jax.jit(jaxik.run, static_argnames="block", compiler_options=QUICK)
    assert_close(run(SYSTEM, RIG, GROUND, frames, block=7, tracks=tracks()), expected, EXACT)


@pytest.mark.parametrize("block", [0, -3])
def test_a_block_without_frames_is_an_error(block):
    with pytest.raises(ValueError, match=f"at least 1 frame.*got {block}"):
        jaxik.run(SYSTEM, RIG, GROUND, parts()[0], block=block)


@pytest.mark.parametrize("call", ["step", "run"])
def test_checked_frames_give_the_same(call: str):
    ik, frames = jaxik.presets.ozz(faithful=True), parts()[0]
    run = functools.partial(jaxik.run, ik, RIG, GROUND, frames)
    if call == "step":
        run = functools.partial(jaxik.step, ik, RIG, GROUND, jaxik.init(ik, RIG), at(frames, 0))
    assert_close(run(checked=True), run(), EXACT)


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
        jaxik.run(SYSTEM, RIG, GROUND, joined(0, 1), tracks={name: jnp.ones(shape)})
