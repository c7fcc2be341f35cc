"""Quaternions: agreement with SciPy's rotations, limits, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from jaxik.maths import quat, vec
from support.gradients import (
    TINY,
    angles,
    assert_gradients_match,
    directions,
    finite_jacobian,
    numbers,
    quaternions,
    vectors,
)

few = settings(max_examples=15, derandomize=True, deadline=None)
HALF_TURN = np.array([0.0, 0.6, 0.0, 0.8])

RNG = np.random.default_rng(1)
P, Q = (q / np.linalg.norm(q, axis=-1, keepdims=True) for q in RNG.normal(size=(2, 4, 4)))
A, B, AXIS = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in RNG.normal(size=(3, 4, 3)))
ANGLE = RNG.uniform(-3, 3, size=4)
COS, SIN = np.cos(ANGLE), np.sin(ANGLE)
FUNCTIONS = {
    "components": (quat.components, (Q,)),
    "stack": (quat.stack, (COS, SIN, COS, SIN)),
    "multiply": (quat.multiply, (P, Q)),
    "conjugate": (quat.conjugate, (Q,)),
    "rotate": (quat.rotate, (Q, A)),
    "axes": (quat.axes, (Q,)),
    "unrotate": (quat.unrotate, (Q, A)),
    "dot": (quat.dot, (P, Q)),
    "normalize": (quat.normalize, (3.0 * Q,)),
    "half_angle": (quat.half_angle, (COS, SIN)),
    "half_cos_sin": (quat.half_cos_sin, (ANGLE,)),
    "from_half_angle": (quat.from_half_angle, (AXIS, COS, SIN)),
    "from_cos_sin": (quat.from_cos_sin, (AXIS, COS, SIN)),
    "from_axis_angle": (quat.from_axis_angle, (AXIS, ANGLE)),
    "from_rotvec": (quat.from_rotvec, (A,)),
    "shortest_arc": (quat.shortest_arc, (A, B, AXIS)),
    "nlerp": (quat.nlerp, (P, Q, ANGLE)),
    "nlerp_identity": (quat.nlerp_identity, (Q, ANGLE)),
    "nlerp_half": (quat.nlerp_half, (np.abs(COS), SIN, ANGLE)),
    "angle": (quat.angle, (P, Q)),
}


def products_and_vectors(p, q, v):
    """Several functions in one program: most of a test's time goes into compiling."""
    products = quat.multiply(p, q), quat.rotate(q, v), quat.unrotate(q, v)
    return *products, quat.normalize(q), quat.from_rotvec(v)


def rotations_about(axis, angle, cos, sin):
    return quat.from_axis_angle(axis, angle), quat.from_cos_sin(axis, cos, sin)


def arc_between(a, b, axis):
    """The arc between the directions of vectors, so that differences stay on the unit sphere."""
    return quat.shortest_arc(vec.normalize(a, axis), vec.normalize(b, axis), axis)


def scipy(q) -> Rotation:
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


def assert_same_rotation(q, expected: Rotation, tolerance: float = 1e-12) -> None:
    """Asserts that `q` has length one and is the expected rotation, whatever its sign."""
    assert_allclose(np.linalg.norm(q), 1.0, atol=tolerance)
    expected_q = expected.as_quat(scalar_first=True)
    assert_allclose(q * np.sign(np.dot(q, expected_q)), expected_q, atol=tolerance)


def everything(args):
    return {name: function(*args[name]) for name, (function, _) in FUNCTIONS.items()}


def test_dtype_follows_the_inputs():
    for dtype in (jnp.float32, jnp.float64):
        args = {
            name: [jnp.asarray(x, dtype) for x in args] for name, (_, args) in FUNCTIONS.items()
        }
        for name, output in jax.eval_shape(everything, args).items():
            assert {leaf.dtype for leaf in jax.tree.leaves(output)} == {jnp.dtype(dtype)}, name


def test_a_compiled_batch_equals_the_vmap_of_single_calls():
    args = {name: [jnp.asarray(x) for x in args] for name, (_, args) in FUNCTIONS.items()}
    batch, singles = jax.jit(everything)(args), jax.jit(jax.vmap(everything))(args)
    for name in FUNCTIONS:
        for actual, expected in zip(
            *map(jax.tree.leaves, (batch[name], singles[name])), strict=True
        ):
            assert_allclose(actual, expected, 1e-14, 1e-14, err_msg=name)


def test_the_identity_rotates_nothing_in_either_precision():
    for dtype in (jnp.float32, jnp.float64):
        identity = quat.identity(dtype)
        assert identity.dtype == dtype
        assert_allclose(quat.rotate(identity, jnp.asarray(A, dtype)), jnp.asarray(A, dtype), atol=0)


def test_one_rotation_broadcasts_against_a_batch_of_vectors():
    rotated = quat.rotate(jnp.asarray(Q[0]), jnp.asarray(A))
    assert_allclose(rotated, scipy(Q[0]).apply(A), atol=1e-14)
    assert quat.multiply(jnp.asarray(Q)[:, None], jnp.asarray(P)).shape == (4, 4, 4)


