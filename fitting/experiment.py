"""Experiment files: what is fitted to what, read from TOML and turned into a `Problem`.

    preset = "record"                    # a function of jaxik.presets
    [[clips]]
    reference = "walk.npz"               # the captured motion; paths are relative to the file
    base = "walk_base.npz"               # the flat animation; without it `base.flat_base` makes one
    terrain = "course.ply"
    [parameters]                         # fixed values that differ from the preset's
    lock.enabled = true
    [free]                               # {} takes range, prior and scale from the rule
    pelvis.on_gain = {}
    contact.planted_height = { low = 0.05, high = 0.2 }
    [sigmas]
    ankle = 0.02
"""

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args

import jax.numpy as jnp
import numpy as np

import jaxik
from jaxik import presets, rule
from jaxik.skeleton import Transform

from . import clips, frames, scenes
from .base import flat_base, load_base
from .clips import edit
from .residuals import Reference, Scene, Sigmas, rows_of_scenes
from .space import Free, Loss, Problem, free, make_space

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


@dataclass(frozen=True)
class FitOptions:
    """How long the solver may go on."""

    starts: int = 1
    max_steps: int = 200


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
    seed: int = 0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    fit: FitOptions = FitOptions()
    sample: SampleOptions = SampleOptions()


def load_experiment(path: str | Path) -> Experiment:
    """Reads an experiment file.

    Raises:
        ValueError: a file that is not there or no TOML; an unknown key, with the nearest known one;
            a value of the wrong kind; a clip or terrain that is not there.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such experiment file")
    try:
        content = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not TOML: {error}") from None
    return parse_experiment(content, path)


def parse_experiment(content: Mapping[str, Any], path: Path) -> Experiment:
    """The experiment in a TOML table; relative paths are meant from beside `path`."""
    known = [one.name for one in fields(Experiment) if one.name != "path"]
    check_keys(content, known, f"{path}")
    for key in ("clips", "free"):
        if not content.get(key):
            raise ValueError(f"{path}: there is no [{key}]; an experiment has at least one of them")
    if not isinstance(content["clips"], list):
        raise ValueError(f"{path}: clips is a table; write [[clips]], one for each clip")
    name_preset(content.get("preset", "record"))
    if (loss := content.get("loss", "squares")) not in get_args(Loss):
        raise ValueError(f"{path}: loss is {loss!r}; it is one of {get_args(Loss)}")
    sigmas = content.get("sigmas", {})
    check_keys(sigmas, list(SIGMAS), f"{path} [sigmas]")
    for key, value in sigmas.items():
        least = -1e-12 if key == "correlation" else 0.0
        if not isinstance(value, int | float) or not value > least:
            raise ValueError(f"{path} [sigmas]: {key} is {value!r}; wanted a number above 0")
    made = dict(content)
    made["clips"] = tuple(_entry(entry, path) for entry in content["clips"])
    made["free"] = {name: _table(v, path, name) for name, v in flat(content["free"], 2).items()}
    made["parameters"] = flat(content.get("parameters", {}), 2)
    made["fit"] = _options(FitOptions, content.get("fit", {}), f"{path} [fit]")
    made["sample"] = _options(SampleOptions, content.get("sample", {}), f"{path} [sample]")
    made.setdefault("name", path.stem)
    return Experiment(path=path, **made)


def flat(tables: Mapping[str, Any], depth: int, prefix: str = "") -> dict[str, Any]:
    """Nested TOML tables as dotted names, `depth` parts each: `lock.enabled`."""
    found: dict[str, Any] = {}
    for key, value in tables.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and name.count(".") + 1 < depth:
            found |= flat(value, depth, f"{name}.")
        else:
            found[name] = value
    return found


def check_keys(given: Mapping[str, Any], known: list[str], where: str) -> None:
    """ValueError for a key that is not known, with the nearest one that is."""
    for key in given:
        if key not in known:
            nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise ValueError(f"{where}: unknown key {key!r}; nearest is {nearest!r} of {known}")


def name_preset(name: str) -> jaxik.FootIK:
    """The preset of this name; ValueError with the list of names."""
    known = sorted(n for n, made in vars(presets).items() if _makes_ik(made))
    if name not in known:
        raise ValueError(f"no preset named {name!r}; there are {known}")
    return getattr(presets, name)()


def _makes_ik(made: Any) -> bool:
    return getattr(made, "__module__", "") == presets.__name__ and callable(made)


def with_max_steps(experiment: Experiment, max_steps: int) -> Experiment:
    """The experiment with another limit to its sampling."""
    if max_steps < 1:
        raise ValueError(f"max-steps is {max_steps}; wanted 1 or more")
    return replace(experiment, sample=replace(experiment.sample, max_steps=max_steps))


def system(experiment: Experiment) -> jaxik.FootIK:
    """The preset with the experiment's fixed parameters."""
    ik = name_preset(experiment.preset)
    return with_parameters(ik, experiment.parameters, f"{experiment.path} [parameters]")


