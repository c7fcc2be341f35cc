"""Vectors and safe scalar functions: agreement with NumPy, limits, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from jaxik.maths import vec
from support.gradients import assert_gradients_match, directions, finite_jacobian, numbers, vectors

few = settings(max_examples=15, derandomize=True, deadline=None)
ANY_SIZE = (1.0, 1e-5, 1e-12, 0.0)

RNG = np.random.default_rng(0)
A, B = RNG.normal(size=(2, 4, 3))
X, Y = RNG.normal(size=(2, 4))
FUNCTIONS = {
    "unstack": (vec.unstack, (A,)),
    "components": (vec.components, (A,)),
    "stack": (vec.stack, (X, Y, X)),
    "barrier": (vec.barrier, (A,)),
    "stacked_barrier": (vec.stacked_barrier, (X, Y)),
    "dot": (vec.dot, (A, B)),
    "cross": (vec.cross, (A, B)),
    "scale": (vec.scale, (A, X)),
    "safe_sqrt": (vec.safe_sqrt, (X**2,)),
    "safe_divide": (vec.safe_divide, (X, Y)),
    "safe_arctan2": (vec.safe_arctan2, (X, Y)),
    "cos_sin": (vec.cos_sin, (X,)),
    "add": (vec.add, (A, B)),
    "length": (vec.length, (A,)),
    "normalize": (vec.normalize, (A, B)),
    "reject": (vec.reject, (A, B)),
    "across": (vec.across, (A, B, B)),
}


def everything(args):
    return {name: function(*args[name]) for name, (function, _) in FUNCTIONS.items()}


def products(a, b, weight):
    """Several functions in one program: most of a test's time goes into compiling."""
    return (
        vec.dot(a, b),
        vec.cross(a, b),
        vec.reject(a, b),
        vec.length(a),
        vec.scale(a, weight),
        vec.barrier(a),
    )


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


def test_one_vector_broadcasts_against_a_batch():
    single = jnp.asarray(B[0])
    assert_allclose(vec.cross(jnp.asarray(A), single), np.cross(A, B[0]), atol=1e-15)
    assert vec.dot(single, jnp.zeros((2, 5, 3))).shape == (2, 5)
    assert vec.scale(single, jnp.asarray(X)).shape == (4, 3)
    assert vec.normalize(jnp.zeros((2, 4, 3)), jnp.asarray(A)).shape == (2, 4, 3)


def test_a_constant_takes_the_dtype_of_the_other_array():
    for dtype in (jnp.float32, jnp.float64):
        up = vec.constant((0.0, 1.0, 0.0), jnp.zeros(2, dtype))
        assert up.dtype == dtype and up.tolist() == [0.0, 1.0, 0.0]


@few
@given(vectors(ANY_SIZE), vectors(ANY_SIZE))
def test_products_agree_with_numpy(a, b):
    ja, jb = jnp.asarray(a), jnp.asarray(b)
    assert_allclose(vec.dot(ja, jb), np.dot(a, b), rtol=1e-12, atol=1e-15)
    assert_allclose(vec.cross(ja, jb), np.cross(a, b), rtol=1e-12, atol=1e-15)
    assert_allclose(vec.add(ja, jb), a + b, atol=0)
    assert_allclose(vec.length(ja), np.linalg.norm(a), rtol=1e-12)
    assert_allclose(vec.stack(*vec.components(ja)), a, atol=0)
    assert_allclose(vec.barrier(ja), a, atol=0)
    assert_allclose(vec.stacked_barrier(ja, jnp.asarray(2.0)), (a, np.full_like(a, 2.0)), atol=0)


def test_the_cross_product_is_right_handed():
    x, y, z = jnp.eye(3)
    assert_allclose(vec.cross(x, y), z, atol=0)
    assert_allclose(vec.cross(y, x), -z, atol=0)


@few
@given(vectors(ANY_SIZE), directions())
def test_normalizing_keeps_the_direction_or_gives_the_fallback(v, pair):
    fallback = jnp.asarray(pair[0])
    direction = vec.normalize(jnp.asarray(v), fallback)
    assert_allclose(vec.length(direction), 1.0, atol=1e-14)
    if v.any():
        assert_allclose(np.cross(direction, v), 0, atol=1e-14)
        assert vec.dot(direction, jnp.asarray(v)) > 0
    else:
        assert_allclose(direction, fallback, atol=0)


@few
@given(vectors(ANY_SIZE), directions())
def test_a_rejection_is_at_right_angles_and_the_rest_parallel(v, pair):
    direction = jnp.asarray(pair[0])
    across = vec.reject(jnp.asarray(v), direction)
    assert_allclose(vec.dot(across, direction), 0, atol=1e-14)
    assert_allclose(np.cross(v - across, direction), 0, atol=1e-14)


