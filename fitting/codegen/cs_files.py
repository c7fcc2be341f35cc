"""The files of a program in C#."""

import html
import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np

from . import cs_code
from .axes import conversions
from .cs_code import FIELD_TYPES, literal, member_of, pascal, type_of
from .functions import LETTERS, calls_of, fill
from .graph import BOOL, FLOAT
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
from .program import Field, Members, Program, constants_of, members_of
from .schedule import Schedule

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
    code = cs_code.functions(program, schedule)
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
    lines = calls_of(program, lambda *phase: f"@TITLE.{cs_code.call(*phase)}", casts=casts)
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
    return _declared(struct, RAYS[struct], members_of(list(ray_fields(program, struct))), texts)


def _struct(program: Program, struct: str) -> str:
    fields, texts = program.fields(struct), meanings(program.trees[struct])
    attributes = _for_inspectors(program, texts) if struct == "parameters" else {}
    return _declared(struct, STRUCTS[struct], members_of(fields), texts, attributes)


def _for_inspectors(program: Program, texts: Mapping[Names, str]) -> dict[Names, str]:
    """What Unity's inspector shows of parameters."""
    ranges, shown = {entry.name: (entry.low, entry.high) for entry in table(program)}, {}
    for field in program.fields("parameters"):
        words = [f"Tooltip({json.dumps(_named(texts[field.path]), ensure_ascii=False)})"]
        if field.kind == FLOAT and (ends := ranges.get(".".join(field.path))):
            words.append(f"Range({', '.join(literal(np.float32(end)) for end in ends)})")
        shown[field.path] = f"[{', '.join(words)}]"
    return shown


def _declared(
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
