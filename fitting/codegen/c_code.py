"""The functions of a program in C99 that is also C++11."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

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
from .program import Place, Program
from .routines import PLATFORM, Routine
from .schedule import Schedule, Target

C_TYPES = {FLOAT: "float", INT: "int", UNSIGNED: "unsigned", BOOL: "int"}

# By operation and type of the operands: an expression of these, or a call of one of HELPERS.
EXPRESSIONS: dict[tuple[str, str], str] = {
    **{(name, FLOAT): f"({{0}} {sign} {{1}})" for name, sign in (
        ("add", "+"), ("subtract", "-"), ("multiply", "*"), ("divide", "/"),
    )},
    **{(name, kind): f"({{0}} {sign} {{1}})" for name, sign in (
        ("LT", "<"), ("LE", "<="), ("EQ", "=="), ("NE", "!="),
    ) for kind in (FLOAT, INT, UNSIGNED, BOOL)},
    **{(name, kind): f"({{0}} {sign} {{1}})" for name, sign in (
        ("and", "&"), ("or", "|"), ("xor", "^"),
    ) for kind in (INT, UNSIGNED, BOOL)},
    **{(name, UNSIGNED): f"({{0}} {sign} {{1}})" for name, sign in (
        ("add", "+"), ("subtract", "-"), ("multiply", "*"),
    )},
    # In unsigned numbers, since C leaves open what too large signed ones become.
    **{(name, INT): f"(int)((unsigned){{0}} {sign} (unsigned){{1}})" for name, sign in (
        ("add", "+"), ("subtract", "-"), ("multiply", "*"),
    )},
    ("negate", FLOAT): "(-{0})",
    ("negate", UNSIGNED): "(0u - {0})",
    ("negate", INT): "(int)(0u - (unsigned){0})",
    ("abs", FLOAT): "fabsf({0})",
    ("abs", INT): "@abs_int({0})",
    ("sign", FLOAT): "@sign({0})",
    ("sign", INT): "(({0} > 0) - ({0} < 0))",
    ("maximum", FLOAT): "@maximum({0}, {1})",
    ("minimum", FLOAT): "@minimum({0}, {1})",
    **{("maximum", kind): "({0} > {1} ? {0} : {1})" for kind in (INT, UNSIGNED)},
    **{("minimum", kind): "({0} < {1} ? {0} : {1})" for kind in (INT, UNSIGNED)},
    ("maximum", BOOL): "({0} | {1})",
    ("minimum", BOOL): "({0} & {1})",
    ("remainder", FLOAT): "fmodf({0}, {1})",
    ("sqrt", FLOAT): "@root({0})",
    ("rsqrt", FLOAT): "(1.0f / @root({0}))",
    ("cbrt", FLOAT): "cbrtf({0})",
    ("exponential", FLOAT): "expf({0})",
    ("exponential_minus_one", FLOAT): "expm1f({0})",
    ("log", FLOAT): "logf({0})",
    ("log_plus_one", FLOAT): "log1pf({0})",
    ("power", FLOAT): "powf({0}, {1})",
    ("cosine", FLOAT): "cosf({0})",
    ("sine", FLOAT): "sinf({0})",
    ("tan", FLOAT): "tanf({0})",
    ("tanh", FLOAT): "tanhf({0})",
    ("atan2", FLOAT): "atan2f({0}, {1})",
    ("floor", FLOAT): "floorf({0})",
    ("ceil", FLOAT): "ceilf({0})",
    ("round_nearest_even", FLOAT): "@round_even({0})",
    ("is_finite", FLOAT): "(({0} - {0}) == 0.0f)",
    ("not", BOOL): "(!{0})",
    ("not", INT): "(~{0})",
    ("not", UNSIGNED): "(~{0})",
    ("shift_left", UNSIGNED): "({1} < 32u ? {0} << {1} : 0u)",
    ("shift_left", INT): "(int)((unsigned){1} < 32u ? (unsigned){0} << {1} : 0u)",
    ("shift_right_logical", UNSIGNED): "({1} < 32u ? {0} >> {1} : 0u)",
    ("shift_right_logical", INT): "(int)((unsigned){1} < 32u ? (unsigned){0} >> {1} : 0u)",
    ("shift_right_arithmetic", INT): "@shift_signed({0}, {1})",
    **{("select", kind): "({0} ? {1} : {2})" for kind in (FLOAT, INT, UNSIGNED, BOOL)},
    ("float_of_bool", BOOL): "({0} ? 1.0f : 0.0f)",
    ("float_of_int", INT): "(float){0}",
    ("float_of_unsigned", UNSIGNED): "(float){0}",
    ("int_of_bool", BOOL): "{0}",
    ("int_of_float", FLOAT): "@int_of({0})",
    ("int_of_unsigned", UNSIGNED): "(int){0}",
    ("unsigned_of_bool", BOOL): "(unsigned){0}",
    ("unsigned_of_float", FLOAT): "@unsigned_of({0})",
    ("unsigned_of_int", INT): "(unsigned){0}",
    ("float_of_bits", UNSIGNED): "@float_of_bits({0})",
    ("lesser", FLOAT): "@lesser({0}, {1})",
    ("greater", FLOAT): "@greater({0}, {1})",
    ("sign_bit", FLOAT): "(@bits_of_float({0}) >> 31 != 0u)",
    ("copysign", FLOAT): "copysignf({0}, {1})",
    ("bits_of_float", FLOAT): "@bits_of_float({0})",
}  # fmt: skip
"""The @ becomes the prefix of all names."""

HELPERS = {
    "abs_int": "static int @abs_int(int x) { return x < 0 ? (int)(0u - (unsigned)x) : x; }",
    "root": """\
