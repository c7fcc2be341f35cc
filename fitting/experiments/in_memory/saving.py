"""Writes what an experiment has in memory as files, for a folder that has to stand alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fitting.datasets.clips import save_clip
from fitting.datasets.terrain.mesh_files import save_mesh
from fitting.datasets.terrain.meshes import Mesh, mesh_of
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.experiments.systems import (
    OWN_ROOT,
    STAGES,
    Preset,
    changed_rules,
    changed_values,
    leaf_names,
    with_rules,
)
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from jaxik.maths import parameter_tree


@in_float64
def with_files(experiment: Experiment, folder: Path | None) -> Experiment:
    """The experiment with nothing left in memory: with files in a folder, and rules by their names.

    Args:
        experiment: the experiment; as it is if it has nothing in memory.
        folder: where the files are written; None writes none and leaves the experiment as it is.

    Raises:
        ValueError: a terrain is no mesh, or a rule's name is not known; nothing is written then.
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
    rules = changed_rules(ik, preset.system())
    for stage, rule in rules.items():
        if STAGES[stage].get(rule) is not type(getattr(ik, stage)):
            raise ValueError(
                f"{stage}: {rule} is a rule of your own, which a file can name only after "
                "fitting.register_rule"
            )
    values = {name: np.asarray(parameter_tree.get(ik, name)).tolist() for name in leaf_names(ik)}
    usual = with_rules(preset.system(), rules, "rules")
    if OWN_ROOT not in changed_values(ik, usual) and OWN_ROOT not in experiment.parameters:
        values.pop(OWN_ROOT, None)
    parameters = values | parameter_tree.options(ik)
    return replace(experiment, system=None, rules=rules, parameters=parameters)
