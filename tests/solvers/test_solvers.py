"""Limbs bent to a pole, joints that aim, knees that open, hips that swing, and soft limits.

Geometry, agreement with the reference, limits, gradients.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat, vec
from jaxik.maths.gate import HARD, AbstractGate, Smooth
from jaxik.solvers import rotations, two_bone
from jaxik.solvers.two_bone import Limb, quartic_limit, soft_limit
from reference import maths
from reference.sample_poses import rotation_angle
from reference.stages import limb as reference
from reference.systems import ozz
from support import gradients
from support.cases import Either
from support.gradients import ROWS, TINY, finite_jacobian, finite_jacobians, limbs, unit, vectors

X, Y, Z = np.eye(3)
ZERO = np.zeros(3)
ONE, NONE = np.float64(1.0), np.float64(0.0)
ONES, ZEROS = np.ones(ROWS), np.zeros(ROWS)
RNG = np.random.default_rng(0)


@jax.jit
def bend(to_hip, to_ankle, hinge, to_target, pole, soften, twist, gate: AbstractGate = HARD):
    """`bend_to_pole` of plain arrays."""
    target = rotations.PoleTarget(to_target, pole, twist)
    return two_bone.bend_to_pole(Limb(to_hip, to_ankle, hinge), target, soften, gate)


@jax.jit
def solve(to_hip, to_ankle, hinge, *task, gate: AbstractGate = HARD):
    """Knee and ankle relative to the hip, hinge and swing after the bend; and `reached`."""
    bent = bend(to_hip, to_ankle, hinge, *task, gate)
    knee_rot = quat.from_half_angle(hinge, bent.half_cos, bent.half_sin)
    knee = -quat.rotate(bent.swing, to_hip)
    ankle = knee + quat.rotate(bent.swing, quat.rotate(knee_rot, to_ankle))
    return knee, ankle, quat.rotate(bent.swing, hinge), bent.swing, bent.reached


def joints(to_hip, to_ankle, hinge, *task):
    """Knee, ankle and hinge after the bend, independent of the sign of a quaternion; `reached`."""
    hinge = jnp.asarray(hinge) / jnp.linalg.norm(hinge, axis=-1, keepdims=True)
    knee, ankle, hinge, _, reached = solve(to_hip, to_ankle, hinge, *task, gate=Smooth(1.0))
    return knee, ankle, hinge, reached


def tasks(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Limbs bent either way, targets well within reach, and poles well off their directions."""
    to_hip, to_ankle, hinge = limbs(rng, rng.uniform(0.1, 3.0, ROWS) * rng.choice([-1, 1], ROWS))
    thigh, shin = (np.linalg.norm(v, axis=-1, keepdims=True) for v in (to_hip, to_ankle))
    direction, pole = unit(vectors(rng, 1.0)), vectors(rng, 1.0, 30.0, 1e-3)
    along = np.linalg.norm(np.cross(direction, unit(pole)), axis=-1, keepdims=True) < 0.1
    pole = np.where(along, np.roll(direction, 1, axis=-1) * [1.0, -1.0, 0.5], pole)
    nearest = np.abs(thigh - shin)
    distance = nearest + rng.uniform(0.05, 0.95, (ROWS, 1)) * (thigh + shin - nearest)
    return to_hip, to_ankle, hinge, direction * distance, pole


def test_a_target_within_reach_is_reached_with_the_knee_towards_the_pole():
    task, twist = tasks(RNG), RNG.uniform(-3, 3, ROWS)
    to_hip, _, _, target, pole = task
    knee, ankle, normal, swing, reached = solve(*task, ONES, ZEROS)
    np.testing.assert_array_equal(reached, 1)
    assert_allclose(ankle, target, atol=1e-12)
    plane = np.cross(target, pole)
    assert_allclose(normal, unit(plane), atol=1e-9)
    assert (np.vecdot(np.cross(target, knee), plane) > 0).all()
    assert_allclose(np.linalg.norm(knee, axis=-1), np.linalg.norm(to_hip, axis=-1), atol=1e-14)
    assert_allclose(np.linalg.norm(swing, axis=-1), 1.0, atol=1e-14)

    twisted, ankle, *_ = solve(*task, ONES, twist)
    assert_allclose(ankle, target, atol=1e-12)
    about_aim = Rotation.from_rotvec(twist[:, None] * unit(target))
    assert_allclose(twisted, about_aim.apply(np.array(knee)), atol=1e-12)