@few
@given(quaternions(), quaternions(), vectors((1.0, TINY, 0.0)))
def test_products_inverses_and_rotated_vectors_agree_with_scipy(p, q, v):
    jp, jq, jv = map(jnp.asarray, (p, q, v))
    assert_same_rotation(quat.multiply(jp, jq), scipy(p) * scipy(q))
    assert_same_rotation(quat.conjugate(jq), scipy(q).inv())
    assert_allclose(quat.rotate(jq, jv), scipy(q).apply(v), atol=1e-14)
    assert_allclose(quat.unrotate(jq, jv), scipy(q).inv().apply(v), atol=1e-14)
    assert_allclose(quat.angle(jp, jq), (scipy(p).inv() * scipy(q)).magnitude(), atol=1e-12)
    assert_allclose(quat.stack(*quat.components(jq)), q, atol=0)


@few
@given(quaternions(), quaternions(), quaternions(), vectors())
def test_rotations_form_a_group_that_acts_on_vectors(p, q, r, v):
    p, q, r, v = map(jnp.asarray, (p, q, r, v))
    assert_allclose(
        quat.multiply(quat.multiply(p, q), r), quat.multiply(p, quat.multiply(q, r)), atol=1e-14
    )
    assert_allclose(quat.multiply(q, quat.conjugate(q)), quat.identity(), atol=1e-14)
    assert_allclose(quat.multiply(q, quat.identity(q.dtype)), q, atol=0)
    assert_allclose(
        quat.rotate(quat.multiply(p, q), v), quat.rotate(p, quat.rotate(q, v)), atol=1e-14
    )
    assert_allclose(quat.rotate(q, v), quat.rotate(-q, v), atol=0)
    assert_allclose(quat.unrotate(q, quat.rotate(q, v)), v, atol=1e-14)


@few
@given(directions(), angles(1e-9))
def test_rotations_about_an_axis_agree_with_scipy(pair, angle):
    axis, jangle = pair[0], jnp.asarray(angle)
    expected = Rotation.from_rotvec(angle * axis)
    assert_same_rotation(quat.from_axis_angle(jnp.asarray(axis), jangle), expected)
    assert_same_rotation(quat.from_rotvec(jnp.asarray(angle * axis)), expected)
    cos, sin = jnp.cos(jangle), jnp.sin(jangle)
    assert_same_rotation(quat.from_cos_sin(jnp.asarray(axis), cos, sin), expected)


@few
@given(angles(1e-9))
def test_a_half_angle_is_exact_and_its_cosine_is_not_negative(angle):
    half_cos, half_sin = quat.half_angle(jnp.cos(angle), jnp.sin(angle))
    assert half_cos >= 0
    assert_allclose(half_cos, np.cos(angle / 2), atol=1e-15)
    assert_allclose(half_sin, np.sin(angle / 2), atol=1e-15)


def test_the_half_angle_of_pi_is_plus_half_pi():
    half_cos, half_sin = quat.half_angle(jnp.asarray(-1.0), jnp.asarray(0.0))
    assert (half_cos, half_sin) == (0.0, 1.0)


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-12, 1e-6, 1.2e-4, 1.3e-4, 1e-2])
def test_small_rotation_vectors_are_exact_on_both_sides_of_the_taylor_series(size):
    v = size * np.array([0.6, 0.0, 0.8])
    assert_allclose(
        quat.from_rotvec(jnp.asarray(v)), [np.cos(size / 2), *(v * np.sinc(size / 2 / np.pi) / 2)],
        rtol=1e-14,
    )  # fmt: skip
    assert jnp.isfinite(jnp.asarray(finite_jacobian(quat.from_rotvec, v))).all()


@few
@given(directions(1e-9))
def test_an_arc_takes_one_direction_to_the_other_the_shortest_way(pair):
    a, b, axis = map(jnp.asarray, pair)
    q = quat.shortest_arc(a, b, axis)
    assert_allclose(jnp.linalg.norm(q), 1.0, atol=1e-12)
    assert_allclose(quat.rotate(q, a), b, atol=1e-7)
    assert_allclose(quat.dot(q, jnp.asarray([0.0, *np.add(a, b)])), 0, atol=1e-12)  # no twist
    assert_allclose(
        quat.angle(q, quat.identity()), np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b), atol=1e-7
    )


def test_an_arc_between_opposed_directions_is_half_a_turn_about_the_fallback_with_zero_gradient():
    a, axis = np.eye(3)[0], np.eye(3)[1]
    assert_allclose(quat.shortest_arc(*map(jnp.asarray, (a, -a, axis))), [0, *axis], atol=0)
    assert_allclose(finite_jacobian(quat.shortest_arc, a, -a, axis)[:, :6], 0, atol=0)


