"""Smoothing laws: exact at any frame time, correct at their limits, with correct gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.typing import ArrayLike
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from jaxik.maths import smoothing
from support.gradients import assert_gradients_match, finite_jacobian, numbers

few = settings(max_examples=15, derandomize=True, deadline=None)
frame_times = st.sampled_from([1 / 240, 1 / 120, 1 / 60, 1 / 30, 0.5])
gains = st.sampled_from([0.0, 1e-6, 0.999, 1.0]) | numbers(0, 1)
half_lives = st.sampled_from([0.0, 1e-6, 1e-3]) | numbers(0.005, 3)

X = np.array([0.1, 0.4, 0.7])
MOTION = smoothing.Motion(jnp.asarray(X), jnp.asarray(-X))
FUNCTIONS = {
    "lerp": (smoothing.lerp, (X, -X, X)),
    "fraction_of_gain": (smoothing.fraction_of_gain, (X, X, 30 * X)),
    "fraction_of_half_life": (smoothing.fraction_of_half_life, (X, X)),
    "fraction_of_speed": (smoothing.fraction_of_speed, (X, X, X)),
    "spring": (smoothing.spring, (MOTION, 2 * X, X, X)),
    "follow": (
        smoothing.follow,
        (MOTION, 2 * X, X, X, X > 0.3),
    ),
    "half_life_of_gain": (smoothing.half_life_of_gain, (X, 30 * X)),
    "gain_of_half_life": (smoothing.gain_of_half_life, (X, 30 * X)),
    "half_life_of_speed": (smoothing.half_life_of_speed, (X, X)),
}


def call(function, *args: ArrayLike | smoothing.Motion):
    """The function of these arguments, turned into arrays."""
    return function(*jax.tree.map(jnp.asarray, args))


def everything(args):
    return {name: function(*args[name]) for name, (function, _) in FUNCTIONS.items()}


def spring(value, velocity, goal, half_life, dt):
    """`smoothing.spring` of plain numbers."""
    return call(smoothing.spring, smoothing.Motion(value, velocity), goal, half_life, dt)


def follow(value, velocity, goal, fraction, dt, use_spring):
    """`smoothing.follow` of plain numbers."""
    motion = smoothing.Motion(value, velocity)
    return call(smoothing.follow, motion, goal, fraction, dt, use_spring)


def spring_and_lerp(value, velocity, goal, half_life, dt):
    return spring(value, velocity, goal, half_life, dt), smoothing.lerp(value, goal, dt)


def fractions(gain, half_life, dt, tick_hz):
    """Several laws in one program: most of a test's time goes into compiling."""
    return (
        smoothing.fraction_of_gain(gain, dt, tick_hz),
        smoothing.fraction_of_half_life(half_life, dt),
        smoothing.gain_of_half_life(half_life, tick_hz),
    )


def test_dtype_follows_the_inputs():
    for dtype in (jnp.float32, jnp.float64):
        cast = functools.partial(jnp.asarray, dtype=dtype)
        args = {name: jax.tree.map(cast, args) for name, (_, args) in FUNCTIONS.items()}
        for name, answer in jax.eval_shape(everything, args).items():
            assert {leaf.dtype for leaf in jax.tree.leaves(answer)} == {jnp.dtype(dtype)}, name


def test_a_compiled_batch_equals_the_vmap_of_single_calls():
    args = {name: jax.tree.map(jnp.asarray, args) for name, (_, args) in FUNCTIONS.items()}
    batch, singles = jax.jit(everything)(args), jax.jit(jax.vmap(everything))(args)
    for name in FUNCTIONS:
        for actual, expected in zip(
            *map(jax.tree.leaves, (batch[name], singles[name])), strict=True
        ):
            assert_allclose(actual, expected, 1e-14, 1e-14, err_msg=name)


@few
@given(gains, half_lives, frame_times)
def test_two_half_steps_equal_one_step(gain, half_life, dt):
    start, goal = jnp.asarray(3.0), jnp.asarray(1.0)
    for fraction in (
        lambda dt: call(smoothing.fraction_of_gain, gain, dt, 30.0),
        lambda dt: call(smoothing.fraction_of_half_life, half_life, dt),
    ):
        half = fraction(dt / 2)
        twice = smoothing.lerp(smoothing.lerp(start, goal, half), goal, half)
        assert_allclose(twice, smoothing.lerp(start, goal, fraction(dt)), rtol=1e-13)
        assert 0 <= half <= fraction(dt) <= 1


@few
@given(numbers(), numbers(), numbers(), half_lives, frame_times)
def test_two_half_steps_of_the_spring_equal_one_step(value, velocity, goal, half_life, dt):
    expected = spring(value, velocity, goal, half_life, dt)
    half = spring(value, velocity, goal, half_life, dt / 2)
    twice = spring(*half, goal, half_life, dt / 2)
    assert_allclose(twice, expected, rtol=1e-11, atol=1e-11)


