"""Gates and smoothing laws: exact, correct at their limits, with correct gradients.

The hard gate decides, the smooth one converges to it. Laws are exact at any frame time.
"""

import functools
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from jaxik.maths import smoothing
from jaxik.maths.gate import HARD, Hard, Smooth
from support.gradients import ROWS, assert_all_gradients_match, finite_jacobian, finite_jacobians

RNG = np.random.default_rng(0)


# Gates.

BAND = 0.02
SOFT = Smooth(0.5)
SOFTNESSES = np.array([0.02, 0.5, 1.0])
X, THRESHOLD, LOW, HIGH = RNG.uniform([[-1], [-1], [-1], [0]], [[1], [1], [0], [1]], (4, ROWS))
THRESHOLD[:2] = X[0], X[1] + 0.01
X[2], X[3] = LOW[2], HIGH[3]
SETS = RNG.uniform(-1, 1, (ROWS, 4))  # to find extremes of
SETS[:3] = [0.3, -0.2, 0.1, 0.7], [0.5, 0.5, -0.5, -0.5], [0.0, 0.0, 0.0, 0.0]


def method(name: str, **band: float) -> Callable[..., jax.Array]:
    """The method of any gate, as a function of the gate and of plain numbers."""
    return lambda gate, *args: getattr(gate, name)(*map(jnp.asarray, args), **band)


below, above, clip, minimum, maximum = (
    method(name, band=BAND) for name in ("below", "above", "clip", "minimum", "maximum")
)
choose = method("choose")


def decisions(gate, x, threshold):
    return below(gate, x, threshold), above(gate, x, threshold)


def clip_with_fixed_softness(gate, x, low, high):
    return clip(jax.lax.stop_gradient(gate), x, low, high)


def test_the_hard_gate_decides_clips_and_finds_extremes_as_numpy_does():
    assert_allclose(below(HARD, X, THRESHOLD), X <= THRESHOLD, atol=0)
    assert_allclose(above(HARD, X, THRESHOLD), X >= THRESHOLD, atol=0)
    assert_allclose(below(HARD, X, X) * above(HARD, X, X), 1.0, atol=0)
    assert_allclose(clip(HARD, X, LOW, HIGH), np.clip(X, LOW, HIGH), atol=0)
    assert_allclose(minimum(HARD, SETS), SETS.min(axis=-1), atol=0)
    assert_allclose(maximum(HARD, SETS), SETS.max(axis=-1), atol=0)
    assert np.isnan(minimum(HARD, np.where(np.eye(3), np.nan, [1.0, -1.0, 0.0]))).all()


def test_the_hard_gate_chooses_one_or_the_other_and_the_smooth_one_blends_by_the_weight():
    weight = np.linspace(0, 1, 11)
    assert choose(HARD, weight, 3.0, -1.0).tolist() == [-1.0] * 6 + [3.0] * 5
    assert_allclose(choose(SOFT, weight, 3.0, -1.0), 4.0 * weight - 1.0, atol=1e-15)


def test_the_hard_gate_gives_the_whole_gradient_to_one_of_several_equal_operands():
    tied = np.array([0.5, 0.2, 0.2])
    assert_allclose(finite_jacobian(minimum, HARD, tied), [[0, 1, 0]], atol=0)
    assert_allclose(finite_jacobian(maximum, HARD, -tied), [[0, 1, 0]], atol=0)
    for x in (-1.0, 1.0):
        assert_allclose(finite_jacobian(clip, HARD, x, -1.0, 1.0), [[1, 0, 0]], atol=0)


def test_the_hard_program_contains_no_sigmoid():
    def everything(x, low, high, sets):
        chosen = choose(HARD, x, low, high), clip(HARD, x, low, high)
        return decisions(HARD, x, low), chosen, minimum(HARD, sets), maximum(HARD, sets)

    program = str(jax.make_jaxpr(everything)(X, LOW, HIGH, SETS))
    assert not any(word in program for word in ("logistic", "exp", "log", "tanh"))


def test_the_smooth_gate_gives_half_at_the_threshold_and_its_weights_add_up_to_one():
    assert_allclose(below(SOFT, X, X), 0.5, atol=1e-15)
    weight = below(SOFT, X, THRESHOLD)
    assert_allclose(weight + above(SOFT, X, THRESHOLD), 1.0, atol=1e-15)
    assert ((weight >= 0) & (weight <= 1)).all()


