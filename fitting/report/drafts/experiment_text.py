"""The file of a first experiment: every key with its meaning, those left out as comments."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

import jaxik
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.experiments.schema.experiment_schema import experiment_schema
from fitting.inference.choice import Forecast
from fitting.runtime import files
from fitting.runtime.validation import Content
from fitting.studies.drafts.draft import Draft
from jaxik.world.body import scaled_declarations

OPENING = """\
# Runs as it is: jaxik fit {name} -o RUN
# What is commented out is not set; it then has the value that the comment shows."""
TOP = ("name", "preset", "faithful", "record_only", "body", "fps")  # that a draft always sets


def as_toml(draft: Draft) -> str:
    """The experiment of a draft with all keys; paths are relative to its folder."""
    experiment, schema = draft.experiment, experiment_schema()["properties"]
    folder = experiment.path.parent
    top = {name: getattr(experiment, name) for name in TOP}
    top["written_in"] = folder.resolve().as_posix()
    parts = [OPENING.format(name=experiment.path.name), "", *_keys(top, _plain_keys(schema))]
    for entry in experiment.clips:
        own = _of_clip(entry, folder)
        parts += ["", "[[clips]]", *_keys(own, schema["clips"]["items"]["properties"])]
    parts += ["", _heading("rules", schema), "", _heading("parameters", schema)]
    parts += [f"{_key(name)} = {_value(value)}" for name, value in experiment.parameters.items()]
    parts += ["", _heading("free", schema), *_free(draft)]
    parts += ["", _heading("capture", schema)]
    for name, entry in schema["capture"]["properties"].items():
        parts.append(f"# {name} = {{}}  # {entry['description']}")
    for name in ("prior", "start", "sigmas", "noise", "hierarchy", "fit", "sample"):
        keys = _plain_keys(schema[name]["properties"])
        parts += ["", _heading(name, schema), *_keys({}, keys)]
    return "\n".join(parts) + "\n"


def _plain_keys(properties: Content) -> Content:
    """The keys of a table that are no tables themselves."""
    tables = ("object", "array")
    return {
        name: entry
        for name, entry in properties.items()
        if "description" in entry and entry.get("type") not in tables
    }


def _heading(name: str, schema: Content) -> str:
    return f"[{name}]  # {schema[name]['description']}"


def _keys(values: Mapping[str, Any], properties: Content) -> Iterator[str]:
    """A line for each key: those with a value, and as comments those without."""
    for name, entry in properties.items():
        meaning = f"  # {_meaning(entry)}"
        if values.get(name) is not None:
            yield f"{name} = {_value(values[name])}{meaning}"
        elif "default" in entry:
            yield f"# {name} = {_value(entry['default'])}{meaning}"
        elif entry.get("description", "").endswith("Default: inf."):
            yield f"# {name} = inf{meaning}"
        else:
            yield f"# {name} ={meaning}"


def _meaning(entry: Content) -> str:
    """What a key is for, and what it may be."""
    text = entry.get("description", "")
    if "enum" in entry:
        return f"{text} One of {', '.join(entry['enum'])}."
    numbers = [entry, *entry.get("anyOf", [])]
    bounded = [part for part in numbers if {"minimum", "maximum"} <= part.keys()]
    if not bounded:
        return text
    return f"{text} {bounded[0]['minimum']:g} to {bounded[0]['maximum']:g}."


def _of_clip(entry: ClipEntry, folder: Path) -> dict[str, Any]:
    """The keys of a clip that are not as they are when left out."""
    values = {}
    for name, default in vars(ClipEntry(Path(), Path())).items():
        value = getattr(entry, name)
        if isinstance(value, Path):
            values[name] = files.relative_path(value, folder)
        elif value != default:
            values[name] = value
    return values


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, Mapping):
        pairs = (f"{key} = {_value(entry)}" for key, entry in value.items())
        return f"{{ {', '.join(pairs)} }}" if value else "{}"
    return tomli_w.dumps({"key": value}).removeprefix("key = ").strip()


def _free(draft: Draft) -> Iterator[str]:
    """The free parameters, and as comments the others with the reason."""
    forecasts, meanings = draft.forecasts, dict(_meanings(draft.experiment, draft.rig))
    groups: list[tuple[str, Sequence[Forecast]]] = [
        (
            "What leaves the feet alone depends on these:"
            if draft.check.flat
            else "These clips should determine:",
            [f for f in forecasts if f.is_free],
        ),
        (
            "Not free, as these clips hardly tell them from another one:",
            [f for f in forecasts if f.rival],
        ),
        (
            "Not free, as they change too little in these clips:",
            [f for f in forecasts if not f.is_free and not f.rival and f.moves],
        ),
        (
            "Not free, as the ground under all stances is flat:"
            if draft.check.flat
            else "Not free, as they change nothing in these clips:",
            [f for f in forecasts if not f.moves],
        ),
    ]
    for title, group in groups:
        if group:
            yield f"# {title}"
        for forecast in group:
            mark = "" if forecast.is_free else "# "
            overrides = _value(dict(draft.experiment.free.get(forecast.name, {})))
            rival = f" Much like {forecast.rival}." if forecast.rival else ""
            yield f"{mark}{_key(forecast.name)} = {overrides}  # {meanings[forecast.name]}{rival}"


def _key(name: str) -> str:
    """A parameter's name as TOML has keys."""
    return f'"{name}"' if "[" in name else name


def _meanings(experiment: Experiment, rig: jaxik.Rig) -> Iterator[tuple[str, str]]:
    """Meaning, range and unit of each parameter, by name, also leg by leg."""
    for name, declared in scaled_declarations(experiment.starting_system(rig), rig).items():
        unit = "" if declared.unit == "1" else f" {declared.unit}"
        text = f"{declared.doc} {declared.low:.4g} to {declared.high:.4g}{unit}."
        yield name, text
        yield from ((f"{name}[{i}]", text) for i in range(max(3, len(rig.names))))
