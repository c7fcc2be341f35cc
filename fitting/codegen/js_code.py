"""A program as a module of JavaScript.

Numbers are doubles, JavaScript's own: to round each to 32 bits would make the code longer and
slower. The answers are then those of `jaxik.run` in 64 bits, nearly. A struct is one array of
doubles, which engines compile to plain loads and stores, in whatever order a page fills it.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np

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
from .meanings import AXES, BLANK_FRAME, STRUCTS, comment, meanings, origin
from .program import Field, Members, Place, Program, constants_of, members_of
from .routines import PLATFORM, Routine, routines
from .schedule import Schedule, Target

CHECK = "check.mjs"
RAY, RAY_SIZE = {"origin": 0, "direction": 3, "length": 6, "layers": 7}, 8
HIT, HIT_SIZE = {"point": 0, "normal": 3, "found": 6}, 7  # without a platform
USE = """\
Use: create() gives a character parameters, as they were here, and room for all else, as arrays of
doubles; PARAMETERS, RIG, FRAME, RESULT, RAY and HIT say at which place a field begins. Fill the
rig, then init(parameters, rig, state) makes the state. In each frame fill the frame, and call in
this order

{calls}

Each of these but the last fills its part of the rays, of RAY_SIZE numbers each. Cast them before
the next call: from their origins along their directions, as far as their lengths, onto the layers
of their masks. Of what ray i hits, write point and normal to the hits from i * HIT_SIZE on, and 1
to its found, or 0 if it hits nothing{platforms}."""

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
    ) for kind in (INT, BOOL)},
    **{(name, UNSIGNED): f"(({{0}} {sign} {{1}}) >>> 0)" for name, sign in (
        ("and", "&"), ("or", "|"), ("xor", "^"), ("add", "+"), ("subtract", "-"),
    )},
    **{(name, INT): f"({{0}} {sign} {{1}} | 0)" for name, sign in (
        ("add", "+"), ("subtract", "-"),
    )},
    ("multiply", INT): "Math.imul({0}, {1})",
    ("multiply", UNSIGNED): "(Math.imul({0}, {1}) >>> 0)",
    ("negate", FLOAT): "(-{0})",
    ("negate", INT): "(-{0} | 0)",
    ("negate", UNSIGNED): "(-{0} >>> 0)",
    ("abs", FLOAT): "Math.abs({0})",
    ("abs", INT): "(Math.abs({0}) | 0)",
    **{("sign", kind): "Math.sign({0})" for kind in (FLOAT, INT)},
    **{("maximum", kind): "Math.max({0}, {1})" for kind in (FLOAT, INT, UNSIGNED)},
    **{("minimum", kind): "Math.min({0}, {1})" for kind in (FLOAT, INT, UNSIGNED)},
    ("maximum", BOOL): "({0} | {1})",
    ("minimum", BOOL): "({0} & {1})",
    ("remainder", FLOAT): "({0} % {1})",
    ("sqrt", FLOAT): "Math.sqrt({0})",
    ("rsqrt", FLOAT): "(1 / Math.sqrt({0}))",
    ("cbrt", FLOAT): "Math.cbrt({0})",
    ("exponential", FLOAT): "Math.exp({0})",
    ("exponential_minus_one", FLOAT): "Math.expm1({0})",
    ("log", FLOAT): "Math.log({0})",
    ("log_plus_one", FLOAT): "Math.log1p({0})",
    ("power", FLOAT): "Math.pow({0}, {1})",
    ("cosine", FLOAT): "Math.cos({0})",
    ("sine", FLOAT): "Math.sin({0})",
    ("tan", FLOAT): "Math.tan({0})",
    ("tanh", FLOAT): "Math.tanh({0})",
    ("atan2", FLOAT): "Math.atan2({0}, {1})",
    ("floor", FLOAT): "Math.floor({0})",
    ("ceil", FLOAT): "Math.ceil({0})",
    ("round_nearest_even", FLOAT): "@round_even({0})",
    ("is_finite", FLOAT): "Number.isFinite({0})",
    ("not", BOOL): "(!{0})",
    ("not", INT): "(~{0})",
    ("not", UNSIGNED): "(~{0} >>> 0)",
    ("shift_left", UNSIGNED): "({1} < 32 ? {0} << {1} >>> 0 : 0)",
    ("shift_left", INT): "({1} >>> 0 < 32 ? {0} << {1} : 0)",
    ("shift_right_logical", UNSIGNED): "({1} < 32 ? {0} >>> {1} : 0)",
    ("shift_right_logical", INT): "({1} >>> 0 < 32 ? {0} >>> {1} | 0 : 0)",
    ("shift_right_arithmetic", INT): "({0} >> ({1} >>> 0 < 32 ? {1} : 31))",
    **{("select", kind): "({0} ? {1} : {2})" for kind in (FLOAT, INT, UNSIGNED, BOOL)},
    ("float_of_bool", BOOL): "({0} ? 1 : 0)",
    ("float_of_int", INT): "{0}",
    ("float_of_unsigned", UNSIGNED): "{0}",
    ("int_of_bool", BOOL): "({0} ? 1 : 0)",
    ("int_of_float", FLOAT): "@int_of({0})",
    ("int_of_unsigned", UNSIGNED): "({0} | 0)",
    ("unsigned_of_bool", BOOL): "({0} ? 1 : 0)",
    ("unsigned_of_float", FLOAT): "@unsigned_of({0})",
    ("unsigned_of_int", INT): "({0} >>> 0)",
    ("float_of_bits", UNSIGNED): "@float_of_bits({0})",
    ("bits_of_float", FLOAT): "@bits_of_float({0})",
    ("lesser", FLOAT): "({0} < {1} ? {0} : {1})",
    ("greater", FLOAT): "({0} > {1} ? {0} : {1})",
    ("sign_bit", FLOAT): "({0} < 0 || 1 / {0} < 0)",
    ("copysign", FLOAT): "@copysign({0}, {1})",
}  # fmt: skip

HELPERS = {
    "round_even": """\
