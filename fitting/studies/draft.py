"""A first experiment of clips, and of whatever ground and animations there are for them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from jaxtyping import Float

import jaxik
from fitting.clips import Clip, edit, flight, load_clip, summary
from fitting.clips.load import AS_FOUND, ClipOptions
from fitting.clips.rigs import USUAL_ERROR, measure_soles
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.problems import ClipData, load_clip_data, problem_from_clips
from fitting.experiment.record_files import PLACES
from fitting.experiment.schema import experiment_schema
from fitting.experiment.systems import Preset, choose_preset
from fitting.ground import coverage
from fitting.ground.meshes import TerrainOptions
from fitting.ground.reconstruction import Reconstruction, reconstruct
from fitting.inference.sensitivity import (
    Forecast,
    FreeTable,
    all_parameters,
    choose_free,
    leave_alone,
)
from fitting.motion import goodness, playback
from fitting.motion.goodness import Distances, describe_setback
from fitting.problem.problem import Problem
from fitting.report import pages
from fitting.report.document import Block, Document, Finding, Grid, Heading, Section, Text, text
from fitting.report.formatting import joined
from fitting.runtime import activity, files
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content, error_context
from jaxik.world import body
from jaxik.world.body import scaled_declarations

from . import terrain_report
from .fit import capture_check, fit_tables
from .fit.capture_check import CaptureCheck, measure_stances
from .output import output_folder
from .terrain_report import SCATTER

FEW_STANCES = 6  # of a foot
RECORD = Preset("record", faithful=True)

EXPERIMENT = "experiment.toml"
FAST, SLOW = 45.0, 30.0  # Hz: clips above the one are resampled to the other, which is enough
HARM = "{} as it comes does not leave these feet alone, as it must on flat ground: {}"
SHORTEST = 0.1  # s that is worth cutting off an end without motion

AS_IT_COMES = "{} as it comes, for this body, without any fit:"
NOTHING_FREE = "free: nothing; a fit writes these parameters and judges them, in seconds"
MORE_THAN_A_RECORD = "what is fitted has more than the game's record holds; for that: --record-only"
MARGIN = 2.0  # m of ground around the stances, over which a foot may swing

OPENING = """\
# Runs as it is: jaxik fit {name} -o RUN
# What is commented out is not set; it then has the value that the comment shows."""
TOP = ("name", "preset", "faithful", "record_only", "body", "fps")  # that a draft always sets


class Assumption(NamedTuple):
    """An assumption about a clip."""

    topic: str
    text: str
    """What is assumed, and from what."""
    advice: str = ""
    """What to check or to do better; empty where the clip bears it out."""


def of_clip(
    data: ClipData, ground: Reconstruction | None, *, base_is_own: bool, sole_is_given: bool = False
) -> list[Assumption]:
    """The assumptions about one clip of an experiment.

    Args:
        data: the loaded clip.
        ground: what the terrain was reconstructed from; None for a terrain that was given.
        base_is_own: whether the flat animation was given, and not made from the capture.
        sole_is_given: whether heights over the sole were given, and not measured or estimated.
    """
    return [
        *_body(data.reference),
        *_legs(data.reference),
        _soles(data.reference, is_given=sole_is_given),
        *_ground(data, ground),
        _base(data, base_is_own=base_is_own),
    ]


def _body(clip: Clip) -> Iterator[Assumption]:
    length = body.leg_length(clip.rig)
    text = f"{clip.scale:.6g} m per unit of the file, {clip.up_axis} up: legs {length:.2f} m long"
    yield Assumption("body", text)
    for remark in clip.remarks:
        yield Assumption("file", remark, "see `jaxik inspect`")
    if text := flight.describe(clip):
        yield Assumption("air", text)


def _legs(clip: Clip) -> Iterator[Assumption]:
    described = summary.describe(clip)
    for leg, name in enumerate(clip.rig.names):
        bend = knee_bend(clip)[:, leg]
        low, high = np.degrees(np.percentile(bend, [1, 99]))
        text = f"the {name} knee bends by {low:.0f}° to {high:.0f}°"
        yield Assumption("knees", text)
    for name, leg in described["legs"].items():
        text = f"the {name} foot {summary.contact_text(described, leg)}"
        few = leg["contacts"] < FEW_STANCES
        yield Assumption(
            "contacts", text, "few steps determine little: take a longer clip" if few else ""
        )


