"""The functions of a program in C# 7.2, which Unity, Burst and Mono compile."""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from . import c_code
from .functions import (
    LETTERS,
    Language,
    body_of,
    helpers_in,
    inputs_of,
    parts_of,
    phase_name,
    routine_lines,
)
from .graph import BOOL, FLOAT, INT, UNSIGNED, Number
from .program import Field, Place, Program
from .routines import PLATFORM, Routine, routines
from .schedule import Schedule, Target

CS_TYPES = {FLOAT: "float", INT: "int", UNSIGNED: "uint", BOOL: "bool"}
FIELD_TYPES = CS_TYPES | {BOOL: "Flag"}
MATHS = "exp log pow cos sin tan tanh atan2 floor ceil".split()

# Those of C, or an expression of C#, or a call of `math` or of one of HELPERS.
EXPRESSIONS: dict[tuple[str, str], str] = {
    **{
        key: re.sub(rf"\b({'|'.join(MATHS)})f\(", r"math.\1(", text).replace("(unsigned)", "(uint)")
        for key, text in c_code.EXPRESSIONS.items()
    },
    **{(name, INT): f"({{0}} {sign} {{1}})" for name, sign in (
        ("add", "+"), ("subtract", "-"), ("multiply", "*"),
    )},
    ("LT", BOOL): "(!{0} & {1})",
    ("LE", BOOL): "(!{0} | {1})",
    ("negate", INT): "(-{0})",
    ("abs", FLOAT): "math.abs({0})",
    ("abs", INT): "({0} < 0 ? -{0} : {0})",
    ("sign", INT): "({0} > 0 ? 1 : {0} < 0 ? -1 : 0)",
    ("remainder", FLOAT): "({0} % {1})",
    ("sqrt", FLOAT): "math.sqrt({0})",
    ("rsqrt", FLOAT): "(1f / math.sqrt({0}))",
    ("cbrt", FLOAT): "@cbrt({0})",
    ("exponential_minus_one", FLOAT): "@expm1({0})",
    ("log_plus_one", FLOAT): "@log1p({0})",
    ("round_nearest_even", FLOAT): "math.round({0})",
    ("shift_left", UNSIGNED): "({1} < 32u ? {0} << (int){1} : 0u)",
    ("shift_left", INT): "((uint){1} < 32u ? {0} << {1} : 0)",
    ("shift_right_logical", UNSIGNED): "({1} < 32u ? {0} >> (int){1} : 0u)",
    ("shift_right_logical", INT): "((uint){1} < 32u ? (int)((uint){0} >> {1}) : 0)",
    ("shift_right_arithmetic", INT): "({0} >> ((uint){1} < 31u ? {1} : 31))",
    ("select", BOOL): "({0} ? (bool){1} : (bool){2})",  # of which one may be a Flag
    ("int_of_bool", BOOL): "({0} ? 1 : 0)",
    ("unsigned_of_bool", BOOL): "({0} ? 1u : 0u)",
    ("float_of_bits", UNSIGNED): "math.asfloat({0})",
    ("bits_of_float", FLOAT): "math.asuint({0})",
    ("sign_bit", FLOAT): "(math.asuint({0}) >> 31 != 0u)",
    ("copysign", FLOAT): "@copysign({0}, {1})",
}  # fmt: skip

