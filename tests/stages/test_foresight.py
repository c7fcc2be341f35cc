"""Footholds that nothing foretells: predicted from each swing so far, and from no later frame."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.stages.probe.foresight import Swings
from reference.stages import foresight as reference
from reference.terrain import Terrain as PlainTerrain
from support.cases import QUICK, RIG
from support.clips import FLAT, assert_close, to_frames, to_ik, to_rig, to_terrain
from support.gradients import finite_jacobian
from support.strides import walk

COUNT = 120
SPRING = {
    "target.spring": True,
    "target.rise_half_life": 0.025,
    "target.fall_half_life": 0.025,
}
run = jax.jit(jaxik.run, compiler_options=QUICK)


def system(remember: bool = True, **values: float | bool) -> jaxik.FootIK:
    ik = to_ik({f"probe.{name}": value for name, value in values.items()} | SPRING, "stride")
    return parameter_tree.with_option(ik, "probe.remember_swings", remember)


PREDICTED = system(use_strides=False)


def steps(height: float = 0.2) -> PlainTerrain:
    """A floor, and another at this height from z = 0.3 on, m."""
    triangles = []
    for near, far, top in ((-3.0, 0.3, 0.0), (0.3, 3.0, height)):
        a, b, c, d = ([x, top, z] for x in (-2.0, 2.0) for z in (near, far))
        triangles += [[a, b, c], [b, d, c]]
    return PlainTerrain(reference.maths.Y, triangles=np.array(triangles))


def frames_of(speed: float = 0.9, known: bool = True) -> jaxik.Frame:
    return to_frames(walk(RIG, COUNT, start=(0.0, 0.0, -0.5), speed=speed, known=known))


def swings_of(result: jaxik.Result) -> Swings:
    assert result.trace is not None
    return result.trace.advanced.state.probe


def test_nothing_changes_on_a_flat_floor():
    frames = frames_of()
    result = run(PREDICTED, to_rig(RIG), to_terrain(FLAT), frames)
    effector = result.trace.advanced.effector
    assert_close(effector.target_ws, result.trace.sensed.ankle_ws, 1e-9)
    assert_close(effector.rot_ws, result.trace.sensed.ankle_rot_ws, 1e-9)
    assert np.abs(result.body.pos).max() < 1e-9


def test_no_later_frame_is_read():
    """Whatever follows frame 70: another walk, at another speed, with other labels."""
    seen = 70
    rig, ground = to_rig(RIG), to_terrain(steps())
    first, other = frames_of(), frames_of(speed=0.5)
    mixed = jax.tree.map(lambda a, b: jnp.concatenate([a[:seen], b[seen:]]), first, other)
    expected, got = (run(PREDICTED, rig, ground, frames) for frames in (first, mixed))
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(got), strict=True):
        np.testing.assert_array_equal(a[:seen], b[:seen])
    later = np.abs(np.asarray(expected.pose.ankle.pos - got.pose.ankle.pos))[seen:]
    assert later.max() > 0.05


def test_labelled_footholds_are_not_read():
    frames, rig, ground = frames_of(), to_rig(RIG), to_terrain(steps())
    nowhere = dataclasses.replace(
        frames.stride,
        last_ws=jnp.full_like(frames.stride.last_ws, 7.0),
        next_ws=jnp.full_like(frames.stride.next_ws, -7.0),
        fraction=jnp.full_like(frames.stride.fraction, 0.3),
    )
    expected, got = (
        run(PREDICTED, rig, ground, dataclasses.replace(frames, stride=stride)).pose.ankle.pos
        for stride in (frames.stride, nowhere)
    )
    np.testing.assert_array_equal(got, expected)


def test_footholds_that_are_known_are_as_without_memory():
    frames, rig, ground = frames_of(), to_rig(RIG), to_terrain(steps())
    without, with_memory = (run(system(on), rig, ground, frames) for on in (False, True))
    assert_close(with_memory.pose.ankle.pos, without.pose.ankle.pos, 1e-12)
    assert_close(with_memory.pose.ankle.rot, without.pose.ankle.rot, 1e-12)


def test_memory_agrees_with_the_reference():
    frames = walk(RIG, COUNT, start=(0.0, 0.0, -0.5), heading=0.3)
    values = {"probe.stance_time": 0.6, "probe.swing_time": 0.4}
    ik = system(use_strides=False, stance_time=0.6, swing_time=0.4)
    result = run(ik, to_rig(RIG), to_terrain(steps()), to_frames(frames))
    stride = sensed_strides(ik, to_frames(frames))
    swings, up = swings_of(result), reference.maths.Y
    for leg in range(2):
        before = None
        for n, frame in enumerate(frames):
            planted = bool(frame.stride.standing[leg] > 0.5)
            before, last, following = reference.follow(values, RIG, frame, leg, planted, up, before)
            assert float(swings.fraction[n, leg]) == pytest.approx(before.fraction, abs=1e-9)
            assert float(swings.time[n, leg]) == pytest.approx(before.time, abs=1e-9)
            for got, wanted in ((stride.last_ws, last), (stride.next_ws, following)):
                np.testing.assert_allclose(got[n, leg, [0, 2]], wanted[[0, 2]], atol=1e-9)


def sensed_strides(ik: jaxik.FootIK, frames: jaxik.Frame) -> jaxik.world.frame.Stride:
    """The strides by which the probe goes, in each frame."""
    return strides_on(to_terrain(steps()), ik, frames)


@functools.partial(jax.jit, compiler_options=QUICK)
def strides_on(
    ground: jaxik.world.terrain.Terrain, ik: jaxik.FootIK, frames: jaxik.Frame
) -> jaxik.world.frame.Stride:
    inputs = jaxik.stages.inputs.Inputs(to_rig(RIG), ground, frames, jaxik.HARD)
    contacts = jax.vmap(lambda frame: ik.contact.sense(inputs.at(frame)))(frames)
    state = jaxik.init(ik, to_rig(RIG))
    return jaxik.pipeline.phases.sense_first("probe", ik, state, inputs, None, {}, contacts)[1]


def test_a_swing_goes_on_and_leads_nearer_and_nearer_to_its_foothold():
    frames = frames_of()
    swings = swings_of(run(PREDICTED, to_rig(RIG), to_terrain(steps()), frames))
    stride = sensed_strides(PREDICTED, frames)
    fraction, labelled = np.asarray(swings.fraction), np.asarray(frames.stride.fraction)
    swinging = np.asarray(frames.stride.standing) < 0.5
    onward = swinging[1:] & swinging[:-1]
    assert (np.diff(fraction, axis=0)[onward] >= 0).all()
    assert np.abs(fraction - labelled)[swinging].mean() < 0.15  # feet turn otherwise than people's
    off = np.linalg.norm((stride.next_ws - frames.stride.next_ws)[..., jnp.array([0, 2])], axis=-1)
    early, late = (off[swinging & (low <= fraction) & (fraction < high)].mean()
                   for low, high in ((0.2, 0.5), (0.8, 1.0)))  # fmt: skip
    assert late < 0.5 * early and late < 0.1


def test_a_foot_that_hardly_leaves_its_foothold_keeps_it():
    """While contact flickers at the end of a stance."""
    frames = frames_of()
    standing = np.asarray(frames.stride.standing).copy()
    ends = np.flatnonzero((standing[:-1, 0] > 0.5) & (standing[1:, 0] < 0.5))
    for end in ends:
        standing[end - 3, 0] = standing[end - 1, 0] = 0.0
    flickering = dataclasses.replace(
        frames, stride=dataclasses.replace(frames.stride, standing=jnp.asarray(standing))
    )
    last, flickered = (
        np.asarray(sensed_strides(PREDICTED, x).last_ws) for x in (frames, flickering)
    )
    after = np.asarray(frames.stride.fraction)[:, 0] > 0
    np.testing.assert_allclose(flickered[after, 0], last[after, 0], atol=0.005)


def test_feet_do_not_pop_where_a_prediction_crosses_an_edge():
    frames, rig, ground = frames_of(), to_rig(RIG), to_terrain(steps())
    without = {"target.rise_half_life": 0.0, "target.fall_half_life": 0.0}
    alone = parameter_tree.replace(system(False, use_strides=False), without)
    raised = [
        np.asarray(r.trace.advanced.effector.target_ws - r.trace.sensed.ankle_ws)[..., 1]
        for r in (run(ik, rig, ground, frames) for ik in (alone, PREDICTED))
    ]
    pops = [np.abs(np.diff(height, axis=0)).max() for height in raised]
    assert pops[0] > 0.1  # m a frame, at 60 Hz
    assert pops[1] < 0.6 * pops[0]


def test_steps_in_turn_are_a_clip():
    frames, rig, ground = frames_of(), to_rig(RIG), to_terrain(steps())
    expected = run(PREDICTED, rig, ground, frames).pose.ankle.pos
    state, step = jaxik.init(PREDICTED, rig), jax.jit(jaxik.step, compiler_options=QUICK)
    for n in range(40):
        frame = jax.tree.map(lambda x, n=n: x[n], frames)
        state, result = step(PREDICTED, rig, ground, state, frame)
        np.testing.assert_allclose(result.pose.ankle.pos, expected[n], atol=1e-9)


@pytest.mark.slow
def test_a_batch_is_each_of_its_members():
    rig, ground = to_rig(RIG), to_terrain(steps())
    both = [frames_of(), frames_of(speed=0.6)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *both)
    batch = jax.jit(jaxik.lanes(lambda frames: jaxik.run(PREDICTED, rig, ground, frames)))(stacked)
    for n, frames in enumerate(both):
        alone = run(PREDICTED, rig, ground, frames)
        np.testing.assert_allclose(batch.pose.ankle.pos[n], alone.pose.ankle.pos, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_derivatives_are_finite(dtype):
    """Over a standing start, a character that stands still, and feet that hang in the air."""
    rig, ground = to_rig(RIG), to_terrain(steps())
    moving = frames_of()
    still = dataclasses.replace(
        jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), moving),
        velocity_ws=jnp.zeros_like(moving.velocity_ws),
    )
    for frames in (moving, still):
        ik, rig_, ground_, frames_ = jax.tree.map(
            lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x,
            (PREDICTED, rig, ground, frames),
        )

        @eqx.filter_grad
        def slope(ik, frames=frames_, rig=rig_, ground=ground_):
            return jnp.sum(jaxik.run(ik, rig, ground, frames).pose.ankle.pos)

        assert all(np.isfinite(x).all() for x in jax.tree.leaves(slope(ik)))


@pytest.mark.slow
def test_derivatives_agree_in_forward_and_reverse_mode():
    frames, rig, ground = frames_of(), to_rig(RIG), to_terrain(steps())

    def heights(values):
        names = ("probe.stance_time", "probe.swing_time")
        ik = parameter_tree.replace(PREDICTED, dict(zip(names, values, strict=True)))
        return jaxik.run(ik, rig, ground, frames).pose.ankle.pos[::8, :, 1].ravel()

    jacobian = finite_jacobian(heights, jnp.array([0.65, 0.45]))
    assert np.abs(jacobian[:, 1]).max() > 1e-3
