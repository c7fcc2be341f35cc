"""From clips, and whatever ground and animations there are for them, to a first experiment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jaxik
from fitting.analysis import playback
from fitting.analysis.goodness import distances
from fitting.analysis.goodness.distances import Distances
from fitting.analysis.goodness.verdict import describe_setback
from fitting.datasets.clips import Clip, edit, load_clip
from fitting.datasets.clips.load import AS_FOUND, ClipOptions
from fitting.datasets.terrain.mesh_files import TerrainOptions
from fitting.datasets.terrain.reconstruction import Reconstruction, reconstruct
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.experiments.problems import ClipData, load_clip_data, problem_from_clips
from fitting.experiments.record_only import PLACES
from fitting.experiments.systems import DEFAULT_PRESET, Preset, preset_system
from fitting.inference.choice import Forecast, choose_free
from fitting.inference.harmless import leave_alone
from fitting.inference.sensitivity import FreeTable, all_parameters
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from fitting.studies.motions import capture_check
from fitting.studies.motions.capture_check import CaptureCheck

from .assumptions import Assumption, of_clip

EXPERIMENT = "experiment.toml"
FAST, SLOW = 45.0, 30.0  # Hz: clips above the one are resampled to the other, which is enough
HARM = "{} as it comes does not leave these feet alone, as it must on flat ground: {}"
SHORTEST = 0.1  # s that is worth cutting off an end without motion


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
        clips = [
            load_clip(path, **vars(self.reading.of_file(path)))  # type: ignore[arg-type]
            for path in self.clips
        ]
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
    request: DraftRequest,
    clips: Sequence[Clip],
    folder: Path,
    grounds: tuple[Ground | None, ...],
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
    with activity.announced(f"Playing the clips with {request.preset.name} as it comes"):
        as_it_comes = playback.play_all(ik, problem_from_clips(experiment, data).data)
    apart = distances.measure(as_it_comes, as_it_comes)
    lines: list[str] = []
    if check.flat:
        moved = _decisive(experiment, data, candidates) if apart.setbacks else []
        forecasts = [
            Forecast(name, is_free=name in moved, reach=float(name in moved), contraction=0)
            for name in candidates
        ]
        if apart.setbacks:
            lines = [HARM.format(request.preset.name, describe_setback(apart.setbacks[0]))]
    else:
        problem = problem_from_clips(replace(experiment, free=candidates), data)
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
            _assumptions(request, clip, ground) for clip, ground in zip(data, grounds, strict=True)
        ),
        forecasts=tuple(forecasts),
        check=check,
        distances=apart,
        rig=rig,
    )


def _decisive(experiment: Experiment, data: Sequence[ClipData], candidates: FreeTable) -> list[str]:
    """Names of the parameters on which it depends whether a flat capture is left alone."""
    scenes = problem_from_clips(experiment, data).data

    def is_harmless(ik: jaxik.FootIK) -> bool:
        played = playback.play_all(ik, scenes)
        return not distances.measure(played, played).setbacks

    ik = experiment.starting_system(data[0].base.rig)
    with activity.announced("Looking for what leaves the feet alone"):
        return leave_alone(ik, candidates, scenes, is_harmless)


def _assumptions(
    request: DraftRequest, data: ClipData, ground: Ground | None
) -> tuple[Assumption, ...]:
    terrain = None if ground is None else ground.terrain
    is_given = request.reading.sole is not None
    return tuple(of_clip(data, terrain, base_is_own=bool(request.bases), sole_is_given=is_given))


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
        reference=path.resolve(),
        terrain=terrain.resolve(),
        base=None if base is None else base.resolve(),
        start=start,
        end=end,
        **ClipEntry.reading(taken, laid),
    )


def _motion(clip: Clip) -> tuple[float, float | None]:
    """Where the motion begins and ends, s: after a T-pose, and before repeated frames."""
    first, last = edit.motion_span(clip)
    start, end = first / clip.fps, (last + 1) / clip.fps
    stays = (clip.frame_count - 1 - last) / clip.fps
    return (start if start > SHORTEST else 0.0), (end if stays > SHORTEST else None)