def test_a_limb_already_at_its_target_does_not_rotate():
    limb = to_hip, to_ankle, _ = limbs(RNG, RNG.uniform(0.1, 3.0, ROWS))
    pole = RNG.choice([1e-3, 1.0, 30.0], (ROWS, 1)) * -to_hip
    knee, ankle, _, swing, reached = solve(*limb, to_ankle - to_hip, pole, ONES, ZEROS)
    assert_allclose(swing, np.tile([1.0, 0, 0, 0], (ROWS, 1)), atol=1e-9)
    assert_allclose(knee, -to_hip, atol=1e-9)
    assert_allclose(ankle, to_ankle - to_hip, atol=1e-9)
    np.testing.assert_array_equal(reached, 1)


def test_tilted_hinges_and_soft_limits_are_those_of_the_reference():
    to_hip, to_ankle, hinge, target, pole = tasks(RNG)
    hinge, target = unit(hinge + vectors(RNG, 0.3, TINY)), RNG.uniform(0.5, 2.0, (ROWS, 1)) * target
    soften, twist = RNG.uniform([[0.3], [-3.0]], [[1.0], [3.0]], (2, ROWS))
    knee, ankle, _, _, reached = solve(to_hip, to_ankle, hinge, target, pole, soften, twist)
    limbs = zip(-to_hip, to_ankle - to_hip, hinge, target, pole, soften, twist, strict=True)
    for row, (to_knee, hip_to_ankle, *rest) in enumerate(limbs):
        hip_rot, knee_rot, in_reach = reference.joint_rotations(to_knee, hip_to_ankle, *rest)
        # An arc cosine near 1 is only accurate to the square root of the rounding error.
        assert_allclose(knee[row], maths.rotate(hip_rot, to_knee), atol=1e-6)
        bent = to_knee + maths.rotate(knee_rot, to_ankle[row])
        assert_allclose(ankle[row], maths.rotate(hip_rot, bent), atol=1e-6)
        assert reached[row] == in_reach


def test_a_target_is_reached_beyond_the_bones_difference_and_up_to_the_soft_length():
    distance = np.array([0.0, 0.25, 0.2501, 1.25, 1.2501, 0.625, 0.6251, 1.25, 0.3])
    soften = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 1.5, -1.0])
    limb = (np.tile(v, (9, 1)) for v in (0.75 * X, 0.5 * Y, Z))
    args = *limb, distance[:, None] * Y, np.tile(X, (9, 1)), soften, np.zeros(9)
    expected = np.array([0, 0, 1, 1, 0, 1, 0, 1, 0])
    np.testing.assert_array_equal(solve(*args)[-1], expected)
    smooth = np.asarray(bend(*args, gate=Smooth(0.1)).reached)
    clear = ~np.isin(distance, [0.25, 1.25, 0.625])
    np.testing.assert_array_equal((smooth > 0.5)[clear], expected[clear])


def test_a_target_on_the_hip_folds_the_knee_and_does_not_rotate_the_hip():
    knee, ankle, _, swing, reached = solve(0.5 * X, 0.5 * Y, Z, ZERO, Y, ONE, ONE)
    assert_allclose(swing, quat.identity(jnp.float64), atol=0)
    assert_allclose(knee, -0.5 * X, atol=0)
    assert_allclose(ankle, ZERO, atol=1e-15)
    assert reached == 0


