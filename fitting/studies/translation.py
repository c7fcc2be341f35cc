"""Translation: the parameters of one system fitted to the motion of another.

The source runs on flat animations over terrain; its motion is the reference of an ordinary
experiment in which parameters of the target are free. The folder is a run like any other, with
these files in addition:

source.npz              the source's motion (source_1.npz, ... for several clips)
source.toml             the source's parameters
<preset>.toml           the fitted parameters again, under the name of the target's preset
translation.json        the remaining differences, as numbers
difference.png          the remaining differences over time
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import jaxik
from fitting.analysis import difference
from fitting.datasets import clip_frames, clips
from fitting.datasets.clips import edit
from fitting.datasets.ground_path import place_root
from fitting.experiments import parameter_files, systems
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.experiments.problems import ClipData, problem_from_clips
from fitting.inference import sensitivity
from fitting.inference.noise.settings import NoiseOptions
from fitting.inference.optimisation.population import evaluate
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.optimisation.state import Search, SearchState
from fitting.inference.optimisation.sweep import sweep
from fitting.inference.sensitivity import FreeTable
from fitting.problem.free_parameters import free_parameter
from fitting.problem.problem import Problem
from fitting.runtime import activity, files, validation
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.validation import error_context

from . import run_folder
from .animations import AnimationFiles, load_animation

# The source has no noise: these say how far apart two motions still count as the same.
TOLERANCES = {
    "ankle": 0.005,  # m
    "knee": 0.005,  # m
    "pelvis": 0.005,  # m
    "foot": 0.03,  # rad
    "body": 0.03,  # rad
}
MAX_SWEEPS = 20  # over the free parameters, before the search
MIN_SWEEP_GAIN = 0.01  # relative fall of the cost that makes another sweep worthwhile
SOURCE = "source.toml"


@dataclass(frozen=True)
class NamedSystem:
    """A system under the name by which the user asked for it."""

    name: str
    """Of a preset, or the stem of a parameter file."""
    preset: systems.Preset
    ik: jaxik.FootIK


@dataclass(frozen=True)
class TranslationRequest:
    """Which system is fitted to which, and on what."""

    source: NamedSystem
    """Whose motion is reproduced."""
    target: NamedSystem
    """Whose parameters are fitted, starting from these values."""
    animations: tuple[AnimationFiles, ...]
    free: FreeTable | None = None
    """None: all that move these clips."""
    fps: float | None = None
    """Clips are resampled to this rate first."""


@dataclass(frozen=True)
class Translation:
    """A translation that is ready to be fitted."""

    source: NamedSystem
    target: NamedSystem
    experiment: Experiment
    clips: tuple[ClipData, ...]
    """Their references are the motions of the source."""
    problem: Problem[jaxik.FootIK]
    free_was_chosen: bool
    """By the user, and not by a sweep over all parameters."""

    @property
    def names(self) -> tuple[str, str]:
        """The source and the target as texts refer to them."""
        same = self.source.name == self.target.name
        return f"`{self.source.name}`{' (source)' if same else ''}", f"`{self.target.name}`"


@in_float64
def load_named_system(
    text: str, option: str = "system", rig: jaxik.Rig | None = None
) -> NamedSystem:
    """The system with the name of a preset, or in a parameter file (.toml).

    Args:
        text: the name or the path.
        option: what the user set to this text, for the error message.
        rig: whose body the system is for; None is the adult.

    Raises:
        ValueError: there is no such preset or file, or the file has a table [noise].
    """
    path = Path(text)
    if path.suffix.lower() == ".toml":
        _check_no_noise(validation.read_toml(path, "a parameter"), text)
        ik, preset = parameter_files.load_system(path, rig)
        return NamedSystem(path.stem, preset, ik)
    with error_context(f"{option} takes a preset or a parameter .toml"):
        preset = systems.Preset(text)
        return NamedSystem(text, preset, preset.system(rig))


def read_free(text: str, ik: jaxik.FootIK, rig: jaxik.Rig | None = None) -> FreeTable:
    """Free parameters as `--free` names them: `name,name`, or a TOML file with a [free] table.

    Args:
        text: names or path.
        ik: the system that has them.
        rig: whose body their ranges are for; None is the adult.

    Raises:
        ValueError: no parameter is named, one is unknown, or it cannot be what the table says; the
            file has a table [noise].
    """
    path = Path(text)
    free: FreeTable
    if path.suffix.lower() == ".toml":
        content = validation.read_toml(path, "a free-parameter")
        _check_no_noise(content, text)
        validation.check_table(content, {"free": validation.TABLE}, text)
        free = systems.read_free_table(content.get("free", {}), f"{text} [free]")
    else:
        free = {name.strip(): {} for name in text.split(",") if name.strip()}
    if not free:
        raise ValueError(f"--free {text}: names no parameter")
    with error_context(f"--free {text}"):
        for name, overrides in free.items():
            free_parameter(ik, name, rig, **overrides)
    return free


def _check_no_noise(content: validation.Table, where: str) -> None:
    if "noise" in content:
        raise ValueError(
            f"{where}: there is a table [noise], but nothing to estimate: the reference of a "
            "translation is exact, and its sigmas are tolerances; leave the table out"
        )


def prepare(request: TranslationRequest, run: Path) -> Translation:
    """Runs the source and builds the problem of fitting the target to it; writes nothing.

    Args:
        request: what is translated.
        run: the folder that the run is going to have.

    Raises:
        ValueError: there is no clip, or a file cannot be read; the source moves nothing in these
            clips; no parameter of the target does.
    """
    if not request.animations:
        raise ValueError("no clip; wanted at least one, with a terrain for each")
    source, target = (
        replace(named, ik=with_floats(named.ik, np.float64))
        for named in (request.source, request.target)
    )
    run = run.resolve()
    with activity.announced(f"Running {source.name} on {len(request.animations)} clip(s)"):
        data = [_source_motion(source, files, request.fps) for files in request.animations]
    rig = data[0].base.rig
    preset = target.preset.system(rig)
    rules = systems.changed_rules(target.ik, preset)
    start = systems.with_rules(preset, rules, target.name, rig)
    experiment = Experiment(
        path=run / run_folder.EXPERIMENT,
        clips=_clip_entries(request, run),
        free=request.free or sensitivity.all_parameters(target.ik, rig),
        preset=target.preset.name,
        faithful=target.preset.faithful,
        name=f"{source.name} to {target.name}",
        fps=request.fps,
        holdout=0.0,
        loss="squares",  # another system's motion has neither outliers nor noise
        noise=NoiseOptions(correlation="given"),
        rules=rules,
        parameters=systems.changed_values(target.ik, start),
        sigmas=TOLERANCES,
    )
    problem = problem_from_clips(experiment, data)
    with activity.announced(f"Measuring what {source.name} moves"):
        _check_moves(source, problem)
    if request.free is None:
        with activity.announced(f"Trying {len(experiment.free)} parameters over their ranges"):
            moving = sensitivity.measure_sensitivity(target.ik, experiment.free, problem.data)
        if not moving:
            raise ValueError(f"no parameter of {target.name} moves anything in these clips")
        experiment = replace(experiment, free={name: experiment.free[name] for name in moving})
        problem = problem_from_clips(experiment, data)
    chosen = request.free is not None
    return Translation(source, target, experiment, tuple(data), problem, chosen)


def _clip_entries(request: TranslationRequest, run: Path) -> tuple[ClipEntry, ...]:
    source, count = request.source, len(request.animations)
    same_rules = systems.rule_names(source.ik) == systems.rule_names(request.target.ik)
    return tuple(
        ClipEntry(
            reference=run / (f"source_{number}.npz" if count > 1 else "source.npz"),
            terrain=animation.terrain.resolve(),
            base=animation.clip.resolve(),
            truth=run / SOURCE if same_rules else None,
            **ClipEntry.reading(animation.clip_options, animation.terrain_options),
            label=f"source: {source.name}",
            mask_pops=False,
            root=animation.root,
        )
        for number, animation in enumerate(request.animations, 1)
    )


def _source_motion(source: NamedSystem, files: AnimationFiles, fps: float | None) -> ClipData:
    """What the source makes of a clip, as the reference."""
    animation = load_animation(files, to_fit=True)
    if fps is not None:
        clip = edit.resample(animation.clip, fps)
        clip, root = place_root(clip, animation.terrain, animation.root.root, animation.floor)
        animation = replace(animation, clip=clip, root=root)
    with error_context(source.name):
        animation.check_shapes(source.ik)
        _, solved = animation.solve(source.ik)
    solved = replace(solved, source=f"{source.name} on {animation.clip.source}")
    return ClipData(solved, animation.clip, animation.terrain, animation.root)


def _check_moves(source: NamedSystem, problem: Problem[jaxik.FootIK]) -> None:
    """Raises ValueError if the source leaves every clip as it is."""
    for scene in problem.data:
        corrections = difference.correction(scene)
        if any(series.max() > difference.NEGLIGIBLE for series in corrections.values()):
            return
    raise ValueError(f"{source.name} moves nothing in these clips: there is nothing to reproduce")


def starting_point(problem: Problem[jaxik.FootIK]) -> np.ndarray:
    """Where the search starts, (free,) in u: the target's values, improved one by one.

    Far from the source, a descent makes each parameter do the work of another one. Moving single
    values over their ranges first does not.
    """
    u = np.asarray(problem.space.pack({}))
    with activity.announced("Moving single parameters over their ranges"):
        cost = float(evaluate(problem, u[None]).cost[0])
        search = Search(problem, SearchSettings(min_sweep_gain=MIN_SWEEP_GAIN))
        state = SearchState.at(u, cost)
        for _ in range(MAX_SWEEPS):
            before = state.point
            state = sweep(search, state)
            if state.point is before:
                break
    return state.point.u


def is_translation(run: Path) -> bool:
    """Whether the folder of a run holds a translation."""
    return (run / SOURCE).is_file()


def check_folder(run: Path) -> None:
    """Checks that a translation can be made here: in a new folder, or where one is unfinished.

    Raises:
        ValueError: the folder holds something else, or cannot be made.
    """
    if not (is_translation(run) and (run / run_folder.SEARCH).is_file()):
        run_folder.check_new_folder(run)


def save_source(run: Path, translation: Translation) -> None:
    """Starts the folder of the run with the source's parameters, which name it, and its motion."""
    run.mkdir(parents=True, exist_ok=True)
    source = translation.source
    files.write_text(run / SOURCE, parameter_files.system_to_toml(source.ik, source.preset))
    for entry, data in zip(translation.experiment.clips, translation.clips, strict=True):
        motion = data.reference
        clips.save_clip(entry.reference, motion, joints=clip_frames.positions_by_role(motion))