@few
@given(directions())
def test_what_is_across_up_has_length_one_or_is_the_fallback(pair):
    direction, fallback = pair[0], np.array([0.6, 0.0, 0.8])
    up = jnp.array([0.0, 1.0, 0.0])
    across = vec.across(jnp.asarray(direction), up, jnp.asarray(fallback))
    horizontal = direction * [1.0, 0.0, 1.0]
    size = np.linalg.norm(horizontal)
    assert_allclose(across, horizontal / size if size > 1e-7 else fallback, atol=1e-14)


def test_a_direction_along_up_but_for_rounding_has_nothing_across_it_and_no_gradient():
    rounded = jnp.asarray([2e-16, 1.0, -1e-16])
    up, fallback = jnp.array([0.0, 1.0, 0.0]), jnp.array([1.0, 0.0, 0.0])
    assert_allclose(vec.across(rounded, up, fallback), fallback, atol=0)
    assert_allclose(jax.jacobian(vec.across)(rounded, up, fallback), 0.0, atol=0)


@few
@given(numbers(), numbers())
def test_safe_functions_equal_the_plain_ones_away_from_their_limits(x, y):
    jx, jy = jnp.asarray(x), jnp.asarray(y)
    assert_allclose(vec.safe_sqrt(jx), np.sqrt(max(x, 0.0)))
    assert_allclose(vec.safe_divide(jx, jy, otherwise=7.0), x / y if y else 7.0)
    if (x, y) != (0, 0):
        assert_allclose(vec.safe_arctan2(jy, jx), np.arctan2(y, x))


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
        rounded = angle.astype(dtype)
        cos, sin = vec.cos_sin(jnp.asarray(rounded))
        assert cos.dtype == sin.dtype == dtype
        exact = rounded.astype(np.float64)
        # One rounding of the result, plus that of an angle of several turns.
        allowed = np.finfo(dtype).eps * (2.0 + 0.5 * np.abs(exact))
        assert np.all(np.abs(np.asarray(cos, np.float64) - np.cos(exact)) <= allowed)
        assert np.all(np.abs(np.asarray(sin, np.float64) - np.sin(exact)) <= allowed)


def test_safe_functions_have_zero_gradient_at_their_limits():
    assert vec.safe_sqrt(jnp.asarray(0.0)) == vec.safe_sqrt(jnp.asarray(-1.0)) == 0
    assert vec.safe_arctan2(jnp.asarray(0.0), jnp.asarray(0.0)) == 0
    for x in (0.0, -1.0):
        assert_allclose(finite_jacobian(vec.safe_sqrt, x), 0, atol=0)
    assert_allclose(finite_jacobian(vec.safe_divide, 1.0, 0.0), 0, atol=0)
    assert_allclose(finite_jacobian(vec.safe_arctan2, 0.0, 0.0), 0, atol=0)
    assert_allclose(finite_jacobian(vec.length, np.zeros(3)), 0, atol=0)
    assert_allclose(finite_jacobian(vec.normalize, np.zeros(3), np.eye(3)[0])[:, :3], 0, atol=0)


@few
@given(vectors((1.0, 1e-5, 0.0)), vectors(), numbers())
def test_gradients_of_products_and_lengths_match_finite_differences(a, b, weight):
    assert_gradients_match(products, a, b, weight)


@few
@given(vectors(), vectors())
def test_gradients_of_directions_match_finite_differences(v, fallback):
    assert_gradients_match(vec.normalize, v, fallback)


@few
@given(numbers(0.1, 2), numbers(0.1, 2), st.sampled_from([1.0, 1e-3]), st.sampled_from([1, -1]))
def test_gradients_of_safe_functions_match_finite_differences(x, y, size, sign):
    assert_gradients_match(vec.safe_sqrt, size * x)
    assert_gradients_match(vec.safe_divide, x, sign * size * y)
    assert_gradients_match(vec.safe_arctan2, size * x, sign * y)
    assert_gradients_match(vec.cos_sin, sign * x)


def test_gradients_stay_finite_in_single_precision_for_vectors_of_any_length():
    sizes = 10.0 ** -jnp.asarray([3, 6, 9, 15, 30], jnp.float32)
    v = sizes[:, None] * jnp.asarray([1.0, 0.0, 0.0], jnp.float32)
    fallback = jnp.asarray([0.0, 1.0, 0.0], jnp.float32)
    of_direction = jax.jit(jax.vmap(jax.jacrev(vec.normalize), (0, None)))(v, fallback)
    of_length = jax.jit(jax.vmap(jax.jacfwd(vec.length)))(v)
    for gradient in (of_direction, of_length):
        assert gradient.dtype == jnp.float32 and jnp.isfinite(gradient).all()
