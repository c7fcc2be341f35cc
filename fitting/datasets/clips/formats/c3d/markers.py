"""The markers of a C3D file: their names, places and gaps, and what the file says of them."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from fitting.datasets.clips.recording import FASTEST, SLOWEST

from .structure import Structure

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
AXES = {
    f"{sign}{letter}": (1.0 if sign != "-" else -1.0) * np.eye(3)[axis]
    for axis, letter in enumerate("XYZ")
    for sign in ("", "+", "-")
}


@dataclass(frozen=True, eq=False)
class Markers:
    """Points in the file's unit and axes; NaN where a marker was not seen."""

    names: tuple[str, ...]
    """Unique, as in the file but for blanks around them."""
    positions: Float64[np.ndarray, "frames markers 3"]
    frame_time: float
    """Seconds."""
    metres_per_unit: float | None
    """None where the file does not state a unit."""
    right: str
    """Axis to the right on a screen (POINT:X_SCREEN), such as "+X"; empty if not stated."""
    up: str
    """Axis upwards on a screen (POINT:Y_SCREEN); likewise."""
    measures: Mapping[str, float]
    """What was measured on the subject (PROCESSING), mm, by names in capitals."""

    @cached_property
    def seen(self) -> Bool[np.ndarray, "frames markers"]:
        """Where each marker was seen."""
        return np.asarray(np.isfinite(self.positions).all(axis=-1))


def read_markers(path: Path) -> Markers:
    """The markers of a file.

    A marker was not seen where its residual is below 0, or where it lies exactly at the origin.

    Raises:
        ValueError: without the file's name, where it is no whole C3D file, has no markers, no
            frames or no rate.
    """
    structure = Structure(path.read_bytes())
    points = structure.points()
    frames, count, _ = points.shape
    if not count:
        raise ValueError("no markers, only analog channels; wanted a C3D file of motion")
    if not frames:
        raise ValueError(f"no frames of its {count} markers")
    positions, lost = points[..., :3], np.signbit(points[..., 3])
    lost |= (positions == 0.0).all(axis=-1) | ~np.isfinite(positions).all(axis=-1)
    rate = structure.number("POINT", "RATE")
    if not SLOWEST <= rate <= FASTEST:
        raise ValueError(f"POINT:RATE is {rate:g} Hz; wanted {SLOWEST:g} to {FASTEST:g}")
    return Markers(
        names=_names(structure, count),
        positions=np.where(lost[..., None], np.nan, positions),
        frame_time=1.0 / rate,
        metres_per_unit=UNITS.get(_text(structure, "UNITS").lower()),
        right=_axis(structure, "X_SCREEN"),
        up=_axis(structure, "Y_SCREEN"),
        measures=_measures(structure),
    )


def _text(structure: Structure, name: str) -> str:
    return next(iter(structure.texts("POINT", name)), "")


def _axis(structure: Structure, name: str) -> str:
    axis = _text(structure, name).upper()
    return axis if axis in AXES else ""


def _measures(structure: Structure) -> dict[str, float]:
    """Positive numbers only: a lab leaves 0 where nothing was measured."""
    names = [name for group, name in structure.parameters if group == "PROCESSING"]
    numbers = {name: structure.number("PROCESSING", name) for name in names}
    return {name: value for name, value in numbers.items() if 0 < value < np.inf}


def _names(structure: Structure, count: int) -> tuple[str, ...]:
    """A unique name for each point."""
    labels = _labels(structure, "LABELS")
    names: list[str] = []
    for index in range(count):
        label = labels[index] if index < len(labels) else ""
        label = label or f"unnamed {index + 1}"
        names.append(label if label not in names else f"{label} ({index + 1})")
    return tuple(names)


def _labels(structure: Structure, name: str) -> list[str]:
    """Names of points; what is more than 255 of them goes on in `LABELS2` and so on."""
    labels: list[str] = []
    for number in itertools.count(1):
        more = structure.texts("POINT", name if number == 1 else f"{name}{number}")
        if not more:
            break
        labels += more
    return labels
