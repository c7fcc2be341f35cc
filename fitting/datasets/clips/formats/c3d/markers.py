"""The markers of a C3D file: their names, places and gaps, and what the file says of them."""

import itertools
import re
from collections.abc import Mapping, Sequence
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
# What models compute of markers, and store as points: parameters that list it, and ends of names.
OUTPUTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
OUTPUT_NAME = re.compile("(angle|force|moment|power|grf)s?$", re.IGNORECASE)
NAMED = 8  # points, in a remark


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
    remarks: tuple[str, ...] = ()

    @cached_property
    def seen(self) -> Bool[np.ndarray, "frames markers"]:
        """Where each marker was seen."""
        return np.asarray(np.isfinite(self.positions).all(axis=-1))


def read_markers(path: Path) -> Markers:
    """The markers of a file.

    A marker was not seen where its residual is below 0, or where it lies exactly at the origin.
    Angles, forces and other numbers that a model has computed are no markers.

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
    labels = (_labels(structure, "LABELS") + [""] * count)[:count]
    stated = _stated_outputs(structure)
    guessed = [name for name in labels if name not in stated and OUTPUT_NAME.search(name)]
    kept = [n for n, label in enumerate(labels) if label not in stated and label not in guessed]
    if not kept:
        raise ValueError(f"no markers, only {count} angles, forces and the like; wanted markers")
    points, names = points[:, kept], _unique_names(labels)
    remark = f"taken for angles, forces or the like by their names, and left out: {listed(guessed)}"
    positions, lost = points[..., :3], np.signbit(points[..., 3])
    lost |= (positions == 0.0).all(axis=-1) | ~np.isfinite(positions).all(axis=-1)
    rate = structure.number("POINT", "RATE")
    if not SLOWEST <= rate <= FASTEST:
        raise ValueError(f"POINT:RATE is {rate:g} Hz; wanted {SLOWEST:g} to {FASTEST:g}")
    return Markers(
        names=tuple(names[n] for n in kept),
        positions=np.where(lost[..., None], np.nan, positions),
        frame_time=1.0 / rate,
        metres_per_unit=UNITS.get(_text(structure, "UNITS").lower()),
        right=_axis(structure, "X_SCREEN"),
        up=_axis(structure, "Y_SCREEN"),
        measures=_measures(structure),
        remarks=(remark,) if guessed else (),
    )


def listed(names: Sequence[str]) -> str:
    """The first names, with commas between."""
    return ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")


def _stated_outputs(structure: Structure) -> set[str]:
    """The points that the file itself lists as no places."""
    groups = [name.upper() for name in structure.texts("POINT", "TYPE_GROUPS")]
    groups = [name for name in groups if not name.endswith("UNITS") and "MARKER" not in name]
    return {label for group in (*OUTPUTS, *groups) for label in _labels(structure, group)}


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


def _unique_names(labels: Sequence[str]) -> list[str]:
    names: list[str] = []
    for index, label in enumerate(labels, start=1):
        label = label or f"unnamed {index}"
        names.append(label if label not in names else f"{label} ({index})")
    return names


def _labels(structure: Structure, name: str) -> list[str]:
    """Names of points; what is more than 255 of them goes on in `LABELS2` and so on."""
    labels: list[str] = []
    for number in itertools.count(1):
        more = structure.texts("POINT", name if number == 1 else f"{name}{number}")
        if not more:
            break
        labels += more
    return labels
