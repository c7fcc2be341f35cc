"""The least that a program has to do, and the least time in which a machine could do it.

This is the roofline model with dispatch added. Bytes are those of the arguments, read once, and of
the results, written once. Operations are counted in JAX's program, before XLA fuses it, as XLA's
own analysis counts the body of a loop once. Both are lower bounds: a program that is close to
neither spends its time on something else. JAX does not promise to keep the names that are read
here, and nothing else in this project depends on them.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, JaxprEqn, Var, jaxprs_in_params
from jax.stages import Compiled, Traced
from jaxtyping import PyTree

# One operation for each element, whether a sine or a sum.
ARITHMETIC = frozenset(
    "add sub mul div rem max min sqrt rsqrt cbrt square integer_pow pow exp exp2 expm1 log log1p "
    "sin cos tan asin acos atan atan2 sinh cosh tanh logistic erf erfc add_any clamp".split()
)
REDUCTIONS = frozenset("reduce_sum reduce_max reduce_min argmin argmax cumsum cumprod".split())


@dataclasses.dataclass(frozen=True)
class Work:
    """The least that a program has to do, and the memory it uses."""

    operations: float = 0.0
    """On floats."""
    moved: float = 0.0
    """Bytes of arguments and results."""
    workspace: float = 0.0
    """Bytes besides those."""

    def __mul__(self, times: int | float) -> "Work":
        """The work of several runs, which use the same workspace again."""
        return Work(times * self.operations, times * self.moved, self.workspace)


def work_of_program(traced: Traced, compiled: Compiled, sparse: PyTree = ()) -> Work:
    """The work of a program, traced by `jax.jit(function).trace(*arguments)` and compiled.

    Bytes of `sparse` arguments do not count: a run reads little of them.
    """
    program = traced.jaxpr.jaxpr
    operations, needed = count_operations(program)
    skipped = {(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(sparse)}
    read = [
        _bytes(argument.aval)
        for argument, is_needed in zip(program.invars, needed, strict=True)
        if is_needed and (argument.aval.shape, argument.aval.dtype) not in skipped
    ]
    written = [_bytes(result.aval) for result in program.outvars]
    memory = compiled.memory_analysis()  # None on some devices
    workspace = float(memory.temp_size_in_bytes) if memory else math.nan
    return Work(operations, sum(read) + sum(written), workspace)


def _bytes(aval: Any) -> float:
    return float(aval.size * aval.dtype.itemsize)


def lower_bound(work: Work, ceilings: Mapping[str, float], floats: str) -> tuple[float, str]:
    """Least seconds in which the work can be done, and which of the ceilings bounds it.

    Ceilings are those of the machine: "memory" in bytes per second, "float32" and "float64" in
    operations per second, "dispatch" in seconds of a program that does nothing. The bound of the
    floats is called "arithmetic".
    """
    seconds = {
        "memory": work.moved / ceilings["memory"],
        "arithmetic": work.operations / ceilings[floats],
        "dispatch": ceilings["dispatch"],
    }
    bound = max(seconds, key=lambda name: seconds[name])
    return seconds[bound], bound


def count_operations(
    program: Jaxpr, wanted: Iterable[bool] = itertools.repeat(True)
) -> tuple[float, list[bool]]:
    """Operations on floats, and which arguments the wanted results need.

    Code on which no result depends does not count, but a loop is taken as a whole. A loop of known
    length counts in full, one whose length depends on its data as one iteration; of branches, the
    longest counts.
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
    """Those of the selected values that are not constants."""
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
