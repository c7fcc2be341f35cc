"""Vectors, safe scalar functions and quaternions: agreement with NumPy and SciPy, gradients.

Of all functions of numbers a batch has the results of single calls, in the precision of its inputs.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.gate import HARD, Smooth
from support import gradients
from support.clips import assert_close
from support.gradients import ROWS, assert_all_gradients_match, finite_jacobian, unit

RNG = np.random.default_rng(0)
V, W = (gradients.vectors(RNG, 1.0, 1e-5, 1e-12, 0.0) for _ in range(2))  # of any size
DIRECTION, *_ = gradients.directions(RNG)
X, Y = RNG.uniform(-2, 2, (2, ROWS))
X[:2], Y[1:3] = 0.0, 0.0
UP, FALLBACK = np.array([0.0, 1.0, 0.0]), np.array([0.6, 0.0, 0.8])
IDENTITY, HALF_TURN = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.0, 0.8])
P, Q = (gradients.quaternions(RNG) for _ in range(2))
ANGLE = gradients.angles(RNG, 1e-9)
WEIGHT = RNG.uniform(0, 1, ROWS)


# Vectors.


def test_a_constant_takes_the_dtype_of_the_other_array():
    for dtype in (jnp.float32, jnp.float64):
        up = vec.constant((0.0, 1.0, 0.0), jnp.zeros(2, dtype))
        assert up.dtype == dtype and up.tolist() == [0.0, 1.0, 0.0]


def test_products_agree_with_numpy():
    v, w = jnp.asarray(V), jnp.asarray(W)
    assert_allclose(vec.dot(v, w), np.vecdot(V, W), rtol=1e-12, atol=1e-15)
    assert_allclose(vec.cross(v, w), np.cross(V, W), rtol=1e-12, atol=1e-15)
    assert_allclose(vec.add(v, w), V + W, atol=0)
    assert_allclose(vec.length(v), np.linalg.norm(V, axis=-1), rtol=1e-12)
    assert_allclose(vec.stack(*vec.components(v)), V, atol=0)
    assert_allclose(vec.barrier(v), V, atol=0)
    assert_allclose(vec.stacked_barrier(v, jnp.asarray(2.0)), (V, np.full_like(V, 2.0)), atol=0)
    # One against a batch.
    assert_allclose(vec.cross(v, w[0]), np.cross(V, W[0]), atol=1e-15)
    assert vec.dot(w[0], jnp.zeros((2, 5, 3))).shape == (2, 5)
    assert vec.scale(w[0], jnp.asarray(X)).shape == (ROWS, 3)
    assert vec.normalize(jnp.zeros((2, ROWS, 3)), v).shape == (2, ROWS, 3)


def test_normalizing_a_vector_keeps_its_direction_or_gives_the_fallback():
    zero = ~V.any(axis=-1)
    direction = np.asarray(vec.normalize(jnp.asarray(V), jnp.asarray(DIRECTION)))
    assert_allclose(np.linalg.norm(direction, axis=-1), 1.0, atol=1e-14)
    assert_allclose(np.cross(direction, V), 0, atol=1e-14)
    assert (np.vecdot(direction, V)[~zero] > 0).all()
    assert_allclose(direction[zero], DIRECTION[zero], atol=0)


def test_a_rejection_is_at_right_angles_and_the_rest_parallel():
    across = vec.reject(jnp.asarray(V), jnp.asarray(DIRECTION))
    assert_allclose(np.vecdot(across, DIRECTION), 0, atol=1e-14)
    assert_allclose(np.cross(V - across, DIRECTION), 0, atol=1e-14)


def test_what_is_across_up_has_length_one_or_is_the_fallback():
    across = vec.across(*map(jnp.asarray, (DIRECTION, UP, FALLBACK)))
    horizontal = DIRECTION * [1.0, 0.0, 1.0]
    size = np.linalg.norm(horizontal, axis=-1, keepdims=True)
    known = size > 1e-7
    assert not known.all()
    expected = np.where(known, horizontal / np.where(known, size, 1.0), FALLBACK)
    assert_allclose(across, expected, atol=1e-14)


def test_a_direction_along_up_but_for_rounding_has_nothing_across_it_and_no_gradient():
    args = [jnp.asarray(x) for x in ([2e-16, 1.0, -1e-16], UP, FALLBACK)]
    assert_allclose(vec.across(*args), FALLBACK, atol=0)
    assert_allclose(jax.jacobian(vec.across)(*args), 0.0, atol=0)


def test_safe_functions_equal_the_plain_ones_away_from_their_limits():
    x, y = jnp.asarray(X), jnp.asarray(Y)
    assert_allclose(vec.safe_sqrt(x), np.sqrt(np.maximum(X, 0.0)))
    expected = np.where(Y != 0, X / np.where(Y != 0, Y, 1.0), 7.0)
    assert_allclose(vec.safe_divide(x, y, otherwise=7.0), expected)
    assert_allclose(vec.safe_arctan2(y, x), np.arctan2(Y, X))


def test_arctan2_is_accurate_to_rounding_at_every_angle_and_size():
    angle = np.linspace(-np.pi, np.pi, 4001)[:, None]
    for dtype, sizes in ((np.float32, (1e-30, 1.0, 1e30)), (np.float64, (1e-200, 1.0, 1e200))):
        y = (np.sin(angle) * sizes).astype(dtype)
        x = (np.cos(angle) * sizes).astype(dtype)
        exact = np.arctan2(y.astype(np.float64), x.astype(np.float64))
        angles = vec.safe_arctan2(jnp.asarray(y), jnp.asarray(x))
        assert angles.dtype == dtype
        assert_allclose(angles, exact, rtol=6 * float(np.finfo(dtype).eps))


def test_cosines_and_sines_are_accurate_to_rounding_at_every_angle():
    angle = np.linspace(-20.0, 20.0, 4001)
    for dtype in (np.float32, np.float64):
        exact = angle.astype(dtype).astype(np.float64)
        # One rounding of the result, plus that of an angle of several turns.
        allowed = np.finfo(dtype).eps * (2.0 + 0.5 * np.abs(exact))
        results = vec.cos_sin(jnp.asarray(angle, dtype))
        for actual, expected in zip(results, (np.cos(exact), np.sin(exact)), strict=True):
            assert actual.dtype == dtype
            assert np.all(np.abs(np.asarray(actual, np.float64) - expected) <= allowed)


def at_limits(zero, minus_one, v, q):
    roots = vec.safe_sqrt(zero), vec.safe_sqrt(minus_one), vec.safe_arctan2(zero, zero)
    lengths = vec.length(v), vec.normalize(v, jnp.asarray(FALLBACK)), quat.normalize(q)
    return *roots, vec.safe_divide(minus_one, zero), *lengths


def test_safe_functions_have_a_value_with_zero_gradient_at_their_limits():
    limits = 0.0, -1.0, np.zeros(3), np.zeros(4)
    expected = [0.0] * 5 + [*FALLBACK, *IDENTITY]
    assert_allclose(np.hstack(at_limits(*map(jnp.asarray, limits))), expected, atol=0)
    assert_allclose(finite_jacobian(at_limits, *limits), 0, atol=0)


def products(a, b, factor):
    products = vec.dot(a, b), vec.cross(a, b), vec.reject(a, b)
    return *products, vec.length(a), vec.scale(a, factor), vec.barrier(a)


def safe_functions(x, y, size, sign):
    return (
        vec.safe_sqrt(size * x),
        vec.safe_divide(x, sign * size * y),
        vec.safe_arctan2(size * x, sign * y),
        vec.cos_sin(sign * x),
    )


def test_gradients_of_vectors_match_finite_differences():
    v, w = gradients.vectors(RNG, 1.0, 1e-5), gradients.vectors(RNG, 1.0, 1e-5)
    assert_all_gradients_match(products, gradients.vectors(RNG, 1.0, 1e-5, 0.0), w, X)
    assert_all_gradients_match(vec.normalize, v, unit(w))
    x, y = RNG.uniform(0.1, 2.0, (2, ROWS))
    sizes, signs = RNG.choice([1.0, 1e-3], ROWS), RNG.choice([1.0, -1.0], ROWS)
    assert_all_gradients_match(safe_functions, x, y, sizes, signs)


def test_gradients_stay_finite_in_single_precision_for_vectors_of_any_length():
    sizes = 10.0 ** -jnp.asarray([3, 6, 9, 15, 30], jnp.float32)
    v = sizes[:, None] * jnp.asarray([1.0, 0.0, 0.0], jnp.float32)
    fallback = jnp.asarray([0.0, 1.0, 0.0], jnp.float32)
    of_direction = jax.jit(jax.vmap(jax.jacrev(vec.normalize), (0, None)))(v, fallback)
    of_length = jax.jit(jax.vmap(jax.jacfwd(vec.length)))(v)
    for gradient in (of_direction, of_length):
        assert gradient.dtype == jnp.float32 and jnp.isfinite(gradient).all()


# Rotations.


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


def test_products_inverses_axes_and_rotated_vectors_agree_with_scipy():
    p, q, v = map(jnp.asarray, (P, Q, V))
    assert_same_rotation(quat.multiply(p, q), scipy(P) * scipy(Q))
    assert_same_rotation(quat.conjugate(q), scipy(Q).inv())
    assert_allclose(quat.rotate(q, v), scipy(Q).apply(V), atol=1e-14)
    assert_allclose(quat.unrotate(q, v), scipy(Q).inv().apply(V), atol=1e-14)
    assert_allclose(quat.angle(p, q), (scipy(P).inv() * scipy(Q)).magnitude(), atol=1e-12)
    assert_allclose(quat.stack(*quat.components(q)), Q, atol=0)
    assert_allclose(np.stack(quat.axes(q), axis=-1), scipy(Q).as_matrix(), atol=1e-14)
    # One against a batch.
    assert_allclose(quat.rotate(q[0], v), scipy(Q[0]).apply(V), atol=1e-14)
    assert quat.multiply(q[:, None], p).shape == (ROWS, ROWS, 4)


def test_rotations_about_an_axis_agree_with_scipy():
    axis, angle = jnp.asarray(DIRECTION), jnp.asarray(ANGLE)
    expected = Rotation.from_rotvec(ANGLE[:, None] * DIRECTION)
    assert_same_rotation(quat.from_axis_angle(axis, angle), expected)
    assert_same_rotation(quat.from_rotvec(jnp.asarray(ANGLE[:, None] * DIRECTION)), expected)
    assert_same_rotation(quat.from_cos_sin(axis, jnp.cos(angle), jnp.sin(angle)), expected)


def test_a_half_angle_is_exact_and_its_cosine_is_not_negative():
    half_cos, half_sin = quat.half_angle(jnp.cos(ANGLE), jnp.sin(ANGLE))
    assert (half_cos >= 0).all()
    assert_allclose(half_cos, np.cos(ANGLE / 2), atol=1e-15)
    assert_allclose(half_sin, np.sin(ANGLE / 2), atol=1e-15)
    assert quat.half_angle(jnp.asarray(-1.0), jnp.asarray(0.0)) == (0.0, 1.0)


def test_small_rotation_vectors_are_exact_on_both_sides_of_the_taylor_series():
    sizes = np.array([0.0, 1e-200, 1e-12, 1e-6, 1.2e-4, 1.3e-4, 1e-2])[:, None]
    v = sizes * [0.6, 0.0, 0.8]
    expected = np.hstack([np.cos(sizes / 2), v * np.sinc(sizes / 2 / np.pi) / 2])
    assert_allclose(quat.from_rotvec(jnp.asarray(v)), expected, rtol=1e-14)
    gradients.finite_jacobians(quat.from_rotvec, v)


def test_an_arc_takes_one_direction_to_the_other_the_shortest_way():
    a, b, axis = map(jnp.asarray, gradients.directions(RNG, 1e-9))
    q = quat.shortest_arc(a, b, axis)
    assert_allclose(jnp.linalg.norm(q, axis=-1), 1.0, atol=1e-12)
    assert_allclose(quat.rotate(q, a), b, atol=1e-7)
    assert_allclose(np.vecdot(q[:, 1:], np.add(a, b)), 0, atol=1e-12)  # no twist
    between = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.vecdot(a, b))
    assert_allclose(quat.angle(q, quat.identity()), between, atol=1e-7)
    # In single precision it errs by a millimetre per metre.
    a, b, axis = (jnp.asarray(v, jnp.float32) for v in gradients.directions(RNG, 1e-4))
    q = quat.shortest_arc(a, b, axis)
    assert_allclose(jnp.linalg.norm(q, axis=-1), 1.0, atol=1e-6)
    assert_allclose(quat.rotate(q, a), b, atol=1e-3)


def test_an_arc_between_opposed_directions_is_half_a_turn_about_the_fallback_with_zero_gradient():
    a, axis = np.eye(3)[0], np.eye(3)[1]
    assert_allclose(quat.shortest_arc(*map(jnp.asarray, (a, -a, axis))), [0, *axis], atol=0)
    assert_allclose(finite_jacobian(quat.shortest_arc, a, -a, axis)[:, :6], 0, atol=0)


def test_normalizing_a_quaternion_keeps_its_rotation():
    for size in (1e-9, 1e-3, 1.0, 1e6):
        assert_allclose(quat.normalize(jnp.asarray(size * Q)), Q, atol=1e-14)


def test_nlerp_starts_at_one_rotation_ends_at_the_other_and_meets_slerp_half_way():
    p, q = jnp.asarray(P), jnp.asarray(Q)
    start, middle, end = (quat.nlerp(p, q, jnp.asarray(weight)) for weight in (0.0, 0.5, 1.0))
    assert_same_rotation(start, scipy(P))
    assert_same_rotation(end, scipy(Q))
    for row in np.flatnonzero(np.abs(np.vecdot(P, Q)) > 1e-6):  # else both ways are equally short
        slerp = Slerp([0, 1], scipy(np.stack([P[row], Q[row]])))
        assert_same_rotation(middle[row], slerp(0.5), 1e-8)


def test_scaling_a_rotation_equals_nlerp_from_the_identity():
    axis, q, weight, angle = map(jnp.asarray, (DIRECTION, Q, WEIGHT, ANGLE))
    expected = quat.nlerp(quat.identity(), q, weight)
    assert_allclose(quat.nlerp_identity(q, weight), expected, atol=1e-14)
    half = quat.half_cos_sin(angle)
    assert_allclose(
        quat.from_half_angle(axis, *quat.nlerp_half(*half, weight)),
        quat.nlerp_identity(quat.from_half_angle(axis, *half), weight),
        atol=1e-14,
    )


def products_and_blends(p, q, v, weight):
    products = quat.multiply(p, q), quat.rotate(q, v), quat.unrotate(q, v)
    return *products, quat.normalize(q), quat.from_rotvec(v), quat.nlerp(p, q, weight)


def rotations_about(axis, angle):
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return quat.from_axis_angle(axis, angle), quat.from_cos_sin(axis, cos, sin)


def arc_between(a, b, axis):
    """The arc between the directions of vectors, so that differences stay on the unit sphere."""
    return quat.shortest_arc(vec.normalize(a, axis), vec.normalize(b, axis), axis)


def test_gradients_of_rotations_match_finite_differences_where_there_is_one_way():
    one_way = np.abs(np.vecdot(P, Q)) > 1e-3
    assert_all_gradients_match(products_and_blends, *(x[one_way] for x in (P, Q, V, WEIGHT)))
    angle = RNG.uniform(-2.9, 2.9, ROWS)
    assert_all_gradients_match(rotations_about, DIRECTION, angle)
    about_axis = np.asarray(quat.from_axis_angle(jnp.asarray(DIRECTION), jnp.asarray(angle)))
    assert_all_gradients_match(quat.angle, np.tile(IDENTITY, (ROWS, 1)), about_axis)
    a, b, axis = gradients.directions(RNG)
    apart = np.vecdot(a, b) > -1 + 1e-12
    assert_all_gradients_match(arc_between, a[apart], b[apart], axis[apart], tolerance=1e-5)


def blends(p, q, weight, cos, sin):
    return quat.angle(p, q), quat.nlerp(p, q, weight), quat.from_cos_sin(q[1:], cos, sin)


def test_gradients_are_finite_between_rotations_that_are_equal_or_half_a_turn_apart():
    assert_allclose(quat.angle(jnp.asarray(Q), jnp.asarray(-Q)), 0, atol=1e-15)
    for q, angle in ((IDENTITY, 0.0), (-IDENTITY, 0.0), (HALF_TURN, np.pi)):
        assert_allclose(quat.angle(jnp.asarray(IDENTITY), jnp.asarray(q)), angle, atol=1e-15)
        jacobian = finite_jacobian(blends, IDENTITY, q, 0.5, 2.0 * q[0] ** 2 - 1.0, 0.0)
        if angle == 0:
            assert_allclose(jacobian[0], 0.0, atol=0)


# All functions of numbers.

S, T = RNG.uniform(0.1, 0.9, (2, 4))
A, B, C = unit(RNG.normal(size=(3, 4, 3)))
M, N = unit(RNG.normal(size=(2, 4, 4)))
MOTION = smoothing.Motion(S, -S)
ARGUMENTS = {
    vec: {
        "unstack": (A,), "components": (A,), "stack": (S, T, S), "barrier": (A,),
        "stacked_barrier": (S, T), "dot": (A, B), "cross": (A, B), "scale": (A, S),
        "safe_sqrt": (S,), "safe_divide": (S, T), "safe_arctan2": (S, T), "cos_sin": (S,),
        "add": (A, B), "length": (A,), "normalize": (A, B), "reject": (A, B), "across": (A, B, B),
    },
    quat: {
        "components": (N,), "stack": (S, T, S, T), "multiply": (M, N), "conjugate": (N,),
        "rotate": (N, A), "axes": (N,), "unrotate": (N, A), "dot": (M, N), "normalize": (3.0 * N,),
        "half_angle": (S, T), "half_cos_sin": (S,), "from_half_angle": (A, S, T),
        "from_cos_sin": (A, S, T), "from_axis_angle": (A, S), "from_rotvec": (A,),
        "shortest_arc": (A, B, C), "nlerp": (M, N, S), "nlerp_identity": (N, S),
        "nlerp_half": (S, T, S), "angle": (M, N),
    },
    smoothing: {
        "lerp": (S, -S, S), "fraction_of_half_life": (S, S),
        "fraction_of_speed": (S, S, S), "spring": (MOTION, 2 * S, S, S),
        "follow": (MOTION, 2 * S, S, S, S > 0.3),
    },
}  # fmt: skip
DECISIONS = {
    "below": (S, T), "above": (S, T), "choose": (S, T, -T), "clip": (S, -0.1 * T, 0.2 * T),
    "minimum": (N,), "maximum": (N,),
}  # fmt: skip


def everything(arguments, decisions, gates):
    """Results of all functions, by name."""
    results = {
        f"{module.__name__}.{name}": getattr(module, name)(*args)
        for module, functions in zip(ARGUMENTS, arguments, strict=True)
        for name, args in functions.items()
    }
    for gate in gates:
        for name, args in decisions.items():
            band = {} if name == "choose" else {"band": 0.02}
            results[f"{type(gate).__name__}.{name}"] = getattr(gate, name)(*args, **band)
    return results


def arrays(dtype):
    convert = functools.partial(jnp.asarray, dtype=dtype)
    softness = Smooth(np.full(4, 0.5))
    return jax.tree.map(convert, (list(ARGUMENTS.values()), DECISIONS, [HARD, softness]))


def test_dtype_follows_the_inputs():
    for dtype in (jnp.float32, jnp.float64):
        for name, result in jax.eval_shape(everything, *arrays(dtype)).items():
            assert {leaf.dtype for leaf in jax.tree.leaves(result)} == {jnp.dtype(dtype)}, name


def test_a_compiled_batch_equals_the_vmap_of_single_calls():
    batch, singles = jax.jit(everything), jax.jit(jax.vmap(everything))
    assert_close(batch(*arrays(jnp.float64)), singles(*arrays(jnp.float64)), 1e-14)
