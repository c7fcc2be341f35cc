"""From StableHLO, to which JAX lowers every program, to a graph of single numbers.

`jax.export` writes StableHLO, which later versions of JAX go on reading. It has fewer kinds of
operations than traces have primitives (35 against 47 in `stride`), and reading that of `stride`
takes 1.2 s, most of which JAX takes to write it.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jax.export import Exported
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import stablehlo as dialect

from .graph import BOOL, DTYPES, FLOAT, INT, UNSIGNED, Graph, Node


class Table(NamedTuple):
    """An array that is not taken apart: numbers of it are read at an index."""

    node: Node
    kind: str
    """Of its numbers."""
    shape: tuple[int, ...]

    def reshape(self, shape: tuple[int, ...]) -> "Table":
        """The same numbers in another shape."""
        return self._replace(shape=shape)


Nodes: TypeAlias = np.ndarray
"""The nodes of an array, in its shape."""
Operation: TypeAlias = ir.OpView
Rule: TypeAlias = Callable[..., Sequence[Nodes]]
"""Of the reader, an operation of StableHLO and its operands, to its results."""

KINDS = {"f32": FLOAT, "i32": INT, "ui32": UNSIGNED, "i1": BOOL}
LOOPS = ("while", "sort", "reduce_window", "select_and_scatter", "scatter", "map")


def read(exported: Exported, graph: Graph, arguments: Sequence[Nodes | Table]) -> list[Nodes]:
    """The results of an exported program of these arguments, as nodes of the graph.

    Raises:
        ValueError: the program has an operation without a rule, such as a loop, or one that does
            more with a table than read it; it says which.
    """
    with ir.Context() as context:
        dialect.register_dialect(context)
        module = dialect.deserialize_portable_artifact(context, exported.mlir_module_serialized)
        functions = {
            _attribute(part, "sym_name").value: part.regions[0].blocks[0] for part in module.body
        }
        return list(_Reader(graph, functions).block(functions["main"], arguments))


class _Reader:
    """Evaluates operations on arrays of nodes."""

    def __init__(self, graph: Graph, functions: Mapping[str, ir.Block]) -> None:
        self.graph = graph
        self.functions = functions

    def block(self, block: ir.Block, arguments: Sequence[Any]) -> Sequence[Any]:
        """What a block, of a function or of a reduction, returns."""
        known: dict[ir.Value, Any] = dict(zip(block.arguments, arguments, strict=True))
        for operation in block.operations:
            operands = [known[value] for value in operation.operands]
            if operation.operation.name in ("func.return", "stablehlo.return"):
                return operands
            of_table = any(isinstance(operand, Table) for operand in operands)
            results = _rule(operation, of_table)(self, operation, *operands)
            known |= zip(operation.results, results, strict=True)
        raise ValueError("a block of the program does not return")

    def each(self, name: str, *operands: Nodes) -> list[Nodes]:
        """An operation on the numbers of arrays of one shape."""
        numbers = zip(*(operand.ravel().tolist() for operand in operands), strict=True)
        return [_array((self.graph.add(name, *each) for each in numbers), operands[0].shape)]

    def constant(self, value: np.generic) -> Nodes:
        """The node of a number, without axes."""
        return np.asarray(self.graph.constant(value))

    def function(self, name: str, operands: Sequence[Nodes]) -> Sequence[Nodes]:
        """What a function of the program returns."""
        return self.block(self.functions[name], operands)

    def window(self, table: Table, starts: Sequence[Node], sizes: Sequence[int]) -> Nodes:
        """Numbers of a table, from indices on that are clipped to leave room for as many."""
        corner = self.graph.constant(np.int32(0))
        for start, size, length in zip(starts, sizes, table.shape, strict=True):
            last = self.graph.constant(np.int32(length - size))
            at = self.graph.add("minimum", last, start)
            at = self.graph.add("maximum", self.graph.constant(np.int32(0)), at)
            corner = self.graph.add("multiply", corner, self.graph.constant(np.int32(length)))
            corner = self.graph.add("add", corner, at)
        window = np.zeros(tuple(sizes), np.int64)
        for index in np.ndindex(*sizes):
            beyond = np.int32(np.ravel_multi_index(index, table.shape))
            at = self.graph.add("add", corner, self.graph.constant(beyond))
            window[index] = self.graph.add(f"read_{table.kind}", at, table.node)
        return window

    def at(self, choices: Nodes, index: Node, last: int) -> Nodes:
        """The entry of the first axis at an index, which is clipped to 0..`last`."""
        value = self.graph.values[index]
        if value is not None:
            return choices[min(max(int(value), 0), last)]
        result = choices[0]
        for number in range(1, last + 1):
            bound = self.graph.constant(DTYPES[self.graph.types[index]](number))
            beyond = np.full(result.shape, self.graph.add("LE", bound, index))
            (result,) = self.each("select", beyond, choices[number], result)
        return result


def _array(nodes: Iterable[Node], shape: tuple[int, ...]) -> Nodes:
    return np.fromiter(nodes, np.int64, math.prod(shape)).reshape(shape)


def _rule(operation: Operation, of_table: bool) -> Rule:
    name = operation.operation.name.removeprefix("stablehlo.")
    if name in RULES and (name in OF_TABLES or not of_table):
        return RULES[name]
    where = str(operation.location).removeprefix("loc(").removesuffix(")")
    place = where.split('"')[1] if '"' in where else where
    if name in RULES:
        raise ValueError(f"the operation {name!r} in {place} does more with a table than read it")
    if name in LOOPS:
        raise ValueError(
            f"the system has a loop, {name!r} in {place}; code without loops is exported, and "
            "rays onto meshes are left to the engine"
        )
    raise ValueError(
        f"there is no rule for the operation {name!r} in {place}; there are {sorted(RULES)}"
    )


def _kind(value: ir.Value) -> str:
    """The type of an array's numbers."""
    element = str(ir.RankedTensorType(value.type).element_type)
    if element not in KINDS:
        raise ValueError(f"numbers of the type {element} are not exported; there are {list(KINDS)}")
    return KINDS[element]