static float @root(float x) {
#ifdef @SSE /* where sqrtf may set errno, which costs a fifth of the code */
    return _mm_cvtss_f32(_mm_sqrt_ss(_mm_set_ss(x)));
#else
    return sqrtf(x);
#endif
}""",
    "sign": "static float @sign(float x) { return x > 0 ? 1.0f : x < 0 ? -1.0f : x; }",
    "lesser": "static float @lesser(float a, float b) { return a < b ? a : b; }",
    "greater": "static float @greater(float a, float b) { return a > b ? a : b; }",
    "maximum": "static float @maximum(float a, float b) { return a > b || a != a ? a : b; }",
    "minimum": "static float @minimum(float a, float b) { return a < b || a != a ? a : b; }",
    "round_even": """\
static float @round_even(float x) {
    const float large = 8388608.0f; /* from here on every number is whole */
    return fabsf(x) < large ? copysignf((fabsf(x) + large) - large, x) : x;
}""",
    "shift_signed": """\
static int @shift_signed(int x, int count) {
    const unsigned places = (unsigned)count < 31u ? (unsigned)count : 31u;
    return x < 0 ? ~(~x >> places) : x >> places;
}""",
    "int_of": """\
static int @int_of(float x) {
    if (x != x) return 0;
    return x >= 2147483648.0f ? 2147483647 : x < -2147483648.0f ? -2147483647 - 1 : (int)x;
}""",
    "unsigned_of": """\
static unsigned @unsigned_of(float x) {
    if (!(x > 0)) return 0;
    return x >= 4294967296.0f ? 4294967295u : (unsigned)x;
}""",
    "float_of_bits": """\
static float @float_of_bits(unsigned bits) {
    float x;
    unsigned char *to = (unsigned char *)&x;
    const unsigned char *from = (const unsigned char *)&bits;
    unsigned i;
    for (i = 0; i < sizeof x; i++) to[i] = from[i];
    return x;
}""",
    "bits_of_float": """\
static unsigned @bits_of_float(float x) {
    unsigned bits;
    unsigned char *to = (unsigned char *)&bits;
    const unsigned char *from = (const unsigned char *)&x;
    unsigned i;
    for (i = 0; i < sizeof x; i++) to[i] = from[i];
    return bits;
}""",
}
PRELUDE = """\
#include <math.h>

#include "@file.h"

#ifdef __FAST_MATH__
#error "compile without -ffast-math: numbers may be infinite"
#endif
#if defined(__GNUC__) && defined(__SSE__)
#include <xmmintrin.h>
#define @SSE
#endif
#ifdef __GNUC__
#define @APART __attribute__((noinline))
#else
#define @APART
#endif
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-thread-jumps") /* or minima and maxima become branches */
#endif

