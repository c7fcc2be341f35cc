"""The experiment file as JSON Schema (draft 2020-12), with which editors complete and check it.

Keys, meanings, units, ranges and choices are those by which files are checked,
defaults those of the classes that it makes, and parameters those that the rules declare. Checks
across keys, and of other files, are left to the reader: what the schema allows may be refused.

JSON Schema of what experiments say of a system: rules, parameters, and which are free.

A table such as [parameters] may hold what any rule of a stage has. Which rule a file has follows
from its preset and its [rules], so conditions then allow only the names of that rule.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, get_args

import equinox as eqx

import jaxik
from fitting.clips.skating import TRAVELS
from fitting.ground.ground_path import ROOTS
from fitting.inference.noise import Correlation, NoiseOptions, Sigmas
from fitting.inference.optimise.solution import SearchSettings
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.settings import Settings, describe
from fitting.problem.problem import Loss
from fitting.problem.scene import LEAST_SIGMAS, WHITENED, Capture
from fitting.problem.space import SPREAD
from fitting.runtime import validation
from fitting.runtime.validation import NUMBER, Constraint, Content
from jaxik.maths import parameter_tree
from jaxik.world.arguments import LAYERS

from . import file_tables, systems
from .experiment import DEFAULT_SIGMAS, ClipEntry, Experiment, FitOptions
from .file_tables import PRIOR_KEYS
from .systems import BODY

DIALECT = "https://json-schema.org/draft/2020-12/schema"


LEG = r"(\[\d+\])?"  # after the name of a free parameter: of one leg
VALUES: dict[str, Content] = {  # of one number, by the kind of its leaf
    "b": {"type": "boolean"},
    "u": {"type": "integer", "minimum": 0, "maximum": 2**LAYERS - 1},
    "f": {"type": ["number", "null"]},  # inf, which is no JSON, may come as null
}

FILES = {
    "reference": "The captured motion: a clip. Needed.",
    "terrain": "The ground under it: a mesh or a heightfield. Needed.",
    "base": "The flat animation; left out, it is made from the reference.",
    "truth": "Parameters that made a synthetic reference, for the report.",
    "tracks": "What changes along the clip: a track file.",
    "asf": "The skeleton of an .amc, where it is not beside it.",
}
FILE_KEYS = tuple(FILES)
AXIS = validation.one_of(("y", "z"))
UNITS = validation.number(1e-9, 1e6)
JOINTS = Constraint(
    "a file, or a table of joint names by role",
    lambda value: validation.TEXT.accepts(value) or validation.TABLE.accepts(value),
    {"anyOf": [validation.TEXT.schema, validation.TABLE.schema]},
)
OFFSET = Constraint(
    "three numbers of metres from -1e+06 to 1e+06",
    lambda value: (
        isinstance(value, list)
        and len(value) == 3
        and all(validation.is_within(entry, -1e6, 1e6) for entry in value)
    ),
    {
        "type": "array",
        "items": {"type": "number", "minimum": -1e6, "maximum": 1e6},
        "minItems": 3,
        "maxItems": 3,
    },
)
CLIP_KEYS: dict[str, Constraint] = {
    **{key: validation.TEXT.meaning(f"{doc} The path is relative.") for key, doc in FILES.items()},
    "label": validation.TEXT.meaning("What plots call the reference."),
    "subject": validation.TEXT.meaning("Whom the clip shows, for [hierarchy]."),
    "start": validation.SECONDS.meaning("Where the part of the clip that counts begins.", "s"),
    "end": validation.SECONDS.meaning("Where it ends; left out, with the clip.", "s"),
    "joints": JOINTS.meaning("Which joint of reference and base is which: a map of joints."),
    "scale": UNITS.meaning("Metres per unit of reference and base; left out, guessed."),
    "up": AXIS.meaning("Up axis of reference and base; left out, guessed."),
    "animation": validation.TEXT.meaning("Which animation of a .glb or .gltf that has several."),
    "travel": validation.one_of(TRAVELS).meaning(
        "Whether the roots of reference and base are moved so that standing feet stay put, or left,"
        " or moved where the clip is clearly a cycle in place; left out, auto."
    ),
    "sole": validation.number(0, 10, "metres").meaning(
        "Height of the balls of reference and base over their soles; left out, measured or"
        " estimated.",
        "m",
    ),
    "file_up": AXIS.meaning("Up axis of the terrain's file."),
    "terrain_scale": UNITS.meaning("Metres per unit of the terrain's file."),
    "terrain_offset": OFFSET.meaning("By which the terrain is moved.", "m"),
    "terrain_cell": validation.number(1e-3, 1e4, "metres").meaning(
        "Between two heights of a terrain whose file does not say it.", "m"
    ),
    "mask_pops": validation.BOOLEAN.meaning(
        "Whether frames in which a captured marker jumps are left out."
    ),
    "held_out": validation.BOOLEAN.meaning(
        "Whether the clip is not fitted, but shows what the fit is worth."
    ),
    "root": validation.one_of(ROOTS).meaning(
        "Where the root is put: where the animation has it, on the ground below it, or on the"
        " ground only where foot IK does not reach it."
    ),
}
DEVIATION = "Standard deviation of the residuals of"
SIGMAS = {  # by kind: meaning and unit
    "ankle": (f"{DEVIATION} ankle positions.", "m"),
    "knee": (f"{DEVIATION} knee positions.", "m"),
    "pelvis": (f"{DEVIATION} the pelvis's position.", "m"),
    "foot": (f"{DEVIATION} the rotation of the ankle joints.", "rad"),
    "body": (f"{DEVIATION} the rotation of the pelvis.", "rad"),
    "contact": (f"{DEVIATION} the weight of contact.", ""),
    "smooth": (f"{DEVIATION} the acceleration of the ankles, which should be 0.", "m/s²"),
}
KINDS = tuple(SIGMAS)
SIGMA_KEYS = {
    kind: validation.number(LEAST_SIGMAS.get(kind, 1e-9), 1e9, or_inf=True).meaning(
        f"{doc} Infinity leaves them out.", unit
    )
    for kind, (doc, unit) in SIGMAS.items()
}
CORRELATIONS = tuple(f"correlation.{kind}" for kind in WHITENED)  # instead of one for all
CORRELATION = validation.CORRELATION.meaning("Correlation of residuals from frame to frame.")


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
        "start": start(),
        "sigmas": _sigmas(),
        "noise": _made_by(NOISE_KEYS, NoiseOptions),
        "fit": _fit(),
        "sample": _made_by(SAMPLE_KEYS, SamplerSettings),
        "hierarchy": _made_by(file_tables.HIERARCHY_KEYS, file_tables.Hierarchy),
        "clips": _list_of(_made_by(CLIP_KEYS, ClipEntry), ("reference", "terrain"), minItems=1),
    }
    schema = _with_tables(_made_by(TOP_KEYS, Experiment), tables)
    references = {name: {"$ref": f"#/properties/{name}"} for name in of_system}
    variant = _with_tables(named(file_tables.ABLATION_KEYS), references)
    schema = _with_tables(schema, {"without": _list_of(variant, ("name",))})
    schema["properties"]["preset"] |= {"enum": systems.preset_names()}
    return {
        "$schema": DIALECT,
        "title": "Experiment of jaxik",
        "description": "What is fitted to what.",
        **schema,
        "required": ["clips", "free"],
        "allOf": [only_originals(), *conditions()],
        "$defs": definitions(),
    }


def _made_by(constraints: Mapping[str, Constraint], maker: type) -> Content:
    """The schema of a table of which a dataclass is made, whose defaults are its fields'."""
    fields = dataclasses.fields(maker)
    return named(constraints, {f.name: f.default for f in fields if _is_plain(f.default)})