def _shape(value: ir.Value) -> tuple[int, ...]:
    return tuple(ir.RankedTensorType(value.type).shape)


def _numbers(operation: Operation, name: str) -> list[int]:
    return [int(number) for number in _attribute(operation, name)]


def _attribute(operation: Operation, name: str) -> Any:
    return operation.attributes[name]


def _elementwise(name: str) -> Rule:
    return lambda reader, operation, *operands: reader.each(name, *operands)


def _copy(reader: _Reader, operation: Operation, *operands: Nodes) -> Sequence[Nodes]:
    return operands


def _constant(reader: _Reader, operation: Operation) -> Sequence[Nodes]:
    values = np.array(operation.attributes["value"])
    if not values.size:
        return [np.zeros(values.shape, np.int64)]
    kind = DTYPES[_kind(operation.results[0])]
    return [_array((reader.graph.constant(kind(x)) for x in values.flat), values.shape)]


def _compare(reader: _Reader, operation: Operation, a: Nodes, b: Nodes) -> Sequence[Nodes]:
    direction = dialect.ComparisonDirectionAttr(operation.attributes["comparison_direction"]).value
    if direction in ("GT", "GE"):
        return reader.each({"GT": "LT", "GE": "LE"}[direction], b, a)
    return reader.each(direction, a, b)


def _select(
    reader: _Reader, operation: Operation, chosen: Nodes, yes: Nodes, no: Nodes
) -> Sequence[Nodes]:
    return reader.each("select", np.broadcast_to(chosen, yes.shape), yes, no)


def _clamp(
    reader: _Reader, operation: Operation, low: Nodes, x: Nodes, high: Nodes
) -> Sequence[Nodes]:
    (raised,) = reader.each("maximum", np.broadcast_to(low, x.shape), x)
    return reader.each("minimum", raised, np.broadcast_to(high, x.shape))


def _convert(reader: _Reader, operation: Operation, x: Nodes) -> Sequence[Nodes]:
    before, after = _kind(operation.operands[0]), _kind(operation.results[0])
    if before == after:
        return [x]
    if after == BOOL:
        zero = np.broadcast_to(reader.constant(DTYPES[before](0)), x.shape)
        return reader.each("NE", x, zero)
    return reader.each(f"{after}_of_{before}", x)


