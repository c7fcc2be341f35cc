"""Experiment files: what is fitted to what, read from TOML and turned into a `Problem`.

preset = "record"                    # a function of jaxik.presets
rules.pelvis = "SupportPelvis"       # rules that differ from the preset's, by stage
[[clips]]
reference = "walk.npz"               # the captured motion; paths are relative to the file
base = "walk_base.npz"               # the flat animation; without it `base.flatten_clip` makes one
terrain = "course.ply"
[parameters]                         # fixed values that differ from the preset's
lock.enabled = true
[free]                               # {} takes range, prior and scale from the rule
pelvis.on_gain = {}
contact.planted_height = { low = 0.05, high = 0.2 }
[sigmas]
ankle = 0.02
[[without]]                          # see `variants`
name = "locks"
parameters = { lock.enabled = false }
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np

import jaxik
from fitting.datasets import clip_frames, clips
from fitting.datasets.clips import edit
from fitting.datasets.flat_animation import flatten_clip, load_flat_animation
from fitting.datasets.terrain import mesh_files
from fitting.inference.sampling import posterior
from fitting.problem.free_parameters import FreeParameter, free_parameter
from fitting.problem.loss import Loss
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Reference, Scene, Sigmas
from fitting.problem.space import make_space
from fitting.runtime import validation
from fitting.runtime.validation import check_table, flatten
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import Terrain

from .ablations import Variant, read_variants
from .systems import free_table, name_preset, with_parameters, with_rules

SIGMAS = {  # defaults: what a good fit of captured motion leaves
    "ankle": 0.02,  # m
    "knee": 0.03,  # m
    "pelvis": 0.02,  # m
    "foot": 0.10,  # rad
    "body": float("inf"),  # rad
    "contact": float("inf"),
    "smooth": float("inf"),  # m/s²
    "correlation": 0.0,
}


@dataclass(frozen=True)
class ClipEntry:
    """One clip of an experiment."""

    reference: Path
    terrain: Path
    base: Path | None = None
    truth: Path | None = None  # known parameters of a made clip, for the report
    start: float = 0.0  # s
    end: float | None = None  # s
    file_up: str = "y"  # of the terrain
    label: str = "captured"  # what pictures call the reference
    mask_pops: bool = True  # leaves out frames in which a captured marker jumps


@dataclass(frozen=True)
class FitOptions:
    """How long the solver may go on."""

    starts: int = 1
    max_steps: int = 1000  # of Levenberg–Marquardt, from each start


@dataclass(frozen=True)
class SampleOptions:
    """How long the sampler may go on."""

    walkers: int | None = None
    max_steps: int = 20_000
    thin_by: int = 1
    stop_at: float = 50.0  # autocorrelation times


@dataclass(frozen=True)
class Experiment:
    """What is fitted to what."""

    path: Path
    clips: tuple[ClipEntry, ...]
    free: Mapping[str, Mapping[str, Any]]
    preset: str = "record"
    name: str = ""
    fps: float | None = None  # clips are resampled to it
    loss: Loss = "squares"
    independent_every: float = 0.0  # s, apart that residuals tell something new; 0 if all do
    seed: int = 0
    rules: Mapping[str, str] = field(default_factory=dict)  # that differ from the preset's
    parameters: Mapping[str, Any] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    fit: FitOptions = FitOptions()
    sample: SampleOptions = SampleOptions()
    without: tuple[Variant, ...] = ()  # what `contribution` leaves out in turn


# What the tables of the file hold.
FILES = ("reference", "terrain", "base", "truth")
CLIP: dict[str, validation.Constraint] = dict.fromkeys((*FILES, "label"), validation.TEXT)
CLIP |= {
    "start": validation.SECONDS,
    "end": validation.SECONDS,
    "file_up": validation.one_of(("y", "z")),
}
CLIP |= {"mask_pops": validation.BOOLEAN}
SIGMA = dict.fromkeys(SIGMAS, validation.POSITIVE) | {"correlation": validation.FRACTION}
FIT = {"starts": validation.COUNT, "max_steps": validation.COUNT}
SAMPLE: dict[str, validation.Constraint] = dict.fromkeys(
    ("walkers", "max_steps", "thin_by"), validation.COUNT
)
SAMPLE |= {"stop_at": validation.POSITIVE}
TOP: dict[str, validation.Constraint] = {
    "name": validation.TEXT,
    "preset": validation.TEXT,
    "loss": validation.one_of(get_args(Loss)),
}
TOP |= {
    "fps": validation.FINITE_POSITIVE,
    "seed": validation.SEED,
    "independent_every": validation.SECONDS,
}
TOP |= dict.fromkeys(("free", "rules", "parameters", "sigmas", "fit", "sample"), validation.TABLE)
TOP |= {
    name: validation.Constraint(
        f"[[{name}]], one for each {each}", lambda made: isinstance(made, list)
    )
    for name, each in (("clips", "clip"), ("without", "variant"))
}


def load_experiment(path: str | Path) -> Experiment:
    """Reads an experiment file.

    Raises:
        ValueError: a file that is not there or no TOML; an unknown key, with the nearest known one;
            a value of the wrong kind; a clip or terrain that is not there.
    """
    path = Path(path)
    return parse_experiment(validation.read_toml(path, "an experiment"), path)


def parse_experiment(content: Mapping[str, Any], path: Path) -> Experiment:
    """The experiment in a TOML table; relative paths are meant from beside `path`."""
    check_table(content, TOP, f"{path}")
    for key in ("clips", "free"):
        if not content.get(key):
            raise ValueError(f"{path}: there is no [{key}]; an experiment has at least one of them")
    with validation.error_context(path):
        ik = name_preset(content.get("preset", "record"))
    ik = with_rules(ik, content.get("rules", {}), f"{path} [rules]")
    check_table(content.get("sigmas", {}), SIGMA, f"{path} [sigmas]")
    made = dict(content)
    made["clips"] = tuple(_entry(entry, path) for entry in content["clips"])
    made["free"] = free_table(content["free"], f"{path} [free]")
    made["parameters"] = flatten(content.get("parameters", {}), 2)
    made["without"] = read_variants(content.get("without", []), ik, f"{path} [[without]]")
    made["fit"] = FitOptions(**check_table(content.get("fit", {}), FIT, f"{path} [fit]"))
    sample = check_table(content.get("sample", {}), SAMPLE, f"{path} [sample]")
    made["sample"] = SampleOptions(**sample)
    if "walkers" in sample:
        with validation.error_context(f"{path} [sample]"):
            posterior.check_walkers(len(made["free"]), sample["walkers"])
    made.setdefault("name", path.stem)
    return Experiment(path=path, **made)


def with_max_steps(experiment: Experiment, max_steps: int) -> Experiment:
    """The experiment with another limit to its sampling."""
    if max_steps < 1:
        raise ValueError(f"max-steps is {max_steps}; wanted 1 or more")
    return replace(experiment, sample=replace(experiment.sample, max_steps=max_steps))


def bare_system(experiment: Experiment) -> jaxik.FootIK:
    """The preset with the experiment's rules."""
    ik = name_preset(experiment.preset)
    return with_rules(ik, experiment.rules, f"{experiment.path} [rules]")