"""
ARGUMENTS = {  # of the functions, by the name with which an expression begins
    "parameters": "const @parameters *parameters",
    "rig": "const @rig *rig",
    "state": "const @state *state",
    "frame": "const @frame *frame",
    "hits": "const @hit *hits",
    "work": "@work *work",
    "rays": "@ray *rays",
    "after": "@state *after",
    "result": "@result *result",
}


def literal(value: Number) -> str:
    """A number in C."""
    kind = value.dtype.kind
    if kind == "f":
        if np.isnan(value):
            return "NAN"
        if np.isinf(value):
            return "INFINITY" if value > 0 else "(-INFINITY)"
        text = str(value)
        text = f"{text}f" if "." in text or "e" in text else f"{text}.0f"
    elif kind == "u":
        text = f"{value}u"
    elif value == np.iinfo(np.int32).min:
        text = "-2147483647 - 1"
    else:
        text = str(int(value))
    return f"({text})" if text.startswith("-") else text


class C(Language):
    """C99 that is also C++11."""

    name = "C"
    expressions = EXPRESSIONS
    helpers = HELPERS

    def literal(self, value: Number) -> str:
        return literal(value)

    def local(self, kind: str, name: str, text: str) -> str:
        return f"const {C_TYPES[kind]} {name} = {text};"

    def work(self, kind: str, place: int) -> str:
        return f"work->{LETTERS[kind]}[{place}]"

    def input(self, place: Place) -> str:
        if place.struct == PLATFORM:
            return PLATFORM
        if place.struct == "hits":
            ray, *axis = place.index
            text = f"hits[{ray}].{place.field.path[0]}" + "".join(f"[{i}]" for i in axis)
        else:
            text = _member(place.struct, place)
        return f"({text} != 0)" if place.field.kind == BOOL else text

    def output(self, target: Target, place: Place | None) -> str:
        if place is None:
            axis = f"[{target.axis}]" if target.name in ("origin", "direction") else ""
            return f"rays[{target.number}].{target.name}{axis}"
        return _member("after" if place.struct == "state" else place.struct, place)

    def part(self, name: str, lines: Sequence[str]) -> tuple[str, list[str]]:
        body = body_of(lines)
        names = [word for word in ARGUMENTS if re.search(rf"\b{word}(->|\[)", body)]
        heads = ", ".join(ARGUMENTS[word] for word in names) or "void"
        return f"@APART static void {name}({heads}) {{\n{body}\n}}", names

    def shared(
        self, name: str, kind: str, arguments: Sequence[tuple[str, str]], lines: Sequence[str]
    ) -> str:
        heads = ", ".join(f"{C_TYPES[each]} {letter}" for each, letter in arguments)
        return f"@APART static {C_TYPES[kind]} {name}({heads}) {{\n{body_of(lines)}\n}}"


def functions(program: Program, schedule: Schedule, routines: Sequence[Routine]) -> list[str]:
    """The helpers, the parts of all phases, and the functions that others call.

    Raises:
        ValueError: an operation on a type for which there is no expression.
    """
    parts = parts_of(program, schedule, C())
    around = [
        f"{routine_head(routine)} {{\n{body_of(routine_lines(routine, C()))}\n}}"
        for routine in routines
    ]
    bodies = "".join([*parts.texts, *around])
    return [*helpers_in(C(), bodies), *parts.texts, *_entries(parts.calls), *around]


def signature(phase: int, rounds: int) -> str:
    """The head of the function of a phase."""
    heads = {name: ARGUMENTS[name] for name in inputs_of(phase, rounds)}
    if phase in (0, rounds + 1):
        heads["state"] = "@state *state"
    return f"void @{phase_name(phase, rounds)}({', '.join(heads.values())})"


def routine_head(routine: Routine) -> str:
    """The head of a routine."""
    inputs = [
        "int platform" if name == PLATFORM else f"const @{struct} *{name}"
        for name, struct in routine.reads
        if name != routine.writes.name
    ]
    written = f"@{routine.writes.struct} *{routine.writes.name}"
    return f"void @{routine.name}({', '.join([*inputs, written])})"


def _entries(calls: Sequence[Sequence[tuple[str, list[str]]]]) -> Iterator[str]:
    """The functions that others call."""
    rounds = len(calls) - 2
    for phase, parts in enumerate(calls):
        head, changes_state = signature(phase, rounds), phase in (0, rounds + 1)
        used = {argument for _, arguments in parts for argument in arguments}
        used |= {"state"} if changes_state else set()
        lines = ["    @state after;"] if changes_state else []
        names = re.findall(r"\*(\w+)[,)]", head)
        lines += [f"    (void){name};" for name in names if name not in used]
        for part, arguments in parts:
            passed = ("&after" if argument == "after" else argument for argument in arguments)
            lines.append(f"    {part}({', '.join(passed)});")
        lines += ["    *state = after;"] if changes_state else []
        yield "\n".join([f"{head} {{", *lines, "}"])


def _member(struct: str, place: Place) -> str:
    return f"{struct}->{'.'.join(place.field.path)}" + "".join(f"[{i}]" for i in place.index)
