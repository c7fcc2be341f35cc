"""What Unreal and Mecanim have besides: legs that stretch, toes that bend, feet that are turned.

And simple ground in flight.

Each against geometry or NumPy, its limits, precision and derivatives.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.runtime.precision import with_floats
from jaxik.maths import parameter_tree, quat
from jaxik.maths.gate import HARD, AbstractGate
from jaxik.stages.foot import KeepFoot, SolvedFoot
from jaxik.stages.inputs import Inputs, Moment
from jaxik.stages.leg import LegGoal, TwoBone
from jaxik.stages.probe import FootProbe, StrideProbe
from jaxik.stages.warp import StrideWarp, with_turned_feet, with_turned_pelvis
from jaxik.world import terrain
from jaxik.world.frame import Contact, Frame, GroundHits, Rays, Sensed
from jaxik.world.skeleton import LegPose, Rig, Transform
from jaxik.world.terrain import Hit
from support.cases import RIG, Either, clip
from support.clips import to_rig
from support.fragments import fragment
from support.gradients import (
    assert_gradients_match,
    finite_jacobian,
)

THIGH, SHIN = 0.44, 0.40  # m


# Legs that stretch.

LEG = TwoBone(max_knee_angle=np.pi, soften=0.95, max_stretch=1.1, allow_stretch=True)
BENT = np.array([0.0, -0.4125, 0.153114])  # m, from hip to knee, with the ankle 0.775 m below
WAY = np.array([0.1, -0.9, 0.3]) / np.linalg.norm([0.1, -0.9, 0.3])


def solved(rule, targets, weight=1.0, gate: AbstractGate = HARD):
    """Knees and ankles (legs 3) of legs with their hips at the origin, m; stretch, and reached."""
    floats = targets.dtype
    zero, ones = jnp.zeros_like(targets), jnp.ones_like(targets[..., 0])
    rot = zero[..., :1] + quat.identity(floats)
    knees, ankles = (zero + jnp.asarray(x, floats) for x in (BENT, [0.0, -0.775, 0.0]))
    pose = LegPose(*(Transform(joint, rot) for joint in (zero, knees, ankles, ankles)))
    rig = fragment(Rig, knee_axis_ls=zero + jnp.asarray([-1.0, 0.0, 0.0], floats))
    leg = rule.solve(rig, LegGoal(pose, targets, weight * ones), gate)
    return leg.pose.knee.pos, leg.pose.ankle.pos, leg.stretch, leg.reached


solve = jax.jit(solved)


def test_a_leg_whose_target_is_out_of_reach_stretches_to_it_and_no_further():
    thigh, shin = np.linalg.norm(BENT), np.linalg.norm(BENT - [0.0, -0.775, 0.0])
    free = 0.95 * (thigh + shin)
    distances = free * np.array([0.6, 0.9, 1.0, 1.04, 1.09, 1.1, 1.2, 1.6])
    targets = jnp.asarray(distances[:, None] * WAY)
    weights = jnp.array([1.0] * 8 + [0.5])
    targets = jnp.concatenate([targets, targets[3:4]])
    *rows, reached = (np.asarray(x) for x in solve(LEG, targets, weights))
    (knee, ankle, stretch), reached = (x[:8] for x in rows), reached[:8]
    expected = np.clip(distances / free, 1.0, 1.1)
    np.testing.assert_allclose(stretch, expected, atol=1e-12)
    np.testing.assert_array_equal(reached, distances < 1.15 * free)
    np.testing.assert_allclose(ankle[:6], targets[:6], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(knee, axis=-1), thigh * expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ankle - knee, axis=-1), shin * expected, atol=1e-12)
    bend = np.vecdot(knee, ankle - knee) / expected**2
    np.testing.assert_allclose(bend[2:6], bend[2], atol=1e-9)
    lengths = np.linalg.norm(ankle[6:], axis=-1)
    assert np.all(lengths > 1.1 * free) and np.all(lengths < 1.1 * (thigh + shin))

    np.testing.assert_allclose(rows[2][8], 1.02, atol=1e-12, err_msg="half of the foot IK")
    rigid = solve(TwoBone(max_knee_angle=np.pi, soften=0.95), targets, weights)
    assert rigid[2] is None
    np.testing.assert_array_equal(rigid[0][:2], knee[:2])


@pytest.mark.slow
def test_a_stretched_leg_has_right_and_finite_derivatives():
    def of_leg(values, target, blurred):
        rule = TwoBone(max_knee_angle=np.pi, allow_stretch=True, **values)
        return solved(rule, target[None], gate=Either(blurred > 0.5))[:3]

    reach = np.linalg.norm(BENT) + np.linalg.norm(BENT - [0.0, -0.775, 0.0])
    values = {"soften": 0.95, "max_stretch": 1.1}
    straight = {"soften": 1.0, "max_stretch": 1.0}
    for blurred in (0.0, 1.0):
        for share in (0.8, 1.0, 1.3):
            assert_gradients_match(of_leg, values, share * reach * WAY, blurred)
        for target in (reach * WAY, 0.0 * WAY, 1.05 * reach * WAY):
            finite_jacobian(of_leg, straight, target, blurred)
    rows = np.array([reach * WAY, 0.0 * WAY, 1.02 * reach * WAY])
    single = with_floats(LEG, np.dtype(np.float32))
    rounded = solve(single, jnp.asarray(rows, jnp.float32), jnp.ones(3, jnp.float32))
    for actual, exact in zip(rounded[:3], solve(LEG, jnp.asarray(rows), jnp.ones(3)), strict=False):
        assert actual.dtype == jnp.float32
        np.testing.assert_allclose(actual, exact, rtol=0, atol=1e-3)


# Toes that bend. Each foot stands on a strip of ground of its own, 1 m wide, with its ball over
# z = 0: the ground rises evenly and has a step 3 cm ahead of the ball.

TOES, SOLE = 0.07, 0.05  # m, from the ball to their tips, and of the ball over its sole
SLOPES = np.array([0.0, 0.0, 0.3, -0.3, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
STEPS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.03, -0.02, 0.2, -0.5, 0.045])
RAISED = np.array([0.0, 0.5, 0.0, 0.0, 0.4, 0.0, 0.3, 0.4, 0.4, 0.0])  # rad, of the heels
LEGS = len(STEPS)


def height_of(slopes, steps, x, z):
    strip = jnp.clip(jnp.floor(x).astype(int), 0, LEGS - 1)
    return slopes[strip] * z + jnp.where(z > 0.03, steps[strip], 0.0)


def bent(rule, slopes, steps, raised, weight=1.0, gate: AbstractGate = HARD):
    """The rotations of toes (legs 4), and their corrections; feet are turned by slope and heel."""
    floats = slopes.dtype
    up = jnp.asarray([0.0, 1.0, 0.0], floats)
    zero, ones = jnp.zeros_like(slopes), jnp.ones_like(slopes)
    pitch = jnp.arctan(slopes)
    # A flat foot on its slope, with the heel raised about the ball.
    rot = quat.from_axis_angle(jnp.asarray([-1.0, 0.0, 0.0], floats), pitch - raised)
    normal = jnp.stack([zero, jnp.cos(pitch), -jnp.sin(pitch)], axis=-1)
    place = jnp.stack([jnp.arange(LEGS) + 0.5 * ones, zero, zero], axis=-1)
    ball = place + SOLE * normal
    still = zero[:, None] + quat.identity(floats)
    joint = Transform(ball, rot)
    foot = SolvedFoot(LegPose(joint, joint, joint, joint), still, ones)
    ground = terrain.function(jax.tree_util.Partial(height_of, slopes, steps), dtype=floats)
    hits = fragment(Hit, normal=normal, found=ones)
    sensed = fragment(
        Sensed,
        leg_up_ws=up,
        ahead_ws=0.0 * place + jnp.asarray([0.0, 0.0, 1.0], floats),
        ankle_rot_ws=still,
        ankle_ws=place + (SOLE + 0.03) * up,
        ball_ws=place + SOLE * up,
        contact=fragment(Contact, lift=SOLE + 0.03 * ones, weight=ones),
        ground=fragment(GroundHits, ankle=hits, rays=fragment(Rays, layers=jnp.uint32(1))),
    )
    frame = fragment(Frame, world_from_model=Transform.identity(floats))
    inputs = fragment(Inputs, frame=frame, terrain=ground, gate=gate)
    foot = rule.with_toes(inputs, sensed, weight * ones, foot)
    return foot.pose.toe.rot, foot.toe


bend = jax.jit(bent)


def lying_toes(slope: float, step: float) -> float:
    """The pitch, rad, at which the sole of toes just touches the ground ahead, by bisection."""
    ball = SOLE * np.array([-np.sin(np.arctan(slope)), np.cos(np.arctan(slope))])  # z, y
    ahead = ball[0] + TOES
    ground = np.array([ahead, slope * ahead + step])

    def over(pitch: float) -> float:  # of the ground over the toes' sole
        normal = np.array([-np.sin(pitch), np.cos(pitch)])
        return float(normal @ (ground - ball)) + SOLE

    low, high = -1.5, 1.5
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if over(middle) > 0 else (low, middle)
    return low


def pitch_of(rots: np.ndarray) -> np.ndarray:
    """Pitch of toes, rad, positive where they rise."""
    ahead = np.asarray(quat.rotate(jnp.asarray(rots), jnp.asarray([0.0, 0.0, 1.0])))
    return np.arctan2(ahead[:, 1], ahead[:, 2])


def test_toes_stay_on_the_ground_under_a_raised_heel_on_slopes_and_steps():
    rule = KeepFoot(toe_length=TOES, max_toe_up=1.2, max_toe_down=0.6)
    arrays = [jnp.asarray(x) for x in (SLOPES, STEPS, RAISED)]
    rots, corrections = map(np.asarray, bend(rule, *arrays))
    # Ground that is too high or too low for the toes counts as going on.
    near = np.where(np.abs(STEPS) > 0.1, 0.0, STEPS)
    expected = [lying_toes(*ground) for ground in zip(SLOPES, near, strict=True)]
    np.testing.assert_allclose(pitch_of(rots), expected, atol=1e-6)
    assert np.abs(np.diff(expected)).max() > 0.3
    feet = np.arctan(SLOPES) - RAISED
    bends = 2.0 * np.arctan2(-corrections[:, 1], corrections[:, 0])
    np.testing.assert_allclose(bends, expected - feet, atol=1e-6)
    np.testing.assert_allclose(bends[[0, 2, 3]], 0.0, atol=1e-6)

    small = KeepFoot(toe_length=TOES, max_toe_up=0.2, max_toe_down=0.1)
    limited = np.asarray(bend(small, *arrays)[0])
    expected = np.clip(expected - feet, -0.1, 0.2) + feet
    np.testing.assert_allclose(pitch_of(limited), expected, atol=1e-6)
    np.testing.assert_array_equal(bend(rule, *arrays, 0.0)[1], np.eye(4)[[0] * LEGS])


@pytest.mark.slow
def test_bent_toes_have_right_and_finite_derivatives_in_both_precisions():
    def of_feet(values, ground, blurred):
        return bent(KeepFoot(**values), *ground, gate=Either(blurred > 0.5))[0]

    values = {"toe_length": TOES, "max_toe_up": 1.2, "max_toe_down": 0.6}
    ground = (SLOPES + 0.01, STEPS + 0.003, RAISED + 0.02)
    for blurred in (0.0, 1.0):
        assert_gradients_match(of_feet, values, ground, blurred)
        for raised in (0.0 * RAISED, 0.0 * RAISED + np.pi / 2):
            finite_jacobian(of_feet, values, (0.0 * SLOPES, 0.0 * STEPS, raised), blurred)
    arrays = [jnp.asarray(x) for x in (SLOPES, STEPS, RAISED)]
    single = with_floats((KeepFoot(), *arrays, jnp.ones(())), np.dtype(np.float32))
    for rounded, exact in zip(bend(*single), bend(KeepFoot(), *arrays, jnp.ones(())), strict=True):
        assert rounded.dtype == jnp.float32
        np.testing.assert_allclose(rounded, exact, rtol=0, atol=1e-5)


# Feet that are turned to where the character goes.

WARP = {"max_angle": 1.2, "pelvis_share": 0.3, "half_life": 0.2}
DT = 0.05  # s


def turned(rule, orientation, grounded, weight, points, bearing, gate: AbstractGate = HARD):
    """The turns of frames, rad, and hips and ankles (frames legs 3), m, of legs at `points`."""
    rig = fragment(Rig, present=jnp.array([True, True, False]), side=jnp.zeros(3, points.dtype))

    def frame(carry, inputs):
        state, started = carry
        orientation, grounded, weight, points, bearing = inputs
        still = 0.0 * points[:, :1] + quat.identity(points.dtype)
        joint = Transform(points, still)
        pose = LegPose(joint, joint, joint, joint)
        fields: dict[str, Any] = dict.fromkeys(REQUIRED)
        fields |= {"weight": weight, "grounded": grounded, "orientation": orientation, "pose": pose}
        frame = Frame(**fields)
        goal = rule.sense(fragment(Inputs, frame=frame, rig=rig, gate=gate))
        state, turn = rule.advance(
            Moment(jnp.asarray(DT, points.dtype), started, gate), goal, state
        )
        carried = with_turned_pelvis(frame, turn)
        feet = with_turned_feet(carried, bearing, turn)
        places = feet.pose.hip.pos, feet.pose.ankle.pos, feet.pose.toe.rot
        return (state, jnp.ones_like(started)), (turn.feet, *places)

    start = rule.init(rig), jnp.zeros((), bool)
    return jax.lax.scan(frame, start, (orientation, grounded, weight, points, bearing))[1]


REQUIRED = [
    field.name for field in dataclasses.fields(Frame) if field.default is dataclasses.MISSING
]
turn_all = jax.jit(turned)


def directions(frames: int = 40) -> tuple[np.ndarray, ...]:
    """Directions all round, in the air at times, with legs of all weights and bearings."""
    rng = np.random.default_rng(2)
    grounded = (np.arange(frames) % 9 > 0).astype(float)
    weight = rng.uniform(0.0, 1.0, (frames, 3)) * (np.arange(frames) % 3 > 0)[:, None]
    points = rng.normal(0.0, 0.5, (frames, 3, 3))
    return np.linspace(-7.0, 7.0, frames), grounded, weight, points, rng.uniform(size=(frames, 3))


def test_feet_and_pelvis_are_turned_as_in_numpy():
    inputs = [jnp.asarray(x) for x in directions()]
    turns, hips, ankles, rots = map(np.asarray, turn_all(StrideWarp(**WARP), *inputs))
    expected, memory = [], None
    for orientation, grounded, weight, points, bearing in zip(*directions(), strict=True):
        sine, cosine = np.sin(orientation), np.cos(orientation)
        aside = np.arctan2(sine, abs(cosine))  # from the line of motion, whichever way along it
        aside = np.clip(aside, -1.2, 1.2) * grounded * min(1.0, weight[:2].sum())
        memory = aside if memory is None else memory + (aside - memory) * (1.0 - 2.0 ** (-DT / 0.2))
        pelvis = Rotation.from_rotvec([0.0, 0.3 * memory, 0.0])
        rest = Rotation.from_rotvec(np.outer(0.7 * memory * bearing, [0.0, 1.0, 0.0]))
        expected.append(
            (memory, pelvis.apply(points), (rest * pelvis).apply(points), rest * pelvis)
        )
    for actual, wanted in zip((turns, hips, ankles), zip(*expected, strict=True), strict=False):
        np.testing.assert_allclose(actual, np.stack(wanted), rtol=0, atol=1e-12)
    for actual, (*_, rot) in zip(rots, expected, strict=True):
        apart = (rot.inv() * Rotation.from_quat(actual, scalar_first=True)).magnitude()
        np.testing.assert_allclose(apart, 0.0, atol=1e-9)
    assert np.abs(turns).max() > 0.4
    assert StrideWarp().sense(fragment(Inputs, frame=fragment(Frame, orientation=None))) is None

    single = with_floats((StrideWarp(**WARP), *inputs), np.dtype(np.float32))
    for rounded, exact in zip(turn_all(*single), (turns, hips, ankles, rots), strict=True):
        assert rounded.dtype == jnp.float32
        np.testing.assert_allclose(rounded, exact, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_turn_has_right_and_finite_derivatives_all_round():
    _, grounded, weight, points, bearing = (x[:3] for x in directions())

    def feet(values, orientation, blurred):
        rest = (jnp.asarray(x) for x in (1.0 + 0.0 * grounded, weight, points, bearing))
        return turned(StrideWarp(**values), orientation, *rest, gate=Either(blurred > 0.5))[:3]

    for blurred in (0.0, 1.0):
        assert_gradients_match(feet, WARP, np.array([0.3, 2.5, -1.0]), blurred)
        finite_jacobian(feet, WARP, np.array([0.0, np.pi, -np.pi / 2]), blurred)
        finite_jacobian(feet, WARP, np.array([0.0, 0.0, 1.2]), blurred)


# Simple ground for feet in flight.

COMPLEX, SIMPLE = (terrain.layer_mask(layer) for layer in (0, 1))


@jax.jit
def grounds(probe, simple, frames, weight):
    """What a probe finds for contacts of these weights (frames legs): 10 cm, or sloping ground."""
    ground = terrain.combine(
        terrain.plane((0.0, 0.1, 0.0), layer=0),
        terrain.plane((0.0, 0.02, 0.0), (0.0, 1.0, -0.2), layer=1),
    )
    seen = parameter_tree.replace(probe, {"flight_layers": simple})

    def ground_of(frame, weight):
        contact = Contact(weight, weight, weight, 1.0 - weight)
        return seen.ground(Inputs(to_rig(RIG), ground, frame, HARD), contact, jnp.asarray(0.08))

    return jax.vmap(ground_of)(frames, weight)


@pytest.mark.slow
@pytest.mark.parametrize(
    "probe",
    [
        pytest.param(FootProbe(layers=COMPLEX), id="foot"),
        pytest.param(StrideProbe(layers=COMPLEX), id="stride"),
    ],
)
def test_feet_in_flight_see_simple_ground_and_standing_feet_the_other(probe):
    frames = clip("walks" if isinstance(probe, StrideProbe) else "goes forward")
    count = len(frames.dt)
    weight = jnp.stack([jnp.linspace(0.0, 1.0, count), jnp.linspace(1.0, 0.0, count)], axis=-1)
    both = dataclasses.replace(probe, simple_in_flight=True)
    complex_only = grounds(probe, SIMPLE, frames, weight)
    simple_only = grounds(dataclasses.replace(probe, layers=SIMPLE), SIMPLE, frames, weight)
    fraction, known = (np.asarray(getattr(frames.stride, x)) for x in ("fraction", "known"))
    apart = 4.0 * fraction * (1.0 - fraction)
    share = (1.0 - np.asarray(weight)) * (1.0 + known * (apart**2 * (3.0 - 2.0 * apart) - 1.0))
    for simple, seen in ((SIMPLE, 1.0), (terrain.layer_mask(9), 0.0)):
        mixed = grounds(both, simple, frames, weight)
        found = [(1.0 - share) * complex_only.ankle.found, seen * share * simple_only.ankle.found]
        np.testing.assert_allclose(mixed.ankle.found, sum(found), rtol=0, atol=1e-9)
        part = (found[1] / np.maximum(sum(found), 1e-300))[..., None]
        points = [np.asarray(x.ankle.point) for x in (complex_only, simple_only)]
        expected = (1.0 - part) * points[0] + part * points[1]
        there = sum(found) > 1e-6
        np.testing.assert_allclose(np.asarray(mixed.ankle.point)[there], expected[there], atol=1e-9)
    between = np.linalg.norm(points[0] - points[1], axis=-1)
    assert between.max() > 0.05 and share.max() > 0.5 and share.min() < 0.01
    np.testing.assert_array_equal(mixed.rays.layers, COMPLEX)