@pytest.mark.parametrize("exponent", range(0, 13, 2))
def test_the_smooth_gate_converges_to_the_hard_one(exponent):
    """A decision exponentially, a limit and an extreme in proportion to the softness."""
    soft, width = Smooth(10.0**-exponent), BAND * 10.0**-exponent
    apart = np.abs(X - THRESHOLD) > 1e-3
    error = np.abs(below(soft, X, THRESHOLD) - below(HARD, X, THRESHOLD))[apart]
    assert (error <= np.exp(-np.abs(X - THRESHOLD)[apart] / width) + 1e-15).all()
    gap = np.abs(clip(soft, X, LOW, HIGH) - clip(HARD, X, LOW, HIGH))
    assert (gap <= np.log(2) * width + 1e-14).all()
    bound = (SETS.shape[1] - 1) * width / np.e + 1e-14
    for gap in (minimum(soft, SETS) - SETS.min(-1), SETS.max(-1) - maximum(soft, SETS)):
        assert ((gap >= -1e-14) & (gap <= bound)).all()


def test_gradients_of_gates_match_finite_differences():
    gaps = RNG.uniform(0.02, 1, ROWS) * RNG.choice([-1, 1], ROWS)
    soft = Smooth(np.resize(SOFTNESSES, ROWS))
    assert_all_gradients_match(decisions, HARD, THRESHOLD + gaps, THRESHOLD)
    assert_all_gradients_match(decisions, soft, THRESHOLD + gaps, THRESHOLD)
    assert_all_gradients_match(decisions, soft, THRESHOLD, THRESHOLD)
    x, softness = np.array(list(itertools.product([-0.9, -0.5, 0.1, 0.45, 0.9], SOFTNESSES))).T
    assert_all_gradients_match(clip, HARD, x, -0.6, 0.5)
    assert_all_gradients_match(clip, Smooth(softness), x, -0.6, 0.5)
    orders = np.array(list(itertools.permutations([0.3, -0.2, 0.1, 0.7])))
    assert_all_gradients_match(minimum, HARD, orders)
    assert_all_gradients_match(maximum, Smooth(np.resize(SOFTNESSES, len(orders))), orders)
    for gate in (HARD, SOFT):
        assert_all_gradients_match(choose, gate, np.array([0.0, 0.3, 1.0]), 3.0, -1.0)


def test_gradients_of_gates_stay_finite_as_softness_falls_to_zero():
    x, softness = np.meshgrid([-0.1, 0.1, 0.2, 0.5], [1e-3, 1e-6, 1e-12, 1e-60])
    soft = Smooth(softness.ravel())
    finite_jacobians(below, soft, x.ravel(), 0.1)
    # Not in the softness itself, where it is a difference of two large numbers.
    finite_jacobians(clip_with_fixed_softness, soft, x.ravel(), -0.1, 0.2)
    for values in SETS[:3]:
        finite_jacobians(minimum, soft, np.tile(values, (soft.softness.size, 1)))


def test_a_softness_may_be_a_float_and_a_new_one_does_not_recompile():
    x = jnp.asarray(0.1, jnp.float32)
    assert below(Smooth(0.5), x, x).dtype == jnp.float32
    traces = []

    @jax.jit
    def decide(gate, x):
        traces.append(gate)
        return below(gate, x, 0.1 * x)

    for softness in (1.0, 0.1, 1e-6):
        decide(Smooth(softness), jnp.asarray(0.3))
    assert len(traces) == 1
    decide(Hard(), jnp.asarray(0.3))
    assert len(traces) == 2


# Smoothing laws.

FRAME_TIMES = RNG.permutation(np.resize([1 / 240, 1 / 120, 1 / 60, 1 / 30, 0.5], ROWS))
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
    half, whole = (
        call(smoothing.fraction_of_half_life, HALF_LIVES, dt)
        for dt in (FRAME_TIMES / 2, FRAME_TIMES)
    )
    twice = smoothing.lerp(smoothing.lerp(start, goal, half), goal, half)
    assert_allclose(twice, smoothing.lerp(start, goal, whole), rtol=1e-13)
    assert ((half >= 0) & (half <= whole) & (whole <= 1)).all()
    expected = spring(VALUE, VELOCITY, GOAL, HALF_LIVES, FRAME_TIMES)
    half = spring(VALUE, VELOCITY, GOAL, HALF_LIVES, FRAME_TIMES / 2)
    twice = spring(*half, GOAL, HALF_LIVES, FRAME_TIMES / 2)
    assert_allclose(twice, expected, rtol=1e-11, atol=1e-11)


