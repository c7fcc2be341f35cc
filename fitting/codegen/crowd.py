"""Crowds by compiled code over vector lanes: built on first use, and kept with cached programs.

The code is C for this machine's processor. It is called through NumPy, without JAX, and so cannot
be traced or differentiated: `jaxik.lanes` can.
"""

# pyright: reportArgumentType=false

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import operator
import os
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import ArrayLike, Int, PyTree

import jaxik
from fitting.runtime import activity, cache_folder, files, machine
from fitting.runtime.threads import on_all_cores, usable_cores
from fitting.runtime.validation import in_one_line
from jaxik.world.surfaces import Mesh
from jaxik.world.terrain import LegTerrains, Terrain

from . import lanes_code, stablehlo, toolchain
from .graph import BOOL, DTYPES, TABLES, Graph, Node, needed
from .program import Field, Place, Program, exported, fields_of, flat, input_nodes

# A frame of a system with its rays, as a graph of single numbers.

LARGEST = 16  # numbers of an array of the terrain that become inputs; others are tables

Keep = Callable[[jaxik.Result], PyTree]
"""What of a frame's result is handed out, as a tree of its arrays."""


class CrowdProgram(NamedTuple):
    """A system's frame with its rays."""

    program: Program
    """Without rounds of rays."""
    setup: list[Place]
    """The inputs that it reads of parameters, rig and terrain."""
    moving: list[Place]
    """Those of a frame."""
    tables: list[int]
    """Of the terrain's leaves, the large ones."""

    def source(self, lanes: int) -> str:
        """In C, for so many characters at once."""
        return lanes_code.source(self.program, self.setup, self.moving, lanes)


def build_program(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frame: jaxik.Frame,
    keep: Keep,
    *,
    checked: bool = False,
) -> CrowdProgram:
    """The program of one character, of these arguments or their shapes, in floats of 32 bits.

    Raises:
        ValueError: the system or its terrain has an operation without a rule, such as a loop, or
            its arrays do not fit the legs.
    """
    with jax.enable_x64(False):
        return _build_program(ik, rig, terrain, frame, keep, checked)


def _build_program(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frame: jaxik.Frame,
    keep: Keep,
    checked: bool,
) -> CrowdProgram:
    state = jax.eval_shape(jaxik.init, ik, rig)

    def of_frame(
        ik: jaxik.FootIK, rig: jaxik.Rig, terrain: Terrain, state: jaxik.State, frame: jaxik.Frame
    ) -> tuple[jaxik.State, PyTree]:
        after, result = jaxik.step(ik, rig, terrain, state, frame, trace=True, checked=checked)
        return after, keep(result)

    graph, inputs, tables = Graph(), [], []
    nodes: dict[str, list] = {}
    for struct, tree in (("parameters", ik), ("rig", rig)):
        nodes[struct] = [input_nodes(graph, inputs, struct, f) for f in fields_of(tree)]
    nodes["terrain"] = []
    for number, field in enumerate(fields_of(terrain)):
        if field.size <= LARGEST:
            nodes["terrain"].append(input_nodes(graph, inputs, "terrain", field))
        else:
            nodes["terrain"].append(_table(graph, inputs, field, len(tables)))
            tables.append(number)
    for struct, tree in (("state", state), ("frame", frame)):
        nodes[struct] = [input_nodes(graph, inputs, struct, f) for f in fields_of(tree)]
    trees = (ik, rig, terrain, state, frame)
    outputs = stablehlo.read(
        exported(of_frame, trees), graph, [node for part in nodes.values() for node in part]
    )
    count = len(jax.tree.leaves(state))
    initial = stablehlo.read(
        exported(jaxik.init, (ik, rig)), graph, [*nodes["parameters"], *nodes["rig"]]
    )
    results = {"init": initial, "state": outputs[:count], "result": outputs[count:]}
    kept = jax.eval_shape(of_frame, *trees)[1]
    structs = {"parameters": ik, "rig": rig, "state": state, "frame": frame, "result": kept}
    numbers = {name: flat(part) for name, part in results.items()}
    legs, platforms = len(rig.side), terrain.platform_count
    program = Program(ik, legs, platforms, [], structs, graph, inputs, [], [], numbers)
    return of_program(program, tables)


