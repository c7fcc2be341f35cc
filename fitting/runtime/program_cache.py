"""Traced programs cached on disk beside the compiled ones, so that the next process need not trace.

JAX's own cache finds compiled code by the text of a program, and has to trace to get that text; for
a fit, tracing takes longer than the search. Here the text itself is cached, in a file that is
named after its `program_key`:

    jaxik program 1                  format and its version, in a line
    {"key": ..., "versions": ...}    header, JSON in a line
    ...                              `jax.export`'s own serialisation of the program

The header holds `key`, which stands for all that the program is traced from; `versions` of Python
and of the libraries; `output`, the structure of the output as `plain_tree` writes it, with a `Slot`
for each array; `sha256` of what follows the header. A file is read only if all of them are as
expected, and if it belongs to the user who runs the program.
"""

import dataclasses
import functools
import hashlib
import importlib
import itertools
import json
import os
import re
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Tracer
from jaxtyping import PyTree

import jaxik
from jaxik.world.terrain import Terrain

from . import activity, cache_folder, files, plain_tree
from .cache_folder import setting, warn_once
from .plain_tree import NotPlainError
from .validation import in_one_line

MAGIC = b"jaxik program 1\n"
LENGTH = 128  # frames
# How JAX names calls from a program back into Python; no program of this project has one.
CALLBACK = re.compile(rb"python_\w*callback")

Arguments: TypeAlias = tuple[tuple[object, ...], Mapping[str, object]]

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


@dataclasses.dataclass(frozen=True)
class Slot:
    """The place of an array in an output."""

    index: int


class _Plain(eqx.Module):
    """An output without its arrays, as it leaves a program."""

    tree: PyTree = eqx.field(static=True)


class Program(NamedTuple):
    """A traced program."""

    exported: export.Exported
    output: PyTree
    """Its output, with a `Slot` in place of each array."""

    def call(self, arrays: list[jax.Array]) -> PyTree:
        """The output for these arrays."""
        outputs = self.exported.call(*arrays)
        return jax.tree.map(
            lambda leaf: outputs[leaf.index] if isinstance(leaf, Slot) else leaf, self.output
        )