def _is_plain(default: object) -> bool:
    return isinstance(default, bool | int | float | str | tuple) and default not in ("", ())


def _sigmas() -> Content:
    """The table [sigmas], in which there may be a correlation for each kind."""
    schema = named(SIGMA_KEYS, DEFAULT_SIGMAS)
    together = schema["properties"]["correlation"]
    meaning, default = (together.pop(key) for key in ("description", "default"))
    names = [name.partition(".")[2] for name in CORRELATIONS]
    each = closed({name: together for name in names})
    both = {"anyOf": [together, each], "description": f"{meaning} One for all kinds, or a table."}
    return schema | {
        "properties": schema["properties"] | {"correlation": both | {"default": default}}
    }


def _fit() -> Content:
    schema = _made_by(FIT_KEYS, FitOptions)
    schema["properties"]["max_steps"]["default"] = SearchSettings().max_steps
    search = _made_by(SEARCH_KEYS, SearchSettings)
    return _with_tables(schema, {"search": search})


def _with_tables(schema: Content, tables: Mapping[str, Content]) -> Content:
    """A schema with those of the tables in it, whose meaning it has."""
    properties = dict(schema["properties"])
    for name, table in tables.items():
        meaning = {"description": properties[name]["description"]}
        properties[name] = table | meaning
    return schema | {"properties": properties}