def of_program(program: Program, tables: list[int]) -> CrowdProgram:
    """A program without rounds of rays, which reads these tables, for many characters."""
    graph = program.graph
    results = {
        name: [_word(graph, node) for node in nodes] for name, nodes in program.results.items()
    }
    reached = needed(graph, [node for nodes in results.values() for node in nodes])
    used = [program.inputs[number] for node, number in graph.inputs.items() if node in reached]
    setup = [place for place in used if place.struct in ("parameters", "rig", "terrain")]
    moving = [place for place in used if place.struct == "frame"]
    return CrowdProgram(dataclasses.replace(program, results=results), setup, moving, tables)


def _word(graph: Graph, node: Node) -> Node:
    """A number as it lies in memory."""
    return graph.add("int_of_bool", node) if graph.types[node] == BOOL else node


def _table(graph: Graph, inputs: list[Place], field: Field, number: int) -> stablehlo.Table:
    """A new input of a graph for a large array."""
    kind = TABLES[field.kind]
    node = graph.input(kind, len(inputs))
    inputs.append(Place("tables", field._replace(kind=kind), (number,)))
    return stablehlo.Table(node, field.kind, field.shape)


# Its compiled code.

SWITCH = "JAXIK_CROWD_KERNELS"  # environment variable; 0 switches them off
FLAGS = ("-O2", "-std=gnu11", "-march=native", "-fno-math-errno", "-shared", "-fPIC")
LANES = {512: 16, 256: 8}  # by bits of the processor's vectors; others take 4
PLACE = np.dtype([("at", np.uintp), ("member", np.intp), ("frame", np.intp)])
FARTHEST = 2**31  # bytes by which numbers of the characters of a block may be apart
ALIGNMENT = 64  # bytes, of results: lines of the cache
BUILDING = threading.Lock()  # several threads may need the same code
STRUCTS = ("parameters", "rig", "terrain", "frame")

Axes: TypeAlias = tuple[PyTree, PyTree, PyTree, PyTree]
"""Of system, rig, terrain and frames: as `in_axes` of `jaxik.lanes`."""


class NoKernelError(Exception):
    """There is no compiled code for a crowd; the message says why."""


class Kernel(NamedTuple):
    """The compiled code of a system on a kind of ground."""

    built: CrowdProgram
    lanes: int
    """How many characters it computes at once."""
    run: Callable[..., None]


def without_trace(result: jaxik.Result) -> jaxik.Result:
    """A result without the outputs of stages."""
    return dataclasses.replace(result, trace=None)


def run_crowd(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frames: jaxik.Frame,
    in_axes: Axes = (None, None, None, 0),
    out_axes: int = 0,
    *,
    starts: Int[ArrayLike, " characters"] | None = None,
    count: int | None = None,
    keep: Keep = without_trace,
    checked: bool = False,
    cores: int | None = None,
) -> PyTree:
    """What `jaxik.run` gives for each of many characters, by C code where that can be compiled.

    The code is built when it is first needed, in less time than JAX compiles its program. Results
    differ from JAX's by rounding. `jaxik.lanes` computes them where there is no compiler, floats
    have 64 bits, the ground is a mesh or JAXIK_CROWD_KERNELS is 0.

    Args:
        ik: the system; its rules and options are those of all.
        rig: the legs.
        terrain: the ground; its large arrays, such as heights, are those of all.
        frames: the animation, as for `jaxik.run`.
        in_axes: of each of these four the axis of characters, None where all share it; or a tree
            of axes.
        out_axes: where the axis of characters is in the results, 0 or -1, which is faster.
        starts: the frame with which each character begins; None is the first.
        count: how many frames are computed from there on; None takes all.
        keep: what of a frame's result is kept, as a tree of its arrays. It must be a function of a
            module, as code is built for each new one.
        checked: a promise that all frames are sound, as in `jaxik.run`.
        cores: how many compute; None takes all.

    Returns:
        What is kept, with axes (characters, frames, ...) or (frames, ..., characters).

    Raises:
        ValueError: there is no axis of characters, or their numbers differ; a clip ends before a
            character has its frames; arrays do not fit the legs.
    """
    call = _Call.of((ik, rig, terrain, frames), in_axes, starts, count, keep, checked)
    try:
        kernel = _kernel(call)
    except NoKernelError:
        return _by_lanes(call, out_axes)
    return _by_kernel(kernel, call, out_axes, cores or usable_cores())


