"""Operations of a program, counted before XLA fuses it.

XLA's own analysis counts the body of a loop once, so this one reads JAX's program. JAX does not
promise to keep the names that are read here: those of its primitives, the `length` of a scan, the
`dimension_numbers` of a product of matrices. Nothing else in this project depends on them.
"""

import itertools
import math
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
from jax.extend.core import Jaxpr, JaxprEqn, Var, jaxprs_in_params

# One operation for each element, whether a sine or a sum.
ARITHMETIC = frozenset(
    "add sub mul div rem max min sqrt rsqrt cbrt square integer_pow pow exp exp2 expm1 log log1p "
    "sin cos tan asin acos atan atan2 sinh cosh tanh logistic erf erfc add_any clamp".split()
)
REDUCTIONS = frozenset("reduce_sum reduce_max reduce_min argmin argmax cumsum cumprod".split())


def count_operations(
    program: Jaxpr, wanted: Iterable[bool] = itertools.repeat(True)
) -> tuple[float, list[bool]]:
    """Operations on floats, and which arguments they need.

    Code on which no result depends does not count, but a loop is taken as a whole. A loop of known
    length counts in full, one whose length depends on its data as one iteration; of branches, the
    longest counts.

    Args:
        program: to count in.
        wanted: which of its results are.
    """
    needed = _variables(program.outvars, wanted)
    total = 0.0
    for equation in reversed(program.eqns):
        results = [result in needed for result in equation.outvars]
        if not any(results):
            continue
        # A loop's results of one iteration are arguments of the next: all of them are wanted.
        within = results if equation.primitive.name == "jit" else itertools.repeat(True)
        called = [count_operations(inner, within) for inner in jaxprs_in_params(equation.params)]
        total += _operations(equation, [operations for operations, _ in called])
        needed |= _variables(equation.invars, _arguments(equation, [read for _, read in called]))
    return total, [argument in needed for argument in program.invars]


def _variables(values: Iterable[Any], selected: Iterable[bool]) -> set[Var]:
    """Those of the selected values that are no constants."""
    pairs = zip(values, selected, strict=False)
    return {value for value, is_selected in pairs if is_selected and isinstance(value, Var)}


def _operations(equation: JaxprEqn, called: list[float]) -> float:
    """Operations of one equation, given those of the programs that it calls."""
    name, parameters = equation.primitive.name, equation.params
    if name == "cond":
        return max(called)
    if name == "scan":
        return parameters["length"] * sum(called)
    if name in REDUCTIONS:
        return _floats(equation.invars[0].aval)
    if name in ARITHMETIC:
        return _floats(equation.outvars[0].aval)
    if name == "dot_general":
        contracted = parameters["dimension_numbers"][0][0]
        left: Any = equation.invars[0].aval
        depth = math.prod(left.shape[axis] for axis in contracted)
        return 2.0 * depth * _floats(equation.outvars[0].aval)
    return sum(called, 0.0)  # calls another program, or only moves numbers


def _arguments(equation: JaxprEqn, called: list[list[bool]]) -> Iterable[bool]:
    """Which arguments an equation reads, given which those of the programs that it calls are."""
    count = len(equation.invars)
    if called and all(len(read) == count for read in called):
        return [any(reads) for reads in zip(*called, strict=True)]
    return itertools.repeat(True)


def _floats(aval: Any) -> float:
    """How many floats an array holds."""
    return float(aval.size) if jnp.issubdtype(aval.dtype, jnp.floating) else 0.0