def system(experiment: Experiment) -> jaxik.FootIK:
    """The preset with the experiment's rules and fixed parameters."""
    ik = bare_system(experiment)
    return with_parameters(ik, experiment.parameters, f"{experiment.path} [parameters]")


def free_parameters(experiment: Experiment, ik: jaxik.FootIK) -> list[FreeParameter]:
    """The free parameters as the experiment and the rules declare them."""
    with validation.error_context(f"{experiment.path} [free]"):
        return [free_parameter(ik, name, **options) for name, options in experiment.free.items()]


def load_pair(entry: ClipEntry, fps: float | None) -> tuple[clips.Clip, clips.Clip, Terrain]:
    """The reference clip, its flat base and the terrain, over the same frames."""
    ground = mesh_files.load_terrain(entry.terrain, file_up=entry.file_up)
    captured = clips.load_clip(entry.reference)
    if entry.mask_pops:
        with validation.error_context(entry.reference):
            captured = edit.mask_pops(captured)  # at its own rate: a pop is shorter than others
    reference = _cut(captured, entry.reference, entry, fps)
    if entry.base is None:
        return reference, flatten_clip(reference, mesh_files.height_function(ground)), ground
    base = _cut(load_flat_animation(entry.base), entry.base, entry, fps)
    ours, theirs = (
        f"{one.frames} frames at {one.fps:g} Hz of the legs {list(one.rig.names)}"
        for one in (base, reference)
    )
    if ours != theirs:
        raise ValueError(f"{entry.base}: the base has {ours}; the reference has {theirs}")
    return reference, base, ground


def _cut(clip: clips.Clip, path: Path, entry: ClipEntry, fps: float | None) -> clips.Clip:
    with validation.error_context(path):
        clip = edit.trim(clip, entry.start, entry.end)
    return clip if fps is None else edit.resample(clip, fps)


