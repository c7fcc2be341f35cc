"""The experiment file as JSON Schema (draft 2020-12), with which editors complete and check it.

Keys, meanings, units, ranges and choices are those by which files are checked,
defaults those of the classes that it makes, and parameters those that the rules declare. Checks
across keys, and of other files, are left to the reader: what the schema allows may be refused.
"""

import dataclasses
from collections.abc import Mapping

from fitting.experiments import ablations, hierarchies, systems
from fitting.experiments.experiment import DEFAULT_SIGMAS, ClipEntry, Experiment, FitOptions
from fitting.inference.noise.settings import NoiseOptions
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.sampling.settings import SamplerSettings
from fitting.runtime.validation import Constraint, Content

from . import keys, system_schema
from .tables import closed, named

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def experiment_schema() -> Content:
    """The schema, as JSON holds it."""
    of_system = {
        "rules": system_schema.rules(),
        "parameters": system_schema.parameters(),
        "free": system_schema.of_free_parameters("free"),
    }
    tables = of_system | {
        "capture": system_schema.capture(),
        "prior": system_schema.prior(),
        "start": system_schema.start(),
        "sigmas": _sigmas(),
        "noise": _made_by(keys.NOISE_KEYS, NoiseOptions),
        "fit": _fit(),
        "sample": _made_by(keys.SAMPLE_KEYS, SamplerSettings),
        "hierarchy": _made_by(hierarchies.KEYS, hierarchies.Hierarchy),
        "clips": _list_of(
            _made_by(keys.CLIP_KEYS, ClipEntry), ("reference", "terrain"), minItems=1
        ),
    }
    schema = _with_tables(_made_by(keys.TOP_KEYS, Experiment), tables)
    references = {name: {"$ref": f"#/properties/{name}"} for name in of_system}
    variant = _with_tables(named(ablations.KEYS), references)
    schema = _with_tables(schema, {"without": _list_of(variant, ("name",))})
    schema["properties"]["preset"] |= {"enum": systems.preset_names()}
    return {
        "$schema": DIALECT,
        "title": "Experiment of jaxik",
        "description": "What is fitted to what.",
        **schema,
        "required": ["clips", "free"],
        "allOf": [system_schema.only_originals(), *system_schema.conditions()],
        "$defs": system_schema.definitions(),
    }


def _made_by(constraints: Mapping[str, Constraint], maker: type) -> Content:
    """The schema of a table of which a dataclass is made, whose defaults are its fields'."""
    fields = dataclasses.fields(maker)
    return named(constraints, {f.name: f.default for f in fields if _is_plain(f.default)})


def _is_plain(default: object) -> bool:
    return isinstance(default, bool | int | float | str | tuple) and default not in ("", ())


def _sigmas() -> Content:
    """The table [sigmas], in which there may be a correlation for each kind."""
    schema = named(keys.SIGMA_KEYS, DEFAULT_SIGMAS)
    together = schema["properties"]["correlation"]
    meaning, default = (together.pop(key) for key in ("description", "default"))
    names = [name.partition(".")[2] for name in keys.CORRELATIONS]
    each = closed({name: together for name in names})
    both = {"anyOf": [together, each], "description": f"{meaning} One for all kinds, or a table."}
    return schema | {
        "properties": schema["properties"] | {"correlation": both | {"default": default}}
    }


def _fit() -> Content:
    schema = _made_by(keys.FIT_KEYS, FitOptions)
    schema["properties"]["max_steps"]["default"] = SearchSettings().max_steps
    search = _made_by(keys.SEARCH_KEYS, SearchSettings)
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