HELPERS = {
    "sign": "static float @sign(float x) { return x > 0f ? 1f : x < 0f ? -1f : x; }",
    "lesser": "static float @lesser(float a, float b) { return a < b ? a : b; }",
    "greater": "static float @greater(float a, float b) { return a > b ? a : b; }",
    "maximum": """\
static float @maximum(float a, float b) { return a > b || float.IsNaN(a) ? a : b; }""",
    "minimum": """\
static float @minimum(float a, float b) { return a < b || float.IsNaN(a) ? a : b; }""",
    "copysign": """\
static float @copysign(float x, float y) {
    return math.asfloat((math.asuint(x) & 0x7fffffffu) | (math.asuint(y) & 0x80000000u));
}""",
    "cbrt": """\
static float @cbrt(float x) {
    float root = (float)Math.Pow(Math.Abs((double)x), 1.0 / 3.0);
    return x < 0f ? -root : root;
}""",
    "expm1": """\
static float @expm1(float x) {
    double wide = x; /* of a small number, two terms of the series are exact enough */
    return (float)(Math.Abs(wide) < 1e-4 ? wide * (1.0 + 0.5 * wide) : Math.Exp(wide) - 1.0);
}""",
    "log1p": """\
static float @log1p(float x) {
    double wide = x; /* likewise */
    return (float)(Math.Abs(wide) < 1e-4 ? wide * (1.0 - 0.5 * wide) : Math.Log(1.0 + wide));
}""",
    "int_of": """\
static int @int_of(float x) {
    if (float.IsNaN(x)) return 0;
    return x >= 2147483648f ? int.MaxValue : x < -2147483648f ? int.MinValue : (int)x;
}""",
    "unsigned_of": """\
static uint @unsigned_of(float x) {
    if (!(x > 0f)) return 0u;
    return x >= 4294967296f ? uint.MaxValue : (uint)x;
}""",
}
ARGUMENTS = {  # of the functions, by the name with which an expression begins: how they are passed
    "parameters": ("in", "Parameters"),
    "rig": ("in", "Rig"),
    "state": ("in", "State"),
    "frame": ("in", "Frame"),
    "hits": ("", "ReadOnlySpan<Hit>"),
    "work": ("ref", "Work"),
    "rays": ("", "Span<Ray>"),
    "after": ("ref", "State"),
    "result": ("ref", "Result"),
}
APART = "[MethodImpl(MethodImplOptions.NoInlining)]"


def literal(value: Number) -> str:
    """A number in C#."""
    if isinstance(value, np.bool_):
        return "true" if value else "false"
    if value.dtype.kind == "f":
        if not np.isfinite(value):
            infinity = "float.PositiveInfinity" if value > 0 else "float.NegativeInfinity"
            return "float.NaN" if np.isnan(value) else infinity
        text = str(value).removesuffix(".0") + "f"
    else:
        text = f"{value}u" if value.dtype.kind == "u" else f"{value}"
    return f"({text})" if text.startswith("-") else text


def pascal(name: str) -> str:
    """A name as C# writes it: `AnkleHeight`."""
    return "".join(word[:1].upper() + word[1:] for word in name.split("_"))


class CSharp(Language):
    """C# 7.2."""

    name = "C#"
    expressions = EXPRESSIONS
    helpers = HELPERS

    def literal(self, value: Number) -> str:
        return literal(value)

    def local(self, kind: str, name: str, text: str) -> str:
        return f"{CS_TYPES[kind]} {name} = {text};"

    def work(self, kind: str, place: int) -> str:
        return f"work.{LETTERS[kind]}{place}"

    def input(self, place: Place) -> str:
        if place.struct == PLATFORM:
            return PLATFORM
        if place.struct == "hits":
            ray, *index = place.index
            return f"hits[{ray}].{member_of(place.field, index)}"
        return f"{place.struct}.{member_of(place.field, place.index)}"

    def output(self, target: Target, place: Place | None) -> str:
        if place is None:
            axis = f".{'xyz'[target.axis]}" if target.name in ("origin", "direction") else ""
            return f"rays[{target.number}].{pascal(target.name)}{axis}"
        struct = "after" if place.struct == "state" else place.struct
        return f"{struct}.{member_of(place.field, place.index)}"

    def part(self, name: str, lines: Sequence[str]) -> tuple[str, list[str]]:
        body = body_of(lines)
        names = [word for word in ARGUMENTS if re.search(rf"\b{word}[.\[]", body)]
        heads = ", ".join(map(_declared, names))
        return f"{APART}\nstatic void {name}({heads}) {{\n{body}\n}}", names

    def routine(self, routine: Routine, lines: Sequence[str]) -> str:
        """A function that others call."""
        name, kind = routine.writes.name, pascal(routine.writes.struct)
        is_read = routine.writes in routine.reads
        heads = [
            "int platform" if argument == PLATFORM else f"in {pascal(struct)} {argument}"
            for argument, struct in routine.reads
            if argument != name
        ]
        heads.append(f"{'ref' if is_read else 'out'} {kind} {name}")
        first = [] if is_read else [f"{name} = default({kind});"]
        return (
            f"public static void @{routine.name}({', '.join(heads)}) {{\n"
            f"{body_of([*first, *lines])}\n}}"
        )

    def shared(
        self, name: str, kind: str, arguments: Sequence[tuple[str, str]], lines: Sequence[str]
    ) -> str:
        heads = ", ".join(f"{CS_TYPES[each]} {letter}" for each, letter in arguments)
        return f"{APART}\nstatic {CS_TYPES[kind]} {name}({heads}) {{\n{body_of(lines)}\n}}"