@few
@given(gains, st.sampled_from([30.0, 60.0]))
def test_a_gain_compounds_over_ticks(gain, tick_hz):
    assert_allclose(call(smoothing.fraction_of_gain, gain, 1 / tick_hz, tick_hz), gain, rtol=1e-13)
    seven_ticks = call(smoothing.fraction_of_gain, gain, 7 / tick_hz, tick_hz)
    assert_allclose(seven_ticks, 1 - (1 - gain) ** 7, rtol=1e-9)


@few
@given(gains, st.sampled_from([30.0, 60.0]), frame_times)
def test_a_gain_and_its_half_life_give_the_same_fraction(gain, tick_hz, dt):
    half_life = call(smoothing.half_life_of_gain, gain, tick_hz)
    assert_allclose(call(smoothing.gain_of_half_life, half_life, tick_hz), gain, rtol=1e-12)
    assert_allclose(
        call(smoothing.fraction_of_half_life, half_life, dt),
        call(smoothing.fraction_of_gain, gain, dt, tick_hz),
        rtol=1e-12,
    )


def test_one_half_life_closes_half_of_the_gap_and_two_close_three_quarters():
    assert_allclose(call(smoothing.fraction_of_half_life, 0.2, 0.2), 0.5, rtol=1e-15)
    assert_allclose(call(smoothing.fraction_of_half_life, 0.2, 0.4), 0.75, rtol=1e-15)
    assert_allclose(call(smoothing.half_life_of_gain, 0.5, 30.0), 1 / 30, rtol=1e-15)


def test_gain_one_and_nonpositive_half_lives_jump_and_gain_zero_stays():
    dt, hz = 1 / 60, 30.0
    assert call(smoothing.fraction_of_gain, 1.0, dt, hz) == 1
    assert call(smoothing.fraction_of_gain, 0.0, dt, hz) == 0
    for half_life in (0.0, -0.1):
        assert call(smoothing.fraction_of_half_life, half_life, dt) == 1
        assert call(smoothing.gain_of_half_life, half_life, hz) == 1
        assert spring(3.0, 2.0, 1.0, half_life, dt) == (1.0, 0.0)
    assert call(smoothing.half_life_of_gain, 1.0, hz) == 0
    assert call(smoothing.half_life_of_gain, 0.0, hz) == np.inf
    assert call(smoothing.fraction_of_half_life, np.inf, dt) == 0


def test_nothing_moves_in_no_time():
    assert call(smoothing.fraction_of_gain, 0.3, 0.0, 30.0) == 0
    assert call(smoothing.fraction_of_half_life, 0.3, 0.0) == 0
    assert spring(3.0, 2.0, 1.0, 0.3, 0.0) == (3.0, 2.0)


@few
@given(numbers(-1, 40), frame_times, st.sampled_from([0.0, 9e-5, -9e-5, 1.1e-4, -1.1e-4, 1.0]))
def test_the_clamped_speed_equals_unreals_interp_to(speed, dt, gap):
    jumps = speed <= 0 or abs(gap) <= smoothing.JUMP_GAP
    expected = 1.0 if jumps else min(dt * speed, 1.0)
    assert_allclose(call(smoothing.fraction_of_speed, speed, dt, gap), expected, rtol=1e-15)


@few
@given(numbers(-1, 40), frame_times)
def test_the_half_life_of_a_clamped_speed_depends_on_the_frame_time(speed, dt):
    half_life = float(call(smoothing.half_life_of_speed, speed, dt))
    fraction = float(call(smoothing.fraction_of_speed, speed, dt, 1.0))
    if fraction == 1:
        assert half_life == 0
    else:
        assert_allclose((1 - fraction) ** (half_life / dt), 0.5, rtol=1e-10)
        assert half_life > call(smoothing.half_life_of_speed, speed, 1.5 * dt)


@few
@given(numbers(), numbers(), numbers(), numbers(0.005, 3), frame_times)
def test_the_spring_equals_the_exponential_of_its_matrix(value, velocity, goal, half_life, dt):
    rate = 2 * np.log(2) / half_life
    transition = expm(dt * np.array([[0, 1], [-(rate**2), -2 * rate]]))
    gap, speed = transition @ [value - goal, velocity]
    after = spring(value, velocity, goal, half_life, dt)
    assert_allclose(after.value, goal + gap, atol=1e-11)
    assert_allclose(after.velocity, speed, atol=1e-11 * max(1, rate))