@pytest.mark.parametrize("pole", [ZERO, Y, -3 * Y], ids=str)
def test_a_pole_without_a_plane_leaves_the_shortest_arc(pole):
    hinge = (Z + 0.2 * Y) / np.sqrt(1.04)
    knee, ankle, _, swing, _ = solve(0.5 * X, 0.4 * Y, hinge, 0.7 * Y, pole, ONE, NONE)
    bent = quat.unrotate(swing, jnp.asarray(ankle))
    direct = quat.shortest_arc(vec.normalize(bent, bent), jnp.asarray(Y), jnp.asarray(X))
    assert_allclose(quat.angle(direct, swing), 0.0, atol=1e-12)
    assert_allclose(knee, -quat.rotate(direct, jnp.asarray(0.5 * X)), atol=1e-12)


def test_a_limb_with_bones_of_length_zero_stays_a_point():
    knee, ankle, normal, swing, reached = solve(ZERO, ZERO, Z, Y, X, ONE, NONE)
    assert_allclose([knee, ankle], 0.0, atol=0)
    assert_allclose([np.linalg.norm(normal), np.linalg.norm(swing)], 1.0, atol=1e-15)
    assert reached == 0


BENT = 0.6 * X, 0.4 * Y, Z
STRAIGHT = 0.6 * X, -0.4 * X, Z
NEARLY = 0.6 * X, -0.4 * X + TINY * Y, Z
SINGULAR = {
    "straight, target within reach": (*STRAIGHT, -0.8 * X, Y, ONE),
    "straight, target nearer": (*STRAIGHT, 0.7 * Y, X, ONE),
    "straight, target at full length": (*STRAIGHT, -1.0 * X, Y, ONE),
    "straight, target out of reach": (*STRAIGHT, -2.0 * X, Y, np.float64(0.97)),
    "nearly straight": (*NEARLY, -0.8 * X, Y, ONE),
    "nearly straight, bent backwards": (0.6 * X, -0.4 * X - TINY * Y, Z, -0.8 * X, Y, ONE),
    "folded, target where it is": (0.6 * X, 0.4 * X, Z, -0.2 * X, Y, ONE),
    "folded, target too near": (0.6 * X, 0.4 * X, Z, -0.1 * X, Y, ONE),
    "ankle on the hip": (0.5 * X, 0.5 * X, Z, 0.3 * Y, X, ONE),
    "target on the hip": (*BENT, ZERO, X, ONE),
    "folded onto a target on the hip": (0.5 * X, 0.5 * X, Z, ZERO, X, ONE),
    "target beside the hip": (0.5 * X, 0.5 * Y, Z, TINY * Y, X, ONE),
    "target at full length": (*BENT, Y, X, ONE),
    "target where softening starts": (*BENT, 0.5 * Y, X, np.float64(0.5)),
    "softened from the start": (*BENT, 0.5 * Y, X, NONE),
    "pole along the target": (*BENT, 0.7 * Y, Y, ONE),
    "pole against the target": (*BENT, 0.7 * Y, -Y, ONE),
    "pole beside the target": (*BENT, 0.7 * Y, Y + TINY * X, ONE),
    "no pole": (*BENT, 0.7 * Y, ZERO, ONE),
    "pole opposed to the knee": (*BENT, 0.4 * Y - 0.6 * X, X, ONE),
    "target opposed to the ankle": (*BENT, 0.6 * X - 0.4 * Y, X, ONE),
    "no thigh": (ZERO, 0.4 * Y, Z, 0.7 * Y, X, ONE),
    "no shin": (0.6 * X, ZERO, Z, 0.7 * Y, X, ONE),
    "no bones": (ZERO, ZERO, Z, 0.7 * Y, X, ONE),
    "hinge along the thigh": (0.6 * X, 0.4 * Y, X, 0.7 * Y, Z, ONE),
    "already at its target": (*BENT, 0.4 * Y - 0.6 * X, -X, ONE),
}


