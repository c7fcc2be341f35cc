"""The least that a program has to do, and the least time in which a machine could do it.

This is the roofline model with dispatch added. Operations are counted in the program before XLA
fuses it, and loops of known length count in full, which XLA's own cost analysis counts once; code
on which no result depends is left out. Bytes are those of the arguments, read once, and of the
results, written once. Both are lower bounds: a program that is close to neither spends its time on
something else.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
from jax.extend.core import Jaxpr, jaxprs_in_params
from jax.interpreters import partial_eval
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
    """The work of a program.

    Args:
        traced: `jax.jit(function).trace(*arguments)`.
        compiled: the same program, compiled.
        sparse: arrays among the arguments of which a run reads little; their bytes do not count.
    """
    program = traced.jaxpr.jaxpr
    live, needed = live_code(program)
    skipped = {(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(sparse)}
    read = [
        _bytes(variable.aval)
        for variable, is_needed in zip(program.invars, needed, strict=True)
        if is_needed and (variable.aval.shape, variable.aval.dtype) not in skipped
    ]
    written = [_bytes(variable.aval) for variable in live.outvars]
    memory = compiled.memory_analysis()  # None on some devices
    workspace = float(memory.temp_size_in_bytes) if memory else math.nan
    return Work(count_operations(live), sum(read) + sum(written), workspace)


def live_code(program: Jaxpr) -> tuple[Jaxpr, list[bool]]:
    """The program without code on which no result depends, and which arguments it needs.

    `dce_jaxpr` is no public API of JAX: this is its only use here.
    """
    return partial_eval.dce_jaxpr(program, [True] * len(program.outvars))


def count_operations(program: Jaxpr) -> float:
    """Operations on floats; a loop whose length depends on its data counts as one iteration."""
    total = 0.0
    for equation in program.eqns:
        name, parameters = equation.primitive.name, equation.params
        inner = [count_operations(called) for called in jaxprs_in_params(parameters)]
        if name == "cond":
            total += max(inner)
        elif name in REDUCTIONS:
            total += _floats(equation.invars[0].aval)
        elif name == "dot_general":
            contracted = parameters["dimension_numbers"][0][0]
            left: Any = equation.invars[0].aval
            depth = math.prod(left.shape[axis] for axis in contracted)
            total += 2.0 * depth * _floats(equation.outvars[0].aval)
        elif name in ARITHMETIC:
            total += _floats(equation.outvars[0].aval)
        else:  # calls another program, or only moves numbers
            total += parameters.get("length", 1) * sum(inner) if name == "scan" else sum(inner)
    return total


def _floats(aval: Any) -> float:
    """How many floats an array holds."""
    return float(aval.size) if jax.numpy.issubdtype(aval.dtype, jax.numpy.floating) else 0.0


def _bytes(aval: Any) -> float:
    return float(aval.size * aval.dtype.itemsize)


def lower_bound(work: Work, ceilings: Mapping[str, float], floats: str) -> tuple[float, str]:
    """Least seconds in which the work can be done, and what bounds it.

    Args:
        work: of one run.
        ceilings: of the machine: "memory" in bytes per second, "float32" and "float64" in
            operations per second, "dispatch" in seconds of a program that does nothing.
        floats: which of the two float types the work uses.

    Returns:
        The seconds, and "memory", "arithmetic" or "dispatch".
    """
    seconds = {
        "memory": work.moved / ceilings["memory"],
        "arithmetic": work.operations / ceilings[floats],
        "dispatch": ceilings["dispatch"],
    }
    bound = max(seconds, key=lambda name: seconds[name])
    return seconds[bound], bound
