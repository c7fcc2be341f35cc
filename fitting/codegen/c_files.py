"""The files of a program in C, and its header: structs with units and meanings, and values."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from . import c_code
from .axes import conversions
from .c_code import C_TYPES, literal, routine_head, signature
from .functions import LETTERS, calls_of, fill, inputs_of, phase_name
from .graph import Number
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
from .program import Field, Members, Program, constants_of, members_of
from .routines import Routine, routines
from .schedule import Schedule

FOLDER = Path(__file__).parent
CHECK, WALK = "check.c", "walk.c"
NODES = {"unreal": ("unreal.h", "AnimNode_@Name.h"), "godot": ("godot.cpp", "@file_modifier.cpp")}
"""For an engine: what calls the code there, and the name of its file."""


def sources(program: Program, name: str, engine: str | None = None) -> dict[str, str]:
    """The header, the functions and the node of an engine; see `export.Language`."""
    schedule, around = program.schedule(), routines(program)
    values = "\n\n".join(constants(program))
    parts = [c_code.PRELUDE + values, *c_code.functions(program, schedule, around)]
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
