"""Quaternions: agreement with SciPy's rotations, limits, gradients."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from jaxik.maths import quat, vec
from support.gradients import (
    ROWS,
    TINY,
    angles,
    assert_all_gradients_match,
    directions,
    finite_jacobian,
    quaternions,
    vectors,
)

IDENTITY, HALF_TURN = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.0, 0.8])
RNG = np.random.default_rng(1)
P, Q, R = (quaternions(RNG) for _ in range(3))
V = vectors(RNG, 1.0, TINY, 0.0)
AXIS, *_ = directions(RNG)
ANGLE = angles(RNG, 1e-9)
WEIGHT = RNG.uniform(0, 1, ROWS)


def scipy(q) -> Rotation:
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


def assert_same_rotation(q, expected: Rotation, tolerance: float = 1e-12) -> None:
    """Asserts that `q` has length one and is the expected rotation, whatever its sign."""
    assert_allclose(np.linalg.norm(q, axis=-1), 1.0, atol=tolerance)
    expected_q = expected.as_quat(scalar_first=True)
    sign = np.sign(np.vecdot(q, expected_q))[..., None]
    assert_allclose(q * sign, expected_q, atol=tolerance)


def test_the_identity_rotates_nothing_in_either_precision():
    for dtype in (jnp.float32, jnp.float64):
        identity = quat.identity(dtype)
        assert identity.dtype == dtype
        assert_allclose(quat.rotate(identity, jnp.asarray(V, dtype)), jnp.asarray(V, dtype), atol=0)


def test_one_rotation_broadcasts_against_a_batch_of_vectors():
    rotated = quat.rotate(jnp.asarray(Q[0]), jnp.asarray(V))
    assert_allclose(rotated, scipy(Q[0]).apply(V), atol=1e-14)
    assert quat.multiply(jnp.asarray(Q)[:, None], jnp.asarray(P)).shape == (ROWS, ROWS, 4)


def test_products_inverses_axes_and_rotated_vectors_agree_with_scipy():
    p, q, v = map(jnp.asarray, (P, Q, V))
    assert_same_rotation(quat.multiply(p, q), scipy(P) * scipy(Q))
    assert_same_rotation(quat.conjugate(q), scipy(Q).inv())
    assert_allclose(quat.rotate(q, v), scipy(Q).apply(V), atol=1e-14)
    assert_allclose(quat.unrotate(q, v), scipy(Q).inv().apply(V), atol=1e-14)
    assert_allclose(quat.angle(p, q), (scipy(P).inv() * scipy(Q)).magnitude(), atol=1e-12)
    assert_allclose(quat.stack(*quat.components(q)), Q, atol=0)
    assert_allclose(np.stack(quat.axes(q), axis=-1), scipy(Q).as_matrix(), atol=1e-14)


def test_rotations_form_a_group_that_acts_on_vectors():
    p, q, r, v = map(jnp.asarray, (P, Q, R, V))
    pq = quat.multiply(p, q)
    assert_allclose(quat.multiply(pq, r), quat.multiply(p, quat.multiply(q, r)), atol=1e-14)
    assert_allclose(quat.multiply(q, quat.conjugate(q)), np.tile(IDENTITY, (ROWS, 1)), atol=1e-14)
    assert_allclose(quat.multiply(q, quat.identity(q.dtype)), q, atol=0)
    assert_allclose(quat.rotate(pq, v), quat.rotate(p, quat.rotate(q, v)), atol=1e-14)
    assert_allclose(quat.rotate(q, v), quat.rotate(-q, v), atol=0)
    assert_allclose(quat.unrotate(q, quat.rotate(q, v)), v, atol=1e-14)


def test_rotations_about_an_axis_agree_with_scipy():
    axis, angle = jnp.asarray(AXIS), jnp.asarray(ANGLE)
    expected = Rotation.from_rotvec(ANGLE[:, None] * AXIS)
    assert_same_rotation(quat.from_axis_angle(axis, angle), expected)
    assert_same_rotation(quat.from_rotvec(jnp.asarray(ANGLE[:, None] * AXIS)), expected)
    assert_same_rotation(quat.from_cos_sin(axis, jnp.cos(angle), jnp.sin(angle)), expected)


def test_a_half_angle_is_exact_and_its_cosine_is_not_negative():
    half_cos, half_sin = quat.half_angle(jnp.cos(ANGLE), jnp.sin(ANGLE))
    assert (half_cos >= 0).all()
    assert_allclose(half_cos, np.cos(ANGLE / 2), atol=1e-15)
    assert_allclose(half_sin, np.sin(ANGLE / 2), atol=1e-15)
    assert quat.half_angle(jnp.asarray(-1.0), jnp.asarray(0.0)) == (0.0, 1.0)


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-12, 1e-6, 1.2e-4, 1.3e-4, 1e-2])
def test_small_rotation_vectors_are_exact_on_both_sides_of_the_taylor_series(size):
    v = size * np.array([0.6, 0.0, 0.8])
    expected = [np.cos(size / 2), *(v * np.sinc(size / 2 / np.pi) / 2)]
    assert_allclose(quat.from_rotvec(jnp.asarray(v)), expected, rtol=1e-14)
    finite_jacobian(quat.from_rotvec, v)


def test_an_arc_takes_one_direction_to_the_other_the_shortest_way():
    a, b, axis = map(jnp.asarray, directions(RNG, 1e-9))
    q = quat.shortest_arc(a, b, axis)
    assert_allclose(jnp.linalg.norm(q, axis=-1), 1.0, atol=1e-12)
    assert_allclose(quat.rotate(q, a), b, atol=1e-7)
    assert_allclose(np.vecdot(q[:, 1:], np.add(a, b)), 0, atol=1e-12)  # no twist
    between = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.vecdot(a, b))
    assert_allclose(quat.angle(q, quat.identity()), between, atol=1e-7)


def test_an_arc_between_opposed_directions_is_half_a_turn_about_the_fallback_with_zero_gradient():
    a, axis = np.eye(3)[0], np.eye(3)[1]
    assert_allclose(quat.shortest_arc(*map(jnp.asarray, (a, -a, axis))), [0, *axis], atol=0)
    assert_allclose(finite_jacobian(quat.shortest_arc, a, -a, axis)[:, :6], 0, atol=0)


def test_an_arc_in_single_precision_has_length_one_and_errs_by_a_millimetre_per_metre():
    a, b, axis = (jnp.asarray(v, jnp.float32) for v in directions(RNG, 1e-4))
    q = quat.shortest_arc(a, b, axis)
    assert_allclose(jnp.linalg.norm(q, axis=-1), 1.0, atol=1e-6)
    assert_allclose(quat.rotate(q, a), b, atol=1e-3)


def test_normalizing_keeps_the_rotation():
    for size in (1e-9, 1e-3, 1.0, 1e6):
        assert_allclose(quat.normalize(jnp.asarray(size * Q)), Q, atol=1e-14)


def test_a_zero_quaternion_becomes_the_identity_with_zero_gradient():
    assert_allclose(quat.normalize(jnp.zeros((2, 4))), [IDENTITY] * 2, atol=0)
    assert_allclose(finite_jacobian(quat.normalize, np.zeros(4)), 0, atol=0)


def test_nlerp_starts_at_one_rotation_ends_at_the_other_and_meets_slerp_half_way():
    p, q = jnp.asarray(P), jnp.asarray(Q)
    start, middle, end = (quat.nlerp(p, q, jnp.asarray(weight)) for weight in (0.0, 0.5, 1.0))
    assert_same_rotation(start, scipy(P))
    assert_same_rotation(end, scipy(Q))
    for row in np.flatnonzero(np.abs(np.vecdot(P, Q)) > 1e-6):  # else both ways are equally short
        slerp = Slerp([0, 1], scipy(np.stack([P[row], Q[row]])))
        assert_same_rotation(middle[row], slerp(0.5), 1e-8)


def test_scaling_a_rotation_equals_nlerp_from_the_identity():
    axis, q, weight, angle = map(jnp.asarray, (AXIS, Q, WEIGHT, ANGLE))
    expected = quat.nlerp(quat.identity(), q, weight)
    assert_allclose(quat.nlerp_identity(q, weight), expected, atol=1e-14)
    half = quat.half_cos_sin(angle)
    assert_allclose(
        quat.from_half_angle(axis, *quat.nlerp_half(*half, weight)),
        quat.nlerp_identity(quat.from_half_angle(axis, *half), weight),
        atol=1e-14,
    )


def products_and_vectors(p, q, v):
    products = quat.multiply(p, q), quat.rotate(q, v), quat.unrotate(q, v)
    return *products, quat.normalize(q), quat.from_rotvec(v)


def rotations_about(axis, angle, cos, sin):
    return quat.from_axis_angle(axis, angle), quat.from_cos_sin(axis, cos, sin)


def arc_between(a, b, axis):
    """The arc between the directions of vectors, so that differences stay on the unit sphere."""
    return quat.shortest_arc(vec.normalize(a, axis), vec.normalize(b, axis), axis)


def test_gradients_match_finite_differences():
    assert_all_gradients_match(products_and_vectors, P, Q, V)
    angle = RNG.uniform(-2.9, 2.9, ROWS)
    assert_all_gradients_match(rotations_about, AXIS, angle, np.cos(angle), np.sin(angle))
    about_axis = np.asarray(quat.from_axis_angle(jnp.asarray(AXIS), jnp.asarray(angle)))
    assert_all_gradients_match(quat.angle, np.tile(IDENTITY, (ROWS, 1)), about_axis)


def test_gradients_of_arcs_and_blends_match_finite_differences_where_there_is_one_way():
    a, b, axis = directions(RNG)
    apart = np.vecdot(a, b) > -1 + 1e-12
    assert_all_gradients_match(arc_between, a[apart], b[apart], axis[apart], tolerance=1e-5)
    one_way = np.abs(np.vecdot(P, Q)) > 1e-3
    assert_all_gradients_match(quat.nlerp, P[one_way], Q[one_way], WEIGHT[one_way])


@pytest.mark.parametrize("q", [IDENTITY, HALF_TURN], ids=["identity", "half a turn"])
def test_gradients_are_finite_at_the_identity_and_at_half_a_turn(q):
    assert_allclose(quat.angle(jnp.asarray(IDENTITY), jnp.asarray(q)), 0 if q[0] else np.pi)
    finite_jacobian(quat.angle, IDENTITY, q)
    finite_jacobian(quat.nlerp, IDENTITY, q, 0.5)
    finite_jacobian(quat.from_cos_sin, q[1:], 2 * q[0] ** 2 - 1, 0.0)


def test_the_angle_between_equal_rotations_is_zero_with_zero_gradient():
    for q in (Q[0], -Q[0]):
        assert_allclose(quat.angle(jnp.asarray(Q[0]), jnp.asarray(q)), 0, atol=1e-15)
    assert_allclose(finite_jacobian(quat.angle, IDENTITY, -IDENTITY), 0, atol=0)
