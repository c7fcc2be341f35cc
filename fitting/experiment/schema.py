"""The experiment file as JSON Schema (draft 2020-12), with which editors complete and check it.

Keys, meanings, units, ranges and choices are those by which files are checked, defaults those of
the classes, and parameters those that the rules declare. Checks across keys, and of other files,
are left to the reader: what the schema allows may be refused.

A table such as [parameters] may hold the parameters of any rule of a stage. Which rule a file has
follows from its preset and its [rules], so conditions then allow only the names of that rule.
"""

import functools
import json
from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx

import jaxik
from fitting.problem.scene import WHITENED, Capture
from fitting.problem.space import SPREAD
from fitting.runtime.declarations import NUMBER, closed, keys, table_schema
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree
from jaxik.world.arguments import LAYERS

from . import systems
from .experiment import ALL_SIGMA_KEYS, CORRELATION, FIT_KEYS, SEARCH_KEYS, Experiment
from .file_tables import DEFAULT_KEYS, PRIOR_KEYS

DIALECT = "https://json-schema.org/draft/2020-12/schema"
TABLES = ("object", "array")
LEG = r"(\[\d+\])?"  # after the name of a free parameter: of one leg
VALUES: dict[str, Content] = {  # of one number, by the kind of its leaf
    "b": {"type": "boolean"},
    "u": {"type": "integer", "minimum": 0, "maximum": 2**LAYERS - 1},
    "f": {"type": ["number", "null"]},  # inf, which JSON does not have, may come as null
}


def experiment_schema() -> Content:
    """The schema, as JSON holds it."""
    of_system = {
        "rules": rules(),
        "parameters": parameters(),
        "free": of_free_parameters("free"),
    }
    tables = of_system | {
        "capture": capture(),
        "prior": prior(),
        "start": _with_captures("start"),
        "sigmas": _sigmas(),
        "fit": _fit(),
    }
    schema = table_schema(keys(Experiment))
    properties = schema["properties"]
    for name, table in tables.items():
        properties[name] = {"description": properties[name]["description"], **table}
    variant = properties["without"]["items"]["properties"]
    for name in of_system:
        reference = {"$ref": f"#/properties/{name}"}
        variant[name] = {"description": variant[name]["description"], **reference}
    properties["clips"]["minItems"] = 1
    properties["preset"]["enum"] = systems.preset_names()
    plain = {name: part for name, part in properties.items() if part.get("type") not in TABLES}
    return {
        "$schema": DIALECT,
        "title": "Experiment of jaxik",
        "description": "Parameters of a system, and the clips to which they are fitted.",
        **schema,
        "properties": plain | properties,  # tables last, as in files
        "allOf": [only_originals(), *conditions()],
        "$defs": definitions(),
    }


def _fit() -> Content:
    """The table [fit], with that of the search in it."""
    schema, search = table_schema(FIT_KEYS), table_schema(SEARCH_KEYS)
    schema["properties"]["search"] |= search
    return schema


def _sigmas() -> Content:
    """The table [sigmas], in which there may be a correlation for each kind."""
    schema = table_schema(ALL_SIGMA_KEYS)
    declared = schema["properties"]["correlation"]
    together = dict(CORRELATION.constraint.schema)
    both = {"anyOf": [together, closed(dict.fromkeys(WHITENED, together))]}
    text = f"{declared['description']} One for all kinds, or a table."
    schema["properties"]["correlation"] = {
        **both, "description": text, "default": declared["default"]
    }  # fmt: skip
    return schema


class Field(NamedTuple):
    """A field that rules of a stage have."""

    schema: Content
    """Of its value."""
    is_parameter: bool
    """Whether it may be free."""
    description: str
    """Meaning, unit, range and defaults; for each rule, where they differ."""


def definitions() -> Content:
    """The schemas to which other schemas of this module refer."""
    return {
        "free": table_schema(systems.FREE_KEYS),
        "prior": table_schema(
            {name: part._replace(default=None) for name, part in PRIOR_KEYS.items()}
        ),
        "start": dict(NUMBER.schema),
    }