def kernel_of(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frames: jaxik.Frame,
    in_axes: Axes = (None, None, None, 0),
    *,
    keep: Keep = without_trace,
    checked: bool = False,
) -> Kernel:
    """The code that `run_crowd` would run for these arguments, built if it is not there.

    Raises:
        NoKernelError: it would run none.
        ValueError: as `run_crowd`.
    """
    return _kernel(_Call.of((ik, rig, terrain, frames), in_axes, None, None, keep, checked))


@dataclasses.dataclass(frozen=True)
class _Call:
    """The arguments of `run_crowd`."""

    trees: tuple
    axes: tuple[tuple[int | None, ...], ...]
    """Of the leaves of each tree."""
    arrays: tuple[list[np.ndarray], ...]
    """The leaves of each tree, with an axis of characters and one of frames in front; see
    `_spread`."""
    members: int
    starts: np.ndarray | None
    count: int
    """Frames of each character."""
    keep: Keep
    checked: bool

    @classmethod
    def of(
        cls,
        trees: tuple,
        in_axes: Axes,
        starts: Int[ArrayLike, " characters"] | None,
        count: int | None,
        keep: Keep,
        checked: bool,
    ) -> "_Call":
        axes = tuple(_leaf_axes(each, tree) for each, tree in zip(in_axes, trees, strict=True))
        arrays = tuple(
            [
                _spread(leaf, axis, struct == "frame")
                for leaf, axis in zip(jax.tree.leaves(tree), each, strict=True)
            ]
            for struct, tree, each in zip(STRUCTS, trees, axes, strict=True)
        )
        sizes = {
            len(array)
            for part, each in zip(arrays, axes, strict=True)
            for array, axis in zip(part, each, strict=True)
            if axis is not None
        }
        if starts is not None:
            starts = np.ascontiguousarray(starts, np.int32)
            sizes.add(len(starts))
        if len(sizes) != 1 or 0 in sizes:
            raise ValueError(f"numbers of characters: {sorted(sizes)}; wanted one, of 1 or more")
        lengths = {array.shape[1] for array in arrays[-1]}
        if len(lengths) != 1:
            raise ValueError(f"numbers of frames: {sorted(lengths)}; wanted one number")
        length = lengths.pop()
        each = length if count is None else count
        first, last = (0, 0) if starts is None else (int(starts.min()), int(starts.max()))
        if min(first, each) < 0 or last + each > length:
            raise ValueError(
                f"{each} frames from frames {first} to {last} on; the clip has {length}"
            )
        return cls(trees, axes, arrays, sizes.pop(), starts, each, keep, checked)


def _is_none(axis: int | None) -> bool:
    return axis is None


def _leaf_axes(axes: PyTree, tree: PyTree) -> tuple[int | None, ...]:
    """The axis of each leaf, from axes of leaves or of whole subtrees."""
    broadcast = jax.tree.broadcast(axes, tree, is_leaf=_is_none)
    return tuple(jax.tree.structure(tree).flatten_up_to(broadcast))


def _spread(leaf: ArrayLike, axis: int | None, of_frames: bool) -> np.ndarray:
    """An array with an axis of characters and one of frames in front; of length 1 for none."""
    array = np.asarray(leaf)
    array = array[None] if axis is None else np.moveaxis(array, axis, 0)
    return array if of_frames else array[:, None]


