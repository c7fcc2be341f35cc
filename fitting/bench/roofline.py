"""The least that a program has to do, and the least time in which a machine could do it.

This is the roofline model with dispatch added. Operations are those of `operations`. Bytes are
those of the arguments, read once, and of the results, written once. Both are lower bounds: a
program that is close to neither spends its time on something else.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
from jax.stages import Compiled, Traced
from jaxtyping import PyTree

from .operations import count_operations


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
