"""Keys of programs: equal for two calls, in whatever process, whose programs are the same."""

import functools
import hashlib
import importlib
import json
import sys
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax

from . import plain_tree
from .cache_folder import setting

Arguments: TypeAlias = tuple[tuple[object, ...], Mapping[str, object]]


class ArrayType(NamedTuple):
    """What a program depends on of an array."""

    shape: tuple[int, ...]
    dtype: str
    weak_type: bool


def array_type(array: jax.Array) -> ArrayType:
    """The type of an array, which may be traced."""
    aval = jax.typeof(array)
    return ArrayType(aval.shape, str(aval.dtype), aval.weak_type)


def program_key(function: Callable, arguments: Arguments) -> str:
    """A digest of everything that a function's program is traced from.

    That is the function, the static part of its arguments, the types of their arrays, JAX's
    settings, the source of this project and the versions of the libraries.

    Raises:
        NotPlainError: the function or an argument comes from elsewhere, where source may change
            unnoticed, or an argument is no plain value.
    """
    module, name = function.__module__, function.__qualname__
    if module.partition(".")[0] not in plain_tree.PROJECT or "<" in name:  # <locals>, <lambda>
        raise plain_tree.NotPlainError(f"{module}.{name} is no named function of this project")
    types = jax.tree.map(lambda leaf: array_type(leaf) if eqx.is_array(leaf) else leaf, arguments)
    settings = [setting("jax_enable_x64"), str(setting("jax_default_matmul_precision"))]
    parts = [
        [module, name],
        plain_tree.describe(types),
        [jax.default_backend(), *settings],
        versions(),
        sources(),
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


@functools.cache
def versions() -> Mapping[str, str]:
    """The versions of Python and of the libraries, by name."""
    return {"python": sys.version} | {name: metadata.version(name) for name in plain_tree.LIBRARIES}


@functools.cache
def sources() -> str:
    """A digest of this project's source."""
    digest = hashlib.sha256()
    for package in plain_tree.PROJECT:
        root = Path(str(importlib.import_module(package).__file__)).parent
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{path.relative_to(root)}".encode() + path.read_bytes())
    return digest.hexdigest()
