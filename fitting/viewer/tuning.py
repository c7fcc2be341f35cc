"""The system as it has been moved so far, with a way back."""

import itertools
import threading
import warnings
from collections.abc import Mapping
from pathlib import Path

import jaxik
from fitting.experiment import parameter_files, record_files
from fitting.experiment.systems import Preset
from fitting.runtime import files
from fitting.runtime.precision import in_float64
from jaxik import record

PAUSE = 1.0  # s, after which moving the same slider is a new step
MOST_STEPS = 1000  # that can be undone

STEM = "tuned"


class Tuning:
    """A system that is changed step by step; calls may come from several threads.

    Moving one slider, without a pause, is one step, however many values it passes.

    Args:
        starts: the systems to go back to, by name; it begins with the first.
    """

    def __init__(self, starts: Mapping[str, jaxik.FootIK]):
        self.starts = dict(starts)
        self._ik = next(iter(self.starts.values()))
        self._undone: list[jaxik.FootIK] = []
        self._done: list[jaxik.FootIK] = []
        self._last: tuple[str, float] = ("", -PAUSE)
        self._lock = threading.RLock()

    @property
    def ik(self) -> jaxik.FootIK:
        """The system as it is."""
        with self._lock:
            return self._ik

    def change(self, ik: jaxik.FootIK, what: str, now: float) -> None:
        """Takes a changed system.

        Args:
            ik: the system.
            what: has changed: the name of a parameter.
            now: s, on any clock.
        """
        with self._lock:
            before, when = self._last
            if what != before or now - when > PAUSE:
                self._done = [*self._done, self._ik][-MOST_STEPS:]
            self._undone, self._ik, self._last = [], ik, (what, now)

    def reset(self, name: str) -> None:
        """Goes back to one of the systems to go back to, which is a step of its own."""
        self.change(self.starts[name], f"reset to {name}", float("inf"))

    def undo(self) -> None:
        """Goes back a step, if there is one."""
        self._move(self._done, self._undone)

    def redo(self) -> None:
        """Does the step again that was undone last, if there is one."""
        self._move(self._undone, self._done)

    def _move(self, source: list[jaxik.FootIK], target: list[jaxik.FootIK]) -> None:
        with self._lock:
            if source:
                target.append(self._ik)
                self._ik = source.pop()
                self._last = ("", -PAUSE)

    def restart(self, name: str, ik: jaxik.FootIK) -> None:
        """Begins anew with a system to go back to, as a fit that goes on finds better ones."""
        with self._lock:
            self.starts, self._ik = {**self.starts, name: ik}, ik
            self._done, self._undone, self._last = [], [], ("", -PAUSE)


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