@few
@given(directions(1e-4))
def test_an_arc_in_single_precision_has_length_one_and_errs_by_a_millimetre_per_metre(pair):
    a, b, axis = (jnp.asarray(v, jnp.float32) for v in pair)
    q = quat.shortest_arc(a, b, axis)
    assert_allclose(jnp.linalg.norm(q), 1.0, atol=1e-6)
    assert_allclose(quat.rotate(q, a), b, atol=1e-3)


@few
@given(quaternions(), st.sampled_from([1e-9, 1e-3, 1.0, 1e6]))
def test_normalizing_keeps_the_rotation(q, size):
    assert_allclose(quat.normalize(jnp.asarray(size * q)), q, atol=1e-14)


def test_a_zero_quaternion_becomes_the_identity_with_zero_gradient():
    assert_allclose(quat.normalize(jnp.zeros((2, 4))), [[1, 0, 0, 0]] * 2, atol=0)
    assert_allclose(finite_jacobian(quat.normalize, np.zeros(4)), 0, atol=0)


@few
@given(quaternions(), quaternions())
def test_nlerp_starts_at_one_rotation_ends_at_the_other_and_meets_slerp_half_way(p, q):
    jp, jq = jnp.asarray(p), jnp.asarray(q)
    assert_same_rotation(quat.nlerp(jp, jq, jnp.asarray(0.0)), scipy(p))
    assert_same_rotation(quat.nlerp(jp, jq, jnp.asarray(1.0)), scipy(q))
    if abs(np.dot(p, q)) > 1e-6:  # half a turn apart, both ways are equally short
        middle = Slerp([0, 1], Rotation.concatenate([scipy(p), scipy(q)]))(0.5)
        assert_same_rotation(quat.nlerp(jp, jq, jnp.asarray(0.5)), middle, 1e-8)


@few
@given(quaternions(), directions(), numbers(-3, 3), numbers(0, 1))
def test_scaling_a_rotation_equals_nlerp_from_the_identity(q, pair, angle, weight):
    axis, weight = jnp.asarray(pair[0]), jnp.asarray(weight)
    identity = quat.identity()
    assert_allclose(
        quat.nlerp_identity(jnp.asarray(q), weight),
        quat.nlerp(identity, jnp.asarray(q), weight),
        atol=1e-14,
    )
    half = quat.half_cos_sin(jnp.asarray(angle))
    assert_allclose(
        quat.from_half_angle(axis, *quat.nlerp_half(*half, weight)),
        quat.nlerp_identity(quat.from_half_angle(axis, *half), weight),
        atol=1e-14,
    )


@few
@given(quaternions())
def test_the_axes_are_the_columns_of_the_matrix(q):
    assert_allclose(np.stack(quat.axes(jnp.asarray(q)), axis=-1), scipy(q).as_matrix(), atol=1e-14)


@few
@given(quaternions(), quaternions(), vectors((1.0, TINY, 0.0)))
def test_gradients_of_products_and_rotated_vectors_match_finite_differences(p, q, v):
    assert_gradients_match(products_and_vectors, p, q, v)


@few
@given(directions(), numbers(-2.9, 2.9))
def test_gradients_of_rotations_about_an_axis_match_finite_differences(pair, angle):
    assert_gradients_match(rotations_about, pair[0], angle, np.cos(angle), np.sin(angle))


@few
@given(directions(opposed=False))
def test_gradients_of_arcs_match_finite_differences(pair):
    assert_gradients_match(arc_between, *pair, tolerance=1e-5)


@few
@given(directions(), numbers(-3, 3))
def test_gradients_of_the_angle_between_rotations_match_finite_differences(pair, angle):
    q = np.asarray(quat.from_axis_angle(jnp.asarray(pair[0]), jnp.asarray(angle)))
    assert_gradients_match(quat.angle, np.array([1.0, 0, 0, 0]), q)


@few
@given(quaternions(), quaternions().filter(lambda q: abs(q[0]) > 1e-3), numbers(0, 1))
def test_gradients_of_blends_match_finite_differences(p, difference, weight):
    q = np.asarray(quat.multiply(jnp.asarray(p), jnp.asarray(difference)))
    assert_gradients_match(quat.nlerp, p, q, weight)


@pytest.mark.parametrize("q", [np.array([1.0, 0, 0, 0]), HALF_TURN])
def test_gradients_are_finite_at_the_identity_and_at_half_a_turn(q):
    identity = np.array([1.0, 0, 0, 0])
    assert_allclose(quat.angle(jnp.asarray(identity), jnp.asarray(q)), 0 if q[0] else np.pi)
    finite_jacobian(quat.angle, identity, q)
    finite_jacobian(quat.nlerp, identity, q, 0.5)
    finite_jacobian(quat.from_cos_sin, q[1:], 2 * q[0] ** 2 - 1, 0.0)


def test_the_angle_between_equal_rotations_is_zero_with_zero_gradient():
    for q in (Q[0], -Q[0]):
        assert_allclose(quat.angle(jnp.asarray(Q[0]), jnp.asarray(q)), 0, atol=1e-15)
    identity = np.array([1.0, 0, 0, 0])
    assert_allclose(finite_jacobian(quat.angle, identity, -identity), 0, atol=0)
