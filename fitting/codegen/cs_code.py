"""A program in C# 7.2, which Unity, Burst and Mono compile: its functions, and its files."""

import html
import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from . import c_code
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
    COLUMNS,
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


# Files.

FOLDER = Path(__file__).parent
CODE, CHECK = "code.cs", "Check.cs"
NODES = {"unity": ("unity.cs", "@TITLEBehaviour.cs")}
"""For an engine: what calls the code there, and the name of its file."""
NEEDS = """\
Needs C# 7.2 and Span, as Unity has from 2021.2 on, where it takes vectors from Unity.Mathematics.
Rays and hits are arrays, or native arrays as spans. All structs are blittable, and Burst compiles
what is called within a job."""
SLIDER = """\
/// <summary>A parameter, for a panel of sliders.</summary>
public struct Slider {
    public string Name, Unit, Meaning;
    public float Value, Low, High;
    public Slider(string name, string unit, string meaning, float value, float low, float high) {
        Name = name; Unit = unit; Meaning = meaning; Value = value; Low = low; High = high;
    }
}"""
SUMMARY = ("/// <summary>", "/// ", "</summary>")
Names: TypeAlias = tuple[str, ...]


def sources(program: Program, name: str, engine: str | None = None) -> dict[str, str]:
    """The code and the component of an engine; see `export.Language`.

    Raises:
        ValueError: something in the code has this name.
    """
    schedule, title = program.schedule(), pascal(name)
    code = functions(program, schedule)
    structs = [
        *(_ray(program, struct) for struct in RAYS),
        *(_struct(program, struct) for struct in STRUCTS),
        _work(schedule),
    ]
    arrays = sorted({int(size) for size in re.findall(r"\bArray(\d+)<", str(structs))})
    members = [
        _counts(program),
        *structs,
        *map(_array, arrays),
        *_constants(program),
        *_sliders(program),
        *code.entries,
        *(_documented(routine.meaning, text) for routine, text in code.routines),
        *(_conversions(engine) if engine else ()),
        *code.parts,
    ]
    content = textwrap.indent("\n\n".join(members), "    ")
    if re.search(rf"^    public [^=({{;]*\b{title}\b", content, re.MULTILINE):
        raise ValueError(f"name is {name!r}; wanted another one: code in C# has a {title} within")
    parts = {"@HEAD": _head(program), "@MEMBERS": content}
    contents = {"@TITLE.cs": fill(_template(FOLDER / CODE), parts)}
    if engine in NODES:
        template, file = NODES[engine]
        contents[file] = _template(FOLDER / "engines" / template)
    return {
        filled(file, program, name): filled(text, program, name) for file, text in contents.items()
    }


def check(program: Program, name: str) -> dict[str, str]:
    """What replays a trace of this program."""
    return {CHECK: filled(_template(FOLDER / CHECK), program, name)}


def filled(template: str, program: Program, name: str) -> str:
    """A text in C# with the names of a program, and the calls of a frame, in it."""
    calls = {
        word: "\n".join(f"        {line}" for line in _calls(program, casts=casts))
        for word, casts in (("@CALLS", False), ("@CASTING", True))
    }
    still = {"@STILL": " hits[i].Platform = -1;" if program.platforms else ""}
    text = fill(template, calls | still | {"@TITLE": pascal(name)})
    return re.sub(r"@(\w+)", lambda name: pascal(name[1]), text)


def _calls(program: Program, *, casts: bool = False) -> list[str]:
    lines = calls_of(program, lambda *phase: f"@TITLE.{call(*phase)}", casts=casts)
    return [line.replace("cast(", "Cast(") for line in lines]


