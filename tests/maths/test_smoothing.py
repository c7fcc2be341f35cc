"""Smoothing laws: exact at any frame time, correct at their limits, with correct gradients."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from jaxik.maths import smoothing
from support.gradients import (
    ROWS,
    assert_all_gradients_match,
    finite_jacobian,
    finite_jacobians,
)

RNG = np.random.default_rng(0)
FRAME_TIMES = RNG.permutation(np.resize([1 / 240, 1 / 120, 1 / 60, 1 / 30, 0.5], ROWS))
TICK_HZ = RNG.choice([30.0, 60.0], ROWS)
GAINS = np.concatenate([[0.0, 1e-6, 0.999, 1.0], RNG.uniform(0, 1, ROWS - 4)])
HALF_LIVES = np.concatenate([[0.0, 1e-6, 1e-3], RNG.uniform(0.005, 3, ROWS - 3)])
VALUE, VELOCITY, GOAL = RNG.uniform(-2, 2, (3, ROWS))


def call(function, *args: ArrayLike | smoothing.Motion):
    """The function of these arguments, turned into arrays."""
    return function(*jax.tree.map(jnp.asarray, args))


def spring(value, velocity, goal, half_life, dt):
    """`smoothing.spring` of plain numbers."""
    return call(smoothing.spring, smoothing.Motion(value, velocity), goal, half_life, dt)


def follow(value, velocity, goal, fraction, dt, use_spring):
    """`smoothing.follow` of plain numbers."""
    motion = smoothing.Motion(value, velocity)
    return call(smoothing.follow, motion, goal, fraction, dt, use_spring)


def test_two_half_steps_equal_one_step():
    start, goal = jnp.asarray(3.0), jnp.asarray(1.0)
    for fraction in (
        lambda dt: call(smoothing.fraction_of_gain, GAINS, dt, 30.0),
        lambda dt: call(smoothing.fraction_of_half_life, HALF_LIVES, dt),
    ):
        half, whole = fraction(FRAME_TIMES / 2), fraction(FRAME_TIMES)
        twice = smoothing.lerp(smoothing.lerp(start, goal, half), goal, half)
        assert_allclose(twice, smoothing.lerp(start, goal, whole), rtol=1e-13)
        assert ((half >= 0) & (half <= whole) & (whole <= 1)).all()
    expected = spring(VALUE, VELOCITY, GOAL, HALF_LIVES, FRAME_TIMES)
    half = spring(VALUE, VELOCITY, GOAL, HALF_LIVES, FRAME_TIMES / 2)
    twice = spring(*half, GOAL, HALF_LIVES, FRAME_TIMES / 2)
    assert_allclose(twice, expected, rtol=1e-11, atol=1e-11)


def test_a_gain_compounds_over_ticks():
    one, seven = (
        call(smoothing.fraction_of_gain, GAINS, ticks / TICK_HZ, TICK_HZ) for ticks in (1, 7)
    )
    assert_allclose(one, GAINS, rtol=1e-13)
    assert_allclose(seven, 1 - (1 - GAINS) ** 7, rtol=1e-9)


def test_a_gain_and_its_half_life_give_the_same_fraction():
    half_life = call(smoothing.half_life_of_gain, GAINS, TICK_HZ)
    assert_allclose(call(smoothing.gain_of_half_life, half_life, TICK_HZ), GAINS, rtol=1e-12)
    assert_allclose(
        call(smoothing.fraction_of_half_life, half_life, FRAME_TIMES),
        call(smoothing.fraction_of_gain, GAINS, FRAME_TIMES, TICK_HZ),
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


def test_the_clamped_speed_equals_unreals_interp_to():
    gaps = [0.0, 9e-5, -9e-5, 1.1e-4, -1.1e-4, 1.0]
    cases = itertools.product([-1.0, 0.0, 0.7, 25.0, 40.0], [1 / 240, 1 / 30, 0.5], gaps)
    speed, dt, gap = np.array(list(cases)).T
    jumps = (speed <= 0) | (np.abs(gap) <= smoothing.JUMP_GAP)
    expected = np.where(jumps, 1.0, np.minimum(dt * speed, 1.0))
    assert_allclose(call(smoothing.fraction_of_speed, speed, dt, gap), expected, rtol=1e-15)


def test_the_half_life_of_a_clamped_speed_depends_on_the_frame_time():
    speed = np.concatenate([[-1.0, 0.0], RNG.uniform(0, 40, ROWS - 2)])
    half_life, longer = (
        np.asarray(call(smoothing.half_life_of_speed, speed, frames * FRAME_TIMES))
        for frames in (1.0, 1.5)
    )
    fraction = np.asarray(call(smoothing.fraction_of_speed, speed, FRAME_TIMES, 1.0))
    jumps = fraction == 1
    assert jumps.any() and (half_life[jumps] == 0).all()
    left = (1 - fraction) ** (half_life / FRAME_TIMES)
    assert_allclose(left[~jumps], 0.5, rtol=1e-10)
    assert (half_life > longer)[~jumps].all()


def test_the_spring_equals_the_exponential_of_its_matrix():
    half_lives = RNG.uniform(0.005, 3, ROWS)
    after = spring(VALUE, VELOCITY, GOAL, half_lives, FRAME_TIMES)
    for row, rate in enumerate(2 * np.log(2) / half_lives):
        transition = expm(FRAME_TIMES[row] * np.array([[0, 1], [-(rate**2), -2 * rate]]))
        gap, speed = transition @ [VALUE[row] - GOAL[row], VELOCITY[row]]
        assert_allclose(after.value[row], GOAL[row] + gap, atol=1e-11)
        assert_allclose(after.velocity[row], speed, atol=1e-11 * max(1, rate))


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


def laws(gain, half_life, dt, tick_hz):
    return (
        smoothing.fraction_of_gain(gain, dt, tick_hz),
        smoothing.fraction_of_half_life(half_life, dt),
        smoothing.gain_of_half_life(half_life, tick_hz),
    )


def springs(value, velocity, goal, half_life, dt):
    return spring(value, velocity, goal, half_life, dt), smoothing.lerp(value, goal, dt)


def clamped_speeds(speed, dt, gap):
    fraction = smoothing.fraction_of_speed(speed, dt, gap)
    return fraction, smoothing.half_life_of_speed(speed, dt)


def test_gradients_match_finite_differences():
    gain, half_life = RNG.uniform(0, 0.99, ROWS), RNG.uniform(0.01, 3, ROWS)
    assert_all_gradients_match(laws, gain, half_life, FRAME_TIMES, 30.0)
    assert_all_gradients_match(smoothing.half_life_of_gain, 0.005 + gain, 30.0)
    assert_all_gradients_match(springs, VALUE, VELOCITY, GOAL, half_life, FRAME_TIMES)
    speeds, gaps = np.meshgrid([-1.0, 0.5, 5.0, 25.0, 70.0], [0.0, 5e-3, -1.0])
    assert_all_gradients_match(clamped_speeds, speeds.ravel(), 1 / 50, gaps.ravel())


def test_gradients_stay_finite_at_the_limits():
    gains, half_lives = np.array([0.0, 1e-9, 1 - 1e-9, 1.0]), np.array([0.0, 1e-9, 1e-6, 1e9])
    jacobians = finite_jacobians(laws, gains, half_lives, 1 / 60, 30.0)
    assert_allclose(jacobians[-1, 0], 0, atol=0)
    finite_jacobians(springs, 3.0, 2.0, 1.0, half_lives, 1 / 60)
    for gap in (0.0, 1e-4):
        finite_jacobians(clamped_speeds, np.array([0.0, 60.0, 1e-9]), 1 / 60, gap)
    finite_jacobian(smoothing.half_life_of_gain, 1.0, 30.0)
