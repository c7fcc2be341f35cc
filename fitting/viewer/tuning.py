"""The values of all sliders of a session as one list, and how a system is saved."""

import itertools
import warnings
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.experiment import parameter_files, record_files
from fitting.experiment.systems import Preset
from fitting.report import live_data
from fitting.report.live_data import LiveSystem
from fitting.report.sliders import Slider, sliders
from fitting.runtime import files
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from jaxik import record
from jaxik.maths import parameter_tree

from .session import Session
from .solving import SOLVED

STEM = "tuned"


class Tuning:
    """What the page's sliders change.

    Args:
        session: with the systems to go back to; values are those of systems like the first.
    """

    def __init__(self, session: Session):
        self._session = session
        self.first = next(iter(session.starts.values()))

    @cached_property
    def sliders(self) -> list[Slider]:
        """All, element by element of each array."""
        return sliders(self.first, self._session.rig, self._session.free)

    def numbers(self, ik: jaxik.FootIK) -> Float64[np.ndarray, " sliders"]:
        """The values of a system."""
        return np.array([slider.read(ik) for slider in self.sliders], np.float64)

    @in_float64
    def system(self, values: Float64[np.ndarray, " sliders"]) -> jaxik.FootIK:
        """The system with these values.

        Raises:
            ValueError: there are more or fewer values, or one that is not a number.
        """
        if values.shape != (len(self.sliders),) or np.isnan(values).any():
            wanted = f"wanted {len(self.sliders)} numbers, one for each slider"
            raise ValueError(f"{wanted}; got {values.size}, {np.isnan(values).sum()} of them NaN")
        arrays: dict[str, np.ndarray] = {}
        for slider, value in zip(self.sliders, values, strict=True):
            leaf = slider.leaf
            if leaf not in arrays:
                arrays[leaf] = np.array(parameter_tree.get(self.first, leaf))
            arrays[leaf][slider.index] = value
        return parameter_tree.replace(self.first, arrays)

    @in_float64
    def content(self) -> Content:
        """The sliders and the systems to go back to, as the page takes them."""
        place: dict[str, int] = {}
        for number, slider in enumerate(self.sliders):
            place.setdefault(slider.leaf, number)
        live = LiveSystem(self._session.starts, self.sliders)
        return {"systems": [live_data.pack_system(SOLVED, live, place, self.numbers)]}

    @in_float64
    def packed(self, ik: jaxik.FootIK) -> str:
        """The values of a system like the first, as the page takes them.

        Raises:
            ValueError: it has other parameters.
        """
        if not live_data.is_alike(ik, self.first):
            raise ValueError("the system has other parameters than the one that is shown")
        return live_data.packed(self.numbers(ik).astype("<f8"))


@in_float64
def save(
    folder: Path,
    ik: jaxik.FootIK,
    preset: Preset,
    leg_length: float | None = None,
    *,
    drop: bool = False,
) -> list[str]:
    """Writes a system under names that are not taken; returns what was written, and what was not.

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
    messages = [f"Parameters are in {toml}."]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            (entry,) = record_files.read(toml, record.Reading(), None, drop=drop)
        except ValueError as error:
            reason = str(error).removeprefix(f"{toml}: ")
            return [*messages, f"No record is written: {reason.partition('. To leave')[0]}."]
    content = record.to_bytes(entry)
    files.write(binary, lambda path: path.write_bytes(content))
    notes = [f"Note: {warning.message}." for warning in caught]
    return [*messages, f"The record is in {binary}.", *notes]


def _free_names(folder: Path) -> tuple[Path, Path]:
    """Paths of a parameter file and a record that do not exist yet."""
    stems = (STEM if number == 1 else f"{STEM}_{number}" for number in itertools.count(1))
    pairs = ((folder / f"{stem}.toml", folder / f"{stem}.bin") for stem in stems)
    return next(pair for pair in pairs if not any(path.exists() for path in pair))
