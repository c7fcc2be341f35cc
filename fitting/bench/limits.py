"""What a program must do at least, and how soon this machine could have done it.

Operations are counted in the program before XLA fuses it, with loops of known length in full, which
XLA's own cost analysis counts once; what no result depends on is left out. Bytes are those of the
arguments, read once, and of the results, written once. Both are floors: a program that reaches
neither the memory's pace nor the arithmetic's spends its time on something else.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
from jax.extend.core import Jaxpr, jaxprs_in_params
from jax.interpreters import partial_eval

# One operation an element each, a sine as much as a sum.
ARITHMETIC = frozenset(
    "add sub mul div rem max min sqrt rsqrt cbrt square integer_pow pow exp exp2 expm1 log log1p "
    "sin cos tan asin acos atan atan2 sinh cosh tanh logistic erf erfc add_any clamp".split()
)
REDUCTIONS = frozenset("reduce_sum reduce_max reduce_min argmin argmax cumsum cumprod".split())


@dataclasses.dataclass(frozen=True)
class Work:
    """What a program does at least, and the room it takes."""

    operations: float = 0.0  # on floats
    moved: float = 0.0  # bytes of arguments and results
    workspace: float = 0.0  # bytes beside them

    def __mul__(self, times: int | float) -> "Work":
        """As many runs of it; they take the same room again."""
        return Work(times * self.operations, times * self.moved, self.workspace)


def work(traced: Any, compiled: Any, sparse: Any = ()) -> Work:
    """The work of a program.

    Args:
        traced: `jax.jit(function).trace(*given)`.
        compiled: the same, compiled.
        sparse: given arrays of which a run reads only a little; their bytes do not count.
    """
    closed = traced.jaxpr
    live, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    skipped = {(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(sparse)}
    read = [
        _bytes(one.aval)
        for one, needed in zip(closed.jaxpr.invars, used, strict=True)
        if needed and (one.aval.shape, one.aval.dtype) not in skipped
    ]
    written = [_bytes(one.aval) for one in live.outvars]
    told = compiled.memory_analysis()  # some devices do not say
    workspace = float(told.temp_size_in_bytes) if told else math.nan
    return Work(operations(live), sum(read) + sum(written), workspace)


def operations(jaxpr: Jaxpr) -> float:
    """Operations on floats; a loop whose length only its data tell counts as one turn."""
    total = 0.0
    for equation in jaxpr.eqns:
        name, parameters = equation.primitive.name, equation.params
        inner = [operations(one) for one in jaxprs_in_params(parameters)]
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
        else:  # what calls a program, or moves numbers about
            total += parameters.get("length", 1) * sum(inner) if name == "scan" else sum(inner)
    return total


def _floats(aval: Any) -> float:
    """How many floats an array holds."""
    return float(aval.size) if jax.numpy.issubdtype(aval.dtype, jax.numpy.floating) else 0.0


def _bytes(aval: Any) -> float:
    return float(aval.size * aval.dtype.itemsize)


def least(work: Work, ceilings: Mapping[str, float], floats: str) -> tuple[float, str]:
    """Seconds under which the work cannot be done, and what forbids it.

    Args:
        work: of one run.
        ceilings: what the machine gives: "memory" in bytes a second, "float32" and "float64" in
            operations a second, "dispatch" in seconds of a program that does nothing.
        floats: which of them it computes with.
    """
    floors = {
        "memory": work.moved / ceilings["memory"],
        "arithmetic": work.operations / ceilings[floats],
        "dispatch": ceilings["dispatch"],
    }
    bound = max(floors, key=lambda name: floors[name])
    return floors[bound], bound
