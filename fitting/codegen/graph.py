"""A program as a graph of operations on single numbers, simplified while it is built.

Equal operations on equal operands are one node, and what is constant is computed at once. Rewriting
changes finite results by rounding at most, as XLA's own does, and signs of zeros.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import numpy as np

Node: TypeAlias = int
FLOAT, INT, UNSIGNED, BOOL = "float", "int", "unsigned", "bool"
DTYPES = {FLOAT: np.float32, INT: np.int32, UNSIGNED: np.uint32, BOOL: np.bool_}
TABLES = {kind: f"table of {kind}" for kind in (FLOAT, INT, UNSIGNED)}
"""Types of large arrays, of which numbers are read at an index."""
Number: TypeAlias = Any
"""Of NumPy, of one of these types."""


@dataclasses.dataclass(frozen=True)
class Operation:
    """An operation on numbers."""

    fold: Callable
    """Its value for constants, in NumPy."""
    result: str | None = None
    """Type of its value; None for that of the last operand."""
    commutes: bool = False


def _typed(dtype: type) -> Callable[[Number], Number]:
    return lambda x: dtype(x)


def _whole(x: Number, low: int, high: int, dtype: type) -> Number:
    """A float as a whole number, as XLA converts it: NaN to 0, others to the nearest there is."""
    return dtype(0 if np.isnan(x) else min(max(int(np.clip(x, low, high)), low), high))


OPERATIONS = {
    "add": Operation(operator.add, commutes=True),
    "subtract": Operation(operator.sub),
    "multiply": Operation(operator.mul, commutes=True),
    "divide": Operation(np.divide),
    "negate": Operation(operator.neg),
    "abs": Operation(np.abs),
    "sign": Operation(np.sign),
    "maximum": Operation(np.maximum),
    "minimum": Operation(np.minimum),
    "remainder": Operation(np.fmod),
    "sqrt": Operation(np.sqrt),
    "rsqrt": Operation(lambda x: np.float32(1) / np.sqrt(x)),
    "cbrt": Operation(np.cbrt),
    "exponential": Operation(np.exp),
    "exponential_minus_one": Operation(np.expm1),
    "log": Operation(np.log),
    "log_plus_one": Operation(np.log1p),
    "power": Operation(np.power),
    "cosine": Operation(np.cos),
    "sine": Operation(np.sin),
    "tan": Operation(np.tan),
    "tanh": Operation(np.tanh),
    "atan2": Operation(np.arctan2),
    "floor": Operation(np.floor),
    "ceil": Operation(np.ceil),
    "round_nearest_even": Operation(np.rint),
    "is_finite": Operation(np.isfinite, BOOL),
    "LT": Operation(operator.lt, BOOL),
    "LE": Operation(operator.le, BOOL),
    "EQ": Operation(operator.eq, BOOL, commutes=True),
    "NE": Operation(operator.ne, BOOL, commutes=True),
    "and": Operation(operator.and_, commutes=True),
    "or": Operation(operator.or_, commutes=True),
    "xor": Operation(operator.xor, commutes=True),
    "not": Operation(np.invert),
    "shift_left": Operation(operator.lshift),
    "shift_right_arithmetic": Operation(operator.rshift),
    "shift_right_logical": Operation(
        lambda x, count: (x.view(np.uint32) >> np.uint32(count)).view(x.dtype)
    ),
    "select": Operation(lambda chosen, yes, no: yes if chosen else no),
    "float_of_bool": Operation(_typed(np.float32), FLOAT),
    "float_of_int": Operation(_typed(np.float32), FLOAT),
    "float_of_unsigned": Operation(_typed(np.float32), FLOAT),
    "int_of_bool": Operation(_typed(np.int32), INT),
    "int_of_float": Operation(lambda x: _whole(x, -(2**31), 2**31 - 1, np.int32), INT),
    "int_of_unsigned": Operation(lambda x: x.view(np.int32), INT),
    "unsigned_of_bool": Operation(_typed(np.uint32), UNSIGNED),
    "unsigned_of_float": Operation(lambda x: _whole(x, 0, 2**32 - 1, np.uint32), UNSIGNED),
    "unsigned_of_int": Operation(lambda x: x.view(np.uint32), UNSIGNED),
    "float_of_bits": Operation(lambda x: x.view(np.float32), FLOAT),
    "bits_of_float": Operation(lambda x: x.view(np.uint32), UNSIGNED),
    "lesser": Operation(lambda a, b: a if a < b else b),
    "greater": Operation(lambda a, b: a if a > b else b),
    "sign_bit": Operation(np.signbit, BOOL),
    "copysign": Operation(np.copysign),
    **{f"read_{kind}": Operation(lambda index, table: table[index], kind) for kind in TABLES},
}
"""Of StableHLO, as far as they act on single numbers. `GT` and `GE` are `LT` and `LE` turned round,
and conversions have a name for each pair of types. The last four come of patterns: `lesser` and
`greater` are the second operand where one is NaN, as a processor's minimum and maximum are."""

