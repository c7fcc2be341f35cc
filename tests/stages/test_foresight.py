"""Footholds that nothing foretells: predicted from each swing so far, and from no later frame."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.runtime.precision import with_floats
from jaxik.maths import parameter_tree
from jaxik.pipeline.phases import sense_first
from jaxik.stages.inputs import Inputs
from jaxik.stages.probe.foresight import Swings
from jaxik.world.frame import Stride
from jaxik.world.terrain import Terrain
from reference import characters
from reference.stages import foresight as reference
from support.cases import QUICK, RIG
from support.clips import assert_close, to_frames, to_ik, to_rig, to_terrain
from support.gradients import finite_jacobian
from support.probing import level_blocks
from support.strides import walk

COUNT = 120
SPRING = {
    "target.spring": True,
    "target.rise_half_life": 0.025,
    "target.fall_half_life": 0.025,
}


def system(remember: bool = True, **values: float | bool) -> jaxik.FootIK:
    ik = to_ik({f"probe.{name}": value for name, value in values.items()} | SPRING, "stride")
    return parameter_tree.with_option(ik, "probe.remember_swings", remember)


PREDICTED = system(use_strides=False)


def frames_of(speed: float = 0.9, known: bool = True) -> jaxik.Frame:
    return to_frames(walk(RIG, COUNT, start=(0.0, 0.0, -0.5), speed=speed, known=known))


@functools.cache
def step_of(height: float) -> Terrain:
    """A step up at z = 0.3, m."""
    return to_terrain(level_blocks((-3.0, 0.3, 0.0), (0.3, 3.0, height)))


def run(ik: jaxik.FootIK, frames: jaxik.Frame, height: float = 0.2) -> jaxik.Result:
    """The clip on a step of this height, m."""
    return jaxik.run(ik, to_rig(RIG), step_of(height), frames)


@jax.jit
def foreseen(ik: jaxik.FootIK, frames: jaxik.Frame) -> tuple[Swings, Stride]:
    """What the probe remembers, and the strides by which it goes, in each frame."""
    inputs = Inputs(to_rig(RIG), step_of(0.2), frames, jaxik.HARD)
    contacts = jax.vmap(lambda frame: ik.contact.sense(inputs.at(frame)))(frames)
    state = jaxik.init(ik, to_rig(RIG))
    return sense_first("probe", ik, state, inputs, None, {}, contacts)


def test_nothing_changes_on_a_flat_floor():
    result = run(PREDICTED, frames_of(), height=0.0)
    effector = result.trace.advanced.effector
    assert_close(effector.target_ws, result.trace.sensed.ankle_ws, 1e-9)
    assert_close(effector.rot_ws, result.trace.sensed.ankle_rot_ws, 1e-9)
    assert np.abs(result.body.pos).max() < 1e-9


def test_no_later_frame_is_read():
    """Whatever follows frame 70: another walk, at another speed, with other labels."""
    seen = 70
    first, other = frames_of(), frames_of(speed=0.5)
    mixed = jax.tree.map(lambda a, b: jnp.concatenate([a[:seen], b[seen:]]), first, other)
    expected, got = (run(PREDICTED, frames) for frames in (first, mixed))
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(got), strict=True):
        np.testing.assert_array_equal(a[:seen], b[:seen])
    later = np.abs(np.asarray(expected.pose.ankle.pos - got.pose.ankle.pos))[seen:]
    assert later.max() > 0.05


def test_labelled_footholds_are_not_read():
    frames = frames_of()
    nowhere = dataclasses.replace(
        frames.stride,
        last_ws=jnp.full_like(frames.stride.last_ws, 7.0),
        next_ws=jnp.full_like(frames.stride.next_ws, -7.0),
        fraction=jnp.full_like(frames.stride.fraction, 0.3),
    )
    expected, got = (
        run(PREDICTED, dataclasses.replace(frames, stride=stride)).pose.ankle.pos
        for stride in (frames.stride, nowhere)
    )
    np.testing.assert_array_equal(got, expected)


def test_footholds_that_are_known_are_as_without_memory():
    frames = frames_of()
    strides = foreseen(system(), frames)[1]
    assert_close(strides, frames.stride, 1e-12)


def flickering(frame: characters.Frame, n: int) -> characters.Frame:
    """The frame with a contact that flickers at the end of each stance."""
    assert frame.stride is not None
    lifted = (n % 60 in (32, 34), n % 60 in (2, 4))  # stances last from 0 to 35 and from 30 to 65
    standing = np.where(lifted, 0.0, frame.stride.standing)
    return dataclasses.replace(frame, stride=dataclasses.replace(frame.stride, standing=standing))


def test_memory_agrees_with_the_reference():
    """Also where a foot hardly leaves its foothold, while contact flickers."""
    frames = walk(RIG, COUNT, start=(0.0, 0.0, -0.5), heading=0.3)
    frames = [flickering(frame, n) for n, frame in enumerate(frames)]
    values = {"probe.stance_time": 0.6, "probe.swing_time": 0.4}
    ik = system(use_strides=False, stance_time=0.6, swing_time=0.4)
    swings, stride = jax.tree.map(np.asarray, foreseen(ik, to_frames(frames)))
    up = reference.maths.Y
    for leg in range(2):
        before = None
        for n, frame in enumerate(frames):
            planted = bool(frame.stride.standing[leg] > 0.5)
            before, last, following = reference.follow(values, RIG, frame, leg, planted, up, before)
            assert float(swings.fraction[n, leg]) == pytest.approx(before.fraction, abs=1e-9)
            assert float(swings.time[n, leg]) == pytest.approx(before.time, abs=1e-9)
            for got, wanted in ((stride.last_ws, last), (stride.next_ws, following)):
                np.testing.assert_allclose(got[n, leg, [0, 2]], wanted[[0, 2]], atol=1e-9)


def test_a_swing_goes_on_and_leads_nearer_and_nearer_to_its_foothold():
    frames = frames_of()
    swings, stride = jax.tree.map(np.asarray, foreseen(PREDICTED, frames))
    fraction, swinging = swings.fraction, np.asarray(frames.stride.standing) < 0.5
    assert (np.diff(fraction, axis=0)[swinging[1:] & swinging[:-1]] >= 0).all()
    # Feet turn otherwise than people's.
    assert np.abs(fraction - np.asarray(frames.stride.fraction))[swinging].mean() < 0.15
    off = np.linalg.norm((stride.next_ws - frames.stride.next_ws)[..., [0, 2]], axis=-1)
    early, late = (off[swinging & (low <= fraction) & (fraction < high)].mean()
                   for low, high in ((0.2, 0.5), (0.8, 1.0)))  # fmt: skip
    assert late < 0.5 * early and late < 0.1


@pytest.mark.slow
def test_feet_do_not_pop_where_a_prediction_crosses_an_edge():
    without = {"target.rise_half_life": 0.0, "target.fall_half_life": 0.0}
    alone = parameter_tree.replace(system(False, use_strides=False), without)
    raised = [
        np.asarray(r.trace.advanced.effector.target_ws - r.trace.sensed.ankle_ws)[..., 1]
        for r in (run(ik, frames_of()) for ik in (alone, PREDICTED))
    ]
    pops = [np.abs(np.diff(height, axis=0)).max() for height in raised]
    assert pops[0] > 0.1  # m a frame, at 60 Hz
    assert pops[1] < 0.6 * pops[0]


@pytest.mark.slow
def test_steps_in_turn_are_a_clip():
    """From the memory of one of its frames on."""
    first, frames = 20, frames_of()
    result = run(PREDICTED, frames)
    state = jax.tree.map(lambda x: x[first - 1], result.trace.advanced.state)
    step = jax.jit(jaxik.step, compiler_options=QUICK)
    for n in range(first, first + 40):
        frame = jax.tree.map(lambda x, n=n: x[n], frames)
        state, stepped = step(PREDICTED, to_rig(RIG), step_of(0.2), state, frame)
        np.testing.assert_allclose(stepped.pose.ankle.pos, result.pose.ankle.pos[n], atol=1e-9)


def standing_still(frames: jaxik.Frame) -> jaxik.Frame:
    """A character that stands still, with its feet as in the first frame."""
    first = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), frames)
    return dataclasses.replace(first, velocity_ws=jnp.zeros_like(frames.velocity_ws))


@pytest.mark.parametrize("moves", [True, False])
def test_strides_have_equal_and_finite_derivatives_in_forward_and_reverse_mode(moves):
    frames = frames_of() if moves else standing_still(frames_of())
    few = jax.tree.map(lambda x: x[20:60:2], frames)

    def strides(values, velocity_ws):
        names = ("probe.stance_time", "probe.swing_time")
        ik = parameter_tree.replace(PREDICTED, dict(zip(names, values, strict=True)))
        moving = dataclasses.replace(few, velocity_ws=velocity_ws)
        return foreseen(ik, moving)[1].next_ws[::4]

    jacobian = finite_jacobian(strides, jnp.array([0.65, 0.45]), few.velocity_ws)
    assert (np.abs(jacobian[:, 1]).max() > 1e-3) == moves


@pytest.mark.slow
def test_a_batch_is_each_of_its_members():
    both = [frames_of(), frames_of(speed=0.6)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *both)
    batch = jax.jit(jaxik.lanes(lambda frames: run(PREDICTED, frames)))(stacked)
    for n, frames in enumerate(both):
        alone = run(PREDICTED, frames)
        np.testing.assert_allclose(batch.pose.ankle.pos[n], alone.pose.ankle.pos, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_derivatives_are_finite(dtype):
    """Over a standing start, a character that stands still, and feet that hang in the air."""

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(ik, rig, ground, frames):
        return jnp.sum(jaxik.run(ik, rig, ground, frames).pose.ankle.pos)

    for frames in (frames_of(), standing_still(frames_of())):
        inputs = with_floats((PREDICTED, to_rig(RIG), step_of(0.2), frames), dtype)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(slope(*inputs)))
