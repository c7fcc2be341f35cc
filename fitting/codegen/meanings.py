"""What the comments of generated code say, in any language."""

import ast
import functools
import hashlib
import inspect
import textwrap
from collections.abc import Iterator, Sequence
from importlib import metadata
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Rule

from .axes import ENGINES
from .graph import BOOL, FLOAT, INT, UNSIGNED
from .memory import words
from .program import Field, Program

COLUMNS = 96
STRUCTS = {
    "parameters": "The numbers of the system; @defaults has those that it was made from.",
    "rig": "What a leg is, apart from its pose.",
    "state": "Memory between frames: @init makes that before the first, @step the next.",
    "frame": "One frame of animation, before foot IK.",
    "result": "One frame after foot IK.",
}
RAYS = {
    "ray": "A ray that the engine is to cast, world space.",
    "hit": "What a ray hits, world space.",
}
USE = """\
Use: @init makes the state of a character. In each frame call, in this order,

{calls}

Each of these but the last adds rays behind those that are there. Cast them before the next call:
from their origins along their directions, as far as their lengths, onto the layers of their masks.
Of what rays[i] hits, write point and normal to hits[i], and 1 to its found, or 0 if it hits
nothing{platforms}. Rays, hits and work need not be kept from one frame to the next. Nothing is
allocated, and there is no other memory: characters may be computed in parallel."""
BLANK_FRAME = "A frame to begin with: full foot IK, on the ground, footholds unknown."
AXES = """\
Axes: x left, y up, z forward in model space; metres, seconds, radians; quaternions are w x y z. Of
names, _ws is world space, _ms model space, and _ls the space of a joint; a_from_b takes points from
b to a. Flags are 1 or 0."""


def origin(program: Program) -> list[str]:
    """From what a program was made, in a paragraph each."""
    rules = {
        stage: getattr(program.ik, stage)
        for stage in vars(program.ik)
        if isinstance(getattr(program.ik, stage), Rule)
    }
    options = [name for name, on in parameter_tree.options(program.ik).items() if on]
    listed = ", ".join(f"{stage} {type(rule).__name__}" for stage, rule in rules.items())
    count = "1 leg" if program.legs == 1 else f"{program.legs} legs"
    versions = f"jaxik {metadata.version('jaxik')} with JAX {jax.__version__}"
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
    return head


def use(program: Program, calls: Sequence[str]) -> list[str]:
    """How an engine uses a program, in a paragraph each, of which the calls are one."""
    moving = ", and to its platform the number of what moves, or -1" if program.platforms else ""
    return USE.format(calls="\n".join(calls), platforms=moving).split("\n\n")


def engine_axes(engine: str, more: str = "") -> str:
    """What the axes of an engine are, and what is converted from them."""
    return (
        f"{engine.capitalize()}: {ENGINES[engine].meaning}{more}. Model space and world space are "
        "converted alike, and rotations of joints."
    )


def ray_fields(program: Program, struct: str) -> dict[Field, str]:
    """The arrays of a struct of `RAYS`, and what each is."""
    if struct == "ray":
        return {
            Field(("origin",), FLOAT, (3,), True): "m",
            Field(("direction",), FLOAT, (3,), True): "unit",
            Field(("length",), FLOAT, ()): "m",
            Field(("layers",), UNSIGNED, ()): "those that it can hit, one bit each",
        }
    platform = {Field(("platform",), INT, ()): "what moves, or -1"} if program.platforms else {}
    return {
        Field(("point",), FLOAT, (3,), True): "m",
        Field(("normal",), FLOAT, (3,), True): "unit",
        Field(("found",), FLOAT, ()): "1, or 0 of a miss, of which nothing else counts",
    } | platform


def comment(
    paragraphs: Sequence[str],
    indent: str = "",
    marks: tuple[str, str, str] = ("/* ", "   ", " */"),
) -> list[str]:
    """The lines of a comment.

    Args:
        paragraphs: what it says; those that are indented stay as they are.
        indent: of all lines.
        marks: before the first line, before each other one, and behind the last.
    """
    start, rest, end = marks
    filled = [
        line
        for paragraph in paragraphs
        for line in (
            [*paragraph.split("\n"), ""]
            if paragraph.startswith(" ")
            else [*textwrap.wrap(paragraph.replace("*/", "* /"), COLUMNS - len(indent)), ""]
        )
    ][:-1]
    lines = [f"{indent}{rest if i else start}{line}".rstrip() for i, line in enumerate(filled)]
    lines[-1] += end
    return lines


def digest(tree: PyTree) -> str:
    """A few letters that tell the numbers of one system from those of another."""
    return hashlib.sha256(words(tree)).hexdigest()[:16]


def meanings(tree: PyTree) -> dict[tuple[str, ...], str]:
    """What the fields of a tree of structs are, by their paths."""
    if isinstance(tree, Rule):
        return {tuple(name.split(".")): text for name, text in _of_parameters(tree).items()}
    return dict(_of_fields(tree, ()))


class Entry(NamedTuple):
    """A parameter, for a panel of sliders."""

    number: int
    """Of its number among those of the struct."""
    name: str
    unit: str
    meaning: str
    value: float
    """From which the program was made."""
    low: float
    high: float


def table(program: Program) -> list[Entry]:
    """All parameters that have a range, and switches from 0 to 1, in the order of their struct."""
    ik = program.ik
    declared, texts = parameter_tree.declarations(ik), parameter_tree.docs(ik)
    entries, number = [], 0
    for field, leaf in zip(program.fields("parameters"), jax.tree.leaves(ik), strict=True):
        name, values = ".".join(field.path), np.asarray(leaf)
        for index in np.ndindex(*field.shape):
            each = name + "".join(f"[{i}]" for i in index)
            if field.kind == FLOAT and name in declared:
                unit, low, high = declared[name].unit, declared[name].low, declared[name].high
                value = float(values[index])
                entries.append(Entry(number, each, unit, texts[name], value, low, high))
            elif field.kind == BOOL:
                entries.append(Entry(number, each, "", texts[name], float(values[index]), 0.0, 1.0))
            number += 1
    return entries


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