def rules() -> Content:
    """The schema of [rules]."""
    stages = {
        stage: {"enum": list(known), "description": f"The rule of the stage {stage}."}
        for stage, known in systems.STAGES.items()
    }
    return closed(stages)


def parameters() -> Content:
    """The schema of [parameters]."""
    return _by_stage(lambda field: field.schema)


def of_free_parameters(table: str) -> Content:
    """The schema of [free], [start] or [prior], without the keys of the table itself."""
    entry = {"$ref": f"#/$defs/{table}"}
    return _by_stage(lambda field: entry if field.is_parameter else None, LEG)


def capture(table: str = "free") -> Content:
    """The schema of [capture], of [prior.capture] or of [start.capture]."""
    entry, fields = {"$ref": f"#/$defs/{table}"}, Capture()
    declared = parameter_tree.declarations(fields)
    descriptions = {
        name: f"{known.doc} Range: {known.low:g} to {known.high:g}"
        f"{'' if known.unit == '1' else f' {known.unit}'}."
        for name, known in declared.items()
    }
    clips = {rf"^({'|'.join(declared)})\[\d+\]$": entry}
    return closed({name: entry | {"description": d} for name, d in descriptions.items()}, clips)


def prior() -> Content:
    """The schema of [prior]: keys of its own, and tables of parameters, and of captures."""
    own = {name: declared.schema for name, declared in DEFAULT_KEYS.items()}
    own["shape"]["default"], own["spread"]["default"] = "normal", SPREAD
    tables = _with_captures("prior")
    return tables | {"properties": own | tables["properties"]}


def _with_captures(table: str) -> Content:
    """The schema of [start] or [prior]: tables of parameters, and of captures."""
    tables, entry = of_free_parameters(table), {"$ref": f"#/$defs/{table}"}
    names = "|".join(parameter_tree.declarations(Capture()))
    pattern = {rf"^capture\.({names}){LEG}$": entry}
    captures = capture(table) | {"description": "Of errors of the captures."}
    return tables | {
        "properties": tables["properties"] | {"capture": captures},
        "patternProperties": tables["patternProperties"] | pattern,
    }


def only_originals() -> Content:
    """The condition that a faithful preset is one that differs from its original."""
    names = [preset.name for preset in systems.all_presets() if preset.faithful]
    faithful = {"properties": {"faithful": {"const": True}}, "required": ["faithful"]}
    return {"if": faithful, "then": {"properties": {"preset": {"enum": names}}}}


def conditions() -> list[Content]:
    """For each rule: where a file has it, its names are the only ones of the stage."""
    chosen = {preset: systems.rule_names(_system(preset)) for preset in systems.all_presets()}
    return [
        {
            "if": {
                "anyOf": [
                    _nested("rules", stage, {"const": name}),
                    *(
                        _by_default(preset, stage)
                        for preset in chosen
                        if chosen[preset][stage] == name
                    ),
                ]
            },
            "then": _only_names(stage, rule()),
        }
        for stage, known in systems.STAGES.items()
        for name, rule in known.items()
    ]


def _by_default(preset: systems.Preset, stage: str) -> Content:
    """The condition that a file has the rule of a preset."""
    default = systems.DEFAULT_PRESET
    required = ["preset"] * (preset.name != default.name) + ["faithful"] * preset.faithful
    return {
        "properties": {"preset": {"const": preset.name}, "faithful": {"const": preset.faithful}},
        "required": required,
        "not": _nested("rules", stage, {}),
    }


def _nested(table: str, key: str, schema: Content) -> Content:
    """The condition that a table has a key whose value meets a schema."""
    inner = {"properties": {key: schema}, "required": [key]}
    return {"properties": {table: inner}, "required": [table]}


def _only_names(stage: str, rule: eqx.Module) -> Content:
    """The condition that [parameters] and [free] have only fields of this rule in its stage."""
    fields = [slot.name for slot in parameter_tree.slots(rule)] + [*parameter_tree.options(rule)]
    tables = {"parameters": (fields, ""), "free": ([*parameter_tree.declarations(rule)], LEG)}
    properties = {}
    for table, (names, suffix) in tables.items():
        name = f"({'|'.join(names)}){suffix}$" if names else "(?!)"
        others = {"not": {"pattern": rf"^{stage}\.(?!{name})"}}  # in quotes, with their stage
        properties[table] = {
            "properties": {stage: {"propertyNames": {"pattern": f"^{name}"}}},
            "propertyNames": others,
        }
    return {"properties": properties}


