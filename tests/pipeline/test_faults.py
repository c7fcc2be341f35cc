"""Frames with numbers that are not finite, and pauses: they change neither memory nor others."""

import dataclasses
import functools

import equinox
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from support.cases import QUICK
from support.clips import make_rig, planes, to_frames, to_rig, to_terrain, wandering

PRESETS = ("record", "ozz", "unreal", "mec", "stride")
COUNT, BAD = 24, 12
RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
LEG_FIELDS = ("pose", "weight", "foot_speed", "toe_speed", "stride")


@functools.cache
def frames() -> jaxik.Frame:
    clip = to_frames(wandering(make_rig(), np.random.default_rng(3), COUNT))
    return dataclasses.replace(clip, stride_scale=jnp.ones_like(clip.dt))


@functools.cache
def step(preset: str):
    ik = getattr(jaxik.presets, preset)()

    @functools.partial(jax.jit, compiler_options=QUICK)
    def call(state, frame):
        return jaxik.step(ik, RIG, GROUND, state, frame)

    return jaxik.init(ik, RIG), call


def at(index: int) -> jaxik.Frame:
    return jax.tree.map(lambda x: x[index], frames())


def played(preset: str, sequence: list[jaxik.Frame]) -> list[tuple]:
    state, call = step(preset)
    steps = []
    for frame in sequence:
        state, result = call(state, frame)
        steps.append((state, result))
    return steps


def damages(frame: jaxik.Frame):
    """Names of a frame's arrays, and the frame with a number replaced in each."""
    leaves, structure = jax.tree.flatten(frame)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(frame)]
    for i, (name, leaf) in enumerate(zip(names, leaves, strict=True)):
        if leaf.size:
            for value in (np.nan, np.inf, -np.inf, 1e30):
                damaged = leaf.at[(0,) * leaf.ndim].set(value)
                parts = [*leaves[:i], damaged, *leaves[i + 1 :]]
                yield name, jax.tree.unflatten(structure, parts)


def assert_same(tree, expected, atol: float = 0.0):
    for got, wanted in zip(jax.tree.leaves(tree), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=atol)


def finite(tree) -> bool:
    return all(np.isfinite(x).all() for x in jax.tree.leaves(tree))


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_one_bad_number_leaves_memory_as_it_was(preset: str):
    """Whatever array has it, the frame or the leg is flagged and passed through."""
    before = played(preset, [at(i) for i in range(BAD)])[-1][0]
    _, call = step(preset)
    animated = at(BAD)
    for name, frame in damages(animated):
        after, result = call(before, frame)
        of_leg = name.split(".")[1] in LEG_FIELDS
        np.testing.assert_array_equal(result.faulty, [True, not of_leg], err_msg=name)
        assert finite((after, result)), name
        if not of_leg:
            assert_same(after, before)
            assert_same(result.pose, animated.pose, 1e-6)
            assert_same(result.body.pos, jnp.zeros(3))
            assert not result.reached.any() and not result.aimed.any()
        identity = np.array([1.0, 0.0, 0.0, 0.0])
        for correction in (result.corrections.hip, result.corrections.knee):
            np.testing.assert_allclose(correction[0], identity, atol=1e-6)


def spoilt(*names: str) -> jaxik.Frame:
    """The clip, with numbers of one frame that are not finite; of legs, only the first leg's."""

    def spoil(path, leaf):
        name = path[0].name
        place = (BAD, 0) if name in LEG_FIELDS else BAD
        return leaf.at[place].set(np.nan) if name in names else leaf

    return jax.tree_util.tree_map_with_path(spoil, frames())


def twice_spoilt() -> jaxik.Frame:
    """The clip, where a whole frame cannot be used, and a leg of another one."""
    clip, last = spoilt("world_from_model"), frames().weight.at[-3, 0].set(jnp.inf)
    return dataclasses.replace(clip, weight=last)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["record", "mec"])
