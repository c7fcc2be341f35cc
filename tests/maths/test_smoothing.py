"""Smoothing laws: exact at any frame time, at their limits, and their slopes."""

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
from support.slopes import assert_slopes_agree, finite_slopes, numbers

few = settings(max_examples=15, derandomize=True, deadline=None)
frame_times = st.sampled_from([1 / 240, 1 / 120, 1 / 60, 1 / 30, 0.5])
gains = st.sampled_from([0.0, 1e-6, 0.999, 1.0]) | numbers(0, 1)
half_lives = st.sampled_from([0.0, 1e-6, 1e-3]) | numbers(0.005, 3)

X = np.array([0.1, 0.4, 0.7])
FUNCTIONS = {
    "lerp": (smoothing.lerp, (X, -X, X)),
    "fraction_of_gain": (smoothing.fraction_of_gain, (X, X, 30 * X)),
    "fraction_of_half_life": (smoothing.fraction_of_half_life, (X, X)),
    "fraction_of_speed": (smoothing.fraction_of_speed, (X, X, X)),
    "spring": (smoothing.spring, (X, -X, 2 * X, X, X)),
    "follow": (smoothing.follow, (X, -X, 2 * X, X, X, X > 0.3)),
    "half_life_of_gain": (smoothing.half_life_of_gain, (X, 30 * X)),
    "gain_of_half_life": (smoothing.gain_of_half_life, (X, 30 * X)),
    "half_life_of_speed": (smoothing.half_life_of_speed, (X, X)),
}


def call(function, *args: ArrayLike):
    return function(*map(jnp.asarray, args))


def everything(args):
    return {name: function(*args[name]) for name, (function, _) in FUNCTIONS.items()}


def sprung(value, velocity, goal, half_life, dt):
    return smoothing.spring(value, velocity, goal, half_life, dt), smoothing.lerp(value, goal, dt)


def shares(gain, half_life, dt, tick_hz):
    """Several answers in one program: most of a test's time goes into compiling."""
    return (
        smoothing.fraction_of_gain(gain, dt, tick_hz),
        smoothing.fraction_of_half_life(half_life, dt),
        smoothing.gain_of_half_life(half_life, tick_hz),
    )


def test_precision_follows_the_inputs():
    for dtype in (jnp.float32, jnp.float64):
        args = {
            name: [jnp.asarray(x, dtype) for x in args] for name, (_, args) in FUNCTIONS.items()
        }
        for name, answer in jax.eval_shape(everything, args).items():
            assert {leaf.dtype for leaf in jax.tree.leaves(answer)} == {jnp.dtype(dtype)}, name


def test_a_compiled_batch_is_many_singles():
    args = {name: [jnp.asarray(x) for x in args] for name, (_, args) in FUNCTIONS.items()}
    batch, singles = jax.jit(everything)(args), jax.jit(jax.vmap(everything))(args)
    for name in FUNCTIONS:
        for one, other in zip(*map(jax.tree.leaves, (batch[name], singles[name])), strict=True):
            assert_allclose(one, other, 1e-14, 1e-14, err_msg=name)


@few
@given(gains, half_lives, frame_times)
def test_two_half_steps_are_one_step(gain, half_life, dt):
    start, goal = jnp.asarray(3.0), jnp.asarray(1.0)
    for share in (
        lambda dt: call(smoothing.fraction_of_gain, gain, dt, 30.0),
        lambda dt: call(smoothing.fraction_of_half_life, half_life, dt),
    ):
        half = share(dt / 2)
        twice = smoothing.lerp(smoothing.lerp(start, goal, half), goal, half)
        assert_allclose(twice, smoothing.lerp(start, goal, share(dt)), rtol=1e-13)
        assert 0 <= half <= share(dt) <= 1


@few
@given(numbers(), numbers(), numbers(), half_lives, frame_times)
def test_two_half_steps_of_the_spring_are_one_step(value, velocity, goal, half_life, dt):
    once = call(smoothing.spring, value, velocity, goal, half_life, dt)
    half = call(smoothing.spring, value, velocity, goal, half_life, dt / 2)
    assert_allclose(
        call(smoothing.spring, *half, goal, half_life, dt / 2), once, rtol=1e-11, atol=1e-11
    )


@few
@given(gains, st.sampled_from([30.0, 60.0]))
def test_a_gain_closes_its_share_in_a_tick_and_all_but_its_power_in_many(gain, tick_hz):
    assert_allclose(call(smoothing.fraction_of_gain, gain, 1 / tick_hz, tick_hz), gain, rtol=1e-13)
    many = call(smoothing.fraction_of_gain, gain, 7 / tick_hz, tick_hz)
    assert_allclose(many, 1 - (1 - gain) ** 7, rtol=1e-9)