CONSTANT, INPUT = "constant", "input"
SMALLEST = 1e-30  # of a constant factor or divisor that is rewritten; its inverse is the largest
NESTED = 2  # operations within a choice that are simplified by what is chosen


class Graph:
    """Nodes in an order in which operands come first."""

    def __init__(self) -> None:
        self.operations: list[str] = []
        self.operands: list[tuple[Node, ...]] = []
        self.types: list[str] = []
        self.values: list[Number | None] = []
        """Of constants."""
        self.inputs: dict[Node, int] = {}
        """The number of each input."""
        self._known: dict[tuple, Node] = {}

    def constant(self, value: Number) -> Node:
        """The node of a number of one of the four types."""
        kind = next(name for name, dtype in DTYPES.items() if isinstance(value, dtype))
        return self._node((CONSTANT, kind, value.tobytes()), CONSTANT, (), kind, value)

    def input(self, kind: str, number: int) -> Node:
        """The node of an input, by its number."""
        node = self._node((INPUT, number), INPUT, (), kind, None)
        self.inputs[node] = number
        return node

    def add(self, name: str, *operands: Node) -> Node:
        """The node of an operation on these, or of something simpler with the same value."""
        operation = OPERATIONS[name]
        values = [self.values[node] for node in operands]
        if all(value is not None for value in values):
            with np.errstate(all="ignore"):
                result = operation.fold(*values)
            return self.constant(DTYPES[self._type(name, operands)](result))
        if (simpler := _simplified(self, name, operands)) is not None:
            return simpler
        if operation.commutes and operands[0] > operands[1]:
            operands = operands[::-1]
        return self._node((name, *operands), name, operands, self._type(name, operands), None)

    def is_constant(self, node: Node, number: int) -> bool:
        """Whether a node is this number; zeros count as equal."""
        value = self.values[node]
        return value is not None and bool(value == number)

    def parts(self, node: Node, name: str) -> tuple[Node, ...] | None:
        """The operands of a node of this operation, None of another one."""
        return self.operands[node] if self.operations[node] == name else None

    def _type(self, name: str, operands: tuple[Node, ...]) -> str:
        return OPERATIONS[name].result or self.types[operands[-1]]

    def _node(
        self, key: tuple, name: str, operands: tuple[Node, ...], kind: str, value: Number | None
    ) -> Node:
        node = self._known.setdefault(key, len(self.operations))
        if node == len(self.operations):
            self.operations.append(name)
            self.operands.append(operands)
            self.types.append(kind)
            self.values.append(value)
        return node


def needed(graph: Graph, results: Iterable[Node]) -> set[Node]:
    """These nodes and all that they depend on."""
    reached, waiting = set(), list(results)
    while waiting:
        if (node := waiting.pop()) not in reached:
            reached.add(node)
            waiting += graph.operands[node]
    return reached


