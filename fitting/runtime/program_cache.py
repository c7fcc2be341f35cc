"""Traced programs kept on disk beside the compiled ones, so that the next process need not trace.

JAX's own cache finds compiled code by the text of a program, and has to trace to get that text; for
a fit, tracing takes longer than the search. Here the text itself is kept. Its key is everything it
was traced from: the function, the static part of its arguments, the shapes and types of their
arrays, the source of this project and the versions of the libraries below.

A cache file is trusted no further than needed: it must belong to the user who runs the program, and
reading it may construct classes that only store their fields, but calls no function.
"""

import contextlib
import dataclasses
import functools
import hashlib
import io
import os
import pickle
import sys
import threading
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Tracer
from jaxtyping import PyTree

import jaxik

from . import files

PROJECT = ("jaxik", "fitting")
LIBRARIES = ("jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy")
STANDARD = ("builtins", "collections", "copyreg", "enum", "functools", "pathlib", "types", "typing")
FOLDER = "traced"  # inside the folder of JAX's cache
# JAX refuses to export these calls because LAPACK's names may change with jaxlib, whose version is
# part of the key here.
UNSTABLE = tuple(
    export.DisabledSafetyCheck.custom_call(f"lapack_{letter}{routine}_ffi")
    for letter in "sd"
    for routine in ("geqrf", "ormqr", "orgqr", "gesdd")  # the least-squares solves of a fit
)
# What outputs are described by, besides modules and dataclasses.
PYTREE_PARTS = (
    jax.ShapeDtypeStruct,
    jax.tree_util.PyTreeDef,
    jax.tree_util.default_registry,
    np.dtype,
)
TRACING = threading.RLock()  # parallel tracing gains nothing, and shared parts are traced once

Inputs = ParamSpec("Inputs")
Output = TypeVar("Output")
Arguments: TypeAlias = tuple[tuple[object, ...], Mapping[str, object]]
# The program, its output with 0 in place of each array, and the static part of its output.
Program: TypeAlias = tuple[export.Exported, PyTree, PyTree]


class _UnknownSource(Exception):
    """A function or class from outside the project, whose source may change unnoticed."""