def make_scene(
    reference: clips.Clip,
    base: clips.Clip,
    ground: Terrain,
    sigmas: Mapping[str, float],
    label: str = "captured",
) -> Scene:
    """The data of one clip; `label` is what pictures call the reference."""
    animation = clip_frames.frames_from_clip(base)
    pelvis = _joint_ws(base, base.rig.pelvis)
    legs = reference.leg_pose_ws()
    stance = reference.stance
    labels = np.zeros(legs.ankle.pos.shape[:2]) if stance is None else stance.astype(float)
    seen = np.ones(reference.frame_count, bool) if reference.mask is None else reference.mask
    given = SIGMAS | dict(sigmas)
    if stance is None:
        given["contact"] = float("inf")
    return Scene(
        rig=base.rig,
        terrain=ground,
        frames=animation,
        pelvis=_seen_from(animation.world_from_model, pelvis),
        reference=Reference(
            pelvis=_joint_ws(reference, reference.rig.pelvis),
            knee_ws=legs.knee.pos,
            ankle=legs.ankle,
            contact=jax.device_put(labels),
            observed=jax.device_put(seen),
            label=label,
        ),
        sigmas=Sigmas(**{name: jax.device_put(np.float64(value)) for name, value in given.items()}),
    )


def _joint_ws(clip: clips.Clip, joint: int) -> Transform:
    places = clip.positions_ws[:, joint], clip.rotations_ws[:, joint]
    return Transform(*jax.device_put(places))


@jax.jit  # outside jit one program, not twelve
def _seen_from(world: Transform, joint: Transform) -> Transform:
    return world.inverse() @ joint


def make_problem(experiment: Experiment) -> Problem:
    """What the solver and the sampler work on.

    Raises:
        ValueError: for anything in the experiment that does not fit its clips or its preset.
    """
    return problem_of(experiment, (load_pair(one, experiment.fps) for one in experiment.clips))


def problem_of(
    experiment: Experiment, pairs: Iterable[tuple[clips.Clip, clips.Clip, Terrain]]
) -> Problem:
    """The problem of clips that need not be files: for each the reference, its base, the terrain.

    Raises:
        ValueError: as `make_problem`.
    """
    ik = system(experiment)
    frees = free_parameters(experiment, ik)
    with validation.error_context(f"{experiment.path} [free]"):
        space = make_space(ik, frees)
    made = []
    for entry, pair in zip(experiment.clips, pairs, strict=True):
        scene = make_scene(*pair, experiment.sigmas, entry.label)
        with validation.error_context(f"{experiment.path} [parameters]"):
            check_shapes(ik, scene.rig, scene.terrain, scene.frames)
        made.append(scene)
    times = np.concatenate([np.asarray(scene.frames.dt) for scene in made])
    share = min(1.0, float(times.mean()) / max(experiment.independent_every, 1e-9))
    return Problem(space, tuple(made), residuals_of_scenes, experiment.loss, share)


def check_shapes(ik: jaxik.FootIK, rig: jaxik.Rig, ground: Terrain, motion: jaxik.Frame) -> None:
    """ValueError where a parameter has another number of values than the rig has legs."""
    several = {
        f"{stage}.{one.name}": getattr(part, one.name).shape
        for stage, part in vars(ik).items()
        for one in fields(part)
        if getattr(part, one.name).shape != getattr(type(part)(), one.name).shape
    }
    if not several:
        return  # the usual case, which need not wait for a trace
    try:
        jax.eval_shape(jaxik.run, ik, rig, ground, motion)
    except (TypeError, ValueError):
        told = ", ".join(f"{name} has {shape[0]} values" for name, shape in several.items())
        raise ValueError(
            f"{told}; wanted one for all legs or, where legs may differ, {len(rig.side)} for the "
            f"legs {list(rig.names)}"
        ) from None


def _entry(given: Any, path: Path) -> ClipEntry:
    table = check_table(given, CLIP, f"{path} [[clips]]")
    made: dict[str, Any] = dict(table)
    for key in ("reference", "terrain"):
        if key not in table:
            raise ValueError(f"{path} [[clips]]: there is no {key}; it needs reference and terrain")
    for key in FILES:
        if key in table:
            made[key] = (path.parent / table[key]).resolve()
            if not made[key].is_file():
                why = validation.why_missing(made[key])
                raise ValueError(f"{path} [[clips]]: {key} {table[key]!r}: {why}")
    return ClipEntry(**made)
