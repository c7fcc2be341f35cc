"""Traced programs kept on disk beside the compiled ones, so that the next process need not trace.

JAX's own cache finds compiled code by the text of a program, and has to trace to get that text; for
a fit, tracing takes longer than the search. Here the text itself is kept, in a `program_file` that
is named after its `program_key`.
"""

import functools
import itertools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import export
from jax.core import Tracer
from jaxtyping import PyTree

import jaxik

from . import cache_folder, program_file
from .cache_folder import warn_once
from .plain_tree import NotPlainError
from .program_file import Program, Slot
from .program_key import Arguments, array_type, program_key, versions
from .validation import in_one_line

# JAX refuses to export these calls because their names may change with jaxlib, whose version is
# part of the key here. They belong to the least-squares solves of a fit.
UNSTABLE = tuple(
    export.DisabledSafetyCheck.custom_call(name)
    for name in ("lapack_sormqr_ffi", "lapack_dormqr_ffi", "cusolver_ormqr_ffi")
)
TRACING = threading.RLock()  # parallel tracing gains nothing, and shared parts are traced once

Inputs = ParamSpec("Inputs")
Output = TypeVar("Output")
Tree = TypeVar("Tree")


class _Place(NamedTuple):
    """Where a program is kept, and its key."""

    path: Path
    key: str


def cached(function: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """`equinox.filter_jit` that also keeps the traced program, wherever JAX keeps compiled ones.

    Arrays among the arguments are traced; everything else is static. A program is kept only if all
    static arguments come from this project or its libraries: a user's function may change and keep
    its name. A failure to keep or to read one is a warning, once, and the call goes on. Called
    inside another traced program, this is plain `filter_jit`.
    """

    def from_cache(*args: Inputs.args, **named: Inputs.kwargs) -> Any:
        arguments = (args, named)
        if (place := _place(function, arguments)) is None:
            return function(*args, **named)
        program, failure = _read(place), ""
        if program is None:
            try:
                program = _trace(function, arguments)
            except Exception as error:
                failure = str(error).partition("\n")[0]
            else:
                _write(place, program)
        if program is None:
            output = function(*args, **named)  # raises the error if the call itself is wrong
            warn_once(f"the program of {function.__name__} is not kept", failure)
            return output
        return program.call(jax.tree.leaves(eqx.filter(arguments, eqx.is_array)))

    inside = eqx.filter_jit(function)
    outside = eqx.filter_jit(functools.wraps(function)(from_cache))

    @functools.wraps(function)
    def call(*args: Inputs.args, **named: Inputs.kwargs) -> Output:
        leaves = jax.tree.leaves((args, named))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return inside(*args, **named)
        args, named = committed((args, named))
        return outside(*args, **named)

    return call


def committed(tree: Tree) -> Tree:
    """The tree with its arrays committed to the one device they are on.

    JAX compiles a program anew for arrays that are committed to a device, which those that come out
    of a kept program are and most others are not. A program that is cached commits its arguments
    itself, but for several hundred arrays that takes longer than many a call; what goes into many
    calls is committed before. Arrays on several devices stay as they are.
    """
    leaves, structure = jax.tree.flatten(tree)
    arrays = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]
    loose = [i for i, leaf in enumerate(leaves) if not getattr(leaf, "committed", True)]
    if not loose or len({device for array in arrays for device in array.devices()}) > 1:
        return tree
    device = leaves[loose[0]].sharding
    for i, leaf in zip(loose, jax.device_put([leaves[i] for i in loose], device), strict=True):
        leaves[i] = leaf
    return jax.tree.unflatten(structure, leaves)


def _place(function: Callable, arguments: Arguments) -> _Place | None:
    """Where the program for arguments of these types is kept; None if it must not be."""
    try:
        folder = cache_folder.traced()
        key = program_key(function, arguments)
    except (cache_folder.SwitchedOffError, NotPlainError):
        return None
    except OSError as error:
        warn_once("traced programs are not kept", in_one_line(error))
        return None
    return _Place(folder / f"{function.__name__}-{key}", key)


def _read(place: _Place) -> Program | None:
    try:
        return program_file.read(place.path, place.key, versions())
    except (OSError, ValueError) as error:
        warn_once("a kept program is traced anew", in_one_line(error))
        return None


def _write(place: _Place, program: Program) -> None:
    try:
        program_file.write(place.path, program, place.key, versions())
    except (OSError, ValueError, NotPlainError) as error:
        warn_once("traced programs are not kept", in_one_line(error))


def _trace(function: Callable, arguments: Arguments) -> Program:
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    leaves, structure = jax.tree.flatten(dynamic)
    types = [
        jax.ShapeDtypeStruct(shape, dtype, weak_type=weak)
        for shape, dtype, weak in map(array_type, leaves)
    ]
    outputs: list[PyTree] = []

    def flat(*leaves: jax.Array) -> list[jax.Array]:
        args, named = eqx.combine(jax.tree.unflatten(structure, leaves), static)
        output = function(*args, **named)
        indices = itertools.count()
        outputs.append(
            jax.tree.map(lambda leaf: Slot(next(indices)) if eqx.is_array(leaf) else leaf, output)
        )
        arrays = jax.tree.leaves(eqx.filter(output, eqx.is_array))
        # Drops weak types, which export would drop: the next program's key must not change.
        return [jnp.asarray(leaf, leaf.dtype) for leaf in arrays]

    with TRACING:
        exported = export.export(jax.jit(flat), disabled_checks=UNSTABLE)(*types)
    return Program(exported, outputs[-1])


run = cached(jaxik.run)