def cached(function: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """`equinox.filter_jit` that also keeps the traced program, wherever JAX keeps compiled ones.

    Arrays among the arguments are traced; everything else is static. A program is kept only if all
    static arguments come from this project or its libraries: a user's function may change and keep
    its name. Called inside another traced program, this is plain `filter_jit`.
    """

    def from_cache(*args: Inputs.args, **named: Inputs.kwargs) -> Any:
        arguments = (args, named)
        if (program := _load_or_trace(function, arguments)) is None:
            return function(*args, **named)
        exported, blank, constants = program
        arrays = exported.call(*jax.tree.leaves(eqx.filter(arguments, eqx.is_array)))
        return eqx.combine(jax.tree.unflatten(jax.tree.structure(blank), arrays), constants)

    inside = eqx.filter_jit(function)
    outside = eqx.filter_jit(functools.wraps(function)(from_cache))

    @functools.wraps(function)
    def call(*args: Inputs.args, **named: Inputs.kwargs) -> Output:
        leaves = jax.tree.leaves((args, named))
        traced = any(isinstance(leaf, Tracer) for leaf in leaves)
        return (inside if traced else outside)(*args, **named)

    return call


def _load_or_trace(function: Callable, arguments: Arguments) -> Program | None:
    """The program for arguments of these types; None if it must not be kept."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    if not folder or not config.jax_enable_compilation_cache or jax.device_count() > 1:
        return None
    try:
        path = Path(folder, FOLDER, _file_name(function, arguments))
        if (program := _read(path)) is None:
            program = _trace(function, arguments)
            _write(path, program)
        return program
    except (
        _UnknownSource, pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError
    ):  # fmt: skip
        return None  # if the call itself is wrong, calling the function will raise the error


def _file_name(function: Callable, arguments: Arguments) -> str:
    """The function's name and a digest of everything the program is traced from."""
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    array_types = jax.tree.map(_array_type, dynamic)
    config: Any = jax.config
    settings = (jax.default_backend(), config.jax_enable_x64, config.jax_default_matmul_precision)
    _check_source(function)
    function_name = (function.__module__, function.__qualname__)
    description = io.BytesIO()
    describer = _Describer(description)
    describer.fast = True  # no memo: otherwise equal and identical objects would differ
    describer.dump((function_name, array_types, static, settings))
    digest = hashlib.sha256(_sources() + description.getvalue()).hexdigest()
    return f"{function.__name__}-{digest}"


def _array_type(leaf: object) -> tuple[tuple[int, ...], str, bool]:
    aval = jax.typeof(leaf)
    return aval.shape, str(aval.dtype), aval.weak_type


class _Describer(pickle.Pickler):
    """Writes down what a program is traced from, functions and classes by their names."""

    def reducer_override(self, obj: object) -> object:
        if isinstance(obj, type) or (callable(obj) and hasattr(obj, "__qualname__")):
            _check_source(obj)
        return NotImplemented


def _check_source(named: Callable) -> None:
    if named.__module__.partition(".")[0] not in {*PROJECT, *LIBRARIES, *STANDARD}:
        raise _UnknownSource(f"{named.__module__}.{named.__qualname__}")


@functools.cache
def _sources() -> bytes:
    """A digest of this project's source and of the libraries' versions."""
    digest = hashlib.sha256(sys.version.encode())
    for package in PROJECT:
        root = Path(str(sys.modules[package].__file__)).parent
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{path.relative_to(root)}".encode() + path.read_bytes())
    for name in LIBRARIES:
        digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.digest()


def _trace(function: Callable, arguments: Arguments) -> Program:
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    leaves, structure = jax.tree.flatten(dynamic)
    types = [
        jax.ShapeDtypeStruct(shape, dtype, weak_type=weak)
        for shape, dtype, weak in map(_array_type, leaves)
    ]
    static_output: list[PyTree] = []

    def flat(*leaves: jax.Array) -> list[jax.Array]:
        args, named = eqx.combine(jax.tree.unflatten(structure, leaves), static)
        arrays, constants = eqx.partition(function(*args, **named), eqx.is_array)
        static_output[:] = [jax.tree.map(lambda _: 0, arrays), constants]
        # Drops weak types, which export would drop: the next program's key must not change.
        return [jnp.asarray(leaf, leaf.dtype) for leaf in jax.tree.leaves(arrays)]

    with TRACING:
        exported = export.export(jax.jit(flat), disabled_checks=UNSTABLE)(*types)
    blank, constants = static_output
    return exported, blank, constants


class _SafeUnpickler(pickle.Unpickler):
    """Reads values that consist of plain data and of classes that only store their fields.

    A pickle may name any function to be called; this finds no functions, and imports nothing.
    """

    def find_class(self, module: str, name: str) -> object:
        found: object = sys.modules.get(module)
        for part in name.split("."):
            found = getattr(found, part)
        known = module.partition(".")[0] in {*PROJECT, *LIBRARIES}
        if not known or not (_only_stores(found) or any(found is part for part in PYTREE_PARTS)):
            raise pickle.UnpicklingError(f"{module}.{name} is not part of an output")
        return found


def _only_stores(found: object) -> bool:
    if not isinstance(found, type):
        return False
    own = found.__module__.partition(".")[0] in PROJECT and dataclasses.is_dataclass(found)
    return own or issubclass(found, eqx.Module | eqx.Enumeration)


def _read(path: Path) -> Program | None:
    """The program in a cache file; None if there is none, or it is damaged or someone else's."""
    try:
        if not _is_own(path):
            return None
        text, blank, constants = _SafeUnpickler(io.BytesIO(path.read_bytes())).load()
        return export.deserialize(text), blank, constants
    except Exception:  # whatever is wrong with the file, the program can be traced again
        return None


def _is_own(path: Path) -> bool:
    """Whether the file is this user's own, and not everybody may write to it."""
    status = path.stat()
    return not hasattr(os, "getuid") or (
        status.st_uid == os.getuid() and not status.st_mode & 0o002
    )


def _write(path: Path, program: Program) -> None:
    """Keeps a program if the folder can be written to."""
    exported, blank, constants = program
    content = pickle.dumps((bytes(exported.serialize()), blank, constants))
    with contextlib.suppress(OSError, ValueError):
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write(path, lambda temporary: temporary.write_bytes(content))


run = cached(jaxik.run)