function @round_even(x) {
    return Math.abs(x % 1) === 0.5 ? 2 * Math.round(x / 2) : Math.round(x);
}""",
    "int_of": """\
function @int_of(x) {
    return x < 2147483647 ? (x > -2147483648 ? x | 0 : -2147483648) : x > 0 ? 2147483647 : 0;
}""",
    "unsigned_of": """\
function @unsigned_of(x) {
    return x > 0 ? (x < 4294967295 ? x >>> 0 : 4294967295) : 0;
}""",
    "float_of_bits": """\
function @float_of_bits(bits) {
    return new Float32Array(Uint32Array.of(bits).buffer)[0];
}""",
    "bits_of_float": """\
function @bits_of_float(x) {
    return new Uint32Array(Float32Array.of(x).buffer)[0];
}""",
    "copysign": """\
function @copysign(x, y) {
    return y < 0 || 1 / y < 0 ? -Math.abs(x) : Math.abs(x);
}""",
}
ARGUMENTS = ("parameters", "rig", "state", "frame", "hits", "work", "rays", "result")
STRUCT_OF = {"standing": "frame", "before": "frame"}  # of arguments with another name
ARRAYS = {FLOAT: "Float64Array", INT: "Int32Array", UNSIGNED: "Uint32Array", BOOL: "Uint8Array"}


def literal(value: Number) -> str:
    """A number in JavaScript."""
    if value.dtype.kind != "f":
        text = str(int(value))
    elif np.isfinite(value):
        text = str(value).removesuffix(".0")
    else:
        text = str(value).replace("inf", "Infinity").replace("nan", "NaN")
    return f"({text})" if text.startswith("-") else text


class JavaScript(Language):
    """Of engines from 2020 on."""

    name = "JavaScript"
    expressions = EXPRESSIONS
    helpers = HELPERS

    def __init__(self, program: Program) -> None:
        """Of a program, whose structs decide at which place a number is."""
        self.places = {
            (struct, place.field.path, place.index): number
            for struct, places in program.places.items()
            for number, place in enumerate(places)
        }
        self.hit, self.hit_size = hit_places(program), hit_size(program)

    def literal(self, value: Number) -> str:
        return literal(value)

    def local(self, kind: str, name: str, text: str) -> str:
        return f"const {name} = {text};"

    def work(self, kind: str, place: int) -> str:
        return f"work.{LETTERS[kind]}[{place}]"

    def input(self, place: Place) -> str:
        if place.struct == PLATFORM:
            return PLATFORM
        if place.struct == "hits":
            ray, *axis = place.index
            at = self.hit[place.field.path[0]] + (axis[0] if axis else 0)
            return f"hits[{self.hit_size * ray + at}]"
        text = self._member(place)
        return f"({text} != 0)" if place.field.kind == BOOL else text

    def output(self, target: Target, place: Place | None) -> str:
        if place is None:
            return f"rays[{RAY_SIZE * target.number + RAY[target.name] + target.axis}]"
        text = self._member(place)
        return f"work.after{text.removeprefix('state')}" if target.struct == "state" else text

    def part(self, name: str, lines: Sequence[str]) -> tuple[str, list[str]]:
        body = body_of(lines)
        names = [word for word in ARGUMENTS if re.search(rf"\b{word}[.\[]", body)]
        return f"function {name}({', '.join(names)}) {{\n{body}\n}}", names

    def routine(self, routine: Routine, lines: Sequence[str]) -> str:
        """A function that others call."""
        names = [name for name, _ in routine.reads if name != routine.writes.name]
        heads = ", ".join([*names, routine.writes.name])
        meaning = "\n".join(comment([routine.meaning]))
        return f"{meaning}\nfunction {routine.name}({heads}) {{\n{body_of(lines)}\n}}"

    def shared(
        self, name: str, kind: str, arguments: Sequence[tuple[str, str]], lines: Sequence[str]
    ) -> str:
        heads = ", ".join(letter for _, letter in arguments)
        return f"function {name}({heads}) {{\n{body_of(lines)}\n}}"

    def _member(self, place: Place) -> str:
        struct = STRUCT_OF.get(place.struct, place.struct)
        number = self.places[struct, place.field.path, place.index]
        return f"{place.struct}[{number}]"


def sources(program: Program, name: str, engine: str | None = None) -> dict[str, str]:
    """The module, by the name of its file; see `export.Language`.

    Raises:
        ValueError: there is an engine, or an operation without an expression.
    """
    if engine is not None:
        raise ValueError("axes: only for C and C#")
    schedule, language = program.schedule(), JavaScript(program)
    around = [*routines(program)]
    code = functions(program, schedule, language)
    code += [language.routine(each, routine_lines(each, language)) for each in around]
    names = [*entry_names(program), *(routine.name for routine in around)]
    parts = [
        "\n".join(comment(_head(program))),
        _counts(program),
        *("\n".join(_places(program, struct)) for struct in STRUCTS),
        _arrays(program, schedule),
        *helpers_in(language, "".join(code)),
        *code,
        f"export {{ {', '.join(names)} }};",
    ]
    return {f"{name}.mjs": "\n\n".join(parts).replace("@", "") + "\n"}


def script(program: Program) -> str:
    """A program as the object `system` of a script, in short."""
    schedule, language = program.schedule(), JavaScript(program)
    code = functions(program, schedule, language)
    ends = np.cumsum([0, *(len(rays) for rays in program.rounds)]).tolist()
    *rays, _ = entry_names(program)[1:]
    sizes = {name: len(program.places[name]) for name in ("rig", "state", "result")}
    sizes |= {"rays": RAY_SIZE * program.ray_count, "hits": hit_size(program) * program.ray_count}
    arrays = [f"{name}: new Float64Array({size})" for name, size in sizes.items()]
    arrays.append(f"work: {memory(schedule, sizes['state'])}")
    parts = [
        *helpers_in(language, "".join(code)),
        *code,
        f"return {{ init, step, rays: [{', '.join(rays)}], ends: {ends}, RAY_SIZE: {RAY_SIZE}, "
        f"HIT_SIZE: {hit_size(program)}, create: () => ({{ {', '.join(arrays)} }}) }};",
    ]
    text = re.sub(r"\n +", "\n", "\n".join(parts)).replace("@", "")
    text = re.sub(r" ?([=+*/<>?:,|&{}()]+) ?", r"\1", text)
    return f"const system = (() => {{\n{text}\n}})();\n"


def check(program: Program, name: str) -> dict[str, str]:
    """What replays a trace of this program."""
    template = Path(__file__).with_name(CHECK).read_text(encoding="utf-8")
    in_order = "\n".join(_calls(program, "  "))
    names = ", ".join(entry_names(program))
    return {CHECK: fill(template, {"@CALLS": in_order, "@NAMES": names, "@file": name, "@": ""})}


def functions(program: Program, schedule: Schedule, language: JavaScript) -> list[str]:
    """The parts of all phases, and the functions that others call.

    Raises:
        ValueError: an operation on a type for which there is no expression.
    """
    parts = parts_of(program, schedule, language)
    return [*parts.texts, *_entries(parts.calls)]


def entry_names(program: Program) -> list[str]:
    """The functions that others call, in their order."""
    rounds = len(program.rounds)
    return [phase_name(phase, rounds) for phase in range(rounds + 2)]


def _calls(program: Program, indent: str) -> list[str]:
    """The calls of a frame."""

    def call(phase: int, rounds: int) -> str:
        return f"{indent}{phase_name(phase, rounds)}({', '.join(inputs_of(phase, rounds))});"

    return list(calls_of(program, call))


def _entries(calls: Sequence[Sequence[tuple[str, list[str]]]]) -> Iterator[str]:
    """The functions that others call."""
    rounds = len(calls) - 2
    for phase, parts in enumerate(calls):
        lines = [f"    {part}({', '.join(names)});" for part, names in parts]
        lines += ["    state.set(work.after);"] if phase > rounds else []
        head = f"function {phase_name(phase, rounds)}({', '.join(inputs_of(phase, rounds))}) {{"
        yield "\n".join([head, *lines, "}"])


def memory(schedule: Schedule, state: int) -> str:
    """What a frame keeps between its functions; `state` is the size of that struct."""
    arrays = [
        f"{LETTERS[kind]}: new {ARRAYS[kind]}({count})" for kind, count in schedule.memory.items()
    ]
    return f"{{ {', '.join([*arrays, f'after: new Float64Array({state})'])} }}"


def _head(program: Program) -> list[str]:
    moving = ", and to its platform the number of what moves, or -1" if program.platforms else ""
    in_order = "\n".join(_calls(program, "    "))
    use = USE.format(calls=in_order, platforms=moving)
    return [*origin(program), *use.split("\n\n"), AXES]


def _counts(program: Program) -> str:
    counts = {"LEGS": program.legs, "RAYS": program.ray_count, "ROUNDS": len(program.rounds)}
    counts |= {f"RAYS_{i}": len(rays) for i, rays in enumerate(program.rounds, 1)}
    counts |= {"RAY_SIZE": RAY_SIZE, "HIT_SIZE": hit_size(program)}
    lines = [f"export const {name} = {count};" for name, count in counts.items()]
    for name, places in (("RAY", RAY), ("HIT", hit_places(program))):
        listed = ", ".join(f"{field}: {place}" for field, place in places.items())
        lines.append(f"export const {name} = {{ {listed} }};")
    return "\n".join(lines)


def hit_size(program: Program) -> int:
    """How many numbers a hit has."""
    return HIT_SIZE + (program.platforms > 0)


def hit_places(program: Program) -> dict[str, int]:
    """At which number of a hit a field begins."""
    return HIT | ({"platform": HIT_SIZE} if program.platforms else {})


def _places(program: Program, struct: str) -> Iterator[str]:
    """At which number of a struct each field begins, by name."""
    yield from comment([STRUCTS[struct]])
    yield f"export const {struct.upper()} = {{"
    texts = meanings(program.trees[struct])
    yield from _members(members_of(program.fields(struct)), starts(program, struct), texts, ())
    yield "};"


def starts(program: Program, struct: str) -> dict[tuple[str, ...], int]:
    """At which number of a struct each field begins."""
    fields = program.fields(struct)
    sizes = [field.size for field in fields]
    return dict(zip((field.path for field in fields), accumulate([0, *sizes]), strict=False))


def _members(
    members: Members,
    places: Mapping[tuple[str, ...], int],
    texts: Mapping[tuple[str, ...], str],
    path: tuple[str, ...],
) -> Iterator[str]:
    indent = "    " * (len(path) + 1)
    for name, member in members.items():
        within = (*path, name)
        if text := texts.get(within):
            yield from comment([text], indent)
        if isinstance(member, Field):
            sizes = "".join(f"[{size}]" for size in member.shape)
            yield f"{indent}{name}: {places[within]},{sizes and f' // {sizes}'}"
        else:
            yield f"{indent}{name}: {{"
            yield from _members(member, places, texts, within)
            yield f"{indent}}},"


def _arrays(program: Program, schedule: Schedule) -> str:
    """The defaults, a frame to begin with, and what makes arrays."""
    numbers = {
        name: ", ".join(literal(value) for array in arrays.values() for value in array.flat)
        for name, (_, arrays) in constants_of(program).items()
    }
    sizes = {struct: len(places) for struct, places in program.places.items()}
    arrays = {name: f"new Float64Array({sizes[name]})" for name in ("rig", "state")}
    arrays |= {
        "work": memory(schedule, sizes["state"]),
        "rays": "new Float64Array(RAYS * RAY_SIZE)",
        "hits": "new Float64Array(RAYS * HIT_SIZE)",
        "result": f"new Float64Array({sizes['result']})",
    }
    listed = "\n".join(f"        {name}: {text}," for name, text in arrays.items())
    return f"""\
export const defaults = Float64Array.of({numbers["defaults"]});

/* {BLANK_FRAME} */
export const blank_frame = Float64Array.of({numbers["blank_frame"]});

/* All arrays of a character; of several, each needs only parameters, rig and state of its own. */
export function create() {{
    return {{
        parameters: defaults.slice(),
        frame: blank_frame.slice(),
{listed}
    }};
}}"""