class Code(NamedTuple):
    """The functions of a program."""

    entries: list[str]
    """Those that others call."""
    routines: list[tuple[Routine, str]]
    parts: list[str]
    """Those that these call."""


def functions(program: Program, schedule: Schedule) -> Code:
    """All functions.

    Raises:
        ValueError: an operation on a type for which there is no expression.
    """
    language = CSharp()
    parts = parts_of(program, schedule, language)
    around = [
        (routine, language.routine(routine, routine_lines(routine, language)))
        for routine in routines(program)
    ]
    bodies = "".join([*parts.texts, *(text for _, text in around)])
    helpers = helpers_in(language, bodies)
    return Code(list(_entries(parts.calls)), around, [*parts.texts, *helpers])


def call(phase: int, rounds: int) -> str:
    """The call of the function of a phase, of variables."""
    modifiers = {name: _modifier(name, phase, rounds) for name in inputs_of(phase, rounds)}
    passed = (f"{modifier} {name}".strip() for name, modifier in modifiers.items())
    return f"@{phase_name(phase, rounds)}({', '.join(passed)});"


def type_of(field: Field) -> str:
    """The type of an array in a struct."""
    kind, sizes = FIELD_TYPES[field.kind], field.shape
    if field.is_vector:
        *sizes, axes = sizes
        kind = "float3" if axes == 3 else "quaternion"
    for size in reversed(sizes):
        kind = f"Array{size}<{kind}>"
    return kind


def _modifier(name: str, phase: int, rounds: int) -> str:
    """How a function that others call takes an argument."""
    if name == "result" or (name == "state" and phase == 0):
        return "out"
    return "ref" if name == "state" and phase > rounds else ARGUMENTS[name][0]


def _declared(name: str, modifier: str | None = None) -> str:
    usual, kind = ARGUMENTS[name]
    return f"{usual if modifier is None else modifier} {kind} {name}".strip()


def _entries(calls: Sequence[Sequence[tuple[str, list[str]]]]) -> Iterator[str]:
    rounds = len(calls) - 2
    for phase, parts in enumerate(calls):
        names = inputs_of(phase, rounds)
        heads = ", ".join(_declared(name, _modifier(name, phase, rounds)) for name in names)
        changes_state = phase in (0, rounds + 1)
        lines = ["State after = default(State);"] if changes_state else []
        lines += ["result = default(Result);"] if "result" in names else []
        for part, arguments in parts:
            passed = (f"{ARGUMENTS[name][0]} {name}".strip() for name in arguments)
            lines.append(f"{part}({', '.join(passed)});")
        lines += ["state = after;"] if changes_state else []
        yield f"public static void @{phase_name(phase, rounds)}({heads}) {{\n{body_of(lines)}\n}}"


def member_of(field: Field, index: Sequence[int]) -> str:
    """A number of an array, in the struct in which that lies."""
    names, axis = list(map(pascal, field.path)), ""
    if field.is_vector:
        *index, place = index
        axis = f".{'xyz'[place]}" if field.shape[-1] == 3 else f".value.{'wxyz'[place]}"
    return ".".join(names) + "".join(f".e{place}" for place in index) + axis