def _soles(clip: Clip, *, is_given: bool) -> Assumption:
    """How high balls are over their soles, which shifts reconstructed ground, and how sure."""
    heights = np.asarray(clip.rig.ball_height)
    text = f"balls are {100 * heights.mean():.1f} cm over their soles"
    if is_given:
        return Assumption("soles", f"{text}, as was given")
    labels = clip.stance_labels()
    soles = measure_soles(clip.rig, clip.positions_ws, clip.rotations_ws, labels)
    if soles.measured.all():
        spread = 100 * np.ptp(heights) / 2
        text += f", measured over the level floor at height 0 (feet differ by ±{spread:.1f} cm)"
        return Assumption("soles", text)
    return Assumption(
        "soles",
        f"{text}, estimated from the feet's length, give or take {100 * USUAL_ERROR:.0f} cm",
        "better: measure it, and give it as --sole",
    )


def knee_bend(clip: Clip) -> Float[np.ndarray, "frames legs"]:
    """Angle between thigh and shin, rad: 0 in a straight leg."""
    hip, knee, ankle = (clip.joints_ws(role) for role in range(3))
    thigh, shin = knee - hip, ankle - knee
    lengths = np.linalg.norm(thigh, axis=-1) * np.linalg.norm(shin, axis=-1)
    cosines = np.sum(thigh * shin, axis=-1) / np.maximum(lengths, 1e-12)
    return np.arccos(np.clip(cosines, -1.0, 1.0))


def _ground(data: ClipData, ground: Reconstruction | None) -> Iterator[Assumption]:
    stances = measure_stances(data)
    covered = ~np.isnan(stances.ground)
    if ground is not None:
        error = 100 * ground.predictions[ground.chosen].rms
        text = (
            f"reconstructed from {int(ground.stances.used.sum())} stances ({ground.chosen}); each "
            f"is predicted from the others to {error:.1f} cm (rms)"
        )
        doubt = "it is not to be trusted; " if 100 * SCATTER < error else ""
        yield Assumption("ground", text, f"{doubt}better: a scan of the ground, with --terrain")
    elif not covered.any():
        yield Assumption("ground", "no foot stands on it", "better: a clip in which the feet stand")
        return
    else:
        gap = (stances.sole - stances.ground)[covered]
        text = (
            f"below {covered.mean():.0%} of the stances; soles stand {100 * np.median(gap):.1f} cm "
            f"above it, give or take {100 * np.std(gap):.1f} cm"
        )
        advice = "does this ground belong to this clip?"
        fits = covered.mean() >= coverage.ENOUGH and np.std(gap) < SCATTER
        yield Assumption("ground", text, "" if fits else advice)


def _base(data: ClipData, *, base_is_own: bool) -> Assumption:
    if base_is_own:
        return Assumption("base", f"{data.base.source}; its root {data.root.reason}")
    return Assumption(
        "base",
        "made from the capture, with the ground taken out from under the feet",
        "better: the flat animation that the game plays, with --base",
    )


@dataclass(frozen=True)
class DraftRequest:
    """The files of which an experiment is made."""

    clips: tuple[Path, ...]
    """Captured."""
    terrains: tuple[Path, ...] = ()
    """None, one for all clips, or one for each; without any, the ground is reconstructed."""
    bases: tuple[Path, ...] = ()
    """Flat animations: none, or one for each clip."""
    preset: Preset | None = None
    """None is the one that serves the clips best, or the record's with `record_only`."""
    record_only: bool = False
    """Whether only what the game's record holds may be free."""
    reading: ClipOptions = AS_FOUND
    """Of clips and bases."""
    terrain_reading: TerrainOptions = TerrainOptions()
    """Of the terrains that are given."""

    def load(self) -> list[Clip]:
        """The captured clips.

        Raises:
            ValueError: as `load_clip`, or a clip has no legs.
        """
        clips = [load_clip(path, **self.reading.of_file(path).given) for path in self.clips]
        for clip in clips:
            clip.rig  # noqa: B018  # raises without legs
        return clips

    def preset_for(self, clips: Sequence[Clip]) -> Preset:
        """What is fitted to the captured clips."""
        if self.record_only:
            return RECORD
        return self.preset or choose_preset(clips)


@dataclass(frozen=True)
class Ground:
    """Ground that was reconstructed from a clip."""

    mesh: Path
    terrain: Reconstruction
    clip: Clip


