"""Files that hold the game's parameter record: binary, CSV, or parameters in TOML."""

import csv
from pathlib import Path

import jaxik
from fitting.runtime import validation
from jaxik import record
from jaxik.maths import parameter_tree

from . import parameter_files, systems


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
    preset: systems.Preset,
    path: Path,
    reading: record.Reading,
    base: record.Record | None = None,
    *,
    drop: bool,
) -> record.Record:
    """The record with the parameters of a system; arguments and errors are those of `read`."""
    original = systems.Preset("record", faithful=True)
    if preset.name != original.name:
        raise ValueError(f"{path}: parameters of {preset.name!r}; only those of 'record' make one")
    if rules := systems.changed_rules(ik, original.system()):
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