# Ozz's angle between the normals has a kink where a hinge begins to tilt in a plane that needs no
# rotation, or one by pi: gradients are compared away from there, and only have to be finite there.
@pytest.mark.slow
def test_gradients_of_a_bend_match_finite_differences():
    hinge, to_hip, to_ankle, target, pole, across = RNG.normal(size=(6, ROWS, 3))
    hinge = unit(hinge)
    to_hip, to_ankle = np.cross(hinge, to_hip), np.cross(hinge, to_ankle)
    length = np.linalg.norm([to_hip, to_ankle], axis=-1).sum(axis=0)
    target = (RNG.uniform(0.7, 1.2, ROWS) * length)[:, None] * unit(target)
    options = RNG.uniform([[0.5], [-3.0]], [[0.9], [3.0]], (2, ROWS))
    hinge += RNG.choice([0.0, 0.3], (ROWS, 1)) * across  # square to its bones, or tilted
    gradients.assert_all_gradients_match(joints, to_hip, to_ankle, hinge, target, pole, *options)


@pytest.mark.slow
def test_gradients_are_finite_where_a_limb_has_no_single_answer():
    singular = [np.stack(x) for x in zip(*SINGULAR.values(), strict=True)]
    singular.append(np.full(len(SINGULAR), 0.3))  # twists
    jacobians = finite_jacobians(joints, *singular)
    gradients.assert_finite_in_single_precision(joints, *singular)
    # The knee and ankle of a straight limb do not depend on where its ankle was sideways.
    straight = list(SINGULAR).index("straight, target within reach")
    assert_allclose(jacobians[straight, :6, 4], 0.0, atol=1e-12)


def test_legs_batches_and_targets_broadcast():
    bent = jax.eval_shape(bend, *BENT, jnp.zeros((3, 2, 3)), Z, np.ones(2), 0.3)
    assert bent.swing.shape == (3, 2, 4)
    assert bent.half_cos.shape == bent.half_sin.shape == bent.reached.shape == (3, 2)
    rot, reached = jax.eval_shape(aim_rotation, jnp.zeros((3, 2, 3)), X, ZERO, Y, Y, 0.3)
    assert rot.shape == (3, 2, 4) and reached.shape == (3, 2)


# Joints that aim: the ray passes through its target, up turns to the pole.


def aim_rotation(to_target, forward, offset, up, pole, twist, gate: AbstractGate = HARD):
    """`rotations.aim_rotation` of plain arrays."""
    return rotations.aim_rotation(
        rotations.PoleTarget(to_target, pole, twist), forward, offset, up, gate
    )


aimed = jax.jit(aim_rotation)


def axes_and_reached(to_target, forward, *rest):
    """Two axes of the rotated joint, independent of the sign of a quaternion; `reached`.

    The last argument says whether decisions are blurred.
    """
    forward = jnp.asarray(forward) / jnp.linalg.norm(forward, axis=-1, keepdims=True)
    rot, reached = aim_rotation(to_target, forward, *rest[:-1], gate=Either(rest[-1] > 0.5))
    return [quat.rotate(rot, jnp.asarray(axis, rot.dtype)) for axis in (X, Y)], reached


def test_the_ray_passes_through_its_target_and_up_turns_to_the_pole_as_in_the_reference():
    target, offset = vectors(RNG, 1.0, 3.0), vectors(RNG, 0.8, 0.0)
    forward, up, pole = unit(vectors(RNG, 1.0)), vectors(RNG, 1.0), vectors(RNG, 1.0, TINY)
    twist = RNG.uniform(-3, 3, ROWS)
    rot, reached = map(np.asarray, aimed(target, forward, offset, up, pole, twist))
    assert 30 < reached.sum() < ROWS
    turn = Rotation.from_quat(rot, scalar_first=True)
    to_target, along = target - turn.apply(offset), turn.apply(forward)
    beside = np.linalg.norm(np.cross(to_target, along), axis=-1)
    assert_allclose(beside[reached > 0], 0.0, atol=1e-7)
    for row, case in enumerate(zip(forward, offset, up, target, pole, twist, strict=True)):
        expected, reaches = ozz.aim(*case)
        assert reached[row] == reaches
        assert rotation_angle(rot[row], expected) < 1e-7, row


