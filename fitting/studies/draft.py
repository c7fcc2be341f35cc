"""From clips, and whatever ground and animations there are for them, to a first experiment."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import jaxik
from fitting.clips import Clip, edit, flight, load_clip, summary
from fitting.clips.load import AS_FOUND, ClipOptions
from fitting.clips.rigs import USUAL_ERROR, measure_soles
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.problems import ClipData, load_clip_data, problem_from_clips
from fitting.experiment.record_files import PLACES
from fitting.experiment.systems import DEFAULT_PRESET, Preset, preset_system
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
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from jaxik.world import body

from .fit import capture_check
from .fit.capture_check import CaptureCheck, stances_of
from .terrain_report import SCATTER

FEW_STANCES = 6  # of a foot


EXPERIMENT = "experiment.toml"
FAST, SLOW = 45.0, 30.0  # Hz: clips above the one are resampled to the other, which is enough
HARM = "{} as it comes does not leave these feet alone, as it must on flat ground: {}"
SHORTEST = 0.1  # s that is worth cutting off an end without motion


class Assumption(NamedTuple):
    """Something taken for granted."""

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
    stances = stances_of(data)
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
    """What there is to make an experiment of."""

    clips: tuple[Path, ...]
    """Captured."""
    terrains: tuple[Path, ...] = ()
    """None, one for all clips, or one for each; without, the ground is reconstructed."""
    bases: tuple[Path, ...] = ()
    """Flat animations: none, or one for each clip."""
    preset: Preset = DEFAULT_PRESET
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


@dataclass(frozen=True)
class Ground:
    """Ground that was reconstructed from a clip."""

    mesh: Path
    terrain: Reconstruction
    clip: Clip


@dataclass(frozen=True)
class Draft:
    """A first experiment, and what it rests on."""

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
    if request.record_only and request.preset.name != "record":
        raise ValueError(f"a record is made of the preset 'record', not {request.preset.name!r}")
    if request.terrain_reading != TerrainOptions() and not terrains:
        raise ValueError("there is no --terrain that the options of terrains could be for")
    request.reading.check_use((*request.clips, *request.bases), "the clips")
    preset_system(request.preset.name, faithful=request.preset.faithful)


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
        request: what there is.
        clips: that are loaded of it.
        folder: where the experiment is going to lie.
        grounds: of `reconstruct_grounds`, whose meshes are written.

    Raises:
        ValueError: a file cannot be read.
    """
    entries = tuple(_entry(request, clips[i], i, ground) for i, ground in enumerate(grounds))
    fast = any(clip.fps > FAST for clip in clips)
    experiment = Experiment(
        path=folder / EXPERIMENT,
        clips=entries,
        free={},
        preset=request.preset.name,
        faithful=request.preset.faithful or request.record_only,
        name=folder.resolve().name,
        fps=SLOW if fast else None,
        record_only=request.record_only,
    )
    with activity.announced("Reading the clips and their ground"):
        data = [
            load_clip_data(entry, experiment.fps, has_file=False, captured=clip)
            for entry, clip in zip(entries, clips, strict=True)
        ]
    rig = data[0].base.rig
    ik = experiment.starting_system(rig)
    candidates = {
        name: overrides
        for name, overrides in all_parameters(ik, rig).items()
        if not request.record_only or name in PLACES
    }
    check = capture_check.check(data)
    problem = problem_from_clips(replace(experiment, free=candidates), data)
    with activity.announced(f"Playing the clips with {request.preset.name} as it comes"):
        as_it_comes = playback.play_all(ik, problem.data)
    apart = goodness.measure_distances(as_it_comes, as_it_comes)
    lines: list[str] = []
    if check.flat:
        moved = _decisive(ik, problem, candidates) if apart.setbacks else []
        forecasts = [
            Forecast(name, is_free=name in moved, reach=float(name in moved), contraction=0)
            for name in candidates
        ]
        if apart.setbacks:
            lines = [HARM.format(request.preset.name, describe_setback(apart.setbacks[0]))]
    else:
        with activity.announced(f"Trying {len(candidates)} parameters over their ranges"):
            forecasts = choose_free(problem.space.system, candidates, problem.data)
    free = {f.name: candidates[f.name] for f in forecasts if f.is_free}
    if not (check.flat or any(forecast.moves for forecast in forecasts)):
        lines.append(f"no parameter of {request.preset.name} moves anything in these clips")
    elif not (check.flat or free):
        lines.append(f"these clips determine no parameter of {request.preset.name}")
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
        distances=apart,
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
    taken = request.reading.of_file(path)
    if base is not None:
        taken = ClipOptions(**{**request.reading.of_file(base).given, **taken.given})
    if ground is not None:
        terrain, laid = ground.mesh, TerrainOptions()
    else:
        terrain = request.terrains[index if len(request.terrains) > 1 else 0]
        laid = request.terrain_reading
    return ClipEntry(
        reference=path,
        terrain=terrain,
        base=base,
        start=start,
        end=end,
        **vars(taken),
        **vars(laid),
    ).with_paths(Path.resolve)


def _motion(clip: Clip) -> tuple[float, float | None]:
    """Where the motion begins and ends, s: after a T-pose, and before repeated frames."""
    first, last = edit.motion_span(clip)
    start, end = first / clip.fps, (last + 1) / clip.fps
    stays = (clip.frame_count - 1 - last) / clip.fps
    return (start if start > SHORTEST else 0.0), (end if stays > SHORTEST else None)
