"""Contact by speed and height: hysteresis, smoothing and memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.pipeline.phases import sense_first
from jaxik.stages.contact import SpeedState
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import Contact
from support.cases import RIG
from support.clips import FLAT, animate, assert_close, at, to_frames, to_ik, to_rig, to_terrain

FRAMES, HALF = 240, 120
SPEEDS = (1.0, 0.4, 0.2, 0.4, 0.6, 0.4)  # m/s, of the toes, one after the other
HEIGHTS = (0.12, 0.09, 0.07, 0.09, 0.11, 0.09)  # m, likewise
STANDS = (0, 0, 1, 1, 0, 0)  # between 0.25 and 0.5 m/s, 0.075 and 0.1 m: as before
EACH = FRAMES // len(SPEEDS)  # frames
STILL, LOW = np.zeros(FRAMES), np.full(FRAMES, 0.02)


def clip(speed: np.ndarray, height: np.ndarray = LOW) -> jaxik.Frame:
    """Standing legs whose toes have these speeds, m/s, and heights, m (frames)."""
    frames = to_frames(animate(RIG, count=FRAMES))
    toe = frames.pose.toe.pos.at[..., 1].set(jnp.asarray(height)[:, None])
    pose = dataclasses.replace(frames.pose, toe=jaxik.Transform(toe, frames.pose.toe.rot))
    toe_speed = jnp.asarray(np.stack([speed, speed], axis=-1))
    return dataclasses.replace(frames, pose=pose, toe_speed=toe_speed)


@jax.jit
def sense(
    frames: jaxik.Frame, half_life: float = 0.0, memory: SpeedState | None = None
) -> tuple[SpeedState, Contact]:
    """Memory and contact in each frame, from a memory or from a fresh start."""
    ik, rig = to_ik({}, "by speed"), to_rig(RIG)
    contact = dataclasses.replace(ik.contact, half_life=jnp.asarray(half_life))
    ik, state = dataclasses.replace(ik, contact=contact), jaxik.init(ik, rig)
    if memory is not None:
        state = dataclasses.replace(state, started=jnp.ones((), bool), contact=memory)
    inputs = Inputs(rig, to_terrain(FLAT), frames, jaxik.HARD)
    return sense_first("contact", ik, state, inputs, None, {})


@pytest.mark.parametrize("by", ["speed", "height"])
def test_a_foot_between_the_thresholds_stays_as_it_was(by: str):
    speed = np.repeat(SPEEDS, EACH) if by == "speed" else STILL
    height = np.repeat(HEIGHTS, EACH) if by == "height" else LOW
    contact = sense(clip(speed, height))[1]
    expected = np.repeat(STANDS, EACH)[:, None].repeat(2, axis=-1)
    np.testing.assert_array_equal(contact.planted, expected)
    np.testing.assert_array_equal(contact.lifted, 1 - expected)
    np.testing.assert_array_equal(contact.weight, expected)


def test_a_foot_between_the_thresholds_in_the_first_frame_swings():
    contact = sense(clip(np.full(FRAMES, 0.4)))[1]
    assert not np.asarray(contact.planted).any()


def test_weight_goes_half_the_way_in_a_half_life_and_starts_settled():
    """A tenth of a second is six frames."""
    speed = np.repeat([0.0, 1.0, 0.0], FRAMES // 3)
    weight = np.asarray(sense(clip(speed), half_life=0.1)[1].weight)[:, 0]
    assert weight[0] == 1.0
    falls, rises = FRAMES // 3 - 1, 2 * (FRAMES // 3) - 1
    np.testing.assert_allclose(weight[[falls + 6, falls + 12]], [0.5, 0.25], rtol=1e-12)
    np.testing.assert_allclose(weight[rises + 6], 0.5, rtol=0, atol=1e-3)


def test_a_clip_resumed_from_the_memory_of_one_of_its_frames_goes_on_as_the_whole():
    frames = clip(np.random.default_rng(0).choice(SPEEDS, FRAMES))
    memories, whole = sense(frames, half_life=0.1)
    assert 0.1 < np.asarray(whole.planted).mean() < 0.9
    resumed = sense(at(frames, slice(HALF, None)), 0.1, at(memories, HALF - 1))
    assert_close(resumed, at((memories, whole), slice(HALF, None)), 1e-12)
