"""The header of a program in C: structs with units and meanings, and the parameters' values."""

import json
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from .axes import conversions
from .c_code import C_TYPES, literal, routine_head, signature
from .functions import LETTERS, calls_of, inputs_of, phase_name
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
from .routines import Routine
from .schedule import Schedule

FAST_MATH = " Do not compile with -ffast-math."


def text(
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
