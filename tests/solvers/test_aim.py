"""Joints that aim: the ray meets its target, up seeks the pole, stated answers, slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat
from jaxik.maths.gate import HARD, Smooth
from jaxik.solvers import aim
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
NOWHERE, LEVEL = np.zeros(3), np.float64(0.0)


@jax.jit
def aimed(to_target, forward, offset, up, pole, twist):
    """The turn, and whether the target is reached."""
    args = map(jnp.asarray, (to_target, forward, offset, up, pole, twist))
    return aim.aim_rotation(*args, gate=HARD)


def axes(to_target, forward, *rest):
    """Three axes of the turned joint: free of a quaternion's choice of sign."""
    unit = jnp.asarray(forward) / jnp.linalg.norm(forward, axis=-1, keepdims=True)
    turn, _ = aimed(to_target, unit, *rest)
    return tuple(quat.rotate(turn, jnp.asarray(axis, turn.dtype)) for axis in (X, Y))


def normed(v):
    return v / np.linalg.norm(v)


def seen(v, direction):
    """Direction of `v`, seen along another; None where that is ill-conditioned."""
    across = v - (v @ direction) * direction
    length = np.linalg.norm(across)
    return across / length if length > 1e-2 * np.linalg.norm(v) else None


@few
@given(vectors((1.0, 3.0)), vectors(), vectors((0.2, 0.0)), vectors(), vectors(), numbers(-3, 3))
def test_the_ray_meets_its_target_and_up_seeks_the_pole(target, forward, offset, up, pole, twist):
    forward = normed(forward)
    turn, reached = aimed(target, forward, offset, up, pole, LEVEL)
    beside = offset - (offset @ forward) * forward
    assert reached == (np.linalg.norm(target) >= np.linalg.norm(beside))
    if not reached:
        return
    assert_allclose(np.linalg.norm(turn), 1.0, atol=1e-14)
    start, along, lifted = (
        np.asarray(quat.rotate(turn, jnp.asarray(v))) for v in (offset, forward, up)
    )
    onward = (target - start) @ along
    assert_allclose(start + onward * along, target, atol=1e-7)

    wanted = seen(pole, normed(target))
    got = seen(lifted, normed(target))
    if wanted is not None and got is not None:
        assert_allclose(got, wanted, atol=1e-7)

    twisted, _ = aimed(target, forward, offset, up, pole, np.float64(twist))
    about = quat.from_axis_angle(jnp.asarray(normed(target)), jnp.asarray(twist))
    assert_allclose(quat.angle(quat.multiply(about, turn), twisted), 0.0, atol=1e-12)


@few
@given(vectors((1.0, 3.0)), vectors((0.2, 0.0)), vectors())
def test_a_joint_that_looks_at_its_target_stays(forward, offset, up):
    forward = normed(forward)
    turn, reached = aimed(offset + 2.0 * forward, forward, offset, up, up, LEVEL)
    assert reached == 1
    assert_allclose(turn, quat.identity(jnp.float64), atol=1e-12)


@few
@given(vectors((1.0,)), vectors((0.2,)), vectors(), vectors(), quaternions(), numbers(-3, 3))
def test_turning_the_target_s_world_turns_the_answer(target, offset, up, pole, turn, twist):
    world = Rotation.from_quat(turn, scalar_first=True)
    task = target, normed(Y + 0.3 * X), offset, up, pole
    here, _ = aimed(*task, np.float64(twist))
    there, _ = aimed(*map(world.apply, task), np.float64(twist))
    around = jnp.asarray(turn)
    carried = quat.multiply(around, quat.multiply(here, quat.conjugate(around)))
    if seen(pole, normed(target)) is not None:
        up_here = np.asarray(quat.rotate(here, jnp.asarray(up)))
        if seen(up_here, normed(target)) is not None:
            assert_allclose(quat.angle(there, carried), 0.0, atol=1e-7)


def test_the_line_may_pass_beside_the_joint_no_farther_than_the_target_is():
    for height, reached in ((0.5, 1), (1.0, 1), (1.001, 0), (2.0, 0)):
        turn, found = aimed(X, X, height * Y, Y, Y, np.float64(0.4))
        assert found == reached
        if not reached:
            assert_allclose(turn, quat.identity(jnp.float64), atol=0)
        args = map(jnp.asarray, (X, X, height * Y, Y, Y, LEVEL))
        smooth = aim.aim_rotation(*args, gate=Smooth(0.1))[1]
        assert (smooth >= 0.5) == reached


def test_a_target_on_the_joint_turns_nothing():
    turn, reached = aimed(NOWHERE, X, NOWHERE, Y, Z, np.float64(0.4))
    assert_allclose(turn, quat.identity(jnp.float64), atol=0)
    assert reached == 1  # as ozz has it: the ray starts at the target
    assert aimed(NOWHERE, X, 0.1 * Y, Y, Z, LEVEL)[1] == 0


