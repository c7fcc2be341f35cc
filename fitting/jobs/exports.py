"""The job that writes parameters for others: as files of ours, the game's record, or settings."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jaxik
from fitting.experiments import parameter_files, record_files
from fitting.experiments.originals import conversion, layout, settings_files
from fitting.experiments.systems import Preset
from fitting.runtime import files
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from fitting.studies import run_folder
from jaxik import record

OURS = (".toml", ".json", ".csv", ".bin")  # parameters, parameters, record, record


class Source(NamedTuple):
    """A system, and what a parameter file says of it besides."""

    ik: jaxik.FootIK
    preset: Preset
    leg_length: float | None = None
    """m, of the body that its numbers are for; None if they fit any body as they are."""


@in_float64
def export(
    source: str | Path, output: str | Path, *, system: str | None = None, drop: bool = False
) -> None:
    """Writes parameters in another form, which the ending of the output chooses.

    Args:
        source: the folder of a run, a parameter file (.toml, .json), a record (.bin, .csv), or a
            table of settings (.toml, .json, .csv).
        output: .toml or .json for parameters, .bin or .csv for the game's record; with a system,
            .toml, .json or .csv for its settings.
        system: whose settings are written, under its own names and in its own units: "ozz",
            "unreal" or "mec". None writes parameters or a record.
        drop: whether to leave out, with a warning, what a record or the settings cannot hold.

    Raises:
        ValueError: the source cannot be read, the output has another ending or cannot be written,
            or cannot hold all parameters and they are not to be left out.
    """
    source, output = Path(source), Path(output)
    suffix = output.suffix.lower()
    _check_suffix(output, OURS if system is None else settings_files.SUFFIXES)
    if system is not None:
        conversion.original_of(system)
    files.check_output_file(output)
    loaded = load(source)
    if system is not None:
        with error_context(source):
            values = conversion.to_settings(loaded.ik, system, drop=drop)
            files.write_text(output, settings_files.settings_text(values, system, suffix))
    elif suffix == ".toml":
        files.write_text(output, parameter_files.system_to_toml(*loaded))
    elif suffix == ".json":
        files.write_text(output, parameter_files.system_to_json(*loaded))
    else:
        units = record.Reading(length_unit="m")
        content = record_files.from_system(loaded.ik, loaded.preset, source, units, drop=drop)
        if suffix == ".csv":
            files.write_text(output, record.to_csv([content]))
        else:
            files.write(output, lambda path: path.write_bytes(record.to_bytes(content)))


def load(source: Path) -> Source:
    """The system in a run, a parameter file, a record or a table of settings.

    Raises:
        ValueError: there is none, or it cannot be read.
    """
    if source.is_dir():
        run_folder.load_fitted_system(source)  # says what is wrong with a run
        return _load_parameters(source / run_folder.PARAMETERS)
    if settings_files.has_settings(source):
        ik, name = settings_files.load_settings(source)
        return Source(ik, layout.ORIGINALS[name].preset)
    if source.suffix.lower() in (".toml", ".json"):
        return _load_parameters(source)
    (only, *more) = record_files.read(source, record.Reading(), None, drop=False)
    if more:
        raise ValueError(f"{source} has {1 + len(more)} rows; give a file with one record")
    with error_context(source):
        return Source(record.to_ik(only), Preset("record", faithful=True))


def _load_parameters(path: Path) -> Source:
    ik, preset = parameter_files.load_system(path)
    return Source(ik, preset, parameter_files.leg_length_of(path))


def _check_suffix(output: Path, suffixes: Sequence[str]) -> None:
    if output.suffix.lower() not in suffixes:
        raise ValueError(f"{output}: wanted a name that ends in one of {list(suffixes)}")
