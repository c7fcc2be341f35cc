"""Gates: the hard one decides, the smooth one converges to it, both have finite gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from jaxik.maths.gate import HARD, AbstractGate, Hard, Smooth
from support.gradients import assert_gradients_match, finite_jacobian, numbers

few = settings(max_examples=15, derandomize=True, deadline=None)
BAND = 0.02
SOFT = Smooth(0.5)
GATES = {"hard": HARD, "smooth": SOFT}
rows = st.lists(numbers(-1, 1), min_size=4, max_size=4)
apart = numbers(-1, 1).filter(lambda x: abs(x) > 0.01)  # more than a step of a difference quotient


def below(gate: AbstractGate, x, threshold):
    return gate.below(x, threshold, band=BAND)


def above(gate: AbstractGate, x, threshold):
    return gate.above(x, threshold, band=BAND)


def clip(gate: AbstractGate, x, low, high):
    return gate.clip(x, low, high, band=BAND)


def clip_with_fixed_softness(gate: AbstractGate, x, low, high):
    """`clip` without a gradient in the softness."""
    return clip(jax.lax.stop_gradient(gate), x, low, high)


def minimum(gate: AbstractGate, x):
    return gate.minimum(x, band=BAND)


def maximum(gate: AbstractGate, x):
    return gate.maximum(x, band=BAND)


def choose(gate: AbstractGate, weight, yes, no):
    return gate.choose(weight, yes, no)


ROW = np.array([0.3, -0.2, 0.1, 0.7])
FUNCTIONS = {
    "below": (below, (ROW, 0.1)),
    "above": (above, (ROW, 0.1)),
    "choose": (choose, (np.array([0.0, 1.0, 0.2, 0.8]), ROW, -ROW)),
    "clip": (clip, (ROW, -0.1, 0.2)),
    "minimum": (minimum, (ROW,)),
    "maximum": (maximum, (ROW,)),
}


def everything(gate, args):
    return {name: function(gate, *args[name]) for name, (function, _) in FUNCTIONS.items()}


@pytest.mark.parametrize("gate", GATES.values(), ids=GATES)
def test_dtype_follows_the_inputs(gate):
    args = {name: args for name, (_, args) in FUNCTIONS.items()}
    for dtype in (jnp.float32, jnp.float64):
        cast = jax.tree.map(functools.partial(jnp.asarray, dtype=dtype), (gate, args))
        for name, output in jax.eval_shape(everything, *cast).items():
            assert output.dtype == dtype, name


@pytest.mark.parametrize("gate", GATES.values(), ids=GATES)
def test_a_compiled_batch_equals_the_vmap_of_single_calls(gate):
    rows = {name: [jnp.asarray(np.broadcast_to(x, (3, 4))) for x in args]
            for name, (_, args) in FUNCTIONS.items()}  # fmt: skip
    batch = jax.jit(everything)(gate, rows)
    singles = jax.jit(jax.vmap(everything, (None, 0)))(gate, rows)
    for name in FUNCTIONS:
        assert_allclose(batch[name], singles[name], atol=1e-15, err_msg=name)


def test_a_softness_given_as_a_python_float_keeps_single_precision():
    x = jnp.asarray(0.1, jnp.float32)
    assert below(Smooth(0.5), x, x).dtype == jnp.float32


@few
@given(numbers(-1, 1), numbers(-1, 1))
def test_the_hard_gate_is_both_below_and_above_at_the_threshold(x, threshold):
    jx, jt = jnp.asarray(x), jnp.asarray(threshold)
    assert below(HARD, jx, jt) == float(x <= threshold)
    assert above(HARD, jx, jt) == float(x >= threshold)
    assert below(HARD, jx, jx) == above(HARD, jx, jx) == 1.0


@few
@given(numbers(-1, 1), numbers(-1, 0), numbers(0, 1), rows)
def test_the_hard_gate_clips_and_finds_extremes_as_numpy_does(x, low, high, row):
    assert clip(HARD, *map(jnp.asarray, (x, low, high))) == np.clip(x, low, high)
    assert minimum(HARD, jnp.asarray(row)) == min(row)
    assert maximum(HARD, jnp.asarray(row)) == max(row)


def test_the_hard_gate_chooses_one_or_the_other_and_never_blends():
    weight, yes, no = jnp.linspace(0, 1, 11), jnp.asarray(3.0), jnp.asarray(-1.0)
    assert HARD.choose(weight, yes, no).tolist() == [-1.0] * 6 + [3.0] * 5


def test_the_hard_gate_gives_the_whole_gradient_to_one_of_several_equal_operands():
    tied = np.array([0.5, 0.2, 0.2])
    assert_allclose(finite_jacobian(minimum, HARD, tied), [[0, 1, 0]], atol=0)
    assert_allclose(finite_jacobian(maximum, HARD, -tied), [[0, 1, 0]], atol=0)
    for x in (-1.0, 1.0):
        assert_allclose(finite_jacobian(clip, HARD, x, -1.0, 1.0), [[1, 0, 0]], atol=0)


@pytest.mark.parametrize("at", range(3))
def test_the_hard_minimum_propagates_nan(at):
    assert np.isnan(minimum(HARD, jnp.asarray([1.0, -1.0, 0.0]).at[at].set(np.nan)))


def test_the_hard_program_contains_no_sigmoid():
    for function, args in FUNCTIONS.values():
        program = str(jax.make_jaxpr(function)(HARD, *map(jnp.asarray, args)))
        assert not any(word in program for word in ("logistic", "exp", "log", "tanh"))


@few
@given(numbers(-1, 1), numbers(-1, 1))
def test_the_smooth_gate_gives_half_at_the_threshold_and_its_weights_add_up_to_one(x, threshold):
    jx, jt = jnp.asarray(x), jnp.asarray(threshold)
    assert_allclose(below(SOFT, jx, jx), 0.5, atol=1e-15)
    assert_allclose(below(SOFT, jx, jt) + above(SOFT, jx, jt), 1.0, atol=1e-15)
    assert 0 <= below(SOFT, jx, jt) <= 1


def test_the_smooth_gate_blends_by_the_weight():
    assert_allclose(choose(SOFT, *map(jnp.asarray, (0.25, 3.0, -1.0))), 0.0, atol=1e-15)


@few
@given(numbers(-1, 1), apart, st.integers(0, 12))
def test_a_smooth_decision_converges_to_the_hard_one_exponentially(threshold, gap, exponent):
    x, jt = jnp.asarray(threshold + gap), jnp.asarray(threshold)
    softness = 10.0**-exponent
    error = abs(below(Smooth(softness), x, jt) - below(HARD, x, jt))
    assert error <= np.exp(-abs(gap) / (BAND * softness)) + 1e-15


@few
@given(
    numbers(-1, 1),
    numbers(-1, 0),
    numbers(0, 1),
    rows,
    st.integers(0, 12),
)
def test_a_smooth_clip_and_extreme_converge_in_proportion_to_the_softness(
    x, low, high, row, exponent
):
    soft, width = Smooth(10.0**-exponent), BAND * 10.0**-exponent
    args = [jnp.asarray(v) for v in (x, low, high)]
    assert abs(clip(soft, *args) - clip(HARD, *args)) <= np.log(2) * width + 1e-14
    values = jnp.asarray(row)
    bound = (len(row) - 1) * width / np.e + 1e-14
    assert -1e-14 <= minimum(soft, values) - minimum(HARD, values) <= bound
    assert -1e-14 <= maximum(HARD, values) - maximum(soft, values) <= bound


@few
@given(numbers(-1, 1), apart, st.sampled_from([0.02, 0.5, 1.0]))
def test_gradients_of_decisions_match_finite_differences(threshold, gap, softness):
    assert_gradients_match(below, HARD, threshold + gap, threshold)
    assert_gradients_match(below, Smooth(softness), threshold + gap, threshold)
    assert_gradients_match(above, Smooth(softness), threshold + gap, threshold)
    assert_gradients_match(below, Smooth(softness), threshold, threshold)


@few
@given(st.sampled_from([-0.9, -0.5, 0.1, 0.45, 0.9]), st.sampled_from([0.02, 0.5, 1.0]))
def test_gradients_of_limits_match_finite_differences(x, softness):
    assert_gradients_match(clip, HARD, x, -0.6, 0.5)
    assert_gradients_match(clip, Smooth(softness), x, -0.6, 0.5)


@few
@given(st.permutations(ROW.tolist()), st.sampled_from([0.02, 0.5, 1.0]))
def test_gradients_of_extremes_match_finite_differences(row, softness):
    assert_gradients_match(minimum, HARD, np.array(row))
    assert_gradients_match(maximum, Smooth(softness), np.array(row))


def test_gradients_of_a_choice_match_finite_differences():
    for weight in (0.0, 0.3, 1.0):
        assert_gradients_match(choose, HARD, weight, 3.0, -1.0)
        assert_gradients_match(choose, SOFT, weight, 3.0, -1.0)


@pytest.mark.parametrize("softness", [1e-3, 1e-6, 1e-12, 1e-60])
def test_gradients_stay_finite_as_softness_falls_to_zero(softness):
    soft = Smooth(softness)
    for x in (-0.1, 0.1, 0.2, 0.5):
        finite_jacobian(below, soft, x, 0.1)
        # Not in the softness itself, where it is a difference of two large numbers.
        finite_jacobian(clip_with_fixed_softness, soft, x, -0.1, 0.2)
    finite_jacobian(minimum, soft, ROW)
    finite_jacobian(minimum, soft, np.zeros(3))


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
