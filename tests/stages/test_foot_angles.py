"""The angles of the ground below a foot, from two hits or one with its normal; their limits."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD
from jaxik.stages import foot
from jaxik.world.frame import Sensed
from support.cases import QUICK
from support.clips import make_rig, planes, to_frames, to_ik, to_rig, to_terrain, wandering

AHEAD, RIGHT = jnp.array([0.0, 0.0, 1.0]), jnp.array([-1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def sensed() -> Sensed:
    """Two standing feet on level ground."""
    frames = to_frames(wandering(make_rig(), np.random.default_rng(4), 4))
    run = jax.jit(jaxik.run, compiler_options=QUICK)
    trace = run(to_ik({}), to_rig(make_rig()), to_terrain(planes((0, 0, 0))), frames).trace
    first = jax.tree.map(lambda x: x[0], trace.sensed)
    contact = dataclasses.replace(first.contact, weight=jnp.ones(2))
    return dataclasses.replace(first, contact=contact)


def pitches(sensed: Sensed, ahead: float, up: float, slope: float = 0.0) -> np.ndarray:
    """Of feet whose toes hit ground so far ahead of their ankles and above them, m.

    The normal below the ankle is that of ground that rises by `slope` m for each m ahead.
    """
    normal = np.array([0.0, 1.0, -slope]) / np.hypot(1.0, slope)
    hits = sensed.ground
    ankle = dataclasses.replace(
        hits.ankle, found=jnp.ones(2), normal=jnp.broadcast_to(normal, (2, 3))
    )
    point = ankle.point + jnp.array([0.0, up, ahead])
    toe = dataclasses.replace(hits.toe, found=jnp.ones(2), point=point)
    ground = dataclasses.replace(hits, ankle=ankle, toe=toe)
    on_step = dataclasses.replace(sensed, ground=ground)
    return np.asarray(foot.ground_angles(on_step, AHEAD, RIGHT, jnp.ones(2))[0])


def test_two_hits_a_centimetre_apart_or_more_give_the_pitch(sensed):
    np.testing.assert_allclose(pitches(sensed, 0.12, 0.05), np.arctan2(0.05, 0.12), rtol=1e-6)
    np.testing.assert_allclose(pitches(sensed, 0.011, 0.05, 0.3), np.arctan2(5, 1.1), rtol=1e-6)


def test_hits_nearer_to_each_other_leave_it_to_the_normal(sensed):
    np.testing.assert_allclose(pitches(sensed, 0.009, 0.05, 0.3), np.arctan(0.3), rtol=1e-6)


def test_a_foot_tilts_no_further_than_its_joint_and_stays_where_that_is_beyond_already():
    """Joints from -0.5 to 0.4 rad; the last two are beyond their limits as animated."""
    joint = jnp.array([0.1, 0.1, 0.1, 0.1, 0.6, -0.7])
    tilt = jnp.array([0.2, -0.2, 0.5, -0.9, 0.3, -0.3])
    limited = foot.limit_tilt(tilt, joint, jnp.full(6, -0.5), jnp.full(6, 0.4), HARD)
    np.testing.assert_allclose(limited, [0.2, -0.2, 0.3, -0.6, 0.0, 0.0], rtol=0, atol=1e-12)