def _simplified(graph: Graph, name: str, operands: tuple[Node, ...]) -> Node | None:
    rule = SIMPLER.get(name)
    return None if rule is None else rule(graph, *operands)


def _all(*nodes: Node | None) -> list[Node] | None:
    """These nodes if there are all of them."""
    present = [node for node in nodes if node is not None]
    return present if len(present) == len(nodes) else None


def _negative(graph: Graph, node: Node) -> Node | None:
    """What a node is the negative of."""
    parts = graph.parts(node, "negate")
    return parts[0] if parts else None


def _flag(graph: Graph, node: Node) -> Node | None:
    """The condition of which a float is 1 or 0."""
    parts = graph.parts(node, "float_of_bool")
    return parts[0] if parts else None


def _add(graph: Graph, a: Node, b: Node) -> Node | None:
    for x, y in ((a, b), (b, a)):
        if graph.is_constant(y, 0):
            return x
        if (other := _negative(graph, y)) is not None:
            return graph.add("subtract", x, other)
    return None


def _subtract(graph: Graph, a: Node, b: Node) -> Node | None:
    if graph.is_constant(b, 0):
        return a
    if (other := _negative(graph, b)) is not None:
        return graph.add("add", a, other)
    if (other := _negative(graph, a)) is not None:
        return graph.add("negate", graph.add("add", other, b))
    if graph.is_constant(a, 1) and (flag := _flag(graph, b)) is not None:
        return graph.add("float_of_bool", graph.add("not", flag))
    return None


def _multiply(graph: Graph, a: Node, b: Node) -> Node | None:
    if flags := _all(_flag(graph, a), _flag(graph, b)):
        return graph.add("float_of_bool", graph.add("and", *flags))
    for x, y in ((a, b), (b, a)):
        if graph.is_constant(y, 1):
            return x
        if graph.is_constant(y, 0):  # of what is not finite, no product counts
            return y
        if graph.is_constant(y, -1):
            return graph.add("negate", x)
    for x, y in ((a, b), (b, a)):
        if (negative := _negative(graph, x)) is not None:
            if graph.values[y] is not None:
                return graph.add("multiply", negative, graph.add("negate", y))
            return graph.add("negate", graph.add("multiply", negative, y))
        if graph.values[y] is not None and (factor := _constant_factor(graph, x)) is not None:
            product = graph.add("multiply", factor[1], y)
            value = graph.values[product]
            if value is not None and SMALLEST <= abs(value) <= 1 / SMALLEST:
                return graph.add("multiply", factor[0], product)
    return None


def _constant_factor(graph: Graph, node: Node) -> tuple[Node, Node] | None:
    """The operands of a product, of which the second is a constant."""
    parts = graph.parts(node, "multiply") if graph.types[node] == FLOAT else None
    for x, y in (parts, parts[::-1]) if parts else ():
        if graph.values[y] is not None:
            return x, y
    return None


def _divide(graph: Graph, a: Node, b: Node) -> Node | None:
    value = graph.values[b]
    if value is not None and SMALLEST <= abs(value) <= 1 / SMALLEST:
        return graph.add("multiply", a, graph.constant(np.float32(1) / value))
    for x, y in ((a, b), (b, a)):
        if (negative := _negative(graph, x)) is not None:
            pair = (negative, y) if x == a else (y, negative)
            return graph.add("negate", graph.add("divide", *pair))
    return None


def _negate(graph: Graph, a: Node) -> Node | None:
    if (factor := _constant_factor(graph, a)) is not None:
        return graph.add("multiply", factor[0], graph.add("negate", factor[1]))
    if (inner := _negative(graph, a)) is not None:
        return inner
    parts = graph.parts(a, "subtract")
    return graph.add("subtract", *parts[::-1]) if parts else None