@dataclass(frozen=True)
class Draft:
    """A first experiment, and the assumptions behind it."""

    experiment: Experiment
    grounds: tuple[Ground | None, ...]
    """Of each clip; None where the terrain was given."""
    assumptions: tuple[tuple[Assumption, ...], ...]
    """Of each clip."""
    forecasts: tuple[Forecast, ...]
    """Of all parameters that could be free; of no reach where the ground is flat."""
    check: CaptureCheck
    """What the clips can tell."""
    distances: Distances
    """How far the system as it comes leaves the capture."""
    rig: jaxik.Rig
    """Of the first clip."""

    @property
    def free(self) -> list[str]:
        """Names of the parameters that the clips should determine."""
        return [forecast.name for forecast in self.forecasts if forecast.is_free]


def check_request(request: DraftRequest) -> None:
    """Checks that counts match, options have a use and the preset exists; loads no clip.

    Raises:
        ValueError: they do not.
    """
    clips, terrains, bases = len(request.clips), len(request.terrains), len(request.bases)
    if not clips:
        raise ValueError("no clip; wanted at least one")
    if terrains not in (0, 1, clips):
        raise ValueError(
            f"{clips} clip(s) and {terrains} terrains; wanted none, one for all, or one for each"
        )
    if bases not in (0, clips):
        raise ValueError(f"{clips} clip(s) and {bases} base(s); wanted none, or one for each")
    preset = request.preset or RECORD
    if request.record_only and preset.name != RECORD.name:
        raise ValueError(f"a record is made of the preset 'record', not {preset.name!r}")
    if request.terrain_reading != TerrainOptions() and not terrains:
        raise ValueError("there is no --terrain that the options of terrains could be for")
    request.reading.check_use((*request.clips, *request.bases), "the clips")
    preset.system()


def reconstruct_grounds(
    request: DraftRequest, clips: Sequence[Clip], folder: Path
) -> tuple[Ground | None, ...]:
    """The ground of each clip that has no terrain; see `reconstruct`. Writes nothing.

    Raises:
        ValueError: a clip has too few stances.
    """
    if request.terrains:
        return (None,) * len(clips)
    names = [path.stem for path in request.clips]
    grounds = []
    for i, clip in enumerate(clips):
        number = "" if names.count(names[i]) == 1 else f"_{i + 1}"
        with error_context("no --terrain, so the ground is reconstructed"):
            with activity.announced(f"Reconstructing the ground of {names[i]}"):
                terrain = reconstruct(clip)
        grounds.append(Ground(folder / f"ground_{names[i]}{number}.ply", terrain, clip))
    return tuple(grounds)


@in_float64
def draft(
    request: DraftRequest, clips: Sequence[Clip], folder: Path, grounds: tuple[Ground | None, ...]
) -> Draft:
    """Chooses what to fit, and says what is assumed.

    Args:
        request: the files.
        clips: of the request, loaded.
        folder: where the experiment is going to lie.
        grounds: of `reconstruct_grounds`, whose meshes are written.

    Raises:
        ValueError: a file cannot be read.
    """
    entries = tuple(_entry(request, clips[i], i, ground) for i, ground in enumerate(grounds))
    fps = SLOW if any(clip.fps > FAST for clip in clips) else None
    with activity.announced("Reading the clips and their ground"):
        data = [
            load_clip_data(entry, fps, has_file=False, captured=clip)
            for entry, clip in zip(entries, clips, strict=True)
        ]
    preset = request.preset_for(clips)
    experiment = Experiment(
        path=folder / EXPERIMENT,
        clips=entries,
        free={},
        preset=preset.name,
        faithful=preset.faithful,
        name=folder.resolve().name,
        fps=fps,
        record_only=request.record_only,
    )
    rig = data[0].base.rig
    ik = experiment.starting_system(rig)
    candidates = {
        name: overrides
        for name, overrides in all_parameters(ik, rig).items()
        if not request.record_only or name in PLACES
    }
    check = capture_check.check(data)
    problem = problem_from_clips(replace(experiment, free=candidates), data)
    with activity.announced(f"Playing the clips with {preset.name} as it comes"):
        as_it_comes = playback.play_all(ik, problem.data)
    distances = goodness.measure_distances(as_it_comes, as_it_comes)
    lines: list[str] = []
    if check.flat:
        moved = _decisive(ik, problem, candidates) if distances.setbacks else []
        forecasts = [
            Forecast(name, is_free=name in moved, reach=float(name in moved), contraction=0)
            for name in candidates
        ]
        if distances.setbacks:
            lines = [HARM.format(preset.name, describe_setback(distances.setbacks[0]))]
    else:
        with activity.announced(f"Trying {len(candidates)} parameters over their ranges"):
            forecasts = choose_free(problem.space.system, candidates, problem.data)
    free = {f.name: candidates[f.name] for f in forecasts if f.is_free}
    if not (check.flat or any(forecast.moves for forecast in forecasts)):
        lines.append(f"no parameter of {preset.name} moves anything in these clips")
    elif not (check.flat or free):
        lines.append(f"these clips determine no parameter of {preset.name}")
    check = replace(check, lines=(*check.lines, *lines))
    return Draft(
        experiment=replace(experiment, free=free),
        grounds=grounds,
        assumptions=tuple(
            tuple(
                of_clip(
                    clip,
                    None if ground is None else ground.terrain,
                    base_is_own=bool(request.bases),
                    sole_is_given=request.reading.sole is not None,
                )
            )
            for clip, ground in zip(data, grounds, strict=True)
        ),
        forecasts=tuple(forecasts),
        check=check,
        distances=distances,
        rig=rig,
    )


