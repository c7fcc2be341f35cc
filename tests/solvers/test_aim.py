"""Aiming joints: the ray passes through its target, up turns to the pole, limits, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat
from jaxik.maths.gate import HARD, AbstractGate, Smooth
from jaxik.solvers import aim
from jaxik.solvers.pole import PoleTarget
from support.gradients import (
    TINY,
    assert_gradients_match,
    finite_jacobian,
    numbers,
    quaternions,
    vectors,
)

few = settings(max_examples=20, derandomize=True, deadline=None)
X, Y, Z = np.eye(3)
ZERO, NO_TWIST = np.zeros(3), np.float64(0.0)


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


def unit(v):
    return v / np.linalg.norm(v)


def projected(v, direction):
    """Direction of `v` seen along another; None where that is ill-conditioned."""
    across = v - (v @ direction) * direction
    length = np.linalg.norm(across)
    return across / length if length > 1e-2 * np.linalg.norm(v) else None


@few
@given(vectors((1.0, 3.0)), vectors(), vectors((0.2, 0.0)), vectors(), vectors(), numbers(-3, 3))
def test_the_ray_passes_through_its_target_and_up_turns_to_the_pole(
    target, forward, offset, up, pole, twist
):
    forward = unit(forward)
    rot, reached = aimed(target, forward, offset, up, pole, NO_TWIST)
    beside = offset - (offset @ forward) * forward
    assert reached == (np.linalg.norm(target) >= np.linalg.norm(beside))
    if not reached:
        return
    assert_allclose(np.linalg.norm(rot), 1.0, atol=1e-14)
    start, along, rotated_up = (
        np.asarray(quat.rotate(rot, jnp.asarray(v))) for v in (offset, forward, up)
    )
    onward = (target - start) @ along
    assert_allclose(start + onward * along, target, atol=1e-7)

    expected = projected(pole, unit(target))
    actual = projected(rotated_up, unit(target))
    if expected is not None and actual is not None:
        assert_allclose(actual, expected, atol=1e-7)

    twisted, _ = aimed(target, forward, offset, up, pole, np.float64(twist))
    twist_rot = quat.from_axis_angle(jnp.asarray(unit(target)), jnp.asarray(twist))
    assert_allclose(quat.angle(quat.multiply(twist_rot, rot), twisted), 0.0, atol=1e-12)


@few
@given(vectors((1.0, 3.0)), vectors((0.2, 0.0)), vectors())
def test_a_joint_that_already_looks_at_its_target_does_not_rotate(forward, offset, up):
    forward = unit(forward)
    rot, reached = aimed(offset + 2.0 * forward, forward, offset, up, up, NO_TWIST)
    assert reached == 1
    assert_allclose(rot, quat.identity(jnp.float64), atol=1e-12)


@few
@given(vectors((1.0,)), vectors((0.2,)), vectors(), vectors(), quaternions(), numbers(-3, 3))
def test_rotating_the_task_rotates_the_result(target, offset, up, pole, world_rot, twist):
    world = Rotation.from_quat(world_rot, scalar_first=True)
    task = target, unit(Y + 0.3 * X), offset, up, pole
    original, _ = aimed(*task, np.float64(twist))
    rotated, _ = aimed(*map(world.apply, task), np.float64(twist))
    q = jnp.asarray(world_rot)
    expected = quat.multiply(q, quat.multiply(original, quat.conjugate(q)))
    if projected(pole, unit(target)) is not None:
        rotated_up = np.asarray(quat.rotate(original, jnp.asarray(up)))
        if projected(rotated_up, unit(target)) is not None:
            assert_allclose(quat.angle(rotated, expected), 0.0, atol=1e-7)


def test_a_ray_that_passes_the_joint_farther_away_than_the_target_does_not_reach_it():
    for height, expected in ((0.5, 1), (1.0, 1), (1.001, 0), (2.0, 0)):
        rot, reached = aimed(X, X, height * Y, Y, Y, np.float64(0.4))
        assert reached == expected
        if not reached:
            assert_allclose(rot, quat.identity(jnp.float64), atol=0)
        _, smooth = aim_rotation(X, X, height * Y, Y, Y, NO_TWIST, Smooth(0.1))
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


@pytest.mark.parametrize("seed", range(5))
def test_gradients_match_finite_differences(seed):
    rng = np.random.default_rng(seed)
    target, forward, offset, up, pole = rng.normal(size=(5, 3))
    target = rng.uniform(0.7, 2.0) * unit(target)
    assert_gradients_match(axes, target, forward, 0.2 * offset, up, pole, rng.uniform(-3, 3))


@pytest.mark.parametrize("case", SINGULAR.values(), ids=SINGULAR.keys())
def test_gradients_are_finite_where_a_joint_has_no_single_answer(case):
    finite_jacobian(axes, *case, 0.3)


def test_gradients_are_finite_there_in_single_precision_too():
    cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
    batch = [jnp.asarray(np.stack(x), jnp.float32) for x in zip(*cases, strict=True)]
    results, vjp = jax.vjp(axes, *batch)
    # A gradient that is not finite makes a sum of gradients not finite either.
    gradients = vjp(jax.tree.map(jnp.ones_like, results))
    for leaf in jax.tree.leaves((results, gradients)):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_gradients_are_finite_through_a_smooth_gate():
    def smooth(*case):
        rot, reached = aim_rotation(*case, gate=Smooth(1.0))
        return quat.rotate(rot, jnp.asarray(X)), reached

    for case in SINGULAR.values():
        finite_jacobian(smooth, *case, 0.3)


@pytest.mark.slow
def test_a_compiled_batch_equals_single_calls_in_either_precision():
    cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
    for dtype, tolerance in ((jnp.float64, 1e-14), (jnp.float32, 1e-6)):
        batch = [jnp.asarray(np.stack(x), dtype) for x in zip(*cases, strict=True)]
        rots, all_reached = aimed(*batch)
        assert rots.dtype == all_reached.dtype == dtype
        for i in range(4):
            rot, reached = aimed(*(x[i] for x in batch))
            assert_allclose(rot, rots[i], atol=tolerance)
            assert reached == all_reached[i]


@pytest.mark.slow
def test_targets_broadcast_against_one_joint():
    targets = np.broadcast_to(X + Y, (3, 2, 3))
    rot, reached = aim_rotation(targets, X, ZERO, Y, Y, 0.3)
    assert rot.shape == (3, 2, 4) and reached.shape == (3, 2)
