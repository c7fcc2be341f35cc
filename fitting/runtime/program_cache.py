"""Traced programs kept on disk beside the compiled ones, so that the next process traces nothing.

JAX's own cache finds compiled code by a program's text, and to have that text it traces: for a fit
that takes longer than the search. Here the text itself is kept, by what it was traced from: the
function, what is static in its arguments, shapes and types of their arrays, the source of this
project and the versions of the libraries below.
"""

import contextlib
import functools
import hashlib
import io
import pickle
import sys
import threading
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import export
from jax.core import Tracer

import jaxik

from . import files

OWN = ("jaxik", "fitting")
LIBRARIES = ("jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy")
PLAIN = ("builtins", "collections", "copyreg", "enum", "functools", "pathlib", "types", "typing")
FOLDER = "traced"  # in that of JAX's cache
# LAPACK's names may change with jaxlib, whose version is part of what a program is found by.
UNSTABLE = tuple(
    export.DisabledSafetyCheck.custom_call(f"lapack_{letter}{routine}_ffi")
    for letter in "sd"
    for routine in ("geqrf", "ormqr", "orgqr", "gesdd")  # of a step's and an ensemble's equations
)
TRACING = threading.RLock()  # two threads would take turns anyway, and trace twice what they share

Given = ParamSpec("Given")
Made = TypeVar("Made")
# Itself, what it makes with 0 for each array, and what of that is static.
Program: TypeAlias = tuple[export.Exported, Any, Any]


class _Unknown(Exception):
    """Something whose source may change without our knowing."""


def cached(function: Callable[Given, Made]) -> Callable[Given, Made]:
    """`equinox.filter_jit`, and where JAX keeps compiled programs the traced one is kept too.

    Arrays of the arguments are traced and everything else is static. A program is only kept if all
    that is static comes from this project or the libraries, by name: a function of the user's may
    change and keep its name. Inside another program this is `filter_jit`.
    """

    def read_or_traced(*args: Given.args, **named: Given.kwargs) -> Any:
        given = (args, named)
        if (program := _program(function, given)) is None:
            return function(*args, **named)
        exported, blank, constants = program
        made = exported.call(*jax.tree.leaves(eqx.filter(given, eqx.is_array)))
        return eqx.combine(jax.tree.unflatten(jax.tree.structure(blank), made), constants)

    inside = eqx.filter_jit(function)
    outside = eqx.filter_jit(functools.wraps(function)(read_or_traced))

    @functools.wraps(function)
    def call(*args: Given.args, **named: Given.kwargs) -> Made:
        leaves = jax.tree.leaves((args, named))
        traced = any(isinstance(leaf, Tracer) for leaf in leaves)
        return (inside if traced else outside)(*args, **named)

    return call


def _program(function: Callable, given: Any) -> Program | None:
    """The program for arguments of this kind, read or traced; None if it is not to be kept."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    if not folder or not config.jax_enable_compilation_cache or jax.device_count() > 1:
        return None
    try:
        path = Path(folder, FOLDER, _name(function, given))
        if (program := _read(path)) is None:
            program = _trace(function, given)
            _write(path, program)
        return program
    except (_Unknown, pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError):
        return None  # what is wrong with the call itself, it will tell when it is made


def _name(function: Callable, given: Any) -> str:
    """The file of a program: what it is, and a digest of all that it is traced from."""
    dynamic, static = eqx.partition(given, eqx.is_array)
    kinds = jax.tree.map(_kind, dynamic)
    config: Any = jax.config
    settings = (jax.default_backend(), config.jax_enable_x64, config.jax_default_matmul_precision)
    _check_known(function)
    which = (function.__module__, function.__qualname__)
    described = io.BytesIO()
    describer = _Describer(described)
    describer.fast = True  # or it would matter which equal things are one and the same
    describer.dump((which, kinds, static, settings))
    digest = hashlib.sha256(_sources() + described.getvalue()).hexdigest()
    return f"{function.__name__}-{digest}"


def _kind(leaf: Any) -> tuple[tuple[int, ...], str, bool]:
    aval = jax.typeof(leaf)
    return aval.shape, str(aval.dtype), aval.weak_type


class _Describer(pickle.Pickler):
    """Writes what a program is traced from; functions and classes count by their names."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type) or (callable(obj) and hasattr(obj, "__qualname__")):
            _check_known(obj)
        return NotImplemented


def _check_known(named: Any) -> None:
    if named.__module__.partition(".")[0] not in {*OWN, *LIBRARIES, *PLAIN}:
        raise _Unknown(f"{named.__module__}.{named.__qualname__}")


@functools.cache
def _sources() -> bytes:
    """A digest of this project's source, and of the libraries' versions."""
    digest = hashlib.sha256(sys.version.encode())
    for package in OWN:
        room = Path(str(sys.modules[package].__file__)).parent
        for path in sorted(room.rglob("*.py")):
            digest.update(f"{path.relative_to(room)}".encode() + path.read_bytes())
    for name in LIBRARIES:
        digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.digest()


def _trace(function: Callable, given: Any) -> Program:
    dynamic, static = eqx.partition(given, eqx.is_array)
    leaves, structure = jax.tree.flatten(dynamic)
    kinds = [jax.ShapeDtypeStruct(*kind[:2], weak_type=kind[2]) for kind in map(_kind, leaves)]
    made: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        args, named = eqx.combine(jax.tree.unflatten(structure, leaves), static)
        arrays, constants = eqx.partition(function(*args, **named), eqx.is_array)
        made[:] = [jax.tree.map(lambda _: 0, arrays), constants]
        # Of the very type it has when read again, or the next program's name would differ.
        return [jnp.asarray(leaf, leaf.dtype) for leaf in jax.tree.leaves(arrays)]

    with TRACING:
        exported = export.export(jax.jit(flat), disabled_checks=UNSTABLE)(*kinds)
    return exported, *made


def _read(path: Path) -> Program | None:
    """What was kept in a file; None where there is none, or a damaged one."""
    try:
        text, blank, constants = pickle.loads(path.read_bytes())
        return export.deserialize(text), blank, constants
    except Exception:  # whatever is wrong with it, it can be made anew
        return None


def _write(path: Path, program: Program) -> None:
    """Keeps a program, where the folder may be written."""
    exported, *made = program
    kept_as = pickle.dumps((exported.serialize(), *made))
    with contextlib.suppress(OSError, ValueError):
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write(path, lambda temporary: temporary.write_bytes(kept_as))


run = cached(jaxik.run)
