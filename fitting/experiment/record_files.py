"""Files of the game's parameter record: binary, CSV, or parameters in TOML."""

import csv
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

import jaxik
from fitting.problem.capture_system import is_of_capture
from fitting.runtime import validation
from fitting.runtime.precision import in_float64
from jaxik import record
from jaxik.maths import parameter_tree

from . import parameter_files
from .experiment import Experiment
from .systems import Preset, changed_rules

ORIGINAL = Preset("record", faithful=True)  # whose parameters the record has room for
Entry = TypeVar("Entry")
PLACES = {ours for _, ours, _ in record.FLOATS}  # of single numbers; of a vector, one each


def read_binary(path: Path) -> record.Record:
    """The record in a binary file; ValueError if there is none."""
    if reason := validation.why_unreadable(path):
        raise ValueError(f"{path}: {reason}, wanted a record")
    with validation.error_context(path):
        return record.from_bytes(path.read_bytes())


def read(
    path: Path, reading: record.Reading, base: record.Record | None, *, drop: bool
) -> list[record.Record]:
    """The records in a binary, CSV or TOML file.

    Args:
        path: the file.
        reading: how the record's fields are meant.
        base: completes a record that is made from parameters.
        drop: whether parameters that a record cannot hold are left out, with a warning.

    Raises:
        ValueError: the file does not exist or cannot be read; the parameters have another preset
            than `record`, other rules, or values that a record cannot hold; a base is given for a
            record that is complete.
    """
    suffix = path.suffix.lower()
    if suffix == ".toml":
        ik, preset = parameter_files.load_system(path)
        return [from_system(ik, preset, path, reading, base, drop=drop)]
    if base is not None:
        raise ValueError(f"{path}: a base completes parameters in a .toml; this is a whole record")
    if suffix != ".csv" or validation.why_unreadable(path):
        return [read_binary(path)]
    try:
        records = record.from_csv(path.read_text(encoding="utf-8"))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path}: {error}") from None
    if not records:
        raise ValueError(f"{path}: the CSV has no row")
    return records


def from_system(
    ik: jaxik.FootIK,
    preset: Preset,
    path: Path,
    reading: record.Reading,
    base: record.Record | None = None,
    *,
    drop: bool,
) -> record.Record:
    """The record with the parameters of a system; arguments and errors are those of `read`."""
    if preset.name != ORIGINAL.name:
        raise ValueError(f"{path}: parameters of {preset.name!r}; only those of 'record' make one")
    if rules := changed_rules(ik, ORIGINAL.system()):
        raise ValueError(
            f"{path}: rules {rules}; only those of 'record' with faithful = true make one; "
            "`jaxik init --record-only` writes an experiment whose fit has them"
        )
    with validation.error_context(path):
        return record.from_ik(ik, base, reading, drop=drop)


def describe(entry: record.Record, reading: record.Reading) -> str:
    """A record with its own names and ours, a line for each field."""
    ik = record.to_ik(entry, reading)
    declared = parameter_tree.declarations(ik)
    axis = record.KNEE_AXIS_NAMES[entry.knee_axis_type]
    lines = [f"{'kneeAxisType':30} {entry.knee_axis_type} ({axis})"]
    for _, name, ours in record.FLAGS:
        lines.append(f"{name:30} {'on' if entry.flag(name) else 'off':>12}   {ours}")
    for name, ours, _ in record.FLOATS:
        leaf, _, index = ours.partition("[")
        value = parameter_tree.get(ik, leaf)
        value = float(value[int(index[:-1])] if index else value)
        meaning = f"{ours} = {value:.6g} {declared[leaf].unit}"
        lines.append(f"{name:30} {entry.value(name):12.6g}   {meaning}")
    return "\n".join(lines)


@in_float64
def restrict(experiment: Experiment) -> Experiment:
    """The experiment with only those free parameters that the game's record has room for.

    All others are fixed at what a reader of the record assumes, so that a fit loses nothing when it
    is written as a record. The unrestricted experiment stays in `whole`.

    Raises:
        ValueError: the experiment has another preset, other rules, or parameters that differ
            between legs; its parameters follow the body; or none that is free has room.
    """
    with validation.error_context(experiment.path):
        _check(experiment)
    assumed = ORIGINAL.system()
    fixed = {
        name: np.asarray(parameter_tree.get(assumed, name)).tolist()
        for name in parameter_tree.docs(assumed)
        if name not in record.PARAMETERS
    }
    hierarchy = replace(
        experiment.hierarchy,
        per_clip=_names_within(experiment.hierarchy.per_clip),
        per_subject=_names_within(experiment.hierarchy.per_subject),
    )
    return replace(
        experiment,
        free=_entries_within(experiment.free),
        parameters={**experiment.parameters, **fixed},
        prior=replace(experiment.prior, named=_entries_within(experiment.prior.named)),
        start=_entries_within(experiment.start),
        hierarchy=hierarchy,
        record_only=True,
        whole=replace(experiment, record_only=False),
    )


def left_out(experiment: Experiment) -> list[str]:
    """Names of the free parameters that a restricted experiment leaves out."""
    whole = experiment.whole or experiment
    return [name for name in whole.free if name not in experiment.free]


def set_aside(experiment: Experiment) -> dict[str, tuple[str, str]]:
    """Fixed parameters that a restricted experiment has changed: as they were, and as they are."""
    whole = experiment.whole or experiment
    lost = record.dropped(whole.starting_system())
    return {name: values for name, values in lost.items() if name in whole.parameters}


def _entries_within(table: Mapping[str, Entry]) -> dict[str, Entry]:
    """The entries of parameters that the record has room for, and of captures."""
    return {name: entry for name, entry in table.items() if name in PLACES or is_of_capture(name)}


def _names_within(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in names if name in PLACES)


def _check(experiment: Experiment) -> None:
    """Raises ValueError for an experiment whose fit could not be a record."""
    own = Preset(experiment.preset, experiment.faithful)
    if own != ORIGINAL:
        raise ValueError(
            "record_only is for preset = 'record' with faithful = true; the experiment has preset "
            f"= {own.name!r} with faithful = {str(own.faithful).lower()}; `jaxik init "
            "--record-only` writes one that has them"
        )
    ik = experiment.starting_system()
    if rules := changed_rules(ik, ORIGINAL.system()):
        raise ValueError(f"record_only is for the record's own rules; these are others: {rules}")
    if experiment.hierarchy.scale_with_body:
        raise ValueError(
            "record_only and [hierarchy] scale_with_body exclude each other: a record's numbers "
            "are the same for every body"
        )
    if experiment.free and not PLACES.intersection(experiment.free):
        raise ValueError(
            f"record_only: the record has no room for any of {list(experiment.free)}; it has for "
            f"{sorted(PLACES)}"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is dropped, which is about to be fixed
        record.from_ik(ik, record.Record(), record.Reading(length_unit="m"), drop=True)