def _template(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _head(program: Program) -> str:
    axes = fill(AXES, {
        "quaternions are w x y z": "quaternions are those of Unity.Mathematics",
        " Flags are 1 or 0.": "",
    })  # fmt: skip
    calls = [f"    {line}" for line in _calls(program)]
    return "\n".join(comment([*origin(program), NEEDS, *use(program, calls), _named(axes)]))


def _named(text: str) -> str:
    """A text in which the names of arrays are those of C#."""
    return re.sub(r"\b_?[a-z]+(_[a-z]+)+\b|\b_[a-z]+\b", lambda name: pascal(name[0]), text)


def _summary(text: str, indent: str = "") -> list[str]:
    """A comment that editors show."""
    text = _named(text.replace(", wxyz", ""))
    return comment([html.escape(text, quote=False)], indent, SUMMARY)


def _documented(text: str, declaration: str) -> str:
    return "\n".join([*_summary(text), declaration])


def _counts(program: Program) -> str:
    counts = {"LegCount": program.legs, "RayCount": program.ray_count}
    counts["SliderCount"] = len(table(program))
    counts |= {f"RayCount{i}": len(rays) for i, rays in enumerate(program.rounds, 1)}
    listed = ", ".join(f"{name} = {count}" for name, count in counts.items())
    return f"public const int {listed};"


def _ray(program: Program, struct: str) -> str:
    texts = {field.path: text for field, text in ray_fields(program, struct).items()}
    return _struct_of(struct, RAYS[struct], members_of(list(ray_fields(program, struct))), texts)


def _struct(program: Program, struct: str) -> str:
    fields, texts = program.fields(struct), meanings(program.trees[struct])
    attributes = _for_inspectors(program, texts) if struct == "parameters" else {}
    return _struct_of(struct, STRUCTS[struct], members_of(fields), texts, attributes)


def _for_inspectors(program: Program, texts: Mapping[Names, str]) -> dict[Names, str]:
    """What Unity's inspector shows of parameters."""
    ranges, shown = {entry.name: (entry.low, entry.high) for entry in table(program)}, {}
    for field in program.fields("parameters"):
        words = [f"Tooltip({json.dumps(_named(texts[field.path]), ensure_ascii=False)})"]
        if field.kind == FLOAT and (ends := ranges.get(".".join(field.path))):
            words.append(f"Range({', '.join(literal(np.float32(end)) for end in ends)})")
        shown[field.path] = f"[{', '.join(words)}]"
    return shown


def _struct_of(
    struct: str,
    text: str,
    members: Members,
    texts: Mapping[Names, str],
    attributes: Mapping[Names, str] | None = None,
) -> str:
    body = _members(members, texts, attributes or {}, ())
    return "\n".join([*_summary(text), *_block(pascal(struct), body)])


def _members(
    members: Members, texts: Mapping[Names, str], attributes: Mapping[Names, str], path: Names
) -> Iterator[str]:
    for name, member in members.items():
        within = (*path, name)
        yield from _summary(texts[within]) if within in texts else ()
        yield from [attributes[within]] if within in attributes else ()
        if isinstance(member, Field):
            yield f"public {type_of(member)} {pascal(name)};"
        else:
            yield f"public {pascal(name)}Data {pascal(name)};"
            yield from _block(f"{pascal(name)}Data", _members(member, texts, attributes, within))


def _block(name: str, lines: Iterable[str]) -> Iterator[str]:
    yield "[Serializable]"
    yield f"public struct {name} {{"
    yield from (f"    {line}" for line in lines)
    yield "}"


def _work(schedule: Schedule) -> str:
    lines = [*_summary("What a frame keeps between its functions.")]
    names = {
        kind: ", ".join(f"{LETTERS[kind]}{place}" for place in range(count))
        for kind, count in schedule.memory.items()
    }
    fields = [f"internal {FIELD_TYPES[kind]} {listed};" for kind, listed in names.items() if listed]
    wrapped = [line for field in fields for line in textwrap.wrap(field, COLUMNS)]
    return "\n".join([*lines, *_block("Work", wrapped)])


def _array(size: int) -> str:
    """Values one after another, in a struct that can lie in others."""
    names = [f"e{place}" for place in range(size)]
    body = [
        f"public T {', '.join(names)};",
        "public T this[int index] {",
        *_switch("    get", (f"return {name};" for name in names)),
        *_switch("    set", (f"{name} = value; break;" for name in names)),
        "}",
    ]
    text = _summary(f"{size} values, with indices from 0.")
    return "\n".join([*text, *_block(f"Array{size}<T> where T : struct", body)])


def _switch(head: str, cases: Iterable[str]) -> Iterator[str]:
    """A function that does something else for each index."""
    indent = " " * (len(head) - len(head.lstrip()))
    yield f"{head} {{"
    yield f"{indent}    switch (index) {{"
    yield from (f"{indent}        case {index}: {case}" for index, case in enumerate(cases))
    yield f"{indent}        default: throw new IndexOutOfRangeException();"
    yield f"{indent}    }}"
    yield f"{indent}}}"


def _sliders(program: Program) -> Iterator[str]:
    """Parameters by their numbers, for a panel in a game."""
    getters, setters, places = [], [], program.places["parameters"]
    for entry in table(program):
        place = places[entry.number]
        name = f"parameters.{member_of(place.field, place.index)}"
        words = name.removeprefix("parameters."), entry.unit, _named(entry.meaning)
        parts = [json.dumps(word, ensure_ascii=False) for word in words]
        is_switch = place.field.kind == BOOL
        parts.append(f"{name} ? 1f : 0f" if is_switch else name)
        parts += (literal(np.float32(end)) for end in (entry.low, entry.high))
        getters.append(f"return new Slider({', '.join(parts)});")
        setters.append(f"{name} = {'value >= 0.5f' if is_switch else 'value'}; break;")
    yield SLIDER
    yield _documented(
        "A parameter as it is, with its range; a switch has 0 to 1.",
        "\n".join(
            _switch("public static Slider GetSlider(in Parameters parameters, int index)", getters)
        ),
    )
    head = "public static void SetSlider(ref Parameters parameters, int index, float value)"
    yield _documented("Changes a parameter.", "\n".join(_switch(head, setters)))


def _constants(program: Program) -> Iterator[str]:
    for name, (struct, values) in constants_of(program).items():
        value = _initialiser(members_of(list(values)), values, (pascal(struct),))
        text = BLANK_FRAME if struct == "frame" else "The parameters that this was made from."
        yield _documented(text, f"public static {pascal(struct)} {pascal(name)} => {value};")


def _initialiser(members: Members, values: Mapping[Field, np.ndarray], types: Names) -> str:
    indent = "    " * len(types)
    parts = (
        f"{pascal(name)} = {_value(member, values[member])}"
        if isinstance(member, Field)
        else f"{pascal(name)} = {_initialiser(member, values, (*types, f'{pascal(name)}Data'))}"
        for name, member in members.items()
    )
    listed = ",\n".join(indent + part for part in parts)
    return f"new {'.'.join(types)} {{\n{listed}\n{indent[4:]}}}"


def _value(field: Field, values: np.ndarray) -> str:
    if values.ndim > field.is_vector:
        parts = ", ".join(f"e{place} = {_value(field, part)}" for place, part in enumerate(values))
        return f"new {type_of(field._replace(shape=values.shape))} {{ {parts} }}"
    if field.is_vector:
        numbers = map(literal, np.roll(values, -1) if len(values) == 4 else values)
        return f"new {type_of(field._replace(shape=values.shape))}({', '.join(numbers)})"
    return literal(values[()] if field.kind != BOOL else np.bool_(values))


def _conversions(engine: str) -> Iterator[str]:
    """From the axes of an engine and back."""
    yield "\n".join(comment([engine_axes(engine)]))
    for name, source, parts in conversions(engine):
        kind, within, ours, theirs = "float3", "", "xyz", "xyz"
        if len(parts) == 4:
            kind, within, ours, theirs = "quaternion", "value.", "wxyz", "xyzw"
        before, after = (theirs, ours) if source == "theirs" else (ours, theirs)
        terms = {
            after[place]: _scaled(f"{source}.{within}{before[index]}", factor)
            for place, (index, factor) in enumerate(parts)
        }
        listed = ", ".join(terms[letter] for letter in theirs)
        yield (
            f"public static {kind} @{name}({kind} {source}) {{\n"
            f"    return new {kind}({listed});\n}}"
        )


def _scaled(text: str, factor: float) -> str:
    if abs(factor) == 1.0:
        return f"-{text}" if factor < 0 else text
    return f"{text} * {literal(np.float32(factor))}"