def _by_stage(schema_of: Callable[[Field], Content | None], suffix: str = "") -> Content:
    """Tables by stage; a name may also stand in quotes with its stage: "foot.max_pitch".

    Args:
        schema_of: the schema of what stands under the name of a field; None if it may not.
        suffix: pattern of what may follow a name.
    """
    stages, patterns = {}, {}
    for stage in systems.STAGES:
        fields, alike = {}, {}  # names by schema
        for name, field in _fields(stage).items():
            if (schema := schema_of(field)) is not None:
                fields[name] = schema | {"description": field.description}
                alike.setdefault(json.dumps(schema), []).append(name)
        if fields:
            names = {f"({'|'.join(names)}){suffix}$": schema for schema, names in alike.items()}
            schemas = {name: json.loads(schema) for name, schema in names.items()}
            legs = {f"^{name}": schema for name, schema in schemas.items()} if suffix else {}
            stages[stage] = closed(fields, legs)
            patterns |= {rf"^{stage}\.{name}": schema for name, schema in schemas.items()}
    return closed(stages, patterns)


def _fields(stage: str) -> dict[str, Field]:
    """The fields of all rules of a stage, by name."""
    rules = {name: rule() for name, rule in systems.STAGES[stage].items()}
    descriptions: dict[str, dict[str, list[str]]] = {}  # by field and text, the rules
    fields: dict[str, Field] = {}
    for rule_name, rule in rules.items():
        for name, text in _described(stage, rule):
            descriptions.setdefault(name, {}).setdefault(text, []).append(rule_name)
            is_parameter = name in parameter_tree.declarations(rule)
            fields[name] = Field(_value_schema(rule, name), is_parameter, "")
    for name, texts in descriptions.items():
        parts = [f"{', '.join(owners)}: {text}" for text, owners in texts.items()]
        description = next(iter(texts)) if len(texts) == 1 else "\n".join(parts)
        fields[name] = fields[name]._replace(description=description)
    return fields


def _described(stage: str, rule: eqx.Module) -> Iterator[tuple[str, str]]:
    """Name and description of each field of a rule."""
    declared = parameter_tree.declarations(rule)
    units = {slot.name: slot.unit for slot in parameter_tree.slots(rule)}
    for name, doc in parameter_tree.docs(rule).items():
        parts = [doc]
        if (unit := units.get(name, "1")) != "1":
            parts.append(f"Unit: {unit}.")
        if name in declared:
            parts.append(f"Range: {declared[name].low:g} to {declared[name].high:g}.")
        yield name, " ".join([*parts, f"Default: {_defaults(stage, rule, name)}."])


def _defaults(stage: str, rule: eqx.Module, name: str) -> str:
    """The values that presets with this rule have under a name; else the rule's own."""
    presets: dict[str, list[str]] = {}  # by value
    for preset in systems.all_presets():
        if type(own := getattr(_system(preset), stage)) is type(rule):
            text = parameter_tree.shown(own, name)
            presets.setdefault(text, []).append("faithful " * preset.faithful + preset.name)
    if not presets:
        return parameter_tree.shown(rule, name)
    return "; ".join(f"{value} in {', '.join(names)}" for value, names in presets.items())


@functools.cache
def _system(preset: systems.Preset) -> jaxik.FootIK:
    return preset.system()


def _value_schema(rule: eqx.Module, name: str) -> Content:
    """The schema of a value: one for all legs, or a list with one a leg; of an option, one."""
    shapes = {slot.name: slot.shape for slot in parameter_tree.slots(rule)}
    if name not in shapes:
        return VALUES["b"]
    single = VALUES[parameter_tree.get(rule, name).dtype.kind]
    for size in shapes[name]:
        single = {"type": "array", "items": single, "minItems": size, "maxItems": size}
    return {"anyOf": [single, {"type": "array", "items": single, "minItems": 1}]}