def _bitcast(reader: _Reader, operation: Operation, x: Nodes) -> Sequence[Nodes]:
    steps = {
        (FLOAT, UNSIGNED): ["bits_of_float"],
        (FLOAT, INT): ["bits_of_float", "int_of_unsigned"],
        (UNSIGNED, FLOAT): ["float_of_bits"],
        (INT, FLOAT): ["unsigned_of_int", "float_of_bits"],
        (INT, UNSIGNED): ["unsigned_of_int"],
        (UNSIGNED, INT): ["int_of_unsigned"],
    }
    for name in steps.get((_kind(operation.operands[0]), _kind(operation.results[0])), []):
        (x,) = reader.each(name, x)
    return [x]


def _broadcast(reader: _Reader, operation: Operation, x: Nodes) -> Sequence[Nodes]:
    shape, axes = _shape(operation.results[0]), _numbers(operation, "broadcast_dimensions")
    aligned = [1] * len(shape)
    for axis, size in zip(axes, x.shape, strict=True):
        aligned[axis] = size
    return [np.broadcast_to(x.reshape(aligned), shape)]


def _reshape(reader: _Reader, operation: Operation, x: Nodes) -> Sequence[Nodes]:
    return [x.reshape(_shape(operation.results[0]))]


def _transpose(reader: _Reader, operation: Operation, x: Nodes) -> Sequence[Nodes]:
    return [x.transpose(_numbers(operation, "permutation"))]


def _reverse(reader: _Reader, operation: Operation, x: Nodes) -> Sequence[Nodes]:
    return [np.flip(x, tuple(_numbers(operation, "dimensions")))]


def _concatenate(reader: _Reader, operation: Operation, *operands: Nodes) -> Sequence[Nodes]:
    return [np.concatenate(operands, _attribute(operation, "dimension").value)]


def _slice(reader: _Reader, operation: Operation, x: Nodes) -> Sequence[Nodes]:
    bounds = (_numbers(operation, f"{name}_indices") for name in ("start", "limit"))
    return [x[tuple(map(slice, *bounds, _numbers(operation, "strides")))]]


def _pad(reader: _Reader, operation: Operation, x: Nodes, filling: Nodes) -> Sequence[Nodes]:
    low = _numbers(operation, "edge_padding_low")
    between = _numbers(operation, "interior_padding")
    padded = np.full(_shape(operation.results[0]), filling)
    # Negative padding cuts off.
    indices = itertools.product(*(range(size) for size in x.shape))
    for index in indices:
        place = tuple(a + i * (1 + b) for a, i, b in zip(low, index, between, strict=True))
        if all(0 <= i < size for i, size in zip(place, padded.shape, strict=True)):
            padded[place] = x[index]
    return [padded]


def _iota(reader: _Reader, operation: Operation) -> Sequence[Nodes]:
    shape, axis = _shape(operation.results[0]), _attribute(operation, "iota_dimension").value
    kind = DTYPES[_kind(operation.results[0])]
    numbers = np.array([reader.graph.constant(kind(i)) for i in range(shape[axis])])
    return [np.broadcast_to(numbers.reshape([-1] + [1] * (len(shape) - axis - 1)), shape)]


def _dynamic_slice(
    reader: _Reader, operation: Operation, x: Nodes, *starts: Nodes
) -> Sequence[Nodes]:
    for axis, (start, size) in enumerate(
        zip(starts, _numbers(operation, "slice_sizes"), strict=True)
    ):
        windows = np.moveaxis(np.lib.stride_tricks.sliding_window_view(x, size, axis), axis, 0)
        chosen = reader.at(windows, int(start), len(windows) - 1)
        x = np.moveaxis(chosen, -1, axis)
    return [x]


def _gather(
    reader: _Reader, operation: Operation, x: Nodes | Table, indices: Nodes
) -> Sequence[Nodes]:
    names = dialect.GatherDimensionNumbers(operation.attributes["dimension_numbers"])
    if names.operand_batching_dims:
        raise ValueError("there is no rule for a gather with batching dimensions")
    sizes = _numbers(operation, "slice_sizes")
    if names.index_vector_dim == indices.ndim:
        indices = indices[..., None]
    indices = np.moveaxis(indices, names.index_vector_dim, -1)
    slices = []
    for place in indices.reshape(-1, indices.shape[-1]):
        starts = [reader.constant(np.int32(0)).item()] * len(sizes)
        for number, axis in zip(place.tolist(), names.start_index_map, strict=True):
            starts[axis] = number
        if isinstance(x, Table):
            window = reader.window(x, starts, sizes)
        else:
            window = np.lib.stride_tricks.sliding_window_view(x, sizes)
            for start in starts:
                window = reader.at(window, start, len(window) - 1)
        slices.append(np.squeeze(window, tuple(names.collapsed_slice_dims)))
    batch = indices.shape[:-1]
    gathered = np.array(slices, np.int64).reshape(*batch, *slices[0].shape)
    # The axes of slices go to their places among those of the batch.
    rank = gathered.ndim
    offsets = list(names.offset_dims)
    rest = [axis for axis in range(rank) if axis not in offsets]
    order = np.argsort([*rest, *offsets])
    return [gathered.transpose(order)]