def _abs(graph: Graph, a: Node) -> Node | None:
    if graph.operations[a] in ("abs", "float_of_bool", "sqrt"):
        return a
    inner = _negative(graph, a)
    return None if inner is None else graph.add("abs", inner)


def _select(graph: Graph, chosen: Node, yes: Node, no: Node) -> Node | None:
    if graph.values[chosen] is not None:
        return yes if graph.values[chosen] else no
    if yes == no:
        return yes
    if (inner := graph.parts(chosen, "not")) is not None:
        return graph.add("select", inner[0], no, yes)
    if (inner := graph.parts(yes, "select")) is not None and inner[0] == chosen:
        return graph.add("select", chosen, inner[1], no)
    if (inner := graph.parts(no, "select")) is not None and inner[0] == chosen:
        return graph.add("select", chosen, yes, inner[2])
    if (extreme := _extreme(graph, chosen, yes, no)) is not None:
        return extreme
    if graph.operations[chosen] == "sign_bit" and graph.parts(yes, "negate") == (no,):
        if (parts := graph.parts(no, "abs")) is not None:
            return graph.add("copysign", parts[0], graph.operands[chosen][0])
    bare = _unguarded(graph, yes, chosen, True), _unguarded(graph, no, chosen, False)
    if bare != (yes, no):
        return graph.add("select", chosen, *bare)
    if graph.is_constant(no, 0) and (parts := graph.parts(yes, "sqrt")) is not None:
        if graph.parts(chosen, "LT") == (no, *parts):  # of what is positive, else 0
            return graph.add("sqrt", graph.add("select", chosen, *parts, no))
    if negatives := _all(_negative(graph, yes), _negative(graph, no)):
        return graph.add("negate", graph.add("select", chosen, *negatives))
    if graph.types[yes] == BOOL:
        return _select_of_flags(graph, chosen, yes, no)
    if graph.types[yes] == FLOAT:
        if flags := _all(_as_flag(graph, yes), _as_flag(graph, no)):
            return graph.add("float_of_bool", graph.add("select", chosen, *flags))
    return None


def _extreme(graph: Graph, chosen: Node, yes: Node, no: Node) -> Node | None:
    """A choice of the lesser or greater of two numbers, or the upper end of a range."""
    compared = graph.parts(chosen, "LT") or graph.parts(chosen, "LE")
    if compared is None or graph.types[yes] != FLOAT:
        return None
    if (yes, no) == compared:
        return graph.add("lesser", yes, no)
    if (no, yes) == compared:
        return graph.add("greater", yes, no)
    low, high = graph.values[yes], graph.values[(graph.parts(no, "lesser") or (no,))[0]]
    if low is not None and high is not None and low <= high:
        if compared == (graph.operands[no][1:] + (yes,) if graph.operands[no] else None):
            return graph.add("greater", yes, no)
    return None


def _unguarded(graph: Graph, node: Node, chosen: Node, value: bool, depth: int = NESTED) -> Node:
    """A node where a condition holds, or does not: what only guards it is left out.

    Functions guard their operands for the sake of derivatives, which nobody takes here.
    """
    if node == chosen:
        return graph.constant(np.bool_(value))
    operands = graph.operands[node]
    if not operands or depth == 0:
        return node
    if graph.operations[node] == "select" and operands[0] == chosen:
        return operands[1 if value else 2]
    simpler = tuple(_unguarded(graph, operand, chosen, value, depth - 1) for operand in operands)
    return node if simpler == operands else graph.add(graph.operations[node], *simpler)


def _as_flag(graph: Graph, node: Node) -> Node | None:
    """The condition of which a float is 1 or 0, of these constants too."""
    for number in (0, 1):
        if graph.is_constant(node, number):
            return graph.constant(np.bool_(number))
    return _flag(graph, node)