def test_a_half_life_closes_half_of_the_gap_or_all_if_it_is_zero_and_none_if_infinite():
    dt = 1 / 60
    assert_allclose(call(smoothing.fraction_of_half_life, 0.2, 0.2), 0.5, rtol=1e-15)
    assert_allclose(call(smoothing.fraction_of_half_life, 0.2, 0.4), 0.75, rtol=1e-15)
    for half_life in (0.0, -0.1):
        assert call(smoothing.fraction_of_half_life, half_life, dt) == 1
        assert spring(3.0, 2.0, 1.0, half_life, dt) == (1.0, 0.0)
    for use_spring in (False, True):
        assert follow(3.0, 2.0, 1.0, 1.0, dt, use_spring) == (1.0, 0.0)
    assert call(smoothing.fraction_of_half_life, np.inf, dt) == 0
    # And nothing moves in no time.
    assert call(smoothing.fraction_of_half_life, 0.3, 0.0) == 0
    assert spring(3.0, 2.0, 1.0, 0.3, 0.0) == (3.0, 2.0)


def test_the_clamped_speed_equals_unreals_interp_to():
    gaps = [0.0, 9e-7, -9e-7, 1.1e-6, -1.1e-6, 1.0]
    cases = itertools.product([-1.0, 0.0, 0.7, 25.0, 40.0], [1 / 240, 1 / 30, 0.5], gaps)
    speed, dt, gap = np.array(list(cases)).T
    jumps = (speed <= 0) | (np.abs(gap) <= smoothing.JUMP_GAP)
    expected = np.where(jumps, 1.0, np.minimum(dt * speed, 1.0))
    assert_allclose(call(smoothing.fraction_of_speed, speed, dt, gap), expected, rtol=1e-15)


@functools.partial(jax.jit, static_argnums=3)
def fades(start: float, goal: float, time: ArrayLike, frames: int) -> jax.Array:
    """A weight after so many frames of 1/60 s that goes all the way in `time`, s."""
    step = smoothing.step_of_time(jnp.asarray(time), jnp.asarray(1 / 60))
    toward = functools.partial(smoothing.move_towards, goal=jnp.asarray(goal), step=step)
    return jax.lax.fori_loop(0, frames, lambda _, weight: toward(weight), jnp.asarray(start))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_weight_arrives_with_a_whole_number_of_steps_however_these_are_rounded(dtype):
    for frames in (3, 12, 49, 60):
        for start, goal in ((dtype(0.0), dtype(1.0)), (dtype(1.0), dtype(0.0))):
            arrives, slope = jax.value_and_grad(fades, 2)(start, goal, dtype(frames / 60), frames)
            assert arrives == goal and slope == 0
    gradual = jax.grad(fades, 2)(dtype(0.0), dtype(1.0), dtype(0.2), 11)
    assert_allclose(gradual, -11 / 60 / 0.2**2, rtol=1e-5)
    assert smoothing.move_towards(*map(jnp.asarray, (1.0 - 1e-6, 1.0, 0.0))) == 1.0 - 1e-6


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
        law = lambda _, x, w=rate, g=goal: [x[1], -(w**2) * (x[0] - g) - 2 * w * x[1]]  # noqa: E731
        expected = solve_ivp(law, (0, dt), expected, rtol=1e-11, atol=1e-12).y[:, -1]
        fraction = call(smoothing.fraction_of_half_life, half_life, dt)
        sprung = np.array(follow(sprung[0], sprung[1], goal, fraction, dt, True))
        assert_allclose(sprung, expected, atol=1e-8)
        value, velocity = follow(eased, 3.0, goal, fraction, dt, False)
        assert_allclose(value, goal + (eased - goal) * 2 ** (-dt / half_life), rtol=1e-12)
        assert velocity == 0
        eased = float(value)


def springs(value, velocity, goal, half_life, dt):
    return spring(value, velocity, goal, half_life, dt), smoothing.lerp(value, goal, dt)


def test_gradients_of_laws_match_finite_differences():
    half_life = RNG.uniform(0.01, 3, ROWS)
    assert_all_gradients_match(smoothing.fraction_of_half_life, half_life, FRAME_TIMES)
    assert_all_gradients_match(springs, VALUE, VELOCITY, GOAL, half_life, FRAME_TIMES)
    speeds, gaps = np.meshgrid([-1.0, 0.5, 5.0, 25.0, 70.0], [0.0, 5e-3, -1.0])
    assert_all_gradients_match(smoothing.fraction_of_speed, speeds.ravel(), 1 / 50, gaps.ravel())


def test_gradients_of_laws_stay_finite_at_the_limits():
    half_lives = np.array([0.0, 1e-9, 1e-6, 1e9, np.inf])
    jacobians = finite_jacobians(smoothing.fraction_of_half_life, half_lives, 1 / 60)
    assert_allclose(jacobians[[0, -1]], 0, atol=0)
    finite_jacobians(springs, 3.0, 2.0, 1.0, half_lives, 1 / 60)
    for gap in (0.0, 1e-6):
        finite_jacobians(smoothing.fraction_of_speed, np.array([0.0, 60.0, 1e-9]), 1 / 60, gap)
