"""The header of a program in C: structs with units and meanings, and the parameters' values."""

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

import jax
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import ArrayLike, PyTree

from .axes import ENGINES, conversions
from .c_code import C_TYPES, literal, routine_head, signature
from .functions import LETTERS
from .graph import Number
from .meanings import AXES, STRUCTS, meanings, origin, table
from .program import Field, Program, blank_value
from .routines import routines
from .schedule import Schedule

COLUMNS = 96
USE = """\
Use: @init makes the state of a character. In each frame call, in this order,

{calls}

Each of these but the last adds rays behind those that are there. Cast them before the next call:
from their origins along their directions, as far as their lengths, onto the layers of their masks.
Of what rays[i] hits, write point and normal to hits[i], and 1 to its found, or 0 if it hits
nothing{platforms}. Rays, hits and work need not be kept from one frame to the next. Nothing is
allocated, and there is no other memory: characters may be computed in parallel. Do not compile
with -ffast-math."""


def text(program: Program, schedule: Schedule, engine: str | None) -> str:
    """The header; each @ stands for the prefix of all names, and @NAME for it in capitals."""
    guard, rounds = "@NAME_H", len(program.rounds)
    counts = {"LEGS": program.legs, "RAYS": program.ray_count, "ROUNDS": rounds}
    counts["SLIDERS"] = len(table(program))
    counts |= {f"RAYS_{i}": len(rays) for i, rays in enumerate(program.rounds, 1)}
    functions = [f"{signature(phase, rounds)};" for phase in range(rounds + 2)]
    lines = [
        *_comment(_head(program)),
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        *(f"#define @NAME_{key} {count}" for key, count in counts.items()),
        "",
        '#ifdef __cplusplus\nextern "C" {\n#endif',
        "",
        *_rays(program),
        *(line for struct in STRUCTS for line in _struct(program, struct)),
        *_comment(["What a frame keeps between its functions."]),
        *_work(schedule),
        "extern const @parameters @defaults;",
        "",
        *_comment(["A parameter, for a panel of sliders: the number of those in @parameters."]),
        "typedef struct @slider {",
        "    int number; /* each takes four bytes */",
        "    const char *name, *unit, *meaning;",
        "    float value, low, high; /* the default and the range; a switch has 0 to 1 */",
        "} @slider;",
        "extern const @slider @sliders[@NAME_SLIDERS];",
        "",
        *_comment(["A frame to begin with: full foot IK, on the ground, footholds unknown."]),
        "extern const @frame @blank_frame;",
        "",
        *functions,
        "",
        *(
            line
            for routine in routines(program)
            for line in (*_comment([routine.meaning]), f"{routine_head(routine)};", "")
        ),
        *(_axes(engine) if engine else ()),
        "#ifdef __cplusplus\n}\n#endif",
        "",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def constants(program: Program) -> list[str]:
    """The parameters that the program was made from, their ranges, and a frame to begin with."""
    frame = [blank_value(field) for field in program.fields("frame")]
    return [
        _constant(program, "parameters", "defaults", jax.tree.leaves(program.ik)),
        _constant(program, "frame", "blank_frame", frame),
        _sliders(program),
    ]


def _sliders(program: Program) -> str:
    rows = []
    for number, name, unit, meaning, *numbers in table(program):
        words = ", ".join(json.dumps(word, ensure_ascii=False) for word in (name, unit, meaning))
        rows.append(
            f"    {{{number}, {words}, {', '.join(literal(np.float32(x)) for x in numbers)}}}"
        )
    listed = ",\n".join(rows)
    return f"const @slider @sliders[@NAME_SLIDERS] = {{\n{listed}\n}};"


def _constant(program: Program, struct: str, name: str, leaves: Sequence[ArrayLike]) -> str:
    pairs = zip(program.fields(struct), leaves, strict=True)
    filled = [(field, np.asarray(leaf, _dtype(leaf))) for field, leaf in pairs if field.size]
    body = _initialiser([field for field, _ in filled], (value for _, value in filled), 0)
    return f"const @{struct} @{name} = {body};"


def _dtype(leaf: ArrayLike) -> DTypeLike:
    dtype = np.asarray(leaf).dtype
    return np.float32 if np.issubdtype(dtype, np.floating) else dtype


def _head(program: Program) -> list[str]:
    moving = ", and to its platform the number of what moves, or -1" if program.platforms else ""
    use = USE.format(calls="\n".join(calls(program, "    ")), platforms=moving)
    return [*origin(program), *use.split("\n\n"), AXES]


def _axes(engine: str) -> Iterator[str]:
    """Conversions from the axes of an engine and back, as functions of a header."""
    yield from _comment([
        f"{engine.capitalize()}: {ENGINES[engine].meaning}; quaternions are x y z w. Model space "
        "and world space are converted alike, and rotations of joints."
    ])  # fmt: skip
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

    def arguments(phase: int) -> str:
        structs = ", ".join(f"{prefix}{name}" for name in ("parameters", "rig", "state", "frame"))
        return f"{structs}, {'hits, ' if phase > 1 else ''}{prefix}work"

    lines, first = [], 0
    for phase, rays in enumerate(program.rounds, 1):
        lines.append(f"@rays_{phase}({arguments(phase)}, rays);")
        lines += [f"cast({first}, {first + len(rays)});"] if casts else []
        first += len(rays)
    lines.append(f"@step({arguments(len(program.rounds) + 1)}, {prefix}result);")
    return [f"{indent}{line}" for line in lines]


def _comment(paragraphs: Sequence[str], indent: str = "") -> list[str]:
    """A comment of these paragraphs; those that are indented stay as they are."""
    filled = [
        line
        for paragraph in paragraphs
        for line in (
            [*paragraph.split("\n"), ""]
            if paragraph.startswith(" ")
            else [*textwrap.wrap(paragraph.replace("*/", "* /"), COLUMNS - len(indent)), ""]
        )
    ][:-1]
    start, rest = f"{indent}/* ", f"{indent}   "
    lines = [f"{rest if i else start}{line}".rstrip() for i, line in enumerate(filled)]
    lines[-1] += " */"
    return lines


def _rays(program: Program) -> list[str]:
    platform = ["    int platform;"] if program.platforms else []
    return [
        *_comment(["A ray that the engine is to cast, world space."]),
        "typedef struct @ray {",
        "    float origin[3]; /* m */",
        "    float direction[3]; /* unit */",
        "    float length; /* m */",
        "    unsigned layers; /* those that it can hit, one bit each */",
        "} @ray;",
        "",
        *_comment(["What a ray hits, world space."]),
        "typedef struct @hit {",
        "    float point[3]; /* m */",
        "    float normal[3]; /* unit */",
        "    float found; /* 1, or 0 of a miss, of which nothing else counts */",
        *platform,
        "} @hit;",
        "",
    ]


def _struct(program: Program, struct: str) -> Iterator[str]:
    tree = program.trees[struct]
    yield from _comment([STRUCTS[struct]])
    yield f"typedef struct @{struct} {{"
    yield from _members(program.fields(struct), tree, meanings(tree), 0)
    yield f"}} @{struct};"
    yield ""


def _members(
    fields: Sequence[Field], tree: PyTree, texts: Mapping[tuple[str, ...], str], depth: int
) -> Iterator[str]:
    indent = "    " * (depth + 1)
    for name, group in groupby(fields, lambda field: field.path[depth]):
        members = [field for field in group if field.size]
        if not members:
            continue
        path = members[0].path[: depth + 1]
        if text := texts.get(path):
            yield from _comment([text], indent)
        if len(members[0].path) > depth + 1:
            yield f"{indent}struct {{"
            yield from _members(members, tree, texts, depth + 1)
            yield f"{indent}}} {name};"
        else:
            sizes = "".join(f"[{size}]" for size in members[0].shape)
            yield f"{indent}{C_TYPES[members[0].kind]} {name}{sizes};"


def _work(schedule: Schedule) -> list[str]:
    arrays = [
        f"    {C_TYPES[kind]} {LETTERS[kind]}[{count}];"
        for kind, count in schedule.memory.items()
        if count
    ]
    return ["typedef struct @work {", *(arrays or ["    int unused;"]), "} @work;", ""]


def _initialiser(fields: Sequence[Field], values: Iterator[np.ndarray], depth: int) -> str:
    parts = []
    for name, group in groupby(fields, lambda field: field.path[depth]):
        members = list(group)
        if len(members[0].path) > depth + 1:
            parts.append(_initialiser(members, values, depth + 1))
        else:
            parts.append(f"{_braced(next(values))} /* {name} */")
    indent = "    " * (depth + 1)
    listed = ",\n".join(f"{indent}{part}" for part in parts)
    return f"{{\n{listed}\n{indent[4:]}}}"


def _braced(values: np.ndarray | Number) -> str:
    if values.ndim:
        return "{" + ", ".join(map(_braced, values)) + "}"
    value = values[()]
    return literal(np.int32(value) if isinstance(value, np.bool_) else value)
