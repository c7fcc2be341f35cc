"""Rules by themselves, by hand: contact by speed, and others in one frame."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD
from jaxik.pipeline.frames import Clip
from jaxik.stages import foot
from jaxik.stages.contact import SpeedState
from jaxik.stages.effector import BodyEffector, BodyState
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.stages.lock import LockState, OffsetLock, PlantLock
from jaxik.stages.pelvis import PelvisState
from jaxik.stages.probe import swing
from jaxik.stages.target import SlopeTarget, TargetState
from jaxik.world.frame import Contact, Foothold, GroundHits, Sensed
from jaxik.world.skeleton import Still, Transform
from jaxik.world.terrain import Hit, Terrain
from support import clips
from support.cases import QUICK, RIG
from support.clips import animate, assert_close, at, planes, to_frames, to_ik, to_rig, to_terrain
from support.fragments import fragment

LEVEL = to_terrain(clips.FLAT)
DT, UP, AHEAD = 1 / 60, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
BOTH, ZEROS = np.ones(2), np.zeros((2, 3))


# Contact by speed and height: hysteresis, smoothing and memory.

FRAMES, HALF = 240, 120
SPEEDS = (1.0, 0.4, 0.2, 0.4, 0.6, 0.4)  # m/s, of the toes, one after the other
HEIGHTS = (0.12, 0.09, 0.07, 0.09, 0.11, 0.09)  # m, likewise
STANDS = (0, 0, 1, 1, 0, 0)  # between 0.25 and 0.5 m/s, 0.075 and 0.1 m: as before


def clip(speed: Any, height: Any = 0.02) -> jaxik.Frame:
    """Standing legs whose toes have these speeds, m/s, and heights, m, in equal parts of it."""
    frames = to_frames(animate(RIG, count=FRAMES))
    speeds, heights = (
        jnp.asarray(np.repeat(x, FRAMES // np.size(x)), float)[:, None] for x in (speed, height)
    )
    toe = frames.pose.toe.pos.at[..., 1].set(heights)
    pose = dataclasses.replace(frames.pose, toe=jaxik.Transform(toe, frames.pose.toe.rot))
    return dataclasses.replace(frames, pose=pose, toe_speed=jnp.tile(speeds, (1, 2)))


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
    inputs = Inputs(rig, LEVEL, frames, jaxik.HARD)
    clip = Clip(ik, inputs, state, None, {})
    return clip.ahead("contact", lambda ik, inputs: ik.contact.sense(inputs))


def test_a_foot_between_the_thresholds_stays_as_it_was_and_swings_in_the_first_frame():
    expected = np.repeat(STANDS, FRAMES // len(STANDS))[:, None].repeat(2, axis=-1)
    for frames in (clip(SPEEDS), clip(0.0, HEIGHTS)):
        contact = sense(frames)[1]
        np.testing.assert_array_equal(contact.planted, expected)
        np.testing.assert_array_equal(contact.lifted, 1 - expected)
        np.testing.assert_array_equal(contact.weight, expected)
    assert not np.asarray(sense(clip(0.4))[1].planted).any()


def test_weight_goes_half_the_way_in_a_half_life_and_starts_settled():
    """A tenth of a second is six frames."""
    weight = np.asarray(sense(clip([0.0, 1.0, 0.0]), half_life=0.1)[1].weight)[:, 0]
    assert weight[0] == 1.0
    falls, rises = FRAMES // 3 - 1, 2 * (FRAMES // 3) - 1
    np.testing.assert_allclose(weight[[falls + 6, falls + 12]], [0.5, 0.25], rtol=1e-12)
    np.testing.assert_allclose(weight[rises + 6], 0.5, rtol=0, atol=1e-3)


def test_a_clip_resumed_from_the_memory_of_one_of_its_frames_goes_on_as_the_whole():
    frames = clip(np.random.default_rng(0).choice(SPEEDS, FRAMES))
    memories, contact = whole = sense(frames, half_life=0.1)
    assert 0.1 < np.asarray(contact.planted).mean() < 0.9
    resumed = sense(at(frames, slice(HALF, None)), 0.1, at(memories, HALF - 1))
    assert_close(resumed, at(whole, slice(HALF, None)), 1e-12)


# One frame.


def moment(started: Any = True, **sensed) -> SensedMoment:
    """A frame of a character on ground whose up is +y, with what the rule reads of it."""
    up = jnp.asarray(UP)
    arrays = {name: jnp.asarray(x) for name, x in sensed.items() if isinstance(x, np.ndarray)}
    frame = fragment(Sensed, up_ws=up, leg_up_ws=up, carry=Still(), **(sensed | arrays))
    ground = fragment(Terrain, up_ws=up)
    return SensedMoment(jnp.asarray(DT), jnp.asarray(started), HARD, frame, ground)


def test_a_faulty_leg_counts_as_one_that_is_not_there_and_no_other_does():
    frame = at(to_frames(animate(RIG, count=1)), 0)
    inputs = Inputs(to_rig(RIG), LEVEL, frame, HARD)
    np.testing.assert_array_equal(inputs.at(frame).rig.present, [True, True])
    for faulty in ([True, False], [False, True], [False, False]):
        present = inputs.at(frame, jnp.array(faulty)).rig.present
        np.testing.assert_array_equal(present, np.logical_not(faulty))


# Effectors: feet that follow their heights relative to the body.


@pytest.mark.parametrize(("started", "fraction"), [(True, 0.25), (False, 1.0)])
def test_feet_cover_a_part_of_their_way_to_their_heights_over_the_body(started, fraction):
    """At 15 / s a quarter in 1/60 s; all of it in the first frame."""
    requested, goal, before = np.array([0.10, -0.05]), -0.05, np.array([0.02, 0.0])
    contact = fragment(Contact, planted=jnp.asarray(BOTH))
    now = moment(started, ankle_ws=ZEROS, weight=BOTH, contact=contact)
    target = Transform(jnp.asarray(requested[:, None] * UP), jnp.eye(4)[jnp.zeros(2, int)])
    pelvis = fragment(PelvisState, goal=jnp.asarray(goal), offset_ws=jnp.asarray(-0.03 * UP))
    memory = BodyState(jnp.asarray(before), jnp.zeros(()))
    state, effector = BodyEffector(speed=15.0).advance(now, target, pelvis, memory)
    height = before + fraction * (requested - goal - before)
    np.testing.assert_allclose(state.height, height, rtol=0, atol=1e-12)
    np.testing.assert_allclose(effector.target_ws[:, 1], height - 0.03, rtol=0, atol=1e-12)


# Targets: how far the smoothing of a foothold's height moves it.


def test_a_foothold_covers_half_its_way_in_a_half_life_up_and_down():
    """From 0 to 0.2 m and from 0.3 to 0.1 m; all of it in the first frame.

    Soles come out of the ground as far as they are deeper than they may be.
    """
    foothold = fragment(
        Foothold,
        point_ws=jnp.array([0.2, 0.1])[:, None] * UP,
        ankle_height_ms=jnp.full(2, 0.1),
        climb=jnp.ones(2),
        lift=jnp.array([0.08, 0.10]),
    )
    level = fragment(GroundHits, ankle=fragment(Hit, normal=jnp.broadcast_to(UP, (2, 3))))

    @functools.partial(jax.jit, compiler_options=QUICK)
    def moved(rise: Any, fall: Any, started: Any, deepest: Any) -> jax.Array:
        state = TargetState(jnp.array([0.0, 0.3]), jnp.zeros(2), jnp.asarray(ZEROS))
        rule = SlopeTarget(rise_half_life=rise, fall_half_life=fall, max_penetration=deepest)
        return rule.advance(moment(started, foothold=foothold, ground=level), state)[1]

    for case, expected in {
        (DT, DT, True, np.inf): [-0.1, 0.1],
        (DT, DT / 2, True, np.inf): [-0.1, 0.05],
        (0.5, 0.5, False, np.inf): [0.0, 0.0],
        (DT, DT, True, 0.03): [-0.03, 0.1],
        (DT, DT, True, 0.0): [0.0, 0.1],
    }.items():
        np.testing.assert_allclose(moved(*case), expected, rtol=0, atol=1e-12, err_msg=f"{case}")


# Locks.


def test_a_lock_takes_as_much_from_a_turn_as_it_holds():
    """A lock that holds 0.4 takes half the rest of the way, to 0.7, while the foot turns."""
    turned = np.array([0.1, -0.2])
    always = {"release_distance": 9.0, "release_cone": 1.5, "release_max_angle": np.pi}
    rule = OffsetLock(**always, release_min_angle=0.0, hold_ball=True, lock_half_life=DT)
    ankle, ball = np.array([[0.1, 0.08, 0.0], [-0.1, 0.08, 0.0]]), ZEROS + 0.12 * AHEAD
    hip = jnp.asarray(ankle + 0.8 * UP)
    now = moment(
        weight=BOTH,
        hip_ws=hip,
        ankle_ws=ankle,
        ball_ws=ball,
        ahead_ws=np.stack([np.sin(turned), 0 * turned, np.cos(turned)], axis=-1),
        rot_ws=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        thigh=0.45 * BOTH,
        shin=0.43 * BOTH,
        contact=fragment(Contact, planted=jnp.ones(2), lifted=jnp.zeros(2)),
        foothold=fragment(Foothold, lift=jnp.full(2, 0.08), found=jnp.ones(2)),
    )
    foothold = jnp.asarray(ankle - 0.08 * UP)
    memory = (BOTH, 0.4 * BOTH, ZEROS, np.array([0.02, 0.0]), foothold, ball, ZEROS + AHEAD)
    before = LockState(*map(jnp.asarray, memory))
    after = jax.jit(lambda: rule.advance(now, foothold, hip, before)[0], compiler_options=QUICK)()
    np.testing.assert_array_equal(after.locked, 1.0)
    np.testing.assert_allclose(after.factor, 0.7, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.turn, [0.02, 0.0] - 0.7 * turned, rtol=0, atol=1e-12)


def test_no_foot_is_planted_or_turned_before_the_first_frame():
    state = PlantLock().init(to_rig(RIG))
    np.testing.assert_array_equal(state.locked, [0.0, 0.0])
    np.testing.assert_array_equal(state.rot, [[1.0, 0.0, 0.0, 0.0]] * 2)


# The angles of the ground below a foot, from two hits or one with its normal; their limits.


def pitches(ahead: float, up: float, slope: float = 0.0) -> np.ndarray:
    """Of standing feet whose toes hit ground so far ahead of their ankles and above them, m.

    The normal below the ankle is that of ground that rises by `slope` m for each m ahead.
    """
    normal = jnp.asarray(ZEROS + (UP - slope * AHEAD) / np.hypot(1.0, slope))
    ankle, toe = (
        fragment(Hit, found=jnp.ones(2), point=jnp.asarray(point), normal=normal)
        for point in (ZEROS, ZEROS + up * UP + ahead * AHEAD)
    )
    ground = fragment(GroundHits, ankle=ankle, toe=toe, swing=jnp.zeros(2))
    sensed = moment(contact=fragment(Contact, weight=jnp.ones(2)), ground=ground).sensed
    right = jnp.array([-1.0, 0.0, 0.0])
    return np.asarray(foot.ground_angles(sensed, jnp.asarray(AHEAD), right, jnp.ones(2))[0])


def test_hits_a_centimetre_apart_give_the_pitch_and_nearer_ones_leave_it_to_the_normal():
    np.testing.assert_allclose(pitches(0.12, 0.05), np.arctan2(0.05, 0.12), rtol=1e-6)
    np.testing.assert_allclose(pitches(0.011, 0.05, 0.3), np.arctan2(5, 1.1), rtol=1e-6)
    np.testing.assert_allclose(pitches(0.009, 0.05, 0.3), np.arctan(0.3), rtol=1e-6)


def test_a_foot_tilts_no_further_than_its_joint_and_stays_where_that_is_beyond_already():
    """Joints from -0.5 to 0.4 rad; the last two are beyond their limits as animated."""
    joint = jnp.array([0.1, 0.1, 0.1, 0.1, 0.6, -0.7])
    tilt = jnp.array([0.2, -0.2, 0.5, -0.9, 0.3, -0.3])
    limited = foot.limit_tilt(tilt, joint, jnp.full(6, -0.5), jnp.full(6, 0.4), HARD)
    np.testing.assert_allclose(limited, [0.2, -0.2, 0.3, -0.6, 0.0, 0.0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_foot_in_the_middle_rolls_onto_the_ground_as_far_as_the_others():
    frames, slope = to_frames(animate(RIG, count=1)), to_terrain(planes((0.0, 0.1, 0.0)))

    def run(side: jax.Array) -> jax.Array:
        rig = dataclasses.replace(to_rig(RIG), side=side)
        return jaxik.run(to_ik({}), rig, slope, frames).corrections.ankle

    sides = jnp.array([[1.0, -1.0], [0.0, 0.0]])
    both, middle = np.asarray(jax.jit(jax.vmap(run), compiler_options=QUICK)(sides))
    assert np.abs(both[..., 1:]).max() > 0.03, "feet roll"
    np.testing.assert_allclose(middle, both, atol=1e-6)


# Curves.


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_curve_of_a_swing_has_finite_slopes_from_its_first_instant_to_its_last(dtype):
    fraction = jnp.array([0.0, 1e-38, 1e-30, 1e-12, 1e-6, 0.25, 0.5, 1.0 - 6e-8, 1.0], dtype)
    for steepness in (1.0, 2.2, 10.0):
        k = jnp.asarray(steepness, dtype)
        slopes = jax.vmap(jax.grad(swing.s_curve, (0, 1)), (0, None))(fraction, k)
        assert all(np.isfinite(slope).all() for slope in slopes), steepness
        value = swing.s_curve(fraction, k)
        assert (value[0], value[6], value[-1]) == (0.0, 0.5, 1.0) and (np.diff(value) >= 0).all()