def _reduce(reader: _Reader, operation: Operation, *operands: Nodes) -> Sequence[Nodes]:
    arrays, starts = operands[: len(operands) // 2], operands[len(operands) // 2 :]
    axes = _numbers(operation, "dimensions")
    body = operation.regions[0].blocks[0]
    rest = [axis for axis in range(arrays[0].ndim) if axis not in axes]
    shape = tuple(arrays[0].shape[axis] for axis in rest)
    flat = [array.transpose([*rest, *axes]).reshape(math.prod(shape), -1) for array in arrays]
    results = [
        functools.reduce(
            lambda before, new: reader.block(body, [*before, *map(np.asarray, new)]),
            zip(*(array[row] for array in flat), strict=True),
            list(starts),
        )
        for row in range(math.prod(shape))
    ]
    return [_array((int(row[i]) for row in results), shape) for i in range(len(arrays))]


def _dot(reader: _Reader, operation: Operation, a: Nodes, b: Nodes) -> Sequence[Nodes]:
    names = dialect.DotDimensionNumbers(operation.attributes["dot_dimension_numbers"])
    if names.lhs_batching_dimensions:
        raise ValueError("there is no rule for a dot_general with batching dimensions")
    summed = names.lhs_contracting_dimensions, names.rhs_contracting_dimensions
    rest = [
        [axis for axis in range(x.ndim) if axis not in axes]
        for x, axes in zip((a, b), summed, strict=True)
    ]
    shapes = [[x.shape[i] for i in axes] for x, axes in zip((a, b), rest, strict=True)]
    rows, columns = (
        x.transpose([*outer, *inner]).reshape(math.prod(shape), -1)
        for x, outer, inner, shape in zip((a, b), rest, summed, shapes, strict=True)
    )
    graph, zero = reader.graph, reader.graph.constant(np.float32(0))
    products = (
        functools.reduce(
            lambda total, pair: graph.add("add", total, graph.add("multiply", *map(int, pair))),
            zip(row, column, strict=True),
            zero,
        )
        for row in rows
        for column in columns
    )
    return [_array(products, (*shapes[0], *shapes[1]))]


def _call(reader: _Reader, operation: Operation, *operands: Nodes) -> Sequence[Nodes]:
    return reader.function(_attribute(operation, "callee").value, operands)


def _composite(reader: _Reader, operation: Operation, *operands: Nodes) -> Sequence[Nodes]:
    return reader.function(_attribute(operation, "decomposition").value, operands)


ELEMENTWISE = (
    "abs add and atan2 cbrt ceil cosine divide exponential exponential_minus_one floor is_finite"
    " log log_plus_one maximum minimum multiply negate not or power remainder"
    " round_nearest_even rsqrt shift_left shift_right_arithmetic shift_right_logical sign sine"
    " sqrt subtract tan tanh xor"
).split()
OF_TABLES = ("composite", "func.call", "gather", "optimization_barrier", "reshape")
# By the name of the operation of StableHLO.
RULES: dict[str, Rule] = {
    **{name: _elementwise(name) for name in ELEMENTWISE},
    "bitcast_convert": _bitcast,
    "broadcast_in_dim": _broadcast,
    "clamp": _clamp,
    "compare": _compare,
    "composite": _composite,
    "concatenate": _concatenate,
    "constant": _constant,
    "convert": _convert,
    "dot_general": _dot,
    "dynamic_slice": _dynamic_slice,
    "func.call": _call,
    "gather": _gather,
    "iota": _iota,
    "optimization_barrier": _copy,
    "pad": _pad,
    "reduce": _reduce,
    "reshape": _reshape,
    "reverse": _reverse,
    "select": _select,
    "slice": _slice,
    "transpose": _transpose,
}
