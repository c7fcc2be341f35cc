"""Builds an experiment of objects: clips, terrains, a system with any rules, free parameters."""

from pathlib import Path
from typing import Any

import jaxik
from fitting.datasets.clips import Clip
from fitting.experiments.experiment import ClipEntry, Experiment, LoadedFiles
from fitting.experiments.record_only import restrict
from fitting.experiments.systems import (
    DEFAULT_PRESET,
    Preset,
    all_presets,
    changed_rules,
    own_root,
)
from fitting.runtime.precision import in_float64
from jaxik.world.terrain import Terrain

from .selectors import Free, free_table

PATH = Path("experiment")  # that messages name
OF_FILES = (
    "file_up", "joints", "scale", "up", "asf", "animation", "travel", "sole", "terrain_scale",
    "terrain_offset", "terrain_cell",
)  # fmt: skip
"""Keys of a clip that say how its files are read."""


def clip_entry(
    reference: Clip, terrain: Terrain, base: Clip | None = None, **keys: Any
) -> ClipEntry:
    """A clip of an experiment, in memory.

    Args:
        reference: the captured motion.
        terrain: the ground under it.
        base: the flat animation, its legs as in `load_flat_animation` or not; None makes one from
            the reference.
        keys: others of `ClipEntry`, such as `start`, `end`, `root` or `subject`.

    Raises:
        ValueError: a key says how files are read.
    """
    if unused := [key for key in OF_FILES if key in keys]:
        raise ValueError(f"{unused} say how files are read; a clip in memory has been read")
    loaded = LoadedFiles(reference, terrain, base)
    names = {"reference": Path(reference.source), "terrain": Path("terrain")}
    flat = None if base is None else Path(base.source)
    return ClipEntry(**names, base=flat, loaded=loaded, **keys)


@in_float64
def make_experiment(
    *clips: ClipEntry, free: Free, system: jaxik.FootIK | str = DEFAULT_PRESET.name, **keys: Any
) -> Experiment:
    """An experiment, with no file on disk; `fitting.fit` and the other jobs take it as any other.

    Args:
        clips: made by `clip_entry`, or of files.
        free: what is fitted: dotted names, or functions that pick leaves of the system, such as
            `lambda ik: ik.pelvis.limit`; a mapping of these has their `low`, `high`, `kind` and
            `scale`.
        system: with any rules; its values are fixed where they are not free. Or the name of a
            preset, for the body of the first clip.
        keys: others of `Experiment`, such as `name`, `sigmas`, `loss` or `fit`.

    Raises:
        ValueError: there is no clip, a preset or parameter does not exist, or a parameter cannot be
            what it is to be.
    """
    if not clips:
        raise ValueError("no clip; wanted one at least, made by clip_entry")
    record_only = keys.pop("record_only", False)
    if isinstance(system, str):
        named = Preset(system, keys.get("faithful", False))
        keys |= {"preset": named.name}
        ik = named.system()
    else:
        ik = system
        nearest = _nearest_preset(ik)
        keys |= {"system": ik, "preset": nearest.name, "faithful": nearest.faithful}
        keys["parameters"] = own_root(ik, nearest.system()) | keys.get("parameters", {})
    table = free_table(free, ik)
    keys = {"path": PATH, "name": PATH.name} | keys
    experiment = Experiment(clips=clips, free=table, **keys)
    experiment.free_parameters(experiment.starting_system())
    return restrict(experiment) if record_only else experiment


def _nearest_preset(ik: jaxik.FootIK) -> Preset:
    """The preset from which a system's rules differ least, which files name."""
    return min(all_presets(), key=lambda preset: len(changed_rules(ik, preset.system())))
