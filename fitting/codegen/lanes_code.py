"""The functions of a program in C over vectors: each number is that of several characters at once.

A file of its own, with the helpers of `vectors.h`, whose `run` computes clips of many characters
in blocks of as many as a vector has lanes.

Nodes are written in an order in which a processor seldom waits for results. Operands first, as they
are asked for, they come in chains each of which waits for the one before. A processor looks ahead
by a few hundred instructions only, which vectors use up quickly: in this order, frames take a fifth
less time.
"""

import heapq
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from .c_code import literal
from .functions import LETTERS, Language, body_of, fill, parts_of
from .graph import BOOL, FLOAT, INT, TABLES, UNSIGNED, Graph, Node, Number
from .program import Place, Program
from .repeats import Repeats
from .schedule import Target

TEMPLATE, VECTORS = (Path(__file__).with_name(name) for name in ("crowd.c", "vectors.h"))

LATENCIES = {"divide": 16, "sqrt": 24, "rsqrt": 40, "negate": 1, "abs": 1}  # cycles, of vectors
USUAL = 4  # cycles
A_CYCLE = 2  # nodes that a processor begins with
AHEAD = 1000  # nodes by which one may be brought forward: more would need more registers

C_TYPES = {FLOAT: "vf", INT: "vi", UNSIGNED: "vu", BOOL: "vb"}
C_TYPES |= {table: f"const {kind} *" for kind, table in TABLES.items()}
# By operation and type of the operands, as in `c_code`.
EXPRESSIONS: dict[tuple[str, str], str] = {
    **{(name, kind): f"({{0}} {sign} {{1}})" for name, sign in (
        ("add", "+"), ("subtract", "-"), ("multiply", "*"),
    ) for kind in (FLOAT, UNSIGNED)},
    ("divide", FLOAT): "({0} / {1})",
    **{(name, INT): f"(vi)((vu){{0}} {sign} (vu){{1}})" for name, sign in (
        ("add", "+"), ("subtract", "-"), ("multiply", "*"),
    )},
    **{(name, kind): f"{name}_{kind}({{0}}, {{1}})" for name in ("LT", "LE", "EQ", "NE")
       for kind in (FLOAT, INT, UNSIGNED)},
    ("LT", BOOL): "AND(NOT({0}), {1})",
    ("LE", BOOL): "OR(NOT({0}), {1})",
    ("EQ", BOOL): "NOT(XOR({0}, {1}))",
    ("NE", BOOL): "XOR({0}, {1})",
    **{(name, BOOL): f"{word}({{0}}, {{1}})" for name, word in (
        ("and", "AND"), ("or", "OR"), ("xor", "XOR"), ("maximum", "OR"), ("minimum", "AND"),
    )},
    **{(name, kind): f"({{0}} {sign} {{1}})" for name, sign in (
        ("and", "&"), ("or", "|"), ("xor", "^"),
    ) for kind in (INT, UNSIGNED)},
    ("not", BOOL): "NOT({0})",
    **{("not", kind): "(~{0})" for kind in (INT, UNSIGNED)},
    **{("select", kind): f"select_{kind}({{0}}, {{1}}, {{2}})"
       for kind in (FLOAT, INT, UNSIGNED, BOOL)},
    ("negate", FLOAT): "(-{0})",
    ("negate", UNSIGNED): "(-{0})",
    ("negate", INT): "(vi)(-(vu){0})",
    ("abs", FLOAT): "vabs({0})",
    ("abs", INT): "select_int(LT_int({0}, all_int(0)), (vi)(-(vu){0}), {0})",
    ("sign", FLOAT): "sign_of({0})",
    ("sign", INT): "(({0} < 0) - ({0} > 0))",
    **{(name, kind): f"{name}_{kind}({{0}}, {{1}})" for name in ("maximum", "minimum")
       for kind in (FLOAT, INT, UNSIGNED)},
    ("sqrt", FLOAT): "vsqrt({0})",
    ("rsqrt", FLOAT): "(1.0f / vsqrt({0}))",
    **{(name, FLOAT): f"v{word}({{0}})" for name, word in (
        ("exponential", "exp"), ("exponential_minus_one", "expm1"), ("log", "log"),
        ("log_plus_one", "log1p"), ("cosine", "cos"), ("sine", "sin"), ("floor", "floor"),
        ("ceil", "ceil"), ("cbrt", "cbrt"), ("tan", "tan"), ("tanh", "tanh"),
        ("round_nearest_even", "round"),
    )},
    **{(name, FLOAT): f"v{word}({{0}}, {{1}})" for name, word in (
        ("remainder", "fmod"), ("power", "pow"), ("atan2", "atan2"),
    )},
    ("is_finite", FLOAT): "EQ_float({0} - {0}, all(0.0f))",
    ("shift_left", UNSIGNED): "((vu)({1} < 32u) & ({0} << ({1} & 31u)))",
    ("shift_left", INT): "(((vu){1} < 32u) & (vi)((vu){0} << ((vu){1} & 31u)))",
    ("shift_right_logical", UNSIGNED): "((vu)({1} < 32u) & ({0} >> ({1} & 31u)))",
    ("shift_right_logical", INT): "(((vu){1} < 32u) & (vi)((vu){0} >> ((vu){1} & 31u)))",
    ("shift_right_arithmetic", INT): "({0} >> (vi)minimum_unsigned((vu){1}, all_unsigned(31u)))",
    ("float_of_bool", BOOL): "select_float({0}, all(1.0f), all(0.0f))",
    ("float_of_int", INT): "__builtin_convertvector({0}, vf)",
    ("float_of_unsigned", UNSIGNED): "__builtin_convertvector({0}, vf)",
    ("int_of_bool", BOOL): "select_int({0}, all_int(1), all_int(0))",
    ("int_of_float", FLOAT): "int_of({0})",
    ("int_of_unsigned", UNSIGNED): "(vi){0}",
    ("unsigned_of_bool", BOOL): "select_unsigned({0}, all_unsigned(1u), all_unsigned(0u))",
    ("unsigned_of_float", FLOAT): "unsigned_of({0})",
    ("unsigned_of_int", INT): "(vu){0}",
    ("float_of_bits", UNSIGNED): "(vf){0}",
    ("lesser", FLOAT): "lesser({0}, {1})",
    ("greater", FLOAT): "greater({0}, {1})",
    ("sign_bit", FLOAT): "LT_int((vi){0}, all_int(0))",
    ("copysign", FLOAT): "with_sign({0}, {1})",
    ("bits_of_float", FLOAT): "(vu){0}",
    **{(f"read_{kind}", table): f"read_{kind}({{0}}, {{1}})" for kind, table in TABLES.items()},
}  # fmt: skip

