"""A knee that opens and a hip that swings: their gradients, regular and singular."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat
from jaxik.solvers import rotations, two_bone
from support.gradients import (
    ROWS,
    assert_all_gradients_match,
    finite_jacobians,
    limbs,
    unit,
    vectors,
)

X, Y, Z = np.eye(3)
RNG = np.random.default_rng(0)


def axes_after_swing(bent, to_target, hinge, twist):
    """Rotated axes: independent of the sign of a quaternion."""
    return quat.axes(two_bone.swing_rotation(bent, to_target, hinge, twist))


def hinge_half_angle(to_hip, to_ankle, hinge, reach):
    return two_bone.hinge_half_angle(two_bone.Limb(to_hip, to_ankle, hinge), reach)


def reaches(to_hip, to_ankle, fraction):
    """Distances of hip and ankle, by the fraction of the way from folded to straight."""
    thigh, shin = (np.linalg.norm(v, axis=-1) for v in (to_hip, to_ankle))
    return np.abs(thigh - shin) + fraction * (thigh + shin - np.abs(thigh - shin))


@pytest.mark.parametrize("side", [X, Y, 0 * X], ids=["across", "along", "none"])
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


def test_gradients_match_finite_differences():
    bent, target, hinge = (unit(vectors(RNG, 1.0)) for _ in range(3))
    along = np.maximum(np.abs(np.vecdot(bent, hinge)), np.abs(np.vecdot(target, hinge)))
    regular = (np.vecdot(bent, target) > -0.99) & (along < 0.99)
    swing = bent, target, hinge, RNG.uniform(-3, 3, ROWS)
    assert_all_gradients_match(axes_after_swing, *(x[regular] for x in swing))
    to_hip, to_ankle, hinge = limbs(RNG, RNG.uniform(0.1, 3.0, ROWS))
    reach = reaches(to_hip, to_ankle, RNG.uniform(0.2, 0.9, ROWS))
    assert_all_gradients_match(hinge_half_angle, to_hip, to_ankle, hinge, reach)


def test_gradients_are_finite_where_a_swing_or_a_knee_has_no_single_answer():
    swings = ((X, -X, Y), (X, -X, X), (X, Y, X), (X, Y, Y), (X, X, X), (0 * X, Y, Z))
    finite_jacobians(axes_after_swing, *np.stack(swings, axis=1), 0.3)
    knees = ((X, -X, Y), (X, X, Y), (X, Y, X), (0 * X, Y, Z), (X, Y, Z))
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