@few
@given(gains, st.sampled_from([30.0, 60.0]), frame_times)
def test_a_gain_and_its_half_life_are_the_same_law(gain, tick_hz, dt):
    half_life = call(smoothing.half_life_of_gain, gain, tick_hz)
    assert_allclose(call(smoothing.gain_of_half_life, half_life, tick_hz), gain, rtol=1e-12)
    assert_allclose(
        call(smoothing.fraction_of_half_life, half_life, dt),
        call(smoothing.fraction_of_gain, gain, dt, tick_hz),
        rtol=1e-12,
    )


def test_half_a_gap_is_closed_in_a_half_life_and_three_quarters_in_two():
    assert_allclose(call(smoothing.fraction_of_half_life, 0.2, 0.2), 0.5, rtol=1e-15)
    assert_allclose(call(smoothing.fraction_of_half_life, 0.2, 0.4), 0.75, rtol=1e-15)
    assert_allclose(call(smoothing.half_life_of_gain, 0.5, 30.0), 1 / 30, rtol=1e-15)


def test_gain_one_and_half_lives_of_zero_or_less_jump_and_gain_zero_stays():
    dt, hz = 1 / 60, 30.0
    assert call(smoothing.fraction_of_gain, 1.0, dt, hz) == 1
    assert call(smoothing.fraction_of_gain, 0.0, dt, hz) == 0
    for half_life in (0.0, -0.1):
        assert call(smoothing.fraction_of_half_life, half_life, dt) == 1
        assert call(smoothing.gain_of_half_life, half_life, hz) == 1
        assert call(smoothing.spring, 3.0, 2.0, 1.0, half_life, dt) == (1.0, 0.0)
    assert call(smoothing.half_life_of_gain, 1.0, hz) == 0
    assert call(smoothing.half_life_of_gain, 0.0, hz) == np.inf
    assert call(smoothing.fraction_of_half_life, np.inf, dt) == 0


def test_no_time_moves_nothing():
    assert call(smoothing.fraction_of_gain, 0.3, 0.0, 30.0) == 0
    assert call(smoothing.fraction_of_half_life, 0.3, 0.0) == 0
    assert call(smoothing.spring, 3.0, 2.0, 1.0, 0.3, 0.0) == (3.0, 2.0)


@few
@given(numbers(-1, 40), frame_times, st.sampled_from([0.0, 9e-5, -9e-5, 1.1e-4, -1.1e-4, 1.0]))
def test_the_clamped_speed_is_unreals_interp_to(speed, dt, gap):
    jumps = speed <= 0 or abs(gap) <= smoothing.JUMP_GAP
    expected = 1.0 if jumps else min(dt * speed, 1.0)
    assert_allclose(call(smoothing.fraction_of_speed, speed, dt, gap), expected, rtol=1e-15)


@few
@given(numbers(-1, 40), frame_times)
def test_the_half_life_of_a_speed_halves_the_gap_and_depends_on_the_frame_time(speed, dt):
    half_life = float(call(smoothing.half_life_of_speed, speed, dt))
    share = float(call(smoothing.fraction_of_speed, speed, dt, 1.0))
    if share == 1:
        assert half_life == 0
    else:
        assert_allclose((1 - share) ** (half_life / dt), 0.5, rtol=1e-10)
        assert half_life > call(smoothing.half_life_of_speed, speed, 1.5 * dt)


@few
@given(numbers(), numbers(), numbers(), numbers(0.005, 3), frame_times)
def test_the_spring_is_the_exponential_of_its_matrix(value, velocity, goal, half_life, dt):
    rate = 2 * np.log(2) / half_life
    motion = expm(dt * np.array([[0, 1], [-(rate**2), -2 * rate]]))
    gap, speed = motion @ [value - goal, velocity]
    moved = call(smoothing.spring, value, velocity, goal, half_life, dt)
    assert_allclose(moved[0], goal + gap, atol=1e-11)
    assert_allclose(moved[1], speed, atol=1e-11 * max(1, rate))