def _kernel(call: _Call) -> Kernel:
    """The code for a call.

    Raises:
        NoKernelError: there is none.
        ValueError: arrays do not fit the legs.
    """
    if os.environ.get(SWITCH) == "0":
        raise NoKernelError(f"{SWITCH} is 0")
    if jax.default_backend() != "cpu":
        raise NoKernelError("an accelerator computes")
    grounds = (call.trees[2], *getattr(call.trees[2], "legs", ()))
    surfaces = (getattr(each, "surface", each) for ground in grounds for each in ground.surfaces)
    if any(isinstance(surface, Mesh) for surface in surfaces):
        raise NoKernelError("rays onto meshes have a loop")  # tracing would say so, seconds later
    arrays = [array for part in call.arrays for array in part]
    types = {array.dtype for array in arrays}
    if types - {np.dtype(dtype) for dtype in DTYPES.values()}:
        raise NoKernelError(f"numbers of the types {sorted(map(str, types))}; C has 32 bits")
    shapes = tuple((array.shape[2:], array.dtype.str) for array in arrays)
    with BUILDING:
        kernel = _built(jax.tree.structure(call.trees), shapes, call.keep, call.checked)
    if isinstance(kernel, NoKernelError):
        raise kernel
    last = 0 if call.starts is None else int(call.starts.max())
    apart = [abs(x.strides[0]) * kernel.lanes + abs(x.strides[1]) * last for x in arrays]
    if max(apart) >= FARTHEST:
        raise NoKernelError(f"numbers of neighbours are {max(apart)} bytes apart")
    if any(call.axes[2][number] is not None for number in kernel.built.tables):
        raise NoKernelError("characters have large arrays of terrain of their own")
    return kernel


@functools.lru_cache(maxsize=64)
def _built(structure: PyTree, shapes: tuple, keep: Keep, checked: bool) -> Kernel | NoKernelError:
    """The code for arguments of these shapes, or why there is none: neither is looked for again."""
    try:
        return _build(structure, shapes, keep, checked)
    except NoKernelError as error:
        return error


def _build(structure: PyTree, shapes: tuple, keep: Keep, checked: bool) -> Kernel:
    if toolchain.compiler() is None:
        raise NoKernelError("no C compiler: $CC is not set, and there is no cc")
    leaves = [jax.ShapeDtypeStruct(shape, np.dtype(dtype)) for shape, dtype in shapes]
    ik, rig, terrain, frame = jax.tree.unflatten(structure, leaves)
    with activity.announced("Building code for a crowd"):
        try:
            built = build_program(ik, rig, terrain, frame, keep, checked=checked)
        except ValueError as error:  # there is no rule, or JAX will say the same
            raise NoKernelError(in_one_line(error)) from error
        try:
            return compiled(built)
        except (OSError, ValueError, subprocess.SubprocessError) as error:
            cache_folder.warn_once("crowds are computed by JAX, as C failed", in_one_line(error))
            raise NoKernelError(in_one_line(error)) from error


def compiled(built: CrowdProgram) -> Kernel:
    """The code of a program, compiled or from the folder of cached programs.

    Raises:
        OSError: there is no compiler, or the code cannot be written or loaded.
        ValueError: the compiler refuses it.
        subprocess.SubprocessError: the compiler fails.
    """
    lanes = LANES.get(machine.vector_bits() or 0, 4)
    return Kernel(built, lanes, _library(toolchain.compiler() or "cc", built.source(lanes)).run)


def _library(compiler: str, source: str) -> ctypes.CDLL:
    """The compiled code of a file, from the folder of cached programs if it is there."""
    version = subprocess.run([compiler, "--version"], check=True, capture_output=True, text=True)
    parts = [source, *FLAGS, compiler, version.stdout, machine.processor()]
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    with contextlib.ExitStack() as stack:
        try:
            folder = cache_folder.kernels()
        except cache_folder.SwitchedOffError:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path = folder / f"crowd-{key}.so"
        if not path.exists():
            files.write(path, lambda to: _compile(compiler, source, to), lasting=False)
        cache_folder.check_own(path, path.stat())
        return ctypes.CDLL(str(path))


def _compile(compiler: str, source: str, to: Path) -> None:
    command = [compiler, *FLAGS, "-x", "c", "-", "-o", str(to), "-lm"]
    done = subprocess.run(command, input=source, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"{compiler}: {done.stderr.strip().partition(chr(10))[0]}")


