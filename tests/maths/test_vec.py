"""Vectors and safe scalar functions: agreement with NumPy, limits, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from jaxik.maths import vec
from support.gradients import (
    ROWS,
    assert_all_gradients_match,
    directions,
    finite_jacobian,
    unit,
    vectors,
)

RNG = np.random.default_rng(0)
V, W = (vectors(RNG, 1.0, 1e-5, 1e-12, 0.0) for _ in range(2))  # of any size
DIRECTION, *_ = directions(RNG)
X, Y = RNG.uniform(-2, 2, (2, ROWS))
X[:2], Y[1:3] = 0.0, 0.0
UP, FALLBACK = np.array([0.0, 1.0, 0.0]), np.array([0.6, 0.0, 0.8])


def test_one_vector_broadcasts_against_a_batch():
    single = jnp.asarray(W[0])
    assert_allclose(vec.cross(jnp.asarray(V), single), np.cross(V, W[0]), atol=1e-15)
    assert vec.dot(single, jnp.zeros((2, 5, 3))).shape == (2, 5)
    assert vec.scale(single, jnp.asarray(X)).shape == (ROWS, 3)
    assert vec.normalize(jnp.zeros((2, ROWS, 3)), jnp.asarray(V)).shape == (2, ROWS, 3)


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


def test_the_cross_product_is_right_handed():
    x, y, z = jnp.eye(3)
    assert_allclose(vec.cross(x, y), z, atol=0)
    assert_allclose(vec.cross(y, x), -z, atol=0)


def test_normalizing_keeps_the_direction_or_gives_the_fallback():
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


def test_safe_functions_have_zero_gradient_at_their_limits():
    assert vec.safe_sqrt(jnp.asarray(0.0)) == vec.safe_sqrt(jnp.asarray(-1.0)) == 0
    assert vec.safe_arctan2(jnp.asarray(0.0), jnp.asarray(0.0)) == 0
    for x in (0.0, -1.0):
        assert_allclose(finite_jacobian(vec.safe_sqrt, x), 0, atol=0)
    assert_allclose(finite_jacobian(vec.safe_divide, 1.0, 0.0), 0, atol=0)
    assert_allclose(finite_jacobian(vec.safe_arctan2, 0.0, 0.0), 0, atol=0)
    assert_allclose(finite_jacobian(vec.length, np.zeros(3)), 0, atol=0)
    assert_allclose(finite_jacobian(vec.normalize, np.zeros(3), FALLBACK)[:, :3], 0, atol=0)


def products(a, b, factor):
    return (
        vec.dot(a, b),
        vec.cross(a, b),
        vec.reject(a, b),
        vec.length(a),
        vec.scale(a, factor),
        vec.barrier(a),
    )


def safe_functions(x, y, size, sign):
    return (
        vec.safe_sqrt(size * x),
        vec.safe_divide(x, sign * size * y),
        vec.safe_arctan2(size * x, sign * y),
        vec.cos_sin(sign * x),
    )


def test_gradients_match_finite_differences():
    v, w = vectors(RNG, 1.0, 1e-5), vectors(RNG, 1.0, 1e-5)
    assert_all_gradients_match(products, vectors(RNG, 1.0, 1e-5, 0.0), w, X)
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
