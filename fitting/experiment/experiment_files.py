"""Experiment files: TOML, checked key by key.

preset = "record"                    # a function of jaxik.presets
faithful = true                      # the original, where the preset differs from it
body = "clip"                        # its defaults: for the first clip's rig, or for the "adult"
record_only = true                   # leave out what the game's record has no room for
written_in = "/runs/walk"            # where paths start that lead nowhere from this file: of runs
rules.pelvis = "SupportPelvis"       # rules that differ from the preset's, by stage
[[clips]]
reference = "walk.npz"               # the captured motion; paths are relative to this file
base = "walk_base.npz"               # the flat animation; left out, one is made from the reference
terrain = "course.ply"
joints = "map.toml"                  # and scale, up, asf: how clips are read where it is not known
terrain_scale = 0.01                 # and terrain_offset, terrain_cell, file_up: likewise
[parameters]                         # fixed values that differ from the preset's
lock.enabled = true
[free]                               # {} takes range and scale from the rule
pelvis.on_gain = {}
contact.planted_height = { low = 0.05, high = 0.2 }
[capture]                            # what of the captures is fitted, too; see `captures`
ground_height = {}
[prior]                              # see `experiment.file_tables`, also for [start]
spread = 1.6
[sigmas]
ankle = 0.02
[noise]                              # which of its properties are estimated
sigmas = "estimated"
[fit.search]                         # overrides settings of the search, see `SearchSettings`
final_sweeps = 12
[[without]]                          # see `ablations`
name = "locks"
parameters = { lock.enabled = false }
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w

from fitting.clips.joint_maps import check_joint_map, read_joint_map
from fitting.inference.noise import NoiseOptions
from fitting.inference.optimise.solution import MAX_STARTS, SearchSettings
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.settings import Setting, Settings, describe
from fitting.runtime import validation
from fitting.runtime.files import relative_path
from fitting.runtime.validation import (
    Content,
    Table,
    check_table,
    flatten,
    nest,
    with_floats,
)

from . import file_tables
from .experiment import DEFAULT_SIGMAS, ClipEntry, Experiment, FitOptions
from .file_tables import (
    hierarchy_to_table,
    priors_to_table,
    read_ablations,
    read_hierarchy,
    read_priors,
    read_start,
)
from .record_files import restrict
from .schema import (
    CLIP_KEYS,
    CORRELATIONS,
    FILE_KEYS,
    FIT_KEYS,
    KINDS,
    NOISE_KEYS,
    SAMPLE_KEYS,
    SEARCH_KEYS,
    SIGMA_KEYS,
    TOP_KEYS,
)
from .systems import DEFAULT_PRESET, preset_system, read_free_table, with_rules

USUAL_SAMPLE_KEYS = ("walkers", "max_steps", "thin_by", "stop_at")  # always written


def load_experiment(path: str | Path) -> Experiment:
    """Reads an experiment file.

    Raises:
        ValueError: the file does not exist or is not TOML; a key is unknown (the message names the
            nearest known one); a value has the wrong type; a clip or terrain does not exist.
    """
    path = Path(path)
    return parse_experiment(validation.read_toml(path, "an experiment"), path)


def parse_experiment(content: Table, path: Path) -> Experiment:
    """The experiment in a TOML table; relative paths start from the folder of `path`.

    Where one leads nowhere, it starts from where the file was written, if the table says so.
    """
    check_table(content, TOP_KEYS, f"{path}")
    if not content.get("clips"):
        raise ValueError(f"{path}: there is no [[clips]]; an experiment has at least one of them")
    if "free" not in content:
        raise ValueError(f"{path}: there is no [free]; it may be empty, where nothing is fitted")
    with validation.error_context(path):
        ik = preset_system(
            content.get("preset", DEFAULT_PRESET.name), faithful=content.get("faithful", False)
        )
    ik = with_rules(ik, content.get("rules", {}), f"{path} [rules]")
    sigmas = flatten(content.get("sigmas", {}), 2)
    check_table(sigmas, SIGMA_KEYS, f"{path} [sigmas]")
    if all((DEFAULT_SIGMAS | sigmas)[kind] == math.inf for kind in KINDS):
        raise ValueError(f"{path} [sigmas]: all of {list(KINDS)} are inf; wanted one that is not")
    free = read_free_table(content["free"], f"{path} [free]")
    without = read_ablations(content.get("without", []), ik, f"{path} [[without]]")
    places = Places(path, content.get("written_in"))
    clips = tuple(read_clip(entry, places) for entry in content["clips"])
    capture = file_tables.read_capture(content.get("capture", {}), len(clips), f"{path} [capture]")
    known = [*free, *(name for ablation in without for name in ablation.free)]
    known = list(dict.fromkeys([*known, *file_tables.known_names(capture, len(clips))]))
    count = len(free) + len(file_tables.free_table(capture, len(clips)))
    subjects, hierarchy = [clip.subject for clip in clips], content.get("hierarchy", {})
    tables = {
        "clips": clips,
        "hierarchy": read_hierarchy(hierarchy, free, subjects, f"{path} [hierarchy]"),
        "free": free,
        "capture": capture,
        "prior": read_priors(content.get("prior", {}), known, f"{path} [prior]"),
        "start": read_start(content.get("start", {}), known, f"{path} [start]"),
        "parameters": flatten(content.get("parameters", {}), 2),
        "sigmas": with_floats(sigmas, sigmas),
        "noise": _noise_options(content.get("noise", {}), f"{path} [noise]"),
        "without": without,
        "fit": _fit_options(content.get("fit", {}), f"{path}"),
        "sample": _sampler_settings(content.get("sample", {}), count, f"{path} [sample]"),
    }
    top = with_floats(content, ("fps", "holdout", "independent_every"))
    top.pop("written_in", None)  # another folder is named when it is written again
    defaults: Content = {"path": path, "name": path.stem}
    if tables["noise"].sigmas == "estimated":  # which takes a distribution of noise
        defaults["loss"] = "squares"
    experiment = Experiment(**{**defaults, **top, **tables})
    return restrict(experiment) if experiment.record_only else experiment


def _values(table: Table, settings: type[Settings]) -> Content:
    return {name: _value(value, describe(settings)[name]) for name, value in table.items()}


def _value(value: Any, declared: Setting) -> Any:
    """A value as its setting holds it: a tuple for a list, and a float unless it is a count."""
    if isinstance(value, list):
        return tuple(_value(entry, declared) for entry in value)
    return float(value) if type(value) is int and not declared.integer else value


def _noise_options(value: object, where: str) -> NoiseOptions:
    return NoiseOptions(**check_table(value, NOISE_KEYS, where))


def _fit_options(value: object, where: str) -> FitOptions:
    table = check_table(value, FIT_KEYS, f"{where} [fit]")
    changed = check_table(table.get("search", {}), SEARCH_KEYS, f"{where} [fit.search]")
    search = _values(changed, SearchSettings)
    search |= {"max_steps": table["max_steps"]} if "max_steps" in table else {}
    with validation.error_context(f"{where} [fit.search]"):
        return FitOptions(table.get("starts", MAX_STARTS), SearchSettings(**search))


def _sampler_settings(value: object, free_count: int, where: str) -> SamplerSettings:
    table = check_table(value, SAMPLE_KEYS, where)
    with validation.error_context(where):
        sampler = SamplerSettings(**_values(table, SamplerSettings))
        sampler.walkers_for(free_count)
    return sampler


def experiment_to_toml(experiment: Experiment, folder: Path | None = None) -> str:
    """The experiment as TOML.

    Args:
        experiment: the experiment.
        folder: in which the file is going to lie. Paths are relative to it, so that it may be moved
            together with what they name; it is named itself, so that it may be moved alone. None
            writes absolute paths.
    """
    fit, sampler = experiment.fit, dataclasses.asdict(experiment.sample)
    fit_table: Content = {"starts": fit.starts, "max_steps": fit.search.max_steps}
    search = dataclasses.replace(fit.search, max_steps=SearchSettings().max_steps)
    if changed := _changed(search):
        fit_table["search"] = changed
    usual = {key: sampler[key] for key in USUAL_SAMPLE_KEYS}
    named = tuple(dataclasses.replace(entry, loaded=None) for entry in experiment.clips)
    plain = dataclasses.replace(experiment, clips=named, whole=None, system=None)
    content = dataclasses.asdict(plain)
    content |= {"fit": fit_table, "sample": usual | _changed(experiment.sample)}
    content["prior"] = priors_to_table(experiment.prior)
    content["hierarchy"] = hierarchy_to_table(experiment.hierarchy)
    for name in ("free", "start", "parameters"):
        content[name] = nest(content[name])
    each = {name: content["sigmas"].pop(name) for name in CORRELATIONS if name in content["sigmas"]}
    content["sigmas"] |= nest(each)
    del content["path"]
    if folder is not None:
        content["written_in"] = folder.resolve().as_posix()
    return tomli_w.dumps(_plain(content, folder))


def _changed(settings: Settings) -> Content:
    """The settings that do not have their default value."""
    defaults = dataclasses.asdict(type(settings)())
    values = dataclasses.asdict(settings)
    return {key: value for key, value in values.items() if value != defaults[key]}


def _plain(value: Any, folder: Path | None) -> Any:
    """The value without paths and None, which TOML does not have."""
    if isinstance(value, Mapping):
        return {key: _plain(entry, folder) for key, entry in value.items() if entry is not None}
    if isinstance(value, tuple | list):
        return [_plain(entry, folder) for entry in value]
    if not isinstance(value, Path):
        return value
    return str(value) if folder is None else relative_path(value, folder)


class Places(NamedTuple):
    """An experiment file, and where relative paths in it may start."""

    file: Path
    written_in: str | None = None
    """The folder in which it was written, from where its paths led."""

    def find(self, path: str, what: str) -> Path:
        """The file that a path names: from the experiment file, or else from where that was.

        Args:
            path: as the experiment file has it.
            what: the key that has it, for the error message.

        Raises:
            ValueError: there is no file to read at either place.
        """
        here = (self.file.parent / path).resolve()
        reason = validation.why_unreadable(here)
        if not reason:
            return here
        if self.written_in is not None:
            before = (Path(self.written_in) / path).resolve()
            if not validation.why_unreadable(before):
                return before
            if before != here:
                reason += f" at {here}, nor at {before}, to where it led when this was written"
        raise ValueError(f"{self.file} [[clips]]: {what} {path!r}: {reason}")


def read_clip(value: object, places: Places) -> ClipEntry:
    """An entry of [[clips]].

    Args:
        value: what the file has there.
        places: the file, and where its paths start.

    Raises:
        ValueError: a key is unknown or missing, a value has the wrong type, a file does not exist,
            or an option belongs to none of the files.
    """
    path = places.file
    table = check_table(value, CLIP_KEYS, f"{path} [[clips]]")
    entry = with_floats(table, ("start", "end", "scale", "sole", "terrain_scale", "terrain_cell"))
    for key in ("reference", "terrain"):
        if key not in table:
            raise ValueError(f"{path} [[clips]]: there is no {key}; it needs reference and terrain")
    has_joint_table = isinstance(table.get("joints"), Mapping)
    for key in (*FILE_KEYS, *(() if has_joint_table else ("joints",))):
        if key in table:
            entry[key] = places.find(table[key], key)
    if "end" in table and table["end"] <= table.get("start", 0.0):
        raise ValueError(
            f"{path} [[clips]]: end is {table['end']}; wanted more than start, which is "
            f"{table.get('start', 0.0)}"
        )
    if has_joint_table:
        entry["joints"] = check_joint_map(table["joints"], f"{path} [[clips]] joints")
    elif "joints" in table:
        read_joint_map(entry["joints"])  # reports mistakes before any clip is read
    if "terrain_offset" in table:
        entry["terrain_offset"] = tuple(float(number) for number in table["terrain_offset"])
    clip = ClipEntry(**entry)
    files = [clip.reference] if clip.base is None else [clip.reference, clip.base]
    clip.clip_options.check_use(files, f"{path} [[clips]]")
    return clip
