"""Experiment files: TOML, checked key by key as `Experiment` declares it; the page shows all."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w

from fitting.clips.joint_maps import check_joint_map, read_joint_map
from fitting.inference.optimise.solution import SearchSettings
from fitting.runtime import validation
from fitting.runtime.declarations import changed, check_table, keys
from fitting.runtime.files import relative_path
from fitting.runtime.validation import Content, Table, flatten, nest

from . import file_tables
from .experiment import (
    ALL_SIGMA_KEYS,
    DEFAULT_SIGMAS,
    FIT_KEYS,
    OWN_CORRELATIONS,
    SEARCH_KEYS,
    SIGMAS,
    STEPS,
    ClipEntry,
    Experiment,
    FitOptions,
)
from .record_files import restrict
from .systems import DEFAULT_PRESET, preset_system, read_free_table, read_parameters, with_rules

USUAL_SAMPLE_KEYS = ("walkers", "max_steps", "thin_by", "stop_at")  # always written
# The first keys of a clip, in the order that digests of unfinished campaigns know.
FIRST = ("reference", "terrain", "base", "truth", "start", "end", "file_up")


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
    if isinstance(content.get("clips", []), list) and not content.get("clips"):
        raise ValueError(f"{path}: there is no [[clips]]; an experiment has at least one of them")
    if "free" not in content:
        raise ValueError(f"{path}: there is no [free]; it may be empty, where nothing is fitted")
    top = check_table({**content, "fit": {}}, keys(Experiment), f"{path}")
    top["fit"] = _fit_options(content.get("fit", {}), f"{path} [fit]")
    with validation.error_context(path):
        ik = preset_system(
            top.get("preset", DEFAULT_PRESET.name), faithful=top.get("faithful", False)
        )
    ik = with_rules(ik, top.get("rules", {}), f"{path} [rules]")
    sigmas = check_table(flatten(top.get("sigmas", {}), 2), ALL_SIGMA_KEYS, f"{path} [sigmas]")
    if all((DEFAULT_SIGMAS | sigmas)[kind] == math.inf for kind in SIGMAS):
        raise ValueError(f"{path} [sigmas]: all of {list(SIGMAS)} are inf; wanted one that is not")
    free = read_free_table(top["free"], ik, f"{path} [free]")
    without = file_tables.read_ablations(top.get("without", ()), ik, f"{path} [[without]]")
    places = Places(path, top.pop("written_in", None))  # another is named when it is written again
    clips = tuple(_with_files(entry, places) for entry in top["clips"])
    capture = file_tables.read_capture(top.get("capture", {}), len(clips), f"{path} [capture]")
    known = [*free, *(name for ablation in without for name in ablation.free)]
    known = list(dict.fromkeys([*known, *file_tables.known_names(capture, len(clips))]))
    subjects = [clip.subject for clip in clips]
    hierarchy = top.get("hierarchy", file_tables.Hierarchy())
    file_tables.check_hierarchy(hierarchy, free, subjects, f"{path} [hierarchy]")
    top |= {
        "clips": clips,
        "free": free,
        "capture": capture,
        "prior": file_tables.read_priors(top.get("prior", {}), known, f"{path} [prior]"),
        "start": file_tables.read_start(top.get("start", {}), known, f"{path} [start]"),
        "parameters": read_parameters(top.get("parameters", {}), ik),
        "sigmas": sigmas,
        "without": without,
    }
    defaults: Content = {"path": path, "name": path.stem}
    if "noise" in top and top["noise"].sigmas == "estimated":  # a distribution of noise
        defaults["loss"] = "squares"
    experiment = Experiment(**(defaults | top))
    with validation.error_context(f"{path} [sample]"):
        experiment.sample.walkers_for(experiment.free_count)
    return restrict(experiment) if experiment.record_only else experiment


def _fit_options(value: object, where: str) -> FitOptions:
    table = check_table(value, FIT_KEYS, where)
    where = f"{where[:-1]}.search]"
    search = check_table(table.pop("search", {}), SEARCH_KEYS, where)
    steps = {name: table.pop(name) for name in STEPS if name in table}
    with validation.error_context(where):
        return FitOptions(**table, search=SearchSettings(**(search | steps)))


def experiment_to_toml(experiment: Experiment, folder: Path | None = None) -> str:
    """The experiment as TOML for a file in a folder.

    Paths are relative to the folder, so that it may be moved together with its files; it is named
    itself, so that it may be moved alone. Without a folder, paths are absolute.
    """
    fit, sampler = experiment.fit, experiment.sample
    search = dataclasses.replace(fit.search, max_steps=SearchSettings().max_steps)
    fit_table: Content = {"starts": fit.starts, "max_steps": fit.search.max_steps}
    if others := changed(search):
        fit_table["search"] = others
    content = {name: getattr(experiment, name) for name in keys(Experiment)} | {
        "clips": [clip_to_table(entry) for entry in experiment.clips],
        "fit": fit_table,
        "sample": {name: getattr(sampler, name) for name in USUAL_SAMPLE_KEYS} | changed(sampler),
        "prior": file_tables.priors_to_table(experiment.prior),
        "hierarchy": changed(experiment.hierarchy),
        "noise": vars(experiment.noise),
        "without": [vars(ablation) for ablation in experiment.without],
        "sigmas": _nest_sigmas(experiment.sigmas),
        "written_in": None if folder is None else folder.resolve().as_posix(),
    }
    for name in ("free", "start", "parameters"):
        content[name] = nest(content[name])
    return tomli_w.dumps(_plain(content, folder))


def clip_to_table(entry: ClipEntry) -> Content:
    """The keys of a clip that have a value, with it."""
    values = {name: getattr(entry, name) for name in dict.fromkeys([*FIRST, *keys(ClipEntry)])}
    return {name: value for name, value in values.items() if value is not None}


def _nest_sigmas(sigmas: Table) -> Content:
    """Sigmas by kind as a table, in which each kind may have a correlation."""
    return {name: sigmas[name] for name in sigmas if name not in OWN_CORRELATIONS} | nest(
        {name: sigmas[name] for name in sigmas if name in OWN_CORRELATIONS}
    )


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

    def find(self, path: Path, what: str) -> Path:
        """The file that a path names: from the experiment file, or else from where that was.

        Raises:
            ValueError: there is no file to read at either place; the message names the key.
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
        raise ValueError(f"{self.file} [[clips]]: {what} {str(path)!r}: {reason}")


def _with_files(entry: ClipEntry, places: Places) -> ClipEntry:
    """An entry of [[clips]] with its paths where its files are.

    Raises:
        ValueError: a file does not exist, the clip ends before it starts, or an option belongs to
            none of the files.
    """
    where = f"{places.file} [[clips]]"
    files = {name: places.find(path, name) for name, path in entry.paths.items()}
    entry = dataclasses.replace(entry, **files)
    if entry.end is not None and entry.end <= entry.start:
        raise ValueError(
            f"{where}: end is {entry.end}; wanted more than start, which is {entry.start}"
        )
    if isinstance(entry.joints, Path):
        read_joint_map(entry.joints)  # reports mistakes before any clip is read
    elif entry.joints is not None:
        check_joint_map(entry.joints, f"{where} joints")
    clips = [entry.reference] if entry.base is None else [entry.reference, entry.base]
    entry.check_use(clips, where)
    return entry
