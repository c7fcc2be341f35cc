"""Gates: the hard one decides, the smooth one converges to it, both have finite gradients."""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxik.maths.gate import HARD, Hard, Smooth
from support.gradients import (
    ROWS,
    assert_all_gradients_match,
    finite_jacobian,
    finite_jacobians,
)

BAND = 0.02
SOFT = Smooth(0.5)
SOFTNESSES = np.array([0.02, 0.5, 1.0])
RNG = np.random.default_rng(0)
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


def test_a_softness_given_as_a_python_float_keeps_single_precision():
    x = jnp.asarray(0.1, jnp.float32)
    assert below(Smooth(0.5), x, x).dtype == jnp.float32


def test_the_hard_gate_decides_clips_and_finds_extremes_as_numpy_does():
    assert_allclose(below(HARD, X, THRESHOLD), X <= THRESHOLD, atol=0)
    assert_allclose(above(HARD, X, THRESHOLD), X >= THRESHOLD, atol=0)
    assert_allclose(below(HARD, X, X) * above(HARD, X, X), 1.0, atol=0)
    assert_allclose(clip(HARD, X, LOW, HIGH), np.clip(X, LOW, HIGH), atol=0)
    assert_allclose(minimum(HARD, SETS), SETS.min(axis=-1), atol=0)
    assert_allclose(maximum(HARD, SETS), SETS.max(axis=-1), atol=0)


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


def test_the_hard_minimum_propagates_nan():
    assert np.isnan(minimum(HARD, np.where(np.eye(3), np.nan, [1.0, -1.0, 0.0]))).all()


def test_the_hard_program_contains_no_sigmoid():
    def everything(x, low, high, sets):
        decided = *decisions(HARD, x, low), clip(HARD, x, low, high), choose(HARD, x, low, high)
        return *decided, minimum(HARD, sets), maximum(HARD, sets)

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


def test_gradients_match_finite_differences():
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


def test_gradients_stay_finite_as_softness_falls_to_zero():
    x, softness = np.meshgrid([-0.1, 0.1, 0.2, 0.5], [1e-3, 1e-6, 1e-12, 1e-60])
    soft = Smooth(softness.ravel())
    finite_jacobians(below, soft, x.ravel(), 0.1)
    # Not in the softness itself, where it is a difference of two large numbers.
    finite_jacobians(clip_with_fixed_softness, soft, x.ravel(), -0.1, 0.2)
    for values in SETS[:3]:
        finite_jacobians(minimum, soft, np.tile(values, (soft.softness.size, 1)))


def test_a_new_softness_does_not_recompile():
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