def _list_of(entry: Content, required: tuple[str, ...], **limits: int) -> Content:
    return {"type": "array", "items": entry | {"required": list(required)}, **limits}


class Field(NamedTuple):
    """A field that rules of a stage have."""

    schema: Content
    """Of its value."""
    is_parameter: bool
    """Whether it may be free."""
    description: str
    """Meaning, unit, range and defaults; for each rule, where they differ."""


def definitions() -> Content:
    """What other schemas of this module refer to."""
    return {
        "free": named(systems.FREE_KEYS),
        "prior": named(PRIOR_KEYS),
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


def start() -> Content:
    """The schema of [start]: tables of parameters, and of captures."""
    return _with_captures("start")


def prior() -> Content:
    """The schema of [prior]: keys of its own, and tables of parameters, and of captures."""
    own = {key: dict(PRIOR_KEYS[key].schema) for key in ("shape", "spread")}
    own["shape"]["default"], own["spread"]["default"] = "normal", SPREAD
    tables = _with_captures("prior")
    return tables | {"properties": own | tables["properties"]}


def _with_captures(table: str) -> Content:
    """The schema of free parameters in a table, those of captures too."""
    tables, entry = of_free_parameters(table), {"$ref": f"#/$defs/{table}"}
    names = "|".join(parameter_tree.declarations(Capture()))
    pattern = {rf"^capture\.({names}){LEG}$": entry}
    captures = capture(table) | {"description": "Of what is fitted of the captures."}
    return tables | {
        "properties": tables["properties"] | {"capture": captures},
        "patternProperties": tables["patternProperties"] | pattern,
    }


def only_originals() -> Content:
    """That a faithful preset is one that differs from its original."""
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
    """That a file has the rule of a preset."""
    default = systems.DEFAULT_PRESET
    required = ["preset"] * (preset.name != default.name) + ["faithful"] * preset.faithful
    return {
        "properties": {"preset": {"const": preset.name}, "faithful": {"const": preset.faithful}},
        "required": required,
        "not": _nested("rules", stage, {}),
    }


def _nested(table: str, key: str, schema: Content) -> Content:
    """That a table is there, with a key whose value meets a schema."""
    inner = {"properties": {key: schema}, "required": [key]}
    return {"properties": {table: inner}, "required": [table]}


def _only_names(stage: str, rule: eqx.Module) -> Content:
    """That [parameters] and [free] have only fields of this rule in its stage."""
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


SIGMA_KEYS |= dict.fromkeys(("correlation", *CORRELATIONS), CORRELATION)


def _constraints(settings: type[Settings]) -> dict[str, Constraint]:
    return {
        name: Constraint(
            declared.range, lambda value, declared=declared: declared.allows(value), declared.schema
        ).meaning(declared.meaning, "" if declared.unit == "1" else declared.unit)
        for name, declared in describe(settings).items()
    }


FIT_KEYS: dict[str, Constraint] = {
    "starts": validation.count(1, 1000).meaning(
        "Independent starts of the search, at most, until enough of them agree."
    ),
    "max_steps": _constraints(SearchSettings)["max_steps"],
    "search": validation.TABLE.meaning("Settings of the search."),
}
SEARCH_KEYS = {
    name: constraint
    for name, constraint in _constraints(SearchSettings).items()
    if name != "max_steps"  # which is a key of [fit]
}
SAMPLE_KEYS = _constraints(SamplerSettings)
NOISE_KEYS = {
    "sigmas": validation.one_of(get_args(Sigmas)).meaning(
        "Whether the standard deviations are as [sigmas] says, or are estimated from there on,"
        " which moves the best point: right where a system can follow all but the noise."
    ),
    "correlation": validation.one_of(get_args(Correlation)).meaning(
        "Whether intervals are as wide as size and correlation of the residuals say (counted), or"
        " as [sigmas] says (given); or the correlation is taken out of the residuals (whitened),"
        " which moves the best point: right where a system can follow all but the noise."
    ),
}
TABLES = {
    "free": "What is fitted, if anything; {} takes range, kind and scale from the rule's"
    " declaration. Needed.",
    "capture": "What is not known of the captures and fitted beside the system, for each clip.",
    "prior": "What is known of free parameters before any clip.",
    "start": "Where the search begins; left out, at the system's values.",
    "rules": "Rules that differ from the preset's, by stage.",
    "parameters": "Fixed values that differ from the preset's.",
    "sigmas": "Standard deviation of each kind of residual.",
    "noise": "Which properties of the noise are estimated, and what for.",
    "fit": "How the best fit is searched for.",
    "sample": "How `jaxik sample` samples the posterior.",
    "hierarchy": "What several clips and subjects have in common; left out, everything.",
}
TOP_KEYS: dict[str, Constraint] = {
    "name": validation.TEXT.meaning("Title of the experiment; left out, the file's name."),
    "written_in": validation.TEXT.meaning(
        "Where the file was written: paths start there that lead nowhere from the file itself, as"
        " after moving a run alone."
    ),
    "preset": validation.TEXT.meaning("The system that is fitted."),
    "faithful": validation.BOOLEAN.meaning(
        "Whether the preset is the original, where the preset differs from it."
    ),
    "body": BODY.meaning(
        "Whose numbers and ranges are meant: those of the first clip's body, or of an adult of"
        " 1.8 m."
    ),
    "record_only": validation.BOOLEAN.meaning(
        "Whether free parameters that the game's record has no room for are left out."
    ),
    "loss": validation.one_of(get_args(Loss)).meaning(
        "How residuals count; all but squares give a few wrong frames less influence. Left out,"
        " huber; squares where sigmas are estimated."
    ),
    "fps": validation.RATE.meaning("Rate to which clips are resampled; left out, none.", "Hz"),
    "holdout": validation.number(0.0, 0.9).meaning(
        "Fraction of each clip, its end, that is not fitted but shows what the fit is worth; clips"
        " of less than 3 s are fitted whole."
    ),
    "seed": validation.SEED.meaning("Of all random numbers."),
    "independent_every": validation.SECONDS.meaning(
        "Time between residuals that count as independent; at 0 as [noise] says.", "s"
    ),
    **{name: validation.TABLE.meaning(doc) for name, doc in TABLES.items()},
    "clips": validation.list_of("[[clips]], one for each clip").meaning("The clips. Needed."),
    "without": validation.list_of("[[without]], one for each variant").meaning(
        "Variants that `jaxik ablate` fits."
    ),
}


def closed(properties: Mapping[str, Content], patterns: Mapping[str, Content] = {}) -> Content:  # noqa: B006
    """The schema of a table with these keys and no others.

    Args:
        properties: schemas of the values, by key.
        patterns: likewise, by pattern of further keys.
    """
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return schema | {"patternProperties": patterns} if patterns else schema


def named(
    constraints: Mapping[str, Constraint], defaults: Mapping[str, object] | None = None
) -> Content:
    """The schema of a table with these keys and no others.

    Args:
        constraints: of the values, by key.
        defaults: values that keys have where they are left out; None is no value.
    """
    properties = {key: dict(constraint.schema) for key, constraint in constraints.items()}
    for key, default in (defaults or {}).items():
        if key not in properties or default is None or isinstance(default, Mapping):
            continue
        if default == math.inf:  # which JSON does not have
            properties[key]["description"] += " Default: inf."
        else:
            properties[key]["default"] = list(default) if isinstance(default, tuple) else default
    return closed(properties)