def test_a_joint_that_already_looks_at_its_target_does_not_rotate():
    forward, offset, up = unit(vectors(RNG, 1.0)), vectors(RNG, 0.2, 0.0), vectors(RNG, 1.0, TINY)
    rot, reached = aimed(offset + 2.0 * forward, forward, offset, up, up, np.zeros(ROWS))
    np.testing.assert_array_equal(reached, 1)
    assert_allclose(rot, np.tile([1.0, 0, 0, 0], (ROWS, 1)), atol=1e-12)


def test_a_ray_that_passes_the_joint_farther_away_than_the_target_does_not_reach_it():
    for height, expected in ((0.5, 1), (1.0, 1), (1.001, 0), (2.0, 0)):
        rot, reached = aimed(X, X, height * Y, Y, Y, np.float64(0.4))
        assert reached == expected
        if not reached:
            assert_allclose(rot, quat.identity(jnp.float64), atol=0)
        _, smooth = aimed(X, X, height * Y, Y, Y, NONE, Smooth(0.1))
        assert (smooth >= 0.5) == expected


def test_a_target_on_the_joint_does_not_rotate_it():
    rot, reached = aimed(ZERO, X, ZERO, Y, Z, np.float64(0.4))
    assert_allclose(rot, quat.identity(jnp.float64), atol=0)
    assert reached == 1  # as in ozz: the ray starts at the target
    assert aimed(ZERO, X, 0.1 * Y, Y, Z, NONE)[1] == 0


@pytest.mark.parametrize(("up", "pole"), [(Y, ZERO), (ZERO, Y), (Y, Z), (Y, -Z), (X, Y)], ids=str)
def test_without_a_pole_or_up_across_the_target_the_arc_is_the_shortest(up, pole):
    # The arc takes up along x to the target's direction, z; the poles along z are there already.
    rot, reached = aimed(2.0 * Z, X, ZERO, up, pole, NONE)
    direct = quat.shortest_arc(jnp.asarray(X), jnp.asarray(Z), jnp.asarray(Y))
    assert_allclose(rot, direct, atol=1e-14)
    assert reached == 1


@pytest.mark.parametrize("up", [Y, Z, ZERO], ids=str)
def test_a_target_behind_the_joint_is_reached_by_half_a_turn(up):
    for forward in np.concatenate([np.eye(3), -np.eye(3)]):
        rot, _ = aimed(-forward, forward, ZERO, up, up, NONE)
        assert_allclose(quat.rotate(rot, jnp.asarray(forward)), -forward, atol=1e-15)
        assert_allclose(np.linalg.norm(rot), 1.0, atol=1e-15)


SINGULAR_AIMS = {
    "already at its target": (X, X, ZERO, Y, Y),
    "nearly at its target": (X + TINY * Z, X, ZERO, Y, Y + TINY * Z),
    "target on the joint": (ZERO, X, ZERO, Y, Z),
    "target beside the joint": (TINY * Z, X, ZERO, Y, Y),
    "target behind": (-X, X, ZERO, Y, Y),
    "target nearly behind": (-X + TINY * Y, X, ZERO, Y, Y),
    "target behind along up": (-Y, Y, ZERO, Y, X),
    "ray that just reaches": (X, X, Y, Y, Z),
    "ray that misses": (X, X, 1.5 * Y, Y, Z),
    "ray that starts at the target": (X, X, X, Y, Z),
    "ray that starts on the joint's far side": (X, X, -3.0 * X, Y, Z),
    "pole along the target": (Y, X, ZERO, X, Y),
    "pole nearly along the target": (Y, X, ZERO, Z, Y + TINY * Z),
    "no pole": (Y, X, ZERO, Z, ZERO),
    "no up": (Y, X, ZERO, ZERO, Z),
    "up along the ray": (Y, X, ZERO, X, Z),
    "pole opposed to up": (X, X, ZERO, Y, -Y),
}


