"""A knee that opens and a hip that swings: their gradients, regular and singular."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat
from jaxik.solvers import rotations, two_bone
from support.gradients import assert_gradients_match, finite_jacobian, numbers, vectors
from support.limbs import limbs

few = settings(max_examples=20, derandomize=True, deadline=None)
X, Y, Z = np.eye(3)


def axes_after_swing(bent, to_target, hinge, twist):
    """Rotated axes: independent of the sign of a quaternion."""
    return quat.axes(two_bone.swing_rotation(bent, to_target, hinge, twist))


def hinge_half_angle(to_hip, to_ankle, hinge, reach):
    return two_bone.hinge_half_angle(two_bone.Limb(to_hip, to_ankle, hinge), reach)


@pytest.mark.parametrize("side", [X, Y, 0 * X], ids=["across", "along", "none"])
def test_the_arc_between_opposed_directions_is_half_a_turn(side):
    for start in (Y, -Y, Z):
        rot = rotations.safe_arc(jnp.asarray(start), jnp.asarray(-start), jnp.asarray(side))
        assert_allclose(quat.rotate(rot, jnp.asarray(start)), -start, atol=1e-15)
        assert_allclose(np.linalg.norm(rot), 1.0, atol=1e-15)


@few
@given(limbs(numbers(0.1, 3.0)), st.floats(0.05, 0.95))
def test_the_hinge_puts_hip_and_ankle_the_wanted_distance_apart(limb, fraction):
    to_hip, to_ankle, hinge = map(jnp.asarray, limb)
    thigh, shin = np.linalg.norm(to_hip), np.linalg.norm(to_ankle)
    reach = abs(thigh - shin) + fraction * (thigh + shin - abs(thigh - shin))
    half = hinge_half_angle(to_hip, to_ankle, hinge, jnp.asarray(reach))
    ankle = quat.rotate(quat.from_half_angle(hinge, *half), to_ankle)
    assert_allclose(np.linalg.norm(ankle - to_hip), reach, atol=1e-12)


@few
@given(vectors((1.0,)), vectors((1.0,)), vectors((1.0,)), numbers(-3, 3))
def test_gradients_of_a_swing_match_finite_differences(bent, to_target, hinge, twist):
    hinge = hinge / np.linalg.norm(hinge)
    aims = [v / np.linalg.norm(v) for v in (bent, to_target)]
    assume(aims[0] @ aims[1] > -0.99)
    assume(max(abs(aims[0] @ hinge), abs(aims[1] @ hinge)) < 0.99)
    assert_gradients_match(axes_after_swing, bent, to_target, hinge, twist)


@few
@given(limbs(numbers(0.1, 3.0)), st.floats(0.2, 0.9))
def test_gradients_of_a_knee_match_finite_differences(limb, fraction):
    to_hip, to_ankle, hinge = limb
    thigh, shin = np.linalg.norm(to_hip), np.linalg.norm(to_ankle)
    reach = abs(thigh - shin) + fraction * (thigh + shin - abs(thigh - shin))
    assert_gradients_match(hinge_half_angle, to_hip, to_ankle, hinge, reach)


@pytest.mark.parametrize("seed", range(8))
def test_a_hinge_that_is_not_square_to_the_bones_puts_them_the_wanted_distance_apart(seed):
    rng = np.random.default_rng(seed)
    to_hip, to_ankle = rng.uniform(-0.5, 0.5, (2, 3))
    hinge = rng.normal(size=3)
    hinge /= np.linalg.norm(hinge)
    turned = Rotation.from_rotvec(rng.uniform(-3, 3) * hinge).apply(to_ankle)
    reach = np.linalg.norm(turned - to_hip)  # so that some angle does it
    half = hinge_half_angle(*map(jnp.asarray, (to_hip, to_ankle, hinge, reach)))
    ankle = quat.rotate(quat.from_half_angle(jnp.asarray(hinge), *half), jnp.asarray(to_ankle))
    assert_allclose(np.linalg.norm(ankle - to_hip), reach, atol=1e-9)


def test_gradients_are_finite_where_a_swing_or_a_knee_has_no_single_answer():
    swings = ((X, -X, Y), (X, -X, X), (X, Y, X), (X, Y, Y), (X, X, X), (0 * X, Y, Z))
    for bent, target, hinge in swings:
        finite_jacobian(two_bone.swing_rotation, bent, target, hinge, 0.3)
    for hip, ankle, hinge in ((X, -X, Y), (X, X, Y), (X, Y, X), (0 * X, Y, Z), (X, Y, Z)):
        for reach in (0.0, 1.0, 2.0, 3.0):
            finite_jacobian(hinge_half_angle, hip, ankle, hinge, reach)


@few
@given(limbs(numbers(0.1, 3.0)))
def test_a_limb_straight_to_within_rounding_has_no_gradient_in_its_reach(limb):
    to_hip, to_ankle, hinge = limb
    full = np.linalg.norm(to_hip) + np.linalg.norm(to_ankle)
    for reach in (full, np.nextafter(full, 0.0), np.nextafter(full, 9.0)):
        args = [jnp.asarray(x) for x in (to_hip, to_ankle, hinge, reach)]
        gradient = jax.jacfwd(hinge_half_angle, argnums=3)(*args)
        np.testing.assert_array_equal(gradient, 0.0)


@pytest.mark.parametrize("hinge", [X, Z, (X + 2.0 * Z) / np.sqrt(5.0)], ids=["x", "z", "between"])
def test_a_limb_that_is_turned_upside_down_turns_about_its_hinge(hinge):
    rot = two_bone.swing_rotation(*map(jnp.asarray, (Y, -Y, hinge, 0.0)))
    assert_allclose(quat.rotate(rot, jnp.asarray(Y)), -Y, atol=1e-12)
    assert_allclose(quat.rotate(rot, jnp.asarray(hinge)), hinge, atol=1e-12)