def write(path: Path, program: Program, key: str, versions: Mapping[str, str]) -> None:
    """Writes a program.

    Raises:
        NotPlainError: its output holds more than arrays, plain values and dataclasses.
        OSError: the disk is full, or the like.
        ValueError: the folder may not be written to.
    """
    body = bytes(program.exported.serialize())
    header = {
        "key": key,
        "versions": versions,
        "output": plain_tree.describe(program.output),
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    content = MAGIC + json.dumps(header).encode() + b"\n" + body
    files.write(path, lambda temporary: temporary.write_bytes(content))


def read(path: Path, key: str, versions: Mapping[str, str]) -> Program | None:
    """The program in a file; None if there is no file.

    Raises:
        OSError: the file cannot be read, or is somebody else's.
        ValueError: it is damaged, or another program than expected.
    """
    try:
        with path.open("rb") as file:
            cache_folder.check_own(path, os.fstat(file.fileno()))
            content = file.read()
    except FileNotFoundError:
        return None
    try:
        return _decode(content, key, versions)
    except Exception as error:  # the many errors with which parsers meet damage
        raise ValueError(f"{path} is damaged: {error}") from error


def _decode(content: bytes, key: str, versions: Mapping[str, str]) -> Program:
    if not content.startswith(MAGIC):
        raise ValueError(f"it begins with {content[: len(MAGIC)]!r}; wanted {MAGIC!r}")
    line, _, body = content[len(MAGIC) :].partition(b"\n")
    header = json.loads(line)
    expected = {"key": key, "versions": versions, "sha256": hashlib.sha256(body).hexdigest()}
    for name, value in expected.items():
        if header[name] != value:
            raise ValueError(f"its {name} is {header[name]!r}; wanted {value!r}")
    if CALLBACK.search(body):
        raise ValueError("the program calls Python")
    return Program(export.deserialize(bytearray(body)), plain_tree.rebuild(header["output"]))


class ArrayType(NamedTuple):
    """What a program depends on of an array."""

    shape: tuple[int, ...]
    dtype: str
    weak_type: bool


def array_type(array: jax.Array) -> ArrayType:
    """The type of an array, which may be traced."""
    aval = jax.typeof(array)
    return ArrayType(aval.shape, str(aval.dtype), aval.weak_type)


def program_key(function: Callable, arguments: Arguments, platform: str = "cpu") -> str:
    """A digest of everything that a function's program is traced from.

    That is the function, the static part of its arguments, the types of their arrays, JAX's name
    of the platform that computes, its settings, the source of this project and the versions of the
    libraries.

    Raises:
        NotPlainError: the function or an argument comes from elsewhere, where source may change
            unnoticed, or an argument is not a plain value.
    """
    module, name = function.__module__, function.__qualname__
    if module.partition(".")[0] not in plain_tree.PROJECT or "<" in name:  # <locals>, <lambda>
        raise plain_tree.NotPlainError(f"{module}.{name} is not a named function of this project")
    types = jax.tree.map(lambda leaf: array_type(leaf) if eqx.is_array(leaf) else leaf, arguments)
    settings = [setting("jax_enable_x64"), str(setting("jax_default_matmul_precision"))]
    parts = [
        [module, name],
        plain_tree.describe(types),
        [platform, *settings],
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


class _Place(NamedTuple):
    """Where a program is cached, and its key."""

    path: Path
    key: str


def cached(function: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """`equinox.filter_jit` that also caches the traced program, wherever JAX caches compiled ones.

    Arrays among the arguments are traced; everything else is static. A program is cached only if
    all static arguments come from this project or its libraries: a user's function may change under
    the same name. A failure to write or to read one is a warning, once, and the call goes on.
    Called inside another traced program, this is plain `filter_jit`.
    """

    name = function.__name__.strip("_").replace("_", " ")

    def from_cache(platform: str | None, arguments: Arguments) -> Any:
        args, named = arguments
        whole: Callable[..., Any] = function
        if (work := activity.innermost()) is not None:
            work.began_compiling(name)
        if platform is None or (place := _place(function, arguments, platform)) is None:
            return whole(*args, **named)
        program, failure = _read(place), ""
        if program is None:
            try:
                program = _trace(function, arguments, platform)
            except Exception as error:
                failure = str(error).partition("\n")[0]
            else:
                _write(place, program)
        if program is None:
            output = whole(*args, **named)  # raises the error if the call itself is wrong
            warn_once(f"the program of {function.__name__} is not cached", failure)
            return output
        return program.call(jax.tree.leaves(eqx.filter(arguments, eqx.is_array)))

    def of_leaves(
        structure: Any, static: tuple[Any, ...], platform: str | None, arrays: list[jax.Array]
    ) -> Any:
        rest = iter(arrays)
        leaves = [next(rest) if leaf is None else leaf for leaf in static]
        output = from_cache(platform, jax.tree.unflatten(structure, leaves))
        traced, plain = eqx.partition(output, eqx.is_array)
        return traced, _Plain(plain)

    of_leaves.__name__ = function.__name__
    inside = eqx.filter_jit(function)
    outside = jax.jit(of_leaves, static_argnums=(0, 1, 2))  # much leaner than `filter_jit`

    @functools.wraps(function)
    def call(*args: Inputs.args, **named: Inputs.kwargs) -> Output:
        leaves, structure = jax.tree.flatten((args, named))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return inside(*args, **named)
        # `jnp.asarray` would compile a program for each shape.
        leaves = [jax.device_put(leaf) if isinstance(leaf, np.ndarray) else leaf for leaf in leaves]
        static = tuple(None if isinstance(leaf, jax.Array) else leaf for leaf in leaves)
        arrays = [leaf for leaf in _committed(leaves) if isinstance(leaf, jax.Array)]
        try:
            traced, plain = outside(structure, static, _platform(leaves), arrays)
            return eqx.combine(traced, plain.tree)
        finally:
            if (work := activity.innermost()) is not None:
                work.ended_compiling(name)

    return call


def committed(tree: Tree) -> Tree:
    """The tree with its arrays committed to the one device they are on.

    JAX compiles a program anew for arrays that are committed to a device, which those that come out
    of a cached program are and most others are not. Such a program commits its arguments itself,
    but for several hundred arrays that takes longer than many a call; what goes into many calls is
    committed before. Arrays on several devices stay as they are.
    """
    leaves, structure = jax.tree.flatten(tree)
    fixed = _committed(leaves)
    return tree if fixed is leaves else jax.tree.unflatten(structure, fixed)


def _committed(leaves: list[Any]) -> list[Any]:
    """The same list if nothing in it has to be committed or may be."""
    loose = [i for i, leaf in enumerate(leaves) if not getattr(leaf, "committed", True)]
    if not loose:
        return leaves
    shardings = [leaf.sharding for leaf in leaves if isinstance(leaf, jax.Array)]
    distinct = {id(sharding): sharding for sharding in shardings}.values()  # hashing takes long
    if len(set().union(*(sharding.device_set for sharding in distinct))) > 1:
        return leaves
    fixed, device = list(leaves), leaves[loose[0]].sharding
    for i, leaf in zip(loose, jax.device_put([leaves[i] for i in loose], device), strict=True):
        fixed[i] = leaf
    return fixed


def _platform(leaves: Sequence[Any]) -> str | None:
    """What computes with these arrays, as programs name it; None where that is not known.

    That is not JAX's default where they are on another device, as on a CPU beside a GPU.
    """
    arrays = (leaf for leaf in leaves if isinstance(leaf, jax.Array))
    known = (array for array in arrays if not isinstance(array, Tracer))
    devices = next((array.sharding.device_set for array in known), ())
    default = jax.default_backend()
    platform = next((device.platform for device in devices), default)
    if platform == default:
        return export.default_export_platform()  # which GPU
    return platform if platform == "cpu" else None


def _place(function: Callable, arguments: Arguments, platform: str) -> _Place | None:
    """Where the program for arguments of these types is cached; None if it must not be."""
    try:
        folder = cache_folder.traced()
        key = program_key(function, arguments, platform)
    except (cache_folder.SwitchedOffError, NotPlainError):
        return None
    except OSError as error:
        warn_once("traced programs are not cached", in_one_line(error))
        return None
    return _Place(folder / f"{function.__name__}-{key}", key)


def _read(place: _Place) -> Program | None:
    try:
        return read(place.path, place.key, versions())
    except (OSError, ValueError) as error:
        warn_once("a cached program is traced anew", in_one_line(error))
        return None


def _write(place: _Place, program: Program) -> None:
    try:
        write(place.path, program, place.key, versions())
    except (OSError, ValueError, NotPlainError) as error:
        warn_once("traced programs are not cached", in_one_line(error))


def _trace(function: Callable, arguments: Arguments, platform: str) -> Program:
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
        exporting = export.export(jax.jit(flat), platforms=[platform], disabled_checks=UNSTABLE)
        exported = exporting(*types)
    return Program(exported, outputs[-1])


_run = cached(jaxik.run)


def run(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain,
    frames: jaxik.Frame,
    tracks: Mapping[str, jax.Array] | None = None,
) -> jaxik.Result:
    """`jaxik.run`, by a program that it shares with clips of other lengths; NumPy arrays."""
    count = len(frames.dt)
    frames, tracks = padded_frames((frames, tracks))
    result = jax.device_get(_run(ik, rig, terrain, frames, tracks=tracks))
    return jax.tree.map(lambda x: x[:count], result)


def padded_frames(tree: PyTree) -> Any:
    """JAX arrays along the frames of a clip, with more of its last one: none before it changes.

    They are as long as a multiple of `LENGTH`: each length is a program of its own, which takes
    seconds to compile, and a frame takes microseconds.
    """

    def pad(x: jax.Array | np.ndarray) -> jax.Array:
        more = -len(x) % LENGTH
        if more:
            rows = np.asarray(x)
            x = np.concatenate([rows, np.repeat(rows[-1:], more, axis=0)])
        return jax.device_put(x)

    return jax.tree.map(pad, tree)