def test_a_clip_goes_on_as_steps_do(preset: str):
    clip = twice_spoilt()
    steps = played(preset, [jax.tree.map(lambda x, i=i: x[i], clip) for i in range(COUNT)])
    ik = getattr(jaxik.presets, preset)()
    resume = jax.jit(jaxik.resume, compiler_options=QUICK)
    state, result = resume(ik, RIG, GROUND, jaxik.init(ik, RIG), clip)
    assert finite(state) and result.faulty.sum() == 3
    expected = jax.tree.map(lambda *x: jnp.stack(x), *[result for _, result in steps])
    assert_same(dataclasses.replace(result, trace=None), expected, 1e-9)
    assert_same(state, steps[-1][0], 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_the_next_frame_goes_on_as_if_the_bad_one_had_not_been(preset: str):
    bad = jax.tree.map(lambda x: x[BAD], spoilt("world_from_model"))
    sequence = [at(i) for i in range(COUNT)]
    with_bad = played(preset, [*sequence[:BAD], bad, *sequence[BAD:]])
    assert_same(with_bad[-1], played(preset, sequence)[-1])


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0, -1.0])
@pytest.mark.parametrize("preset", PRESETS)
def test_nothing_moves_in_a_pause(preset: str, dt: float):
    paused = dataclasses.replace(at(BAD), dt=jnp.asarray(dt, frames().dt.dtype))
    sequence = [*(at(i) for i in range(BAD + 1)), paused, paused]
    *_, (before, moving), (first, still), (second, again) = played(preset, sequence)
    assert_same(first, before)
    assert_same(second, before)
    assert_same(again, still)
    assert not still.faulty.any()
    assert_same(still.pose.hip.pos, moving.pose.hip.pos, 1e-6)


@pytest.mark.parametrize("dt", [0.0, 1.0, 1e4])
def test_a_first_frame_of_any_length_is_settled(dt: float):
    expected = played("record", [at(0)])[0]
    frame = dataclasses.replace(at(0), dt=jnp.asarray(dt, frames().dt.dtype))
    assert_same(played("record", [frame])[0][1].pose, expected[1].pose, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_after_a_long_frame_everything_is_where_it_is_going(preset: str):
    state, result = played(preset, [at(0), dataclasses.replace(at(BAD), dt=jnp.asarray(1e4))])[1]
    assert finite((state, result)) and not result.faulty.any()


@pytest.mark.slow
@pytest.mark.parametrize("batched", [jax.vmap, jaxik.lanes])
def test_a_bad_member_does_not_touch_its_neighbours(batched):
    ik = jaxik.presets.record()
    clips = jax.tree.map(lambda *x: jnp.stack(x), frames(), spoilt("pose"), frames())
    run = jax.jit(
        batched(lambda clip: jaxik.run(ik, RIG, GROUND, clip).pose), compiler_options=QUICK
    )
    poses = run(clips)
    alone = run(jax.tree.map(lambda x: jnp.stack([x] * 3), frames()))
    for got, wanted in zip(jax.tree.leaves(poses), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(got[0], wanted[0])
        np.testing.assert_array_equal(got[2], wanted[2])


@pytest.mark.slow
def test_gradients_stay_finite():
    clip = twice_spoilt()

    def size(ik):
        result = jaxik.run(ik, RIG, GROUND, clip, jaxik.Smooth(1.0))
        return jnp.sum(result.pose.ankle.pos**2) + jnp.sum(result.body.pos**2)

    slopes = jax.jit(lambda ik: equinox.filter_grad(size)(ik), compiler_options=QUICK)
    gradient = slopes(jaxik.presets.record())
    assert finite(gradient)
    assert any(np.any(x != 0) for x in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_checked_frames_give_the_same():
    ik = jaxik.presets.record()
    run = jax.jit(jaxik.run, static_argnames="checked", compiler_options=QUICK)
    expected = run(ik, RIG, GROUND, frames())
    assert_same(run(ik, RIG, GROUND, frames(), checked=True), expected, 1e-9)


def test_legs_that_are_not_there_may_hold_anything():
    rig = dataclasses.replace(RIG, present=jnp.array([False, True]))
    run = jax.jit(jaxik.run, compiler_options=QUICK)
    ik = jaxik.presets.record()
    result = run(ik, rig, GROUND, spoilt("pose"))
    assert not result.faulty.any() and finite(result.pose)
    expected = run(ik, rig, GROUND, frames()).pose.ankle.pos[:, 1]
    np.testing.assert_allclose(result.pose.ankle.pos[:, 1], expected, atol=1e-9)


@pytest.mark.parametrize("others", [True, False])
def test_legs_that_are_not_there_spoil_no_memory(others: bool):
    """Sums over legs take in what has the weight 0, which makes NaN of what is infinite."""
    rig = dataclasses.replace(RIG, present=jnp.array([False, others]))
    call = jax.jit(functools.partial(jaxik.step, jaxik.presets.stride()), compiler_options=QUICK)
    state, _ = call(rig, GROUND, jaxik.init(jaxik.presets.stride(), rig), at(BAD - 1))
    expected = call(rig, GROUND, state, at(BAD))[1]
    for name, frame in damages(at(BAD)):
        if name.split(".")[1] in LEG_FIELDS:
            after, result = call(rig, GROUND, state, frame)
            assert finite((after, result)), name
            assert not result.faulty.any()
            assert_same(result.pose.ankle.pos[1], expected.pose.ankle.pos[1], 1e-9)
