"""Functions of numbers: a batch has the results of single calls, in the precision of its inputs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.gate import HARD, Smooth
from support.clips import assert_close
from support.gradients import unit

RNG = np.random.default_rng(0)
X, Y = RNG.uniform(0.1, 0.9, (2, 4))
A, B, C = unit(RNG.normal(size=(3, 4, 3)))
P, Q = unit(RNG.normal(size=(2, 4, 4)))
MOTION = smoothing.Motion(X, -X)
ARGUMENTS = {
    vec: {
        "unstack": (A,), "components": (A,), "stack": (X, Y, X), "barrier": (A,),
        "stacked_barrier": (X, Y), "dot": (A, B), "cross": (A, B), "scale": (A, X),
        "safe_sqrt": (X,), "safe_divide": (X, Y), "safe_arctan2": (X, Y), "cos_sin": (X,),
        "add": (A, B), "length": (A,), "normalize": (A, B), "reject": (A, B), "across": (A, B, B),
    },
    quat: {
        "components": (Q,), "stack": (X, Y, X, Y), "multiply": (P, Q), "conjugate": (Q,),
        "rotate": (Q, A), "axes": (Q,), "unrotate": (Q, A), "dot": (P, Q), "normalize": (3.0 * Q,),
        "half_angle": (X, Y), "half_cos_sin": (X,), "from_half_angle": (A, X, Y),
        "from_cos_sin": (A, X, Y), "from_axis_angle": (A, X), "from_rotvec": (A,),
        "shortest_arc": (A, B, C), "nlerp": (P, Q, X), "nlerp_identity": (Q, X),
        "nlerp_half": (X, Y, X), "angle": (P, Q),
    },
    smoothing: {
        "lerp": (X, -X, X), "fraction_of_gain": (X, X, 30 * X), "fraction_of_half_life": (X, X),
        "fraction_of_speed": (X, X, X), "spring": (MOTION, 2 * X, X, X),
        "follow": (MOTION, 2 * X, X, X, X > 0.3), "half_life_of_gain": (X, 30 * X),
        "gain_of_half_life": (X, 30 * X), "half_life_of_speed": (X, X),
    },
}  # fmt: skip
DECISIONS = {
    "below": (X, Y), "above": (X, Y), "choose": (X, Y, -Y), "clip": (X, -0.1 * Y, 0.2 * Y),
    "minimum": (Q,), "maximum": (Q,),
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