def _by_kernel(kernel: Kernel, call: _Call, out_axes: int, cores: int = 1) -> PyTree:
    """The results of compiled code."""
    built, words = kernel.built, {}
    for struct, tree, arrays in zip(STRUCTS, call.trees, call.arrays, strict=True):
        for path, array in zip(_paths(jax.tree.structure(tree)), arrays, strict=True):
            words[struct, path] = array.astype(np.int32) if array.dtype == bool else array
    places = {key: _Leaf.of(array, key[0] == "frame") for key, array in words.items()}
    inputs = [
        places[place.struct, place.field.path].at(place.index)
        for place in (*built.setup, *built.moving)
    ]
    tables = [np.ascontiguousarray(call.arrays[2][number][0, 0]) for number in built.tables]
    results, outputs = [], []
    for field in built.program.fields("result"):
        dtype = np.int32 if field.kind == BOOL else DTYPES[field.kind]
        if out_axes == 0:
            result = spread = _empty((call.members, call.count, *field.shape), dtype)
        else:
            result = _empty((call.count, *field.shape, call.members), dtype)
            spread = np.moveaxis(result, -1, 0)
        results.append(result)
        outputs += map(_Leaf.of(spread, True).at, np.ndindex(*field.shape))
    _run(kernel, call, np.array(inputs, PLACE), np.array(outputs, PLACE), tables, cores)
    typed = [
        result != 0 if field.kind == BOOL else result
        for field, result in zip(built.program.fields("result"), results, strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(built.program.trees["result"]), typed)


def _run(
    kernel: Kernel,
    call: _Call,
    inputs: np.ndarray,
    outputs: np.ndarray,
    tables: Sequence[np.ndarray],
    cores: int,
) -> None:
    """Computes all characters."""
    pointers = (ctypes.c_void_p * (len(tables) + 1))(*(table.ctypes.data for table in tables))
    shared = [_pointer(inputs), _pointer(outputs), pointers, _pointer(call.starts)]
    blocks = -(-call.members // kernel.lanes)
    each = kernel.lanes * -(-blocks // cores)
    calls = [
        functools.partial(
            kernel.run,
            *shared,
            *map(ctypes.c_ssize_t, (first, min(each, call.members - first), call.count)),
        )
        for first in range(0, call.members, each)
    ]
    if len(calls) > 1:
        on_all_cores(calls)
    else:
        calls[0]()


def _pointer(array: np.ndarray | None) -> ctypes.c_void_p | None:
    return None if array is None else array.ctypes.data_as(ctypes.c_void_p)


class _Leaf(NamedTuple):
    """Where numbers of an array are that has axes of characters and frames in front."""

    first: int
    """Address."""
    strides: tuple[int, ...]

    @classmethod
    def of(cls, array: np.ndarray, of_frames: bool) -> "_Leaf":
        members, frames, *rest = array.strides
        apart = members if len(array) > 1 else 0, frames if of_frames else 0
        return cls(array.ctypes.data, (*apart, *rest))

    def at(self, index: tuple[int, ...]) -> tuple[int, int, int]:
        """A `PLACE`: of the first character and frame, and bytes to those of others."""
        members, frames, *rest = self.strides
        return self.first + sum(map(operator.mul, index, rest)), members, frames


@functools.lru_cache(maxsize=64)
def _paths(structure: PyTree) -> list[tuple[str, ...]]:
    """The names of the leaves of a tree, as in programs."""
    zeros = jax.tree.unflatten(structure, [np.zeros(())] * structure.num_leaves)
    return [field.path for field in fields_of(zeros)]


def _empty(shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """A new array that begins with a line of the cache."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.empty(size + ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    return memory[first : first + size].view(dtype).reshape(shape)


def _by_lanes(call: _Call, out_axes: int) -> PyTree:
    """The results of JAX."""
    leaves, structure = jax.tree.flatten(call.trees)
    axes = tuple(axis for each in call.axes for axis in each)
    starts = np.zeros(call.members, np.int32) if call.starts is None else call.starts
    return _lanes(leaves, starts, structure, axes, out_axes, call.count, call.keep, call.checked)


@functools.partial(jax.jit, static_argnums=range(2, 8))
def _lanes(
    leaves: list,
    starts: Int[ArrayLike, " characters"],
    structure: PyTree,
    axes: tuple[int | None, ...],
    out_axes: int,
    count: int,
    keep: Keep,
    checked: bool,
) -> PyTree:
    def of_one(leaves: list, start: jax.Array) -> PyTree:
        ik, rig, terrain, frames = jax.tree.unflatten(structure, leaves)
        frames = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, count), frames)
        return keep(jaxik.run(ik, rig, terrain, frames, checked=checked))

    return jaxik.lanes(of_one, in_axes=(list(axes), 0), out_axes=out_axes)(leaves, starts)