ARGUMENTS = {  # of the functions, by the name with which an expression begins
    "input": "const vf *input",
    "state": "const vf *state",
    "tables": "const void *const *tables",
    "work": "memory *work",
    "after": "vf *after",
    "result": "vf *result",
}


class Lanes(Language):
    """C over vectors, of a program that casts its rays itself."""

    name = "C over vectors"
    expressions = EXPRESSIONS
    helpers: Mapping[str, str] = {}
    width = 0  # so that operations stay in the order of the lines

    def __init__(self, inputs: Sequence[Place], states: Sequence[Place]) -> None:
        """Takes inputs and memory in the order in which they will be there."""
        self._numbers = {
            place: number for places in (inputs, states) for number, place in enumerate(places)
        }

    def literal(self, value: Number) -> str:
        if value.dtype.kind == "b":
            return f"all_bool({int(value)})"
        kind = {"f": "all", "i": "all_int", "u": "all_unsigned"}[value.dtype.kind]
        return f"{kind}({literal(value)})"

    def local(self, kind: str, name: str, text: str) -> str:
        return f"const {C_TYPES[kind]} {name} = {text};"

    def work(self, kind: str, place: int) -> str:
        return f"work->{LETTERS[kind]}[{place}]"

    def input(self, place: Place) -> str:
        kind = place.field.kind
        if place.struct == "tables":
            return f"({C_TYPES[kind]})tables[{place.index[0]}]"
        name = "state" if place.struct == "state" else "input"
        text = f"{name}[{self._numbers[place]}]"
        return f"NE_int((vi){text}, all_int(0))" if kind == BOOL else f"({C_TYPES[kind]}){text}"

    def output(self, target: Target, place: Place | None) -> str:
        assert place is not None  # the program casts its rays
        name = "after" if place.struct == "state" else "result"
        kind = "vi" if place.field.kind == BOOL else C_TYPES[place.field.kind]
        return f"*({kind} *)&{name}[{target.number}]"

    def part(self, name: str, lines: Sequence[str]) -> tuple[str, list[str]]:
        body = body_of(lines)
        names = [word for word in ARGUMENTS if re.search(rf"\b{word}(->|\[)", body)]
        heads = ", ".join(ARGUMENTS[word] for word in names) or "void"
        return f"APART void {name}({heads}) {{\n{body}\n}}", names

    def shared(
        self, name: str, kind: str, arguments: Sequence[tuple[str, str]], lines: Sequence[str]
    ) -> str:
        heads = ", ".join(f"{C_TYPES[each]} {letter}" for each, letter in arguments)
        return f"APART {C_TYPES[kind]} {name}({heads}) {{\n{body_of(lines)}\n}}"