def with_parameters(ik: jaxik.FootIK, values: Mapping[str, Any], where: str) -> jaxik.FootIK:
    """The system with these values by dotted name, switches included; ValueError for a wrong one."""
    leaves = leaf_names(ik)
    check_keys(values, leaves, where)
    for name, value in values.items():
        old = rule.get(ik, name)
        new = np.asarray(value)
        if new.dtype.kind not in ("b" if old.dtype == bool else "if") or np.isnan(new).any():
            kind = "true or false" if old.dtype == bool else "a number"
            raise ValueError(f"{where}: {name} is {value!r}; wanted {kind}")
        if new.shape != old.shape and new.ndim != 1:
            raise ValueError(f"{where}: {name} has shape {new.shape}; wanted {old.shape}")
    return rule.replace(ik, dict(values))


def leaf_names(ik: jaxik.FootIK) -> list[str]:
    """Dotted names of all parameters, conventions and switches of a system."""
    return [f"{stage}.{one.name}" for stage, part in vars(ik).items() for one in fields(part)]


def free_parameters(experiment: Experiment, ik: jaxik.FootIK) -> list[Free]:
    """The free parameters as the experiment and the rules declare them."""
    try:
        return [free(ik, name, **options) for name, options in experiment.free.items()]
    except ValueError as error:
        raise ValueError(f"{experiment.path} [free]: {error}") from None


def load_pair(entry: ClipEntry, fps: float | None) -> tuple[clips.Clip, clips.Clip, Any]:
    """The reference clip, its flat base and the terrain, over the same frames."""
    ground = scenes.load_terrain(entry.terrain, file_up=entry.file_up)
    reference = edit.mask_pops(_cut(clips.load_clip(entry.reference), entry, fps))
    if entry.base is None:
        return reference, flat_base(reference, scenes.heights(ground)), ground
    base = _cut(load_base(entry.base), entry, fps)
    if base.frames != reference.frames or len(base.rig.side) != len(reference.rig.side):
        raise ValueError(
            f"{entry.base}: the base has {base.frames} frames and {len(base.rig.side)} legs, "
            f"the reference {reference.frames} and {len(reference.rig.side)}"
        )
    return reference, base, ground


def _cut(clip: clips.Clip, entry: ClipEntry, fps: float | None) -> clips.Clip:
    clip = edit.trim(clip, entry.start, entry.end)
    return clip if fps is None else edit.resample(clip, fps)


def make_scene(
    reference: clips.Clip, base: clips.Clip, ground: Any, sigmas: Mapping[str, float]
) -> Scene:
    """The data of one clip."""
    animation = frames.frames_of(base)
    pelvis = _joint_ws(base, base.rig.pelvis)
    legs = reference.leg_pose_ws()
    stance = reference.stance
    labels = np.zeros(legs.ankle.pos.shape[:2]) if stance is None else stance.astype(float)
    seen = np.ones(reference.frames, bool) if reference.mask is None else reference.mask
    given = SIGMAS | dict(sigmas)
    if stance is None:
        given["contact"] = float("inf")
    return Scene(
        rig=base.rig,
        terrain=ground,
        frames=animation,
        pelvis=animation.world_from_model.inverse() @ pelvis,
        reference=Reference(
            pelvis=_joint_ws(reference, reference.rig.pelvis),
            knee_ws=legs.knee.pos,
            ankle=legs.ankle,
            contact=jnp.asarray(labels),
            seen=jnp.asarray(seen),
        ),
        sigmas=Sigmas(**{name: jnp.asarray(value, float) for name, value in given.items()}),
    )


def _joint_ws(clip: clips.Clip, joint: int) -> Transform:
    return Transform(
        jnp.asarray(clip.positions_ws[:, joint]), jnp.asarray(clip.rotations_ws[:, joint])
    )


def make_problem(experiment: Experiment) -> Problem:
    """What the solver and the sampler work on.

    Raises:
        ValueError: for anything in the experiment that does not fit its clips or its preset.
    """
    ik = system(experiment)
    space = make_space(ik, free_parameters(experiment, ik))
    made = []
    for entry in experiment.clips:
        made.append(make_scene(*load_pair(entry, experiment.fps), experiment.sigmas))
    return Problem(space, tuple(made), rows_of_scenes, experiment.loss)


def _entry(given: Any, path: Path) -> ClipEntry:
    table = _table(given, path, "[[clips]]")
    known = [one.name for one in fields(ClipEntry)]
    check_keys(table, known, f"{path} [[clips]]")
    made: dict[str, Any] = dict(table)
    for key in ("reference", "terrain"):
        if key not in table:
            raise ValueError(f"{path} [[clips]]: there is no {key}; it needs reference and terrain")
    for key in ("reference", "terrain", "base", "truth"):
        if key in table:
            made[key] = (path.parent / str(table[key])).resolve()
            if not made[key].is_file():
                raise ValueError(f"{path} [[clips]]: {key} {table[key]!r}: no such file")
    return ClipEntry(**made)


def _options(kind: type, given: Any, where: str) -> Any:
    if not isinstance(given, Mapping):
        raise ValueError(f"{where}: is {given!r}; wanted a table")
    check_keys(given, [one.name for one in fields(kind)], where)
    for key, value in given.items():
        if not isinstance(value, int | float) or not value > 0:
            raise ValueError(f"{where}: {key} is {value!r}; wanted a number above 0")
    return kind(**given)


def _table(given: Any, path: Path, name: str) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise ValueError(f"{path}: {name} is {given!r}; wanted a table, such as {{}}")
    return given
