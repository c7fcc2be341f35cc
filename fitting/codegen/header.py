"""The header of a program in C: structs with units and meanings, and the parameters' values."""

import ast
import functools
import hashlib
import inspect
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from itertools import groupby

import jax
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import PyTree

from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Rule

from .c_code import C_TYPES, LETTERS, literal, signature
from .graph import Number
from .memory import words
from .program import Field, Program
from .schedule import Schedule

COLUMNS = 96
STRUCTS = {
    "parameters": "The numbers of the system; @defaults has those that it was made from.",
    "rig": "What a leg is, apart from its pose.",
    "state": "Memory between frames: @init makes that before the first, @step the next.",
    "frame": "One frame of animation, before foot IK.",
    "result": "One frame after foot IK.",
}
USE = """\
Use: @init makes the state of a character. In each frame call, in this order,

{calls}

Each of these but the last adds rays behind those that are there. Cast them before the next call:
from their origins along their directions, as far as their lengths, onto the layers of their masks.
Of what rays[i] hits, write point and normal to hits[i], and 1 to its found, or 0 if it hits
nothing{platforms}. Rays, hits and work need not be kept from one frame to the next. Nothing is
allocated, and there is no other memory: characters may be computed in parallel. Do not compile
with -ffast-math.

Axes: x left, y up, z forward in model space; metres, seconds, radians; quaternions are w x y z. Of
names, _ws is world space, _ms model space, and _ls the space of a joint; a_from_b takes points from
b to a. Flags are 1 or 0."""


def digest(tree: PyTree) -> str:
    """A few letters that tell the numbers of one system from those of another."""
    return hashlib.sha256(words(tree)).hexdigest()[:16]


def text(program: Program, schedule: Schedule) -> str:
    """The header; each @ stands for the prefix of all names, and @NAME for it in capitals."""
    guard, rounds = "@NAME_H", len(program.rounds)
    counts = {"LEGS": program.legs, "RAYS": program.ray_count, "ROUNDS": rounds}
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
        *functions,
        "",
        "#ifdef __cplusplus\n}\n#endif",
        "",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def defaults(program: Program) -> str:
    """The values of the parameters that the program was made from, as a constant of C."""
    values = iter(np.asarray(leaf, _dtype(leaf)) for leaf in jax.tree.leaves(program.ik))
    body = _initialiser(program.fields("parameters"), values, 0)
    return f"const @parameters @defaults = {body};"


def _dtype(leaf: jax.Array) -> DTypeLike:
    return np.float32 if np.issubdtype(leaf.dtype, np.floating) else leaf.dtype


def _head(program: Program) -> list[str]:
    rules = {
        stage: getattr(program.ik, stage)
        for stage in vars(program.ik)
        if isinstance(getattr(program.ik, stage), Rule)
    }
    options = [name for name, on in parameter_tree.options(program.ik).items() if on]
    listed = ", ".join(f"{stage} {type(rule).__name__}" for stage, rule in rules.items())
    count = "1 leg" if program.legs == 1 else f"{program.legs} legs"
    versions = f"jaxik {metadata.version('jaxik')} with JAX {jax.__version__}"
    moving = ", and to its platform the number of what moves, or -1" if program.platforms else ""
    ups = ", ".join(str(tuple(up.round(6).tolist())) for up in program.ups)
    head = [
        f"Foot IK of {count}, made by {versions}. Do not edit.",
        f"System: {listed}; with {', '.join(options) or 'no options'}.",
        f"Parameters: {digest(program.ik)}, the digest of their numbers.",
        f"Up, of the body and of legs that have their own: {ups}.",
    ]
    if program.order != sorted(program.order):
        numbers = " ".join(map(str, program.order))
        head.append(f"In `jaxik.step`, the rays have the numbers {numbers}.")
    return [
        *head,
        *USE.format(calls="\n".join(calls(program, "    ")), platforms=moving).split("\n\n"),
    ]


def calls(program: Program, indent: str, prefix: str = "&") -> list[str]:
    """The calls of a frame, of variables or, without the prefix, of pointers."""

    def arguments(phase: int) -> str:
        structs = ", ".join(f"{prefix}{name}" for name in ("parameters", "rig", "state", "frame"))
        return f"{structs}, {'hits, ' if phase > 1 else ''}{prefix}work"

    rounds = len(program.rounds)
    rays = [f"{indent}@rays_{i}({arguments(i)}, rays);" for i in range(1, rounds + 1)]
    return [*rays, f"{indent}@step({arguments(rounds + 1)}, {prefix}result);"]


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


def meanings(tree: PyTree) -> dict[tuple[str, ...], str]:
    """What the fields of a tree of structs are, by their paths."""
    if isinstance(tree, Rule):
        return {tuple(name.split(".")): text for name, text in _of_parameters(tree).items()}
    return dict(_of_fields(tree, ()))


def _of_parameters(ik: Rule) -> dict[str, str]:
    declared, texts = parameter_tree.declarations(ik), parameter_tree.docs(ik)
    for name, declaration in declared.items():
        unit = "" if declaration.unit == "1" else f"{declaration.unit}, "
        texts[name] = f"{unit}{declaration.low:g} to {declaration.high:g}: {texts[name]}"
    for slot in parameter_tree.slots(ik):
        if slot.name not in declared and slot.unit != "1":
            texts[slot.name] = f"{slot.unit}: {texts[slot.name]}"
    return texts


def _of_fields(tree: PyTree, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    texts = _field_texts(type(tree))
    for name, value in vars(tree).items():
        if name in texts:
            yield (*path, name), texts[name]
        if hasattr(value, "__dataclass_fields__"):
            yield from _of_fields(value, (*path, name))


@functools.cache
def _field_texts(cls: type) -> dict[str, str]:
    """The strings below the fields of a class, and of those that it extends."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base.__module__.split(".")[0] in ("builtins", "equinox", "abc"):
            continue
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(definition, ast.ClassDef)
        for field, below in zip(definition.body, definition.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                if isinstance(field.target, ast.Name) and isinstance(below.value, ast.Constant):
                    texts[field.target.id] = " ".join(str(below.value.value).split())
    return texts