def _passed(arguments: Sequence[str]) -> str:
    """What a function gets of a block."""
    of_block = {"work": "&block->work", "tables": "tables"}
    return ", ".join(of_block.get(name, f"block->{name}") for name in arguments)


def source(program: Program, setup: Sequence[Place], moving: Sequence[Place], lanes: int) -> str:
    """The program as a function of characters and all their frames.

    Args:
        program: without rays.
        setup: its inputs that stay.
        moving: those that change from frame to frame.
        lanes: how many characters are computed at once.

    Raises:
        ValueError: an operation on a type for which there is no expression.
    """
    schedule = program.schedule()
    for part in itertools.chain.from_iterable(schedule.phases):
        part.nodes = without_waiting(program.graph, schedule.repeats, part.nodes)
    language = Lanes([*setup, *moving], program.places["state"])
    parts = parts_of(program, schedule, language)
    init, step = (
        "\n".join(f"{indent}{name}({_passed(arguments)});" for name, arguments in calls)
        for indent, calls in zip((" " * 8, " " * 12), parts.calls, strict=True)
    )
    work = [
        f"    {C_TYPES[kind]} {LETTERS[kind]}[{count}];"
        for kind, count in schedule.memory.items()
        if count
    ]
    return fill(
        TEMPLATE.read_text(encoding="utf-8"),
        {
            "@LANES": str(lanes),
            "@VECTORS": VECTORS.read_text(encoding="utf-8"),
            "@WORK": "\n".join(work or ["    int unused;"]),
            "@FUNCTIONS": "\n\n".join(parts.texts),
            "@INPUTS": str(len(setup) + len(moving)),
            "@SETUP": str(len(setup)),
            "@STATES": str(len(program.places["state"])),
            "@RESULTS": str(len(program.places["result"])),
            "@INIT": init,
            "@STEP": step,
            "@": "",
        },
    )


def without_waiting(graph: Graph, repeats: Repeats, nodes: Sequence[Node]) -> list[Node]:
    """The same nodes, each when its operands are there, or as soon as any are."""
    place = {node: number for number, node in enumerate(nodes)}
    users: dict[Node, list[Node]] = {node: [] for node in nodes}
    missing: dict[Node, int] = {}
    for node in nodes:
        operands = {other for other in repeats.operands(graph, node) if other in place}
        missing[node] = len(operands)
        for operand in operands:
            users[operand].append(node)
    ready = dict.fromkeys(nodes, 0.0)  # cycles from the start
    waiting = [place[node] for node in nodes if not missing[node]]  # a heap
    order: list[Node] = []
    done, first, now = set(), 0, 0.0
    while waiting:
        while nodes[first] in done:
            first += 1
        early: list[int] = []
        while waiting and waiting[0] <= first + AHEAD and ready[nodes[waiting[0]]] > now:
            early.append(heapq.heappop(waiting))
        if waiting and waiting[0] <= first + AHEAD:
            number = heapq.heappop(waiting)
        else:
            number = min(early, key=lambda number: ready[nodes[number]])
            early.remove(number)
        for other in early:
            heapq.heappush(waiting, other)
        node = nodes[number]
        done.add(node)
        order.append(node)
        now = max(now, ready[node]) + 1 / A_CYCLE
        for user in users[node]:
            latency = LATENCIES.get(graph.operations[node], USUAL)
            ready[user] = max(ready[user], now + latency)
            missing[user] -= 1
            if not missing[user]:
                heapq.heappush(waiting, place[user])
    return order
