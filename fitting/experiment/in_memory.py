"""Builds an experiment of objects: clips, terrains, a system with any rules, free parameters."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np

import jaxik
from fitting.clips import Clip, save_clip
from fitting.clips.load import ClipOptions
from fitting.ground.meshes import Mesh, TerrainOptions, mesh_of, save_mesh
from fitting.inference.sensitivity import FreeTable
from fitting.runtime.declarations import keys
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from jaxik.maths import parameter_tree
from jaxik.world.terrain import Terrain

from . import systems
from .experiment import ClipEntry, Experiment, LoadedFiles
from .record_files import restrict
from .systems import DEFAULT_PRESET, OWN_ROOT, Preset

Selector: TypeAlias = Callable[[Any], object]  # of a system; its rules have leaves of their own
Choice: TypeAlias = str | Selector
Free: TypeAlias = Choice | Iterable[Choice] | Mapping[Choice, Mapping[str, float | str]]
"""A name or a selector, or several; a mapping has what overrides the declaration of each."""


PATH = Path("experiment")  # that messages name
OF_FILES = {*keys(ClipOptions), *keys(TerrainOptions)}  # say how the files of a clip are read


@in_float64
def with_files(experiment: Experiment, folder: Path | None) -> Experiment:
    """The experiment with nothing left in memory: with files in a folder, and rules by their names.

    Without a folder it stays as it is.

    Raises:
        ValueError: a terrain is not a mesh, or a rule's name is not known; nothing is written then.
    """
    if folder is None:
        return experiment
    meshes = [None if entry.loaded is None else _mesh(entry) for entry in experiment.clips]
    if experiment.system is not None:
        experiment = _with_named_rules(experiment)
    if not any(meshes):
        return experiment
    folder.mkdir(parents=True, exist_ok=True)
    several = len(experiment.clips) > 1
    clips = tuple(
        entry if mesh is None else _saved(entry, folder, f"_{number}" if several else "", mesh)
        for number, (entry, mesh) in enumerate(zip(experiment.clips, meshes, strict=True), 1)
    )
    return replace(experiment, clips=clips)


def _mesh(entry: ClipEntry) -> Mesh:
    assert entry.loaded is not None
    with error_context(f"{entry.reference}: its terrain cannot be saved; fit without an output"):
        return mesh_of(entry.loaded.terrain)


def _saved(entry: ClipEntry, folder: Path, ending: str, mesh: Mesh) -> ClipEntry:
    """The entry with its clips and its terrain as files."""
    assert entry.loaded is not None
    folder = folder.resolve()
    reference, terrain = folder / f"captured{ending}.npz", folder / f"terrain{ending}.ply"
    save_clip(reference, entry.loaded.reference)
    save_mesh(terrain, *mesh)
    base = None if entry.loaded.base is None else folder / f"animation{ending}.npz"
    if base is not None and entry.loaded.base is not None:
        save_clip(base, entry.loaded.base)
    return replace(entry, reference=reference, terrain=terrain, base=base, loaded=None)


def _with_named_rules(experiment: Experiment) -> Experiment:
    """The experiment with preset, rules and parameters instead of a system."""
    ik, preset = experiment.starting_system(), Preset(experiment.preset, experiment.faithful)
    rules = systems.changed_rules(ik, preset.system())
    for stage, rule in rules.items():
        if systems.STAGES[stage].get(rule) is not type(getattr(ik, stage)):
            raise ValueError(
                f"{stage}: {rule} is a rule of your own, which a file can name only after "
                "fitting.register_rule"
            )
    names = systems.leaf_names(ik)
    values = {name: np.asarray(parameter_tree.get(ik, name)).tolist() for name in names}
    usual = systems.with_rules(preset.system(), rules, "rules")
    changed = systems.changed_values(ik, usual)
    if OWN_ROOT not in changed and OWN_ROOT not in experiment.parameters:
        values.pop(OWN_ROOT, None)
    parameters = values | parameter_tree.options(ik)
    return replace(experiment, system=None, rules=rules, parameters=parameters)


class _Name(str):
    """The dotted name of a leaf, in its place in a system; an index names the value of one leg."""

    def __getitem__(self, leg: object) -> "_Name":
        return _Name(f"{self}[{leg}]")


def free_table(free: Free, ik: jaxik.FootIK) -> FreeTable:
    """Free parameters by dotted name, with overrides of their declaration.

    Args:
        free: names, functions that pick one or several leaves of a system, or both.
        ik: the system.

    Raises:
        ValueError: nothing is named, or a function picks something else.
    """
    if isinstance(free, str) or callable(free):
        free = [free]
    entries = free.items() if isinstance(free, Mapping) else ((entry, {}) for entry in free)
    table = {name: dict(overrides) for entry, overrides in entries for name in _names(entry, ik)}
    if not table:
        raise ValueError("free: names no parameter; wanted one at least")
    return table


def _names(entry: Choice, ik: jaxik.FootIK) -> list[str]:
    """The dotted names of what an entry picks."""
    if isinstance(entry, str):
        return [entry]
    leaves, structure = jax.tree_util.tree_flatten_with_path(ik)
    names = [_Name(jax.tree_util.keystr(path).removeprefix(".")) for path, _ in leaves]
    wanted = "wanted a function that picks leaves, as lambda ik: ik.pelvis.limit"
    try:
        picked = jax.tree.leaves(entry(jax.tree_util.tree_unflatten(structure, names)))
    except (AttributeError, TypeError) as error:
        raise ValueError(f"free: {error}; {wanted}") from None
    if not picked or not all(isinstance(name, _Name) for name in picked):
        raise ValueError(f"free: a function picks {picked}; {wanted}")
    return [str(name) for name in picked]


def clip_entry(
    reference: Clip, terrain: Terrain, base: Clip | None = None, **others: Any
) -> ClipEntry:
    """A clip of an experiment, in memory.

    Args:
        reference: the captured motion.
        terrain: the ground under it.
        base: the flat animation, its legs as in `load_flat_animation` or not; None makes one from
            the reference.
        others: fields of `ClipEntry`, such as `start`, `end`, `root` or `subject`.

    Raises:
        ValueError: a key says how files are read.
    """
    if unused := sorted(OF_FILES & others.keys()):
        raise ValueError(f"{unused} say how files are read; a clip in memory has been read")
    loaded = LoadedFiles(reference, terrain, base)
    names = {"reference": Path(reference.source), "terrain": Path("terrain")}
    flat = None if base is None else Path(base.source)
    return ClipEntry(**names, base=flat, loaded=loaded, **others)


@in_float64
def make_experiment(
    *clips: ClipEntry, free: Free, system: jaxik.FootIK | str = DEFAULT_PRESET.name, **others: Any
) -> Experiment:
    """An experiment, with no file on disk, for `fitting.fit` and the other jobs.

    Args:
        clips: made by `clip_entry`, or of files.
        free: dotted names, or functions that pick leaves of the system, such as
            `lambda ik: ik.pelvis.limit`; a mapping of these has their `low`, `high`, `kind` and
            `scale`.
        system: with any rules; its values are fixed where they are not free. Or the name of a
            preset, for the body of the first clip.
        others: others of `Experiment`, such as `name`, `sigmas`, `loss` or `fit`.

    Raises:
        ValueError: there is no clip, a preset or parameter does not exist, or a parameter cannot be
            free in this way.
    """
    if not clips:
        raise ValueError("no clip; wanted one at least, made by clip_entry")
    record_only = others.pop("record_only", False)
    if isinstance(system, str):
        named = Preset(system, others.get("faithful", False))
        others |= {"preset": named.name}
        ik = named.system()
    else:
        ik = system
        nearest = _nearest_preset(ik)
        others |= {"system": ik, "preset": nearest.name, "faithful": nearest.faithful}
        others["parameters"] = systems.own_root(ik, nearest.system()) | others.get("parameters", {})
    table = free_table(free, ik)
    others = {"path": PATH, "name": PATH.name} | others
    experiment = Experiment(clips=clips, free=table, **others)
    experiment.free_parameters(experiment.starting_system())
    return restrict(experiment) if record_only else experiment


def _nearest_preset(ik: jaxik.FootIK) -> Preset:
    """The preset from which a system's rules differ least, which files name."""
    return min(
        systems.all_presets(), key=lambda preset: len(systems.changed_rules(ik, preset.system()))
    )
