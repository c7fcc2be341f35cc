"""One system's parameters from another's motion.

The source runs on flat animations over terrain; what it makes of them is the reference of an
ordinary experiment, in which the target's parameters are free. The folder is a run like any other,
with these files besides:

source.npz              the source's motion (source_1.npz, ... of several clips)
source.toml             the source's parameters
<preset>.toml           the fitted parameters again, under the name of the target's preset
translation.json        what remains, in numbers
difference.png          what remains, over time
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import jaxik
from fitting.analysis import difference
from fitting.datasets import clip_frames, clips
from fitting.datasets.clips import edit
from fitting.datasets.flat_animation import load_flat_animation
from fitting.datasets.terrain import mesh_files
from fitting.experiments import experiment, parameter_files, systems
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.inference import sensitivity
from fitting.inference.optimisation.population import evaluate
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.optimisation.state import Search, SearchState
from fitting.inference.optimisation.sweep import sweep
from fitting.problem.free_parameters import free_parameter
from fitting.problem.problem import Problem
from fitting.runtime import files, validation
from jaxik.maths import parameter_tree

from . import run_folder
from .comparison import solve

# Nothing is noisy here: these say how far off still counts as the same.
SIGMAS = {
    "ankle": 0.005,  # m
    "knee": 0.005,  # m
    "pelvis": 0.005,  # m
    "foot": 0.03,  # rad
    "body": 0.03,  # rad
}
SWEEPS, GAIN = 20, 0.01  # of the approach: at most so many, each of so much of the cost
SOURCE = "source.toml"


@dataclass(frozen=True)
class System:
    """A system as it was asked for."""

    name: str  # of a preset, or of a parameter file
    preset: str
    ik: jaxik.FootIK


@dataclass(frozen=True)
class Translation:
    """What is to be fitted to what."""

    source: System
    target: System
    experiment: Experiment
    motions: tuple[clips.Clip, ...]  # what the source makes of each clip
    problem: Problem
    chosen: bool  # the free parameters were named, and not found by a sweep

    @property
    def names(self) -> tuple[str, str]:
        """What texts call the source and the target."""
        same = self.source.name == self.target.name
        return f"`{self.source.name}`{' (source)' if same else ''}", f"`{self.target.name}`"


def read_system(given: str, option: str) -> System:
    """The system of a preset's name or of a parameter file.

    Raises:
        ValueError: for a name or a file that is neither.
    """
    path = Path(given)
    if path.suffix.lower() == ".toml":
        ik, preset = parameter_files.load_system(path)
        return System(path.stem, preset, ik)
    with validation.error_context(f"{option} takes a preset or a parameter .toml"):
        return System(given, given, systems.preset_system(given))


def read_free(given: str, ik: jaxik.FootIK) -> dict[str, Mapping[str, Any]]:
    """FreeParameter parameters by name: `name,name`, or the [free] table of a TOML file as experiments have.

    Raises:
        ValueError: for no name, an unknown one, or what it cannot be.
    """
    path = Path(given)
    named: dict[str, Mapping[str, Any]]
    if path.suffix.lower() == ".toml":
        content = validation.read_toml(path, "a free-parameter")
        validation.check_table(content, {"free": validation.TABLE}, given)
        named = systems.read_free_table(content.get("free", {}), f"{given} [free]")
    else:
        named = {one.strip(): {} for one in given.split(",") if one.strip()}
    if not named:
        raise ValueError(f"--free {given}: names no parameter")
    with validation.error_context("--free"):
        for name, options in named.items():
            free_parameter(ik, name, **options)
    return named


def check_place(run: Path) -> None:
    """ValueError where no new folder can be made; an empty one counts as new."""
    run_folder.check_place(run)
    if run.is_dir() and (there := sorted(os.listdir(run))):
        raise ValueError(f"{run}: there is something in it already: {there}; name a new folder")


def plan(
    source: System,
    target: System,
    paths: Sequence[Path],
    terrains: Sequence[Path],
    run: Path,
    *,
    named: Mapping[str, Mapping[str, Any]] | None = None,
    fps: float | None = None,
    file_up: str = "y",
) -> Translation:
    """Runs the source, and says what of the target is to be fitted to it; writes nothing.

    Args:
        source: whose motion is reproduced.
        target: what is not free keeps its values, and what is free starts there.
        paths: clips over flat ground.
        terrains: a mesh for each.
        run: folder that the run is going to have.
        named: free parameters; None takes all that move these clips.
        fps: rate to which clips are resampled first.
        file_up: up axis of the meshes.

    Raises:
        ValueError: as many clips as terrains are wanted; what cannot be read; a source that moves
            nothing, or a target none of whose parameters does.
    """
    if len(paths) != len(terrains) or not paths:
        raise ValueError(
            f"{len(paths)} clip(s) and {len(terrains)} terrain(s); wanted a terrain for each clip"
        )
    run = run.resolve()
    alike = systems.rule_names(source.ik) == systems.rule_names(target.ik)
    truth = run / SOURCE if alike else None
    entries, pairs = [], []
    for i, (path, terrain) in enumerate(zip(paths, terrains, strict=True)):
        name = f"source_{i + 1}.npz" if len(paths) > 1 else "source.npz"
        ground = mesh_files.load_terrain(terrain, file_up=file_up)
        base = load_flat_animation(path)
        base = base if fps is None else edit.resample(base, fps)
        pairs.append((_solved(source, base, ground), base, ground))
        entries.append(
            ClipEntry(
                run / name, terrain.resolve(), path.resolve(), truth, file_up=file_up,
                label=f"source: {source.name}", mask_pops=False,
            )
        )  # fmt: skip
    preset = systems.preset_system(target.preset)
    rules = systems.changed_rules(target.ik, preset)
    asked = Experiment(
        path=run / run_folder.EXPERIMENT,
        clips=tuple(entries),
        free=named or sensitivity.declared(target.ik),
        preset=target.preset,
        name=f"{source.name} to {target.name}",
        fps=fps,
        rules=rules,
        parameters=_changed(target.ik, systems.with_rules(preset, rules, target.name)),
        sigmas=SIGMAS,
    )
    problem = problems.problem_from_clips(asked, pairs)
    _check_moves(source, problem)
    if named is None:
        moving = sensitivity.moving(target.ik, asked.free, problem.data)
        if not moving:
            raise ValueError(f"no parameter of {target.name} moves anything in these clips")
        asked = replace(asked, free={name: asked.free[name] for name in moving})
        problem = problems.problem_from_clips(asked, pairs)
    motions = tuple(reference for reference, _, _ in pairs)
    return Translation(source, target, asked, motions, problem, named is not None)


def _solved(source: System, base: clips.Clip, ground: Any) -> clips.Clip:
    """What the source makes of a clip."""
    motion = clip_frames.frames_from_clip(base)
    with validation.error_context(source.name):
        problems.check_shapes(source.ik, base.rig, ground, motion)
        _, solved = solve(source.ik, base, ground, motion, 0.0)
    return replace(solved, source=f"{source.name} on {base.source}")


def _changed(ik: jaxik.FootIK, preset: jaxik.FootIK) -> dict[str, Any]:
    """Values in which a system differs from its preset, whose rules are the same."""
    values = {name: np.asarray(parameter_tree.get(ik, name)) for name in systems.leaf_names(ik)}
    return {
        name: value.tolist()
        for name, value in values.items()
        if not np.array_equal(value, np.asarray(parameter_tree.get(preset, name)))
    }


def _check_moves(source: System, problem: Problem) -> None:
    """ValueError where the source leaves every clip as it is."""
    for scene in problem.data:
        apart = difference.correction(scene)
        if any(one.max() > difference.NEGLIGIBLE for one in apart.values()):
            return
    raise ValueError(f"{source.name} moves nothing in these clips: there is nothing to reproduce")


def approach(problem: Problem) -> np.ndarray:
    """Where the fit starts, (1, free) in `u`: the target's own values, carried closer one by one.

    Far from the source, slopes lead every parameter into the part of some other; single values
    carried over their ranges do not.
    """
    u = np.asarray(problem.space.pack({}))
    cost = float(evaluate(problem, u[None]).cost[0])
    search = Search(problem, SearchSettings(min_sweep_gain=GAIN))
    state = SearchState.at(u, cost)
    for _ in range(SWEEPS):
        before = state.point
        state = sweep(search, state)
        if state.point is before:
            break
    return state.point.u[None]


def save_source(run: Path, made: Translation) -> None:
    """Begins the folder of the run with the source's motion and parameters."""
    run.mkdir(parents=True, exist_ok=True)
    for entry, motion in zip(made.experiment.clips, made.motions, strict=True):
        clips.save_clip(entry.reference, motion, joints=clip_frames.positions_by_role(motion))
    files.write_text(
        run / SOURCE, parameter_files.system_to_toml(made.source.ik, made.source.preset)
    )
