"""Limbs bent to a pole: geometry, agreement with the reference, limits, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat, vec
from jaxik.maths.gate import HARD, AbstractGate, Smooth
from jaxik.solvers import pole as poles
from jaxik.solvers.two_bone import Limb
from reference import maths
from reference.stages import pole as reference
from support.gradients import (
    ROWS,
    TINY,
    assert_all_gradients_match,
    assert_finite_in_single_precision,
    finite_jacobians,
    limbs,
    unit,
    vectors,
)

X, Y, Z = np.eye(3)
ONE, NONE = np.float64(1.0), np.float64(0.0)
ONES, ZEROS = np.ones(ROWS), np.zeros(ROWS)
RNG = np.random.default_rng(0)


@jax.jit
def bend(to_hip, to_ankle, hinge, to_target, pole, soften, twist, gate: AbstractGate = HARD):
    """`bend_to_pole` of plain arrays."""
    arrays = map(jnp.asarray, (to_hip, to_ankle, hinge, to_target, pole, soften, twist))
    to_hip, to_ankle, hinge, to_target, pole, soften, twist = arrays
    target = poles.PoleTarget(to_target, pole, twist)
    return poles.bend_to_pole(Limb(to_hip, to_ankle, hinge), target, soften, gate)


@jax.jit
def solve(to_hip, to_ankle, hinge, *task):
    """Knee and ankle relative to the hip, hinge and swing after the bend; and `reached`."""
    bent = bend(to_hip, to_ankle, hinge, *task)
    knee_rot = quat.from_half_angle(hinge, bent.half_cos, bent.half_sin)
    knee = -quat.rotate(bent.swing, to_hip)
    ankle = knee + quat.rotate(bent.swing, quat.rotate(knee_rot, to_ankle))
    return knee, ankle, quat.rotate(bent.swing, hinge), bent.swing, bent.reached


def joints(to_hip, to_ankle, hinge, *task):
    """Knee, ankle and hinge after the bend: independent of the sign of a quaternion."""
    hinge = jnp.asarray(hinge) / jnp.linalg.norm(hinge, axis=-1, keepdims=True)
    return solve(to_hip, to_ankle, hinge, *task)[:3]


def smoothly_reached(*case):
    return bend(*case, gate=Smooth(1.0)).reached


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
    knee, ankle, _, swing, reached = solve(0.5 * X, 0.5 * Y, Z, 0 * X, Y, ONE, ONE)
    assert_allclose(swing, quat.identity(jnp.float64), atol=0)
    assert_allclose(knee, -0.5 * X, atol=0)
    assert_allclose(ankle, 0 * X, atol=1e-15)
    assert reached == 0


@pytest.mark.parametrize("pole", [0 * X, Y, -3 * Y], ids=["none", "along", "against"])
def test_a_pole_without_a_plane_leaves_the_shortest_arc(pole):
    hinge = (Z + 0.2 * Y) / np.sqrt(1.04)
    knee, ankle, _, swing, _ = solve(0.5 * X, 0.4 * Y, hinge, 0.7 * Y, pole, ONE, NONE)
    bent = quat.unrotate(swing, jnp.asarray(ankle))
    direct = quat.shortest_arc(vec.normalize(bent, bent), jnp.asarray(Y), jnp.asarray(X))
    assert_allclose(quat.angle(direct, swing), 0.0, atol=1e-12)
    assert_allclose(knee, -quat.rotate(direct, jnp.asarray(0.5 * X)), atol=1e-12)


def test_a_limb_with_bones_of_length_zero_stays_a_point():
    knee, ankle, normal, swing, reached = solve(0 * X, 0 * X, Z, Y, X, ONE, NONE)
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
    "target on the hip": (*BENT, 0 * X, X, ONE),
    "folded onto a target on the hip": (0.5 * X, 0.5 * X, Z, 0 * X, X, ONE),
    "target beside the hip": (0.5 * X, 0.5 * Y, Z, TINY * Y, X, ONE),
    "target at full length": (*BENT, Y, X, ONE),
    "target where softening starts": (*BENT, 0.5 * Y, X, np.float64(0.5)),
    "softened from the start": (*BENT, 0.5 * Y, X, NONE),
    "pole along the target": (*BENT, 0.7 * Y, Y, ONE),
    "pole against the target": (*BENT, 0.7 * Y, -Y, ONE),
    "pole beside the target": (*BENT, 0.7 * Y, Y + TINY * X, ONE),
    "no pole": (*BENT, 0.7 * Y, 0 * X, ONE),
    "pole opposed to the knee": (*BENT, 0.4 * Y - 0.6 * X, X, ONE),
    "target opposed to the ankle": (*BENT, 0.6 * X - 0.4 * Y, X, ONE),
    "no thigh": (0 * X, 0.4 * Y, Z, 0.7 * Y, X, ONE),
    "no shin": (0.6 * X, 0 * X, Z, 0.7 * Y, X, ONE),
    "no bones": (0 * X, 0 * X, Z, 0.7 * Y, X, ONE),
    "hinge along the thigh": (0.6 * X, 0.4 * Y, X, 0.7 * Y, Z, ONE),
    "already at its target": (*BENT, 0.4 * Y - 0.6 * X, -X, ONE),
}


SINGULAR_ROWS = [np.stack(x) for x in zip(*SINGULAR.values(), strict=True)]
TWISTS = np.full(len(SINGULAR), 0.3)


# Ozz's angle between the normals has a kink where a hinge begins to tilt in a plane that needs no
# rotation, or one by pi: gradients are compared away from there, and only have to be finite there.
@pytest.mark.parametrize("tilt", [0.0, 0.3], ids=["square", "tilted"])
def test_gradients_match_finite_differences(tilt):
    hinge, to_hip, to_ankle, target, pole, across = RNG.normal(size=(6, ROWS, 3))
    hinge = unit(hinge)
    to_hip, to_ankle = np.cross(hinge, to_hip), np.cross(hinge, to_ankle)
    length = np.linalg.norm([to_hip, to_ankle], axis=-1).sum(axis=0)
    target = (RNG.uniform(0.7, 1.2, ROWS) * length)[:, None] * unit(target)
    options = RNG.uniform([[0.5], [-3.0]], [[0.9], [3.0]], (2, ROWS))
    task = to_hip, to_ankle, hinge + tilt * across, target, pole
    assert_all_gradients_match(joints, *task, *options)


def test_gradients_are_finite_where_a_limb_has_no_single_answer():
    jacobians = finite_jacobians(joints, *SINGULAR_ROWS, TWISTS)
    finite_jacobians(smoothly_reached, *SINGULAR_ROWS, TWISTS)
    # The knee and ankle of a straight limb do not depend on where its ankle was sideways.
    straight = list(SINGULAR).index("straight, target within reach")
    assert_allclose(jacobians[straight, :6, 4], 0.0, atol=1e-12)


def test_gradients_are_finite_there_in_single_precision_too():
    assert_finite_in_single_precision(joints, *SINGULAR_ROWS, TWISTS)


def test_legs_and_batches_broadcast():
    bent = jax.eval_shape(bend, *BENT, jnp.zeros((3, 2, 3)), Z, np.ones(2), 0.3)
    assert bent.swing.shape == (3, 2, 4)
    assert bent.half_cos.shape == bent.half_sin.shape == bent.reached.shape == (3, 2)
