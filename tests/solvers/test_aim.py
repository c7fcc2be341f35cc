"""Aiming joints: the ray passes through its target, up turns to the pole, limits, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat
from jaxik.maths.gate import HARD, AbstractGate, Smooth
from jaxik.solvers import aim
from jaxik.solvers.pole import PoleTarget
from reference.sample_poses import rotation_angle
from reference.systems import ozz
from support.gradients import (
    ROWS,
    TINY,
    assert_all_gradients_match,
    assert_finite_in_single_precision,
    finite_jacobians,
    unit,
    vectors,
)

X, Y, Z = np.eye(3)
ZERO, NO_TWIST = np.zeros(3), np.float64(0.0)
RNG = np.random.default_rng(0)


def aim_rotation(to_target, forward, offset, up, pole, twist, gate: AbstractGate = HARD):
    """`aim.aim_rotation` of plain arrays."""
    arrays = map(jnp.asarray, (to_target, forward, offset, up, pole, twist))
    to_target, forward, offset, up, pole, twist = arrays
    return aim.aim_rotation(PoleTarget(to_target, pole, twist), forward, offset, up, gate)


aimed = jax.jit(aim_rotation)


def axes(to_target, forward, *rest):
    """Two axes of the rotated joint: independent of the sign of a quaternion."""
    forward = jnp.asarray(forward) / jnp.linalg.norm(forward, axis=-1, keepdims=True)
    rot, _ = aimed(to_target, forward, *rest)
    return tuple(quat.rotate(rot, jnp.asarray(axis, rot.dtype)) for axis in (X, Y))


def smooth_axis_and_reached(*case):
    rot, reached = aim_rotation(*case, gate=Smooth(1.0))
    return quat.rotate(rot, jnp.asarray(X)), reached


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
        _, smooth = aimed(X, X, height * Y, Y, Y, NO_TWIST, Smooth(0.1))
        assert (smooth >= 0.5) == expected


def test_a_target_on_the_joint_does_not_rotate_it():
    rot, reached = aimed(ZERO, X, ZERO, Y, Z, np.float64(0.4))
    assert_allclose(rot, quat.identity(jnp.float64), atol=0)
    assert reached == 1  # as in ozz: the ray starts at the target
    assert aimed(ZERO, X, 0.1 * Y, Y, Z, NO_TWIST)[1] == 0


@pytest.mark.parametrize(("up", "pole"), [(Y, ZERO), (ZERO, Y), (Y, Z), (Y, -Z), (X, Y)], ids=str)
def test_without_a_pole_or_up_across_the_target_the_arc_is_the_shortest(up, pole):
    # The arc takes up along x to the target's direction, z; the poles along z are there already.
    rot, reached = aimed(2.0 * Z, X, ZERO, up, pole, NO_TWIST)
    direct = quat.shortest_arc(jnp.asarray(X), jnp.asarray(Z), jnp.asarray(Y))
    assert_allclose(rot, direct, atol=1e-14)
    assert reached == 1


@pytest.mark.parametrize("up", [Y, Z, ZERO], ids=str)
def test_a_target_behind_the_joint_is_reached_by_half_a_turn(up):
    for forward in np.concatenate([np.eye(3), -np.eye(3)]):
        rot, _ = aimed(-forward, forward, ZERO, up, up, NO_TWIST)
        assert_allclose(quat.rotate(rot, jnp.asarray(forward)), -forward, atol=1e-15)
        assert_allclose(np.linalg.norm(rot), 1.0, atol=1e-15)


SINGULAR = {
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
SINGULAR_ROWS = [np.stack(x) for x in zip(*SINGULAR.values(), strict=True)]
TWISTS = np.full(len(SINGULAR), 0.3)


def test_gradients_match_finite_differences():
    target, forward, offset, up, pole = RNG.normal(size=(5, ROWS, 3))
    target = RNG.uniform(0.7, 2.0, (ROWS, 1)) * unit(target)
    twist = RNG.uniform(-3, 3, ROWS)
    assert_all_gradients_match(axes, target, forward, 0.2 * offset, up, pole, twist)


@pytest.mark.parametrize("function", [axes, smooth_axis_and_reached])
def test_gradients_are_finite_where_a_joint_has_no_single_answer(function):
    finite_jacobians(function, *SINGULAR_ROWS, TWISTS)


def test_gradients_are_finite_there_in_single_precision_too():
    assert_finite_in_single_precision(axes, *SINGULAR_ROWS, TWISTS)


def test_targets_broadcast_against_one_joint():
    rot, reached = jax.eval_shape(aim_rotation, jnp.zeros((3, 2, 3)), X, ZERO, Y, Y, 0.3)
    assert rot.shape == (3, 2, 4) and reached.shape == (3, 2)
