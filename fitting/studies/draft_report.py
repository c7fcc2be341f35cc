"""A first experiment: its files, and what it assumes as text for the terminal."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

import jaxik
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.schema import experiment_schema
from fitting.inference.sensitivity import Forecast
from fitting.report import pages
from fitting.report.document import Block, Document, Finding, Grid, Heading, Section, Text, text
from fitting.report.formatting import joined
from fitting.runtime import activity, files
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from jaxik.world.body import scaled_declarations

from . import terrain_report
from .draft import EXPERIMENT, Draft, DraftRequest, check_request, draft, reconstruct_grounds
from .fit import goodness_report
from .output import output_folder

AS_IT_COMES = "{} as it comes, for this body, without any fit:"
NOTHING_FREE = "free: nothing; a fit writes these parameters and judges them, in seconds"
MORE_THAN_A_RECORD = "what is fitted has more than the game's record holds; for that: --record-only"
MARGIN = 2.0  # m of ground around the stances, over which a foot may swing

OPENING = """\
# Runs as it is: jaxik fit {name} -o RUN
# What is commented out is not set; it then has the value that the comment shows."""
TOP = ("name", "preset", "faithful", "record_only", "body", "fps")  # that a draft always sets


def document(draft: Draft) -> Document:
    """What is assumed of each clip, what would be better, and what is free."""
    experiment, free, count = draft.experiment, draft.free, len(draft.forecasts)
    named = f"free: {len(free)} of {count} parameters: {', '.join(free)}" if free else NOTHING_FREE
    findings = [*(Finding(line, bad=True) for line in draft.check.lines), Finding(named)]
    if experiment.preset == "record" and not experiment.record_only:
        findings.append(Finding(MORE_THAN_A_RECORD))
    assumed: list[Block] = []
    for entry, assumptions in zip(experiment.clips, draft.assumptions, strict=True):
        table = [["assumed", "from the clip", "what to check or improve"], *map(list, assumptions)]
        assumed += [Heading(entry.reference.name, brief=True), Grid(table, "What is assumed")]
    as_it_comes: list[Block] = [
        Text(AS_IT_COMES.format(experiment.preset), brief=True),
        Grid(goodness_report.distances_of_preset(draft.distances), "Distances from the capture"),
    ]
    return Document(
        file="",
        kind="A first experiment",
        title=experiment.name,
        verdict="Ready to fit" if free else "Nothing is free",
        good=bool(free),
        findings=findings,
        sections=[Section("The clips", assumed), Section("As it comes", as_it_comes)],
        asked=pages.rows(experiment),
    )


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


@in_float64
def init(request: DraftRequest, output: str | Path) -> Experiment:
    """Writes an experiment that runs as it is, with every key and what it means.

    Where clips come without ground, it is reconstructed from their stances; parameters are free
    that the clips should be able to determine. What is assumed, and what would be better, is
    logged.

    Args:
        request: the clips, and what there is besides.
        output: folder for the experiment and the grounds; it may hold other files.

    Raises:
        ValueError: a file cannot be read, the folder holds an experiment or ground already, or
            there is nothing that these clips could determine.
    """
    folder = Path(output)
    check_request(request)
    if (folder / EXPERIMENT).exists():
        raise ValueError(f"{folder / EXPERIMENT}: is there already; name another folder")
    with activity.announced(f"Reading {len(request.clips)} clip(s)"):
        clips = request.load()
    with output_folder(folder):
        if not request.terrains:
            activity.log("no --terrain: the ground is reconstructed from where the feet stand")
        grounds = reconstruct_grounds(request, clips, folder)
        meshes = [ground.mesh for ground in grounds if ground is not None]
        for mesh in meshes:
            terrain_report.check_new_files(mesh)
        try:
            with activity.announced("Writing and drawing the ground"):
                for ground in grounds:
                    if ground is not None:
                        terrain_report.write(ground.mesh, ground.terrain, ground.clip, MARGIN)
            drafted = draft(request, clips, folder, grounds)
        except BaseException:  # also Ctrl-C: ground without an experiment is of no use
            for mesh in meshes:
                terrain_report.remove(mesh)
            raise
        path = drafted.experiment.path
        files.write_text(path, as_toml(drafted))
        activity.log(joined(["", text(document(drafted)), ""]))
        activity.log(f"written to {path}; now: jaxik fit {path} -o RUN")
        return drafted.experiment