@pytest.mark.parametrize(
    ("up", "pole"), [(Y, NOWHERE), (NOWHERE, Y), (Y, Z), (Y, -Z), (X, Y)], ids=str
)
def test_without_a_pole_or_an_up_seen_along_the_target_the_arc_is_the_shortest(up, pole):
    # Up along x comes to lie along the target, z; the poles along z do from the start.
    turn, reached = aimed(2.0 * Z, X, NOWHERE, up, pole, LEVEL)
    direct = quat.shortest_arc(jnp.asarray(X), jnp.asarray(Z), jnp.asarray(Y))
    assert_allclose(turn, direct, atol=1e-14)
    assert reached == 1


@pytest.mark.parametrize("up", [Y, Z, NOWHERE], ids=str)
def test_a_target_behind_is_met_by_half_a_turn(up):
    for forward in np.concatenate([np.eye(3), -np.eye(3)]):
        turn, _ = aimed(-forward, forward, NOWHERE, up, up, LEVEL)
        assert_allclose(quat.rotate(turn, jnp.asarray(forward)), -forward, atol=1e-15)
        assert_allclose(np.linalg.norm(turn), 1.0, atol=1e-15)


SINGULAR = {
    "nothing to do": (X, X, NOWHERE, Y, Y),
    "nearly nothing": (X + TINY * Z, X, NOWHERE, Y, Y + TINY * Z),
    "target on the joint": (NOWHERE, X, NOWHERE, Y, Z),
    "target beside the joint": (TINY * Z, X, NOWHERE, Y, Y),
    "target behind": (-X, X, NOWHERE, Y, Y),
    "target nearly behind": (-X + TINY * Y, X, NOWHERE, Y, Y),
    "target behind along up": (-Y, Y, NOWHERE, Y, X),
    "ray that just reaches": (X, X, Y, Y, Z),
    "ray that passes": (X, X, 1.5 * Y, Y, Z),
    "ray that starts at the target": (X, X, X, Y, Z),
    "ray that starts on the joint's far side": (X, X, -3.0 * X, Y, Z),
    "pole along the target": (Y, X, NOWHERE, X, Y),
    "pole nearly along the target": (Y, X, NOWHERE, Z, Y + TINY * Z),
    "no pole": (Y, X, NOWHERE, Z, NOWHERE),
    "no up": (Y, X, NOWHERE, NOWHERE, Z),
    "up along the ray": (Y, X, NOWHERE, X, Z),
    "pole opposed to up": (X, X, NOWHERE, Y, -Y),
}


@pytest.mark.parametrize("seed", range(5))
def test_slopes_are_those_of_finite_differences(seed):
    rng = np.random.default_rng(seed)
    target, forward, offset, up, pole = rng.normal(size=(5, 3))
    target = rng.uniform(0.7, 2.0) * normed(target)
    assert_gradients_match(axes, target, forward, 0.2 * offset, up, pole, rng.uniform(-3, 3))


@pytest.mark.parametrize("case", SINGULAR.values(), ids=SINGULAR.keys())
def test_slopes_are_finite_where_a_joint_has_no_single_answer(case):
    finite_jacobian(axes, *case, 0.3)


def test_slopes_are_finite_there_in_single_precision_too():
    cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
    batch = [jnp.asarray(np.stack(x), jnp.float32) for x in zip(*cases, strict=True)]
    answers, pull = jax.vjp(axes, *batch)
    # What is not finite in one slope is not finite in a sum of slopes either.
    slopes = pull(jax.tree.map(jnp.ones_like, answers))
    for leaf in jax.tree.leaves((answers, slopes)):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_slopes_are_finite_through_a_smooth_gate():
    def smooth(*case):
        turn, reached = aim.aim_rotation(*map(jnp.asarray, case), gate=Smooth(1.0))
        return quat.rotate(turn, jnp.asarray(X)), reached

    for case in SINGULAR.values():
        finite_jacobian(smooth, *case, 0.3)


@pytest.mark.slow
def test_a_compiled_batch_is_many_singles_in_either_precision():
    cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
    for dtype, tolerance in ((jnp.float64, 1e-14), (jnp.float32, 1e-6)):
        batch = [jnp.asarray(np.stack(x), dtype) for x in zip(*cases, strict=True)]
        turns, reached = aimed(*batch)
        assert turns.dtype == reached.dtype == dtype
        for i in range(4):
            turn, found = aimed(*(x[i] for x in batch))
            assert_allclose(turn, turns[i], atol=tolerance)
            assert found == reached[i]


@pytest.mark.slow
def test_targets_are_broadcast_against_one_joint():
    target = jnp.asarray(np.broadcast_to(X + Y, (3, 2, 3)))
    x, y, nowhere = (jnp.asarray(v) for v in (X, Y, NOWHERE))
    turn, reached = aim.aim_rotation(target, x, nowhere, y, y, jnp.asarray(0.3), HARD)
    assert turn.shape == (3, 2, 4) and reached.shape == (3, 2)
