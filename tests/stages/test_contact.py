"""Contact by speed and height: hysteresis, smoothing and memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from support.cases import QUICK, RIG
from support.clips import (
    FLAT,
    FRAMES,
    animate,
    assert_close,
    at,
    to_frames,
    to_ik,
    to_rig,
    to_terrain,
)

HALF = FRAMES // 2
SPEEDS = (1.0, 0.4, 0.2, 0.4, 0.6, 0.4)  # m/s, of the toes, one after the other
HEIGHTS = (0.12, 0.09, 0.07, 0.09, 0.11, 0.09)  # m, likewise
STANDS = (0, 0, 1, 1, 0, 0)  # between 0.25 and 0.5 m/s, 0.075 and 0.1 m: as before
EACH = FRAMES // len(SPEEDS)  # frames
resume = jax.jit(jaxik.resume, compiler_options=QUICK)


def clip(speed: np.ndarray, height: np.ndarray) -> jaxik.Frame:
    """Standing legs whose toes have these speeds, m/s, and heights, m (frames)."""
    frames = to_frames(animate(RIG))
    toe = frames.pose.toe.pos.at[..., 1].set(jnp.asarray(height)[:, None])
    pose = dataclasses.replace(frames.pose, toe=jaxik.Transform(toe, frames.pose.toe.rot))
    toe_speed = jnp.asarray(np.stack([speed, speed], axis=-1))
    return dataclasses.replace(frames, pose=pose, toe_speed=toe_speed)


def result_of(frames: jaxik.Frame, **values: float) -> jaxik.Result:
    ik = to_ik({f"contact.{name}": value for name, value in values.items()}, "by speed")
    return resume(ik, to_rig(RIG), to_terrain(FLAT), jaxik.init(ik, to_rig(RIG)), frames)[1]


@pytest.mark.slow
@pytest.mark.parametrize("by", ["speed", "height"])
def test_a_foot_between_the_thresholds_stays_as_it_was(by: str):
    still, low = np.zeros(FRAMES), np.full(FRAMES, 0.02)
    speed = np.repeat(SPEEDS, EACH) if by == "speed" else still
    height = np.repeat(HEIGHTS, EACH) if by == "height" else low
    contact = result_of(clip(speed, height)).trace.sensed.contact
    expected = np.repeat(STANDS, EACH)[:, None].repeat(2, axis=-1)
    np.testing.assert_array_equal(contact.planted, expected)
    np.testing.assert_array_equal(contact.lifted, 1 - expected)
    np.testing.assert_array_equal(contact.weight, expected)


def test_a_foot_between_the_thresholds_in_the_first_frame_swings():
    between = clip(np.full(FRAMES, 0.4), np.full(FRAMES, 0.02))
    assert not np.asarray(result_of(between).trace.sensed.contact.planted).any()


def test_weight_goes_half_the_way_in_a_half_life_and_starts_settled():
    """A tenth of a second is six frames."""
    speed = np.repeat([0.0, 1.0, 0.0], FRAMES // 3)
    weight = result_of(clip(speed, np.full(FRAMES, 0.02)), half_life=0.1).trace.sensed.contact
    weight = np.asarray(weight.weight)[:, 0]
    assert weight[0] == 1.0
    falls, rises = FRAMES // 3 - 1, 2 * (FRAMES // 3) - 1
    np.testing.assert_allclose(weight[[falls + 6, falls + 12]], [0.5, 0.25], rtol=1e-12)
    np.testing.assert_allclose(weight[rises + 6], 0.5, rtol=0, atol=1e-3)


def test_a_clip_cut_in_two_and_resumed_equals_the_whole():
    values = {"contact.half_life": 0.1, "target.rise_half_life": 0.1, "target.spring": True}
    ik = to_ik(values, "by speed")
    rng = np.random.default_rng(0)
    frames = clip(rng.choice(SPEEDS, FRAMES), np.full(FRAMES, 0.02))
    rig, ground = to_rig(RIG), to_terrain(FLAT)
    whole = resume(ik, rig, ground, jaxik.init(ik, rig), frames)
    memory, first = resume(ik, rig, ground, jaxik.init(ik, rig), at(frames, slice(HALF)))
    memory, second = resume(ik, rig, ground, memory, at(frames, slice(HALF, None)))
    assert 0.1 < np.asarray(whole[1].trace.sensed.contact.planted).mean() < 0.9
    assert_close(memory, whole[0], 1e-12)
    halves = jax.tree.map(lambda *parts: jnp.concatenate(parts), first, second)
    assert_close(halves, whole[1], 1e-12)


def test_the_trace_holds_the_memory_after_each_frame():
    """So a clip can be resumed from the trace at any frame."""
    speed = np.repeat(SPEEDS, EACH)
    result = result_of(clip(speed, np.full(FRAMES, 0.02)))
    standing = result.trace.advanced.state.contact.standing
    np.testing.assert_array_equal(standing[:, 0], np.repeat(STANDS, EACH))