def _select_of_flags(graph: Graph, chosen: Node, yes: Node, no: Node) -> Node | None:
    for node, name, otherwise in ((yes, "or", no), (no, "and", yes)):
        value = graph.values[node]
        if value is not None and bool(value) == (name == "or"):
            return graph.add(name, chosen, otherwise)
        if value is not None:
            opposite = graph.add("not", chosen)
            return graph.add("and" if name == "or" else "or", opposite, otherwise)
    return None


def _and(graph: Graph, a: Node, b: Node) -> Node | None:
    return _joined(graph, a, b, neutral=True)


def _or(graph: Graph, a: Node, b: Node) -> Node | None:
    return _joined(graph, a, b, neutral=False)


def _joined(graph: Graph, a: Node, b: Node, neutral: bool) -> Node | None:
    if a == b:
        return a
    if graph.types[a] != BOOL:
        return None
    for x, y in ((a, b), (b, a)):
        if (value := graph.values[y]) is not None:
            return x if bool(value) == neutral else y
        if graph.parts(y, "not") == (x,):
            return graph.constant(np.bool_(not neutral))
    return None


def _not(graph: Graph, a: Node) -> Node | None:
    parts = graph.parts(a, "not")
    if parts is None and graph.operations[a] in ("EQ", "NE"):
        return graph.add({"EQ": "NE", "NE": "EQ"}[graph.operations[a]], *graph.operands[a])
    return parts[0] if parts else None


def _compared(name: str, graph: Graph, a: Node, b: Node) -> Node | None:
    """A comparison with a constant of what is one of two constants."""
    fold = OPERATIONS[name].fold
    if (parts := _shifted_sign(graph, name, a, b)) is not None:
        return graph.add("sign_bit", parts)
    if (negatives := _all(_negated(graph, a), _negated(graph, b))) and a != b:
        return graph.add(name, *negatives[::-1])
    for index, (x, y) in enumerate(((a, b), (b, a))):
        limit = graph.values[y]
        cases = _two_constants(graph, x)
        if limit is None or cases is None:
            continue
        chosen, *constants = cases
        outcomes = (fold(*((value, limit)[:: -1 if index else 1])) for value in constants)
        return graph.add("select", chosen, *(graph.constant(np.bool_(o)) for o in outcomes))
    return None


def _negated(graph: Graph, node: Node) -> Node | None:
    """What a node is the negative of, if it is one or a constant."""
    value = graph.values[node]
    if value is not None and graph.types[node] == FLOAT:
        return graph.constant(-value)
    return _negative(graph, node)


def _shifted_sign(graph: Graph, name: str, a: Node, b: Node) -> Node | None:
    """The float whose sign a comparison of its shifted bits asks for."""
    for x, zero in ((a, b), (b, a)):
        if name == "NE" and graph.is_constant(zero, 0):
            shift = graph.parts(x, "shift_right_arithmetic")
            if shift and graph.is_constant(shift[1], 31):
                bits = graph.parts(shift[0], "int_of_unsigned") or (shift[0],)
                if (parts := graph.parts(bits[0], "bits_of_float")) is not None:
                    return parts[0]
    return None


def _two_constants(graph: Graph, node: Node) -> tuple[Node, Number, Number] | None:
    if (flag := _flag(graph, node)) is not None:
        return flag, np.float32(1), np.float32(0)
    if (parts := graph.parts(node, "int_of_bool")) is not None:
        return parts[0], np.int32(1), np.int32(0)
    if (parts := graph.parts(node, "select")) is not None:
        yes, no = (graph.values[part] for part in parts[1:])
        if yes is not None and no is not None:
            return parts[0], yes, no
    return None


SIMPLER: dict[str, Callable[..., Node | None]] = {
    "add": _add,
    "subtract": _subtract,
    "multiply": _multiply,
    "divide": _divide,
    "negate": _negate,
    "abs": _abs,
    "select": _select,
    "and": _and,
    "or": _or,
    "not": _not,
    **{name: functools.partial(_compared, name) for name in ("LT", "LE", "EQ", "NE")},
}