@pytest.mark.slow
def test_gradients_of_aims_match_finite_differences():
    target, forward, offset, up, pole = RNG.normal(size=(5, ROWS, 3))
    target = RNG.uniform(0.7, 2.0, (ROWS, 1)) * unit(target)
    twist = RNG.uniform(-3, 3, ROWS)
    task = target, forward, 0.2 * offset, up, pole, twist, np.resize([0.0, 1.0], ROWS)
    gradients.assert_all_gradients_match(axes_and_reached, *task)


def test_gradients_are_finite_where_a_joint_has_no_single_answer():
    singular = [np.stack(2 * x) for x in zip(*SINGULAR_AIMS.values(), strict=True)]
    twist, blurred = np.full(len(singular[0]), 0.3), np.repeat([0.0, 1.0], len(SINGULAR_AIMS))
    singular += [twist, blurred]
    gradients.finite_jacobians(axes_and_reached, *singular)
    gradients.assert_finite_in_single_precision(axes_and_reached, *singular)


# The knee that opens and the hip that swings.


def axes_after_swing(bent, to_target, hinge, twist):
    """Rotated axes: independent of the sign of a quaternion."""
    return quat.axes(two_bone.swing_rotation(bent, to_target, hinge, twist))


def hinge_half_angle(to_hip, to_ankle, hinge, reach):
    return two_bone.hinge_half_angle(Limb(to_hip, to_ankle, hinge), reach)


def reaches(to_hip, to_ankle, fraction):
    """Distances of hip and ankle, by the fraction of the way from folded to straight."""
    thigh, shin = (np.linalg.norm(v, axis=-1) for v in (to_hip, to_ankle))
    return np.abs(thigh - shin) + fraction * (thigh + shin - np.abs(thigh - shin))


@pytest.mark.parametrize("side", [X, Y, ZERO], ids=["across", "along", "none"])
def test_the_arc_between_opposed_directions_is_half_a_turn(side):
    for start in (Y, -Y, Z):
        rot = rotations.safe_arc(jnp.asarray(start), jnp.asarray(-start), jnp.asarray(side))
        assert_allclose(quat.rotate(rot, jnp.asarray(start)), -start, atol=1e-15)
        assert_allclose(np.linalg.norm(rot), 1.0, atol=1e-15)


@pytest.mark.parametrize("square", [True, False])
def test_the_hinge_puts_hip_and_ankle_the_wanted_distance_apart(square):
    to_hip, to_ankle, hinge = limbs(RNG, RNG.uniform(0.1, 3.0, ROWS))
    if not square:
        to_hip, to_ankle = RNG.uniform(-0.5, 0.5, (2, ROWS, 3))
    turned = Rotation.from_rotvec(RNG.uniform(-3, 3, (ROWS, 1)) * hinge).apply(to_ankle)
    wanted = np.linalg.norm(turned - to_hip, axis=-1)  # so that some angle does it
    half = hinge_half_angle(*map(jnp.asarray, (to_hip, to_ankle, hinge, wanted)))
    ankle = quat.rotate(quat.from_half_angle(jnp.asarray(hinge), *half), jnp.asarray(to_ankle))
    distance = np.linalg.norm(ankle - to_hip, axis=-1)
    assert_allclose(distance, wanted, atol=1e-12 if square else 1e-9)


@pytest.mark.slow
def test_gradients_of_swings_and_knees_match_finite_differences():
    bent, target, hinge = (unit(vectors(RNG, 1.0)) for _ in range(3))
    along = np.maximum(np.abs(np.vecdot(bent, hinge)), np.abs(np.vecdot(target, hinge)))
    regular = (np.vecdot(bent, target) > -0.99) & (along < 0.99)
    swing = bent, target, hinge, RNG.uniform(-3, 3, ROWS)
    gradients.assert_all_gradients_match(axes_after_swing, *(x[regular] for x in swing))
    to_hip, to_ankle, hinge = limbs(RNG, RNG.uniform(0.1, 3.0, ROWS))
    reach = reaches(to_hip, to_ankle, RNG.uniform(0.2, 0.9, ROWS))
    gradients.assert_all_gradients_match(hinge_half_angle, to_hip, to_ankle, hinge, reach)