def _decisive(ik: jaxik.FootIK, problem: Problem[jaxik.FootIK], candidates: FreeTable) -> list[str]:
    """Names of the parameters on which it depends whether a flat capture is left alone."""

    def is_harmless(ik: jaxik.FootIK) -> bool:
        played = playback.play_all(ik, problem.data)
        return not goodness.measure_distances(played, played).setbacks

    with activity.announced("Looking for what leaves the feet alone"):
        return leave_alone(ik, candidates, problem.data, is_harmless)


def _entry(request: DraftRequest, clip: Clip, index: int, ground: Ground | None) -> ClipEntry:
    start, end = (0.0, None) if request.bases else _motion(clip)
    path, base = request.clips[index], request.bases[index] if request.bases else None
    reading = request.reading.of_file(path)
    if base is not None:
        reading = ClipOptions(**{**request.reading.of_file(base).given, **reading.given})
    if ground is not None:
        terrain, terrain_reading = ground.mesh, TerrainOptions()
    else:
        terrain = request.terrains[index if len(request.terrains) > 1 else 0]
        terrain_reading = request.terrain_reading
    return ClipEntry(
        reference=path,
        terrain=terrain,
        base=base,
        start=start,
        end=end,
        **vars(reading),
        **vars(terrain_reading),
    ).with_paths(Path.resolve)


def _motion(clip: Clip) -> tuple[float, float | None]:
    """Where the motion begins and ends, s: after a T-pose, and before repeated frames."""
    first, last = edit.motion_span(clip)
    start, end = first / clip.fps, (last + 1) / clip.fps
    stays = (clip.frame_count - 1 - last) / clip.fps
    return (start if start > SHORTEST else 0.0), (end if stays > SHORTEST else None)


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
        Grid(fit_tables.distances_of_preset(draft.distances), "Distances from the capture"),
    ]
    return Document(
        file="",
        kind="A first experiment",
        title=experiment.name,
        verdict="Ready to fit" if free else "Nothing is free",
        good=bool(free),
        findings=findings,
        sections=[Section("The clips", assumed), Section("As it comes", as_it_comes)],
        setup=pages.rows(experiment),
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
    """The keys of a table that are not tables themselves."""
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
    """The keys of a clip that differ from their defaults."""
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
        request: the clips, and the files that belong to them.
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
            for path in terrain_report.output_files(mesh):
                if path.exists():
                    raise ValueError(f"{path}: is there already; name another folder")
        try:
            with activity.announced("Writing and drawing the ground"):
                for ground in grounds:
                    if ground is not None:
                        terrain_report.write(ground.mesh, ground.terrain, ground.clip, MARGIN)
            drafted = draft(request, clips, folder, grounds)
        except BaseException:  # also Ctrl-C: ground without an experiment is of no use
            for mesh in meshes:
                for path in terrain_report.output_files(mesh):
                    path.unlink(missing_ok=True)
            raise
        path = drafted.experiment.path
        files.write_text(path, as_toml(drafted))
        activity.log(joined(["", text(document(drafted)), ""]))
        activity.log(f"written to {path}; now: jaxik fit {path} -o RUN")
        return drafted.experiment
