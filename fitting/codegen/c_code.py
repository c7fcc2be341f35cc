"""A program in C99 that is also C++11: its functions, its files, and their header."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from .axes import conversions
from .functions import (
    LETTERS,
    Language,
    body_of,
    calls_of,
    fill,
    helpers_in,
    inputs_of,
    parts_of,
    phase_name,
    routine_lines,
)
from .graph import BOOL, FLOAT, INT, UNSIGNED, Number
from .meanings import (
    AXES,
    BLANK_FRAME,
    RAYS,
    STRUCTS,
    comment,
    engine_axes,
    meanings,
    origin,
    ray_fields,
    table,
    use,
)
from .program import Field, Members, Place, Program, constants_of, members_of
from .routines import PLATFORM, Routine, routines
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


# Files, and the header: structs with units and meanings, and values.

FOLDER = Path(__file__).parent
CHECK, WALK = "check.c", "walk.c"
NODES = {"unreal": ("unreal.h", "AnimNode_@Name.h"), "godot": ("godot.cpp", "@file_modifier.cpp")}
"""For an engine: what calls the code there, and the name of its file."""


def sources(program: Program, name: str, engine: str | None = None) -> dict[str, str]:
    """The header, the functions and the node of an engine; see `export.Language`."""
    schedule, around = program.schedule(), routines(program)
    values = "\n\n".join(constants(program))
    parts = [PRELUDE + values, *functions(program, schedule, around)]
    contents = {
        "@file.h": header(program, schedule, around, engine),
        "@file.c": "\n\n".join(parts) + "\n",
    }
    if engine in NODES:
        template, file = NODES[engine]
        contents[file] = (FOLDER / "engines" / template).read_text(encoding="utf-8")
    return {
        filled(file, program, name): filled(text, program, name) for file, text in contents.items()
    }


def check(program: Program, name: str) -> dict[str, str]:
    """What replays a trace of this program, and what walks its animation over another ground."""
    paths = FOLDER / CHECK, FOLDER / "engines" / WALK
    return {path.name: filled(path.read_text(encoding="utf-8"), program, name) for path in paths}


def filled(template: str, program: Program, name: str) -> str:
    """A text in C with the names of a program, and the calls of a frame, in it."""
    of_frame = {
        "@CALLS": "\n".join(calls(program, "        ")),
        "@CASTING": "\n".join(calls(program, "        ", casts=True)),
        "@POINTED": "\n".join(calls(program, "        ", "")),
        "@STILL": " hits[i].platform = -1;" if program.platforms else "",
    }
    names = {"@NAME": name.upper(), "@Name": name.title().replace("_", ""), "@file": name}
    return fill(template, of_frame | names | {"@": f"{name}_"})


FAST_MATH = " Do not compile with -ffast-math."


def header(
    program: Program, schedule: Schedule, routines: Sequence[Routine], engine: str | None
) -> str:
    """The header; each @ stands for the prefix of all names, and @NAME for it in capitals."""
    guard, rounds = "@NAME_H", len(program.rounds)
    counts = {"LEGS": program.legs, "RAYS": program.ray_count, "ROUNDS": rounds}
    counts["SLIDERS"] = len(table(program))
    counts |= {f"RAYS_{i}": len(rays) for i, rays in enumerate(program.rounds, 1)}
    functions = [f"{signature(phase, rounds)};" for phase in range(rounds + 2)]
    lines = [
        *comment(_head(program)),
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        *(f"#define @NAME_{key} {count}" for key, count in counts.items()),
        "",
        '#ifdef __cplusplus\nextern "C" {\n#endif',
        "",
        *(line for struct in RAYS for line in _ray(program, struct)),
        *(line for struct in STRUCTS for line in _struct(program, struct)),
        *comment(["What a frame keeps between its functions."]),
        *_work(schedule),
        "extern const @parameters @defaults;",
        "",
        *comment(["A parameter, for a panel of sliders: the number of those in @parameters."]),
        "typedef struct @slider {",
        "    int number; /* each takes four bytes */",
        "    const char *name, *unit, *meaning;",
        "    float value, low, high; /* the default and the range; a switch has 0 to 1 */",
        "} @slider;",
        "extern const @slider @sliders[@NAME_SLIDERS];",
        "",
        *comment([BLANK_FRAME]),
        "extern const @frame @blank_frame;",
        "",
        *functions,
        "",
        *(
            line
            for routine in routines
            for line in (*comment([routine.meaning]), f"{routine_head(routine)};", "")
        ),
        *(_axes(engine) if engine else ()),
        "#ifdef __cplusplus\n}\n#endif",
        "",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def constants(program: Program) -> Iterator[str]:
    """The parameters that the program was made from, a frame to begin with, and sliders."""
    for name, (struct, values) in constants_of(program).items():
        body = _initialiser(members_of(list(values)), values, 0)
        yield f"const @{struct} @{name} = {body};"
    yield _sliders(program)


def _sliders(program: Program) -> str:
    rows = []
    for number, name, unit, meaning, *numbers in table(program):
        words = ", ".join(json.dumps(word, ensure_ascii=False) for word in (name, unit, meaning))
        rows.append(
            f"    {{{number}, {words}, {', '.join(literal(np.float32(x)) for x in numbers)}}}"
        )
    listed = ",\n".join(rows)
    return f"const @slider @sliders[@NAME_SLIDERS] = {{\n{listed}\n}};"


def _head(program: Program) -> list[str]:
    *paragraphs, last = use(program, calls(program, "    "))
    return [*origin(program), *paragraphs, last + FAST_MATH, AXES]


def _axes(engine: str) -> Iterator[str]:
    """Conversions from the axes of an engine and back, as functions of a header."""
    yield from comment([engine_axes(engine, "; quaternions are x y z w")])
    for name, source, parts in conversions(engine):
        arguments = f"const float {source}[{len(parts)}], float to[{len(parts)}]"
        yield f"static inline void @{name}({arguments}) {{"
        for number, (index, factor) in enumerate(parts):
            sign, size = "-" if factor < 0 else "", literal(np.float32(abs(factor)))
            by = "" if abs(factor) == 1.0 else f" * {size}"
            yield f"    to[{number}] = {sign}{source}[{index}]{by};"
        yield "}"
    yield ""


def calls(program: Program, indent: str, prefix: str = "&", *, casts: bool = False) -> list[str]:
    """The calls of a frame, of variables or, without the prefix, of pointers.

    Where it `casts`, a call `cast(first, end)` follows the rays of each round.
    """

    def call(phase: int, rounds: int) -> str:
        names = inputs_of(phase, rounds)
        passed = (name if name in ("hits", "rays") else prefix + name for name in names)
        return f"@{phase_name(phase, rounds)}({', '.join(passed)});"

    return [indent + line for line in calls_of(program, call, casts=casts)]


def _ray(program: Program, struct: str) -> Iterator[str]:
    yield from comment([RAYS[struct]])
    yield f"typedef struct @{struct} {{"
    for field, text in ray_fields(program, struct).items():
        yield f"    {_declared(field)} /* {text} */"
    yield f"}} @{struct};"
    yield ""


def _struct(program: Program, struct: str) -> Iterator[str]:
    yield from comment([STRUCTS[struct]])
    yield f"typedef struct @{struct} {{"
    yield from _members(members_of(program.fields(struct)), meanings(program.trees[struct]), ())
    yield f"}} @{struct};"
    yield ""


def _members(
    members: Members, texts: Mapping[tuple[str, ...], str], path: tuple[str, ...]
) -> Iterator[str]:
    indent = "    " * (len(path) + 1)
    for name, member in members.items():
        within = (*path, name)
        if text := texts.get(within):
            yield from comment([text], indent)
        if isinstance(member, Field):
            yield indent + _declared(member)
        else:
            yield f"{indent}struct {{"
            yield from _members(member, texts, within)
            yield f"{indent}}} {name};"


def _declared(field: Field) -> str:
    sizes = "".join(f"[{size}]" for size in field.shape)
    return f"{C_TYPES[field.kind]} {field.path[-1]}{sizes};"


def _work(schedule: Schedule) -> list[str]:
    arrays = [
        f"    {C_TYPES[kind]} {LETTERS[kind]}[{count}];"
        for kind, count in schedule.memory.items()
        if count
    ]
    return ["typedef struct @work {", *(arrays or ["    int unused;"]), "} @work;", ""]


def _initialiser(members: Members, values: Mapping[Field, np.ndarray], depth: int) -> str:
    indent = "    " * (depth + 1)
    parts = (
        f"{_braced(values[member])} /* {name} */"
        if isinstance(member, Field)
        else _initialiser(member, values, depth + 1)
        for name, member in members.items()
    )
    listed = ",\n".join(f"{indent}{part}" for part in parts)
    return f"{{\n{listed}\n{indent[4:]}}}"


def _braced(values: np.ndarray | Number) -> str:
    if values.ndim:
        return "{" + ", ".join(map(_braced, values)) + "}"
    value = values[()]
    return literal(np.int32(value) if isinstance(value, np.bool_) else value)