def test_gradients_are_finite_where_a_swing_or_a_knee_has_no_single_answer():
    swings = ((X, -X, Y), (X, -X, X), (X, Y, X), (X, Y, Y), (X, X, X), (ZERO, Y, Z))
    finite_jacobians(axes_after_swing, *np.stack(swings, axis=1), 0.3)
    knees = ((X, -X, Y), (X, X, Y), (X, Y, X), (ZERO, Y, Z), (X, Y, Z))
    rows = np.repeat(np.stack(knees, axis=1), 4, axis=1)
    finite_jacobians(hinge_half_angle, *rows, np.tile([0.0, 1.0, 2.0, 3.0], len(knees)))


def test_a_limb_straight_to_within_rounding_has_no_gradient_in_its_reach():
    to_hip, to_ankle, hinge = limbs(RNG, RNG.uniform(0.1, 3.0, ROWS))
    full = reaches(to_hip, to_ankle, 1.0)
    slopes = jax.jit(jax.vmap(jax.jacfwd(hinge_half_angle, argnums=3)))
    for reach in (full, np.nextafter(full, 0.0), np.nextafter(full, 9.0)):
        np.testing.assert_array_equal(slopes(to_hip, to_ankle, hinge, reach), 0.0)


@pytest.mark.parametrize("hinge", [X, Z, (X + 2.0 * Z) / np.sqrt(5.0)], ids=["x", "z", "between"])
def test_a_limb_that_is_turned_upside_down_turns_about_its_hinge(hinge):
    rot = two_bone.swing_rotation(*map(jnp.asarray, (Y, -Y, hinge, 0.0)))
    assert_allclose(quat.rotate(rot, jnp.asarray(Y)), -Y, atol=1e-12)
    assert_allclose(quat.rotate(rot, jnp.asarray(hinge)), hinge, atol=1e-12)


# Soft limits: where they start, where they end.


@pytest.mark.parametrize(
    ("curve", "first_slope", "end", "left"),
    [(quartic_limit, 4 / 3, 50.0, 1e-6), (soft_limit, 1.0, 5.0, 1e-3)],
)
def test_a_curve_starts_with_its_slope_and_rises_to_its_limit(curve, first_slope, end, left):
    x = np.linspace(0.0, end, 5001)
    y = np.asarray(curve(jnp.asarray(x), jnp.asarray(0.9), jnp.asarray(1.4)))
    assert_allclose(y[x <= 0.9], x[x <= 0.9], atol=0)
    assert (np.diff(y) > 0).all() and y[-1] < 1.4
    assert_allclose(y[-1], 1.4, atol=left)
    assert_allclose(finite_jacobian(curve, 0.9 + 1e-9, 0.9, 1.4)[0, 0], first_slope, atol=1e-6)
    if curve is quartic_limit:
        assert_allclose((y - x).max(), 0.028 * 0.5, rtol=0.02)


def test_the_quartic_curve_has_right_gradients_and_without_room_only_the_soft_one_limits():
    x, free, room = RNG.uniform(0.1, [[3.0], [1.0], [2.0]], (3, ROWS))
    x = np.where(np.abs(x - free) > 0.01, x, free + 0.02)
    gradients.assert_all_gradients_match(quartic_limit, x, free, free + room)
    x, free = jnp.asarray(x), jnp.asarray(free)
    assert_allclose(quartic_limit(x, free, free), x, atol=0)
    assert_allclose(soft_limit(x, free, free), np.minimum(x, free), atol=0)
    by_x, *by_limits = jax.vmap(jax.grad(soft_limit, (0, 1, 2)))(x, free, free)
    assert_allclose([by_x, sum(by_limits)], [x < free, x > free], atol=0)