def test_the_spring_solves_its_differential_equation():
    rate, goal, times = 2 * np.log(2) / 0.2, 0.7, np.linspace(0.1, 1.5, 8)
    answer = solve_ivp(
        lambda _, state: [state[1], -(rate**2) * (state[0] - goal) - 2 * rate * state[1]],
        (0, 1.5),
        [2.0, -3.0],
        t_eval=times,
        rtol=1e-11,
        atol=1e-12,
    )
    start, velocity = jnp.full(8, 2.0), jnp.full(8, -3.0)
    moved = call(smoothing.spring, start, velocity, goal, 0.2, times)
    assert_allclose(moved, answer.y, atol=1e-9)


def test_what_follows_goals_told_frame_by_frame_solves_the_equation_of_each():
    """With one half-life up and one down, chosen as each frame begins."""
    rng, dt = np.random.default_rng(0), 1 / 30
    sprung = wanted = np.array([0.4, 0.0])
    eased = 0.4
    for goal in np.repeat(rng.normal(size=12), 4):
        half_life = 0.15 if goal > wanted[0] else 0.06
        rate = 2 * np.log(2) / half_life
        wanted = solve_ivp(
            lambda _, x, w=rate, g=goal: [x[1], -(w**2) * (x[0] - g) - 2 * w * x[1]],
            (0, dt),
            wanted,
            rtol=1e-11,
            atol=1e-12,
        ).y[:, -1]
        share = call(smoothing.fraction_of_half_life, half_life, dt)
        sprung = np.array(call(smoothing.follow, *sprung, goal, share, dt, True))
        assert_allclose(sprung, wanted, atol=1e-8)
        moved, velocity = call(smoothing.follow, eased, 3.0, goal, share, dt, False)
        assert_allclose(moved, goal + (eased - goal) * 2 ** (-dt / half_life), rtol=1e-12)
        assert velocity == 0
        eased = float(moved)


def test_a_share_of_one_jumps_and_stops():
    for springy in (False, True):
        assert call(smoothing.follow, 3.0, 2.0, 1.0, 1.0, 1 / 60, springy) == (1.0, 0.0)


def test_a_spring_at_rest_creeps_to_its_goal_without_passing_it_and_stays():
    still, times = np.zeros(100), np.linspace(0.01, 10, 100)
    moved, speed = map(np.asarray, call(smoothing.spring, still, still, 1.0, 0.1, times))
    assert (np.diff(moved) >= 0).all() and (moved <= 1).all() and (speed >= 0).all()
    assert_allclose((moved[-1], speed[-1]), (1, 0), atol=1e-15)
    assert call(smoothing.spring, 1.0, 0.0, 1.0, 0.1, 0.5) == (1.0, 0.0)


@few
@given(numbers(0, 0.99), numbers(0.005, 3), frame_times)
def test_slopes_of_exponential_laws_are_those_of_differences(gain, half_life, dt):
    assert_slopes_agree(shares, gain, half_life, dt, 30.0)
    assert_slopes_agree(smoothing.half_life_of_gain, 0.005 + gain, 30.0)


@few
@given(numbers(), numbers(), numbers(), numbers(0.01, 3), frame_times)
def test_slopes_of_the_spring_are_those_of_differences(value, velocity, goal, half_life, dt):
    assert_slopes_agree(sprung, value, velocity, goal, half_life, dt)


@few
@given(st.sampled_from([-1.0, 0.5, 5.0, 25.0, 70.0]), st.sampled_from([0.0, 5e-3, -1.0]))
def test_slopes_of_the_clamped_speed_are_those_of_differences(speed, gap):
    assert_slopes_agree(smoothing.fraction_of_speed, speed, 1 / 50, gap)
    assert_slopes_agree(smoothing.half_life_of_speed, speed, 1 / 50)


def test_slopes_stay_finite_at_the_limits():
    for gain in (0.0, 1e-9, 1 - 1e-9, 1.0):
        finite_slopes(shares, gain, 0.1, 1 / 120, 30.0)
    assert_allclose(finite_slopes(shares, 1.0, 0.1, 1 / 120, 30.0)[0], 0, atol=0)
    for half_life in (0.0, 1e-9, 1e-6, 1e9):
        finite_slopes(shares, 0.5, half_life, 1 / 60, 30.0)
        finite_slopes(sprung, 3.0, 2.0, 1.0, half_life, 1 / 60)
    for speed in (0.0, 60.0, 1e-9):
        finite_slopes(smoothing.fraction_of_speed, speed, 1 / 60, 0.0)
        finite_slopes(smoothing.fraction_of_speed, speed, 1 / 60, 1e-4)
        finite_slopes(smoothing.half_life_of_speed, speed, 1 / 60)
    finite_slopes(smoothing.half_life_of_gain, 1.0, 30.0)