def test_the_spring_solves_its_differential_equation():
    rate, goal, times = 2 * np.log(2) / 0.2, 0.7, np.linspace(0.1, 1.5, 8)
    solution = solve_ivp(
        lambda _, state: [state[1], -(rate**2) * (state[0] - goal) - 2 * rate * state[1]],
        (0, 1.5),
        [2.0, -3.0],
        t_eval=times,
        rtol=1e-11,
        atol=1e-12,
    )
    start, velocity = jnp.full(8, 2.0), jnp.full(8, -3.0)
    assert_allclose(spring(start, velocity, goal, 0.2, times), solution.y, atol=1e-9)


def test_following_a_goal_that_changes_every_frame_solves_the_equation_of_each_frame():
    """One half-life upwards and another downwards, chosen at the start of each frame."""
    rng, dt = np.random.default_rng(0), 1 / 30
    sprung = expected = np.array([0.4, 0.0])
    eased = 0.4
    for goal in np.repeat(rng.normal(size=12), 4):
        half_life = 0.15 if goal > expected[0] else 0.06
        rate = 2 * np.log(2) / half_life
        expected = solve_ivp(
            lambda _, x, w=rate, g=goal: [x[1], -(w**2) * (x[0] - g) - 2 * w * x[1]],
            (0, dt),
            expected,
            rtol=1e-11,
            atol=1e-12,
        ).y[:, -1]
        fraction = call(smoothing.fraction_of_half_life, half_life, dt)
        sprung = np.array(follow(sprung[0], sprung[1], goal, fraction, dt, True))
        assert_allclose(sprung, expected, atol=1e-8)
        value, velocity = follow(eased, 3.0, goal, fraction, dt, False)
        assert_allclose(value, goal + (eased - goal) * 2 ** (-dt / half_life), rtol=1e-12)
        assert velocity == 0
        eased = float(value)


def test_a_fraction_of_one_jumps_and_stops():
    for use_spring in (False, True):
        assert follow(3.0, 2.0, 1.0, 1.0, 1 / 60, use_spring) == (1.0, 0.0)


def test_a_spring_that_starts_at_rest_reaches_its_goal_without_overshooting():
    zeros, times = np.zeros(100), np.linspace(0.01, 10, 100)
    value, velocity = map(np.asarray, spring(zeros, zeros, 1.0, 0.1, times))
    assert (np.diff(value) >= 0).all() and (value <= 1).all() and (velocity >= 0).all()
    assert_allclose((value[-1], velocity[-1]), (1, 0), atol=1e-15)
    assert spring(1.0, 0.0, 1.0, 0.1, 0.5) == (1.0, 0.0)


@few
@given(numbers(0, 0.99), numbers(0.005, 3), frame_times)
def test_gradients_of_exponential_laws_match_finite_differences(gain, half_life, dt):
    assert_gradients_match(fractions, gain, half_life, dt, 30.0)
    assert_gradients_match(smoothing.half_life_of_gain, 0.005 + gain, 30.0)


@few
@given(numbers(), numbers(), numbers(), numbers(0.01, 3), frame_times)
def test_gradients_of_the_spring_match_finite_differences(value, velocity, goal, half_life, dt):
    assert_gradients_match(spring_and_lerp, value, velocity, goal, half_life, dt)


@few
@given(st.sampled_from([-1.0, 0.5, 5.0, 25.0, 70.0]), st.sampled_from([0.0, 5e-3, -1.0]))
def test_gradients_of_the_clamped_speed_match_finite_differences(speed, gap):
    assert_gradients_match(smoothing.fraction_of_speed, speed, 1 / 50, gap)
    assert_gradients_match(smoothing.half_life_of_speed, speed, 1 / 50)


def test_gradients_stay_finite_at_the_limits():
    for gain in (0.0, 1e-9, 1 - 1e-9, 1.0):
        finite_jacobian(fractions, gain, 0.1, 1 / 120, 30.0)
    assert_allclose(finite_jacobian(fractions, 1.0, 0.1, 1 / 120, 30.0)[0], 0, atol=0)
    for half_life in (0.0, 1e-9, 1e-6, 1e9):
        finite_jacobian(fractions, 0.5, half_life, 1 / 60, 30.0)
        finite_jacobian(spring_and_lerp, 3.0, 2.0, 1.0, half_life, 1 / 60)
    for speed in (0.0, 60.0, 1e-9):
        finite_jacobian(smoothing.fraction_of_speed, speed, 1 / 60, 0.0)
        finite_jacobian(smoothing.fraction_of_speed, speed, 1 / 60, 1e-4)
        finite_jacobian(smoothing.half_life_of_speed, speed, 1 / 60)
    finite_jacobian(smoothing.half_life_of_gain, 1.0, 30.0)
