"""Saves a system as a parameter file and, where that has room for it, as the game's record."""

import itertools
import warnings
from pathlib import Path

import jaxik
from fitting.experiments import parameter_files, record_files
from fitting.experiments.systems import Preset
from fitting.runtime import files
from fitting.runtime.precision import in_float64
from jaxik import record

STEM = "tuned"


@in_float64
def save(
    folder: Path,
    ik: jaxik.FootIK,
    preset: Preset,
    leg_length: float | None = None,
    *,
    drop: bool = False,
) -> list[str]:
    """Writes a system under names that are not taken; says what was written, and what was not.

    The record is read from the file of parameters, as `jaxik record to-bytes` does.

    Args:
        folder: where.
        ik: the system.
        preset: of which it differs.
        leg_length: m, of the body that its numbers are for; None if they fit any body as they are.
        drop: whether the record leaves out what it cannot hold, instead of not being written.

    Returns:
        Sentences.

    Raises:
        ValueError: the folder cannot be written to.
    """
    toml, binary = _free_names(folder)
    files.write_text(toml, parameter_files.system_to_toml(ik, preset, leg_length))
    said = [f"Parameters are in {toml}."]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            (entry,) = record_files.read(toml, record.Reading(), None, drop=drop)
        except ValueError as error:
            reason = str(error).removeprefix(f"{toml}: ")
            return [*said, f"No record is written: {reason.partition('. To leave')[0]}."]
    content = record.to_bytes(entry)
    files.write(binary, lambda path: path.write_bytes(content))
    notes = [f"Note: {warning.message}." for warning in caught]
    return [*said, f"The record is in {binary}.", *notes]


def _free_names(folder: Path) -> tuple[Path, Path]:
    """Paths of a parameter file and a record that do not exist yet."""
    stems = (STEM if number == 1 else f"{STEM}_{number}" for number in itertools.count(1))
    pairs = ((folder / f"{stem}.toml", folder / f"{stem}.bin") for stem in stems)
    return next(pair for pair in pairs if not any(path.exists() for path in pair))
