"""Rules in one frame by themselves, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxik import HARD
from jaxik.stages import foot
from jaxik.stages.effector import BodyEffector, BodyState
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.stages.lock import OffsetLock, PlantLock
from jaxik.stages.lock.offset import LockState
from jaxik.stages.pelvis import PelvisState
from jaxik.stages.target import SlopeTarget, TargetState
from jaxik.world.frame import Contact, Foothold, GroundHits, Sensed
from jaxik.world.skeleton import Still, Transform
from jaxik.world.terrain import Hit, Terrain
from support.cases import QUICK
from support.clips import FLAT, animate, make_rig, to_frames, to_rig, to_terrain
from support.fragments import fragment

DT, UP, AHEAD = 1 / 60, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
BOTH, ZEROS = np.ones(2), np.zeros((2, 3))


def moment(started: bool = True, **sensed) -> SensedMoment:
    """A frame of a character on ground whose up is +y, with what the rule reads of it."""
    up = jnp.asarray(UP)
    arrays = {name: jnp.asarray(x) for name, x in sensed.items() if isinstance(x, np.ndarray)}
    frame = fragment(Sensed, leg_up_ws=up, carry=Still(), **(sensed | arrays))
    return SensedMoment(
        jnp.asarray(DT), jnp.asarray(started), HARD, frame, fragment(Terrain, up_ws=up)
    )


def test_a_faulty_leg_counts_as_one_that_is_not_there_and_no_other_does():
    rig, frames = to_rig(make_rig()), to_frames(animate(make_rig(), count=1))
    frame = jax.tree.map(lambda x: x[0], frames)
    inputs = Inputs(rig, to_terrain(FLAT), frame, HARD)
    np.testing.assert_array_equal(inputs.at(frame).rig.present, [True, True])
    for faulty in ([True, False], [False, True], [False, False]):
        present = inputs.at(frame, jnp.array(faulty)).rig.present
        np.testing.assert_array_equal(present, np.logical_not(faulty))


# Effectors: feet that follow their heights relative to the body.


@pytest.mark.parametrize(
    ("started", "fraction"), [(True, 0.25), (False, 1.0)], ids=["later", "first frame"]
)
def test_feet_cover_a_part_of_their_way_to_their_heights_over_the_body(started, fraction):
    """At 15 / s a quarter in 1/60 s; all of it in the first frame."""
    requested, goal, before = np.array([0.10, -0.05]), -0.05, np.array([0.02, 0.0])
    contact = fragment(Contact, planted=jnp.asarray(BOTH))
    now = moment(started, ankle_ws=ZEROS, weight=BOTH, contact=contact)
    target = Transform(jnp.asarray(requested[:, None] * UP), jnp.eye(4)[jnp.zeros(2, int)])
    pelvis = fragment(PelvisState, goal=jnp.asarray(goal), offset_ws=jnp.asarray(-0.03 * UP))
    state, effector = BodyEffector(speed=15.0).advance(
        now, target, pelvis, BodyState(jnp.asarray(before), jnp.zeros(()))
    )
    height = before + fraction * (requested - goal - before)
    np.testing.assert_allclose(state.height, height, rtol=0, atol=1e-12)
    np.testing.assert_allclose(effector.target_ws[:, 1], height - 0.03, rtol=0, atol=1e-12)


# Targets: how far the smoothing of a foothold's height moves it.


@pytest.mark.parametrize(
    ("rise", "fall", "started", "moved"),
    [(DT, DT, True, [-0.1, 0.1]), (DT, DT / 2, True, [-0.1, 0.05]), (0.5, 0.5, False, [0.0, 0.0])],
    ids=["half-lives", "falls faster", "first frame"],
)
def test_a_foothold_covers_half_its_way_in_a_half_life_up_and_down(rise, fall, started, moved):
    """From 0 to 0.2 m and from 0.3 to 0.1 m; all of it in the first frame."""
    foothold = fragment(
        Foothold,
        point_ws=jnp.asarray(ZEROS),
        height=jnp.array([0.2, 0.1]),
        ankle_height_ms=jnp.full(2, 0.1),
        climb=jnp.ones(2),
    )
    level = fragment(Hit, normal=jnp.broadcast_to(UP, (2, 3)))
    now = moment(started, foothold=foothold, ground=fragment(GroundHits, ankle=level))
    state = TargetState(jnp.array([0.0, 0.3]), jnp.zeros(2), jnp.asarray(ZEROS))
    rule = SlopeTarget(rise_half_life=rise, fall_half_life=fall)
    actual = jax.jit(lambda rule: rule.advance(now, state)[1], compiler_options=QUICK)(rule)
    np.testing.assert_allclose(actual, moved, rtol=0, atol=1e-12)


# Locks.


def test_a_lock_takes_as_much_from_a_turn_as_it_holds():
    """A lock that holds 0.4 takes half the rest of the way, to 0.7, while the foot turns."""
    turned = np.array([0.1, -0.2])
    always = {"release_distance": 9.0, "release_cone": 1.5, "release_max_angle": np.pi}
    rule = OffsetLock(**always, release_min_angle=0.0, hold_ball=True, lock_half_life=DT)
    ankle, ball = np.array([[0.1, 0.08, 0.0], [-0.1, 0.08, 0.0]]), ZEROS + 0.12 * AHEAD
    hip = ankle + 0.8 * UP
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
    foothold = ankle - 0.08 * UP
    memory = (BOTH, 0.4 * BOTH, ZEROS, np.array([0.02, 0.0]), foothold, ball, ZEROS + AHEAD)
    before = LockState(*map(jnp.asarray, memory))

    def advance() -> LockState:
        return rule.advance(now, jnp.asarray(foothold), now.sensed.hip_ws, before)[0]

    after = jax.jit(advance, compiler_options=QUICK)()
    np.testing.assert_array_equal(after.locked, 1.0)
    np.testing.assert_allclose(after.factor, 0.7, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.turn, [0.02, 0.0] - 0.7 * turned, rtol=0, atol=1e-12)


def test_no_foot_is_planted_or_turned_before_the_first_frame():
    state = PlantLock().init(to_rig(make_rig()))
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
