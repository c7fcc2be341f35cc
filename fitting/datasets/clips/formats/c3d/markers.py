"""The markers of a C3D file: their names, places and gaps, and what the file says of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from fitting.datasets.clips.recording import FASTEST, SLOWEST
from fitting.runtime.validation import in_one_line

from .structure import check_structure

MISSING = 'a .c3d is read by ezc3d: pip install "jaxik[c3d]"'
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
AXES = {
    f"{sign}{letter}": (1.0 if sign != "-" else -1.0) * np.eye(3)[axis]
    for axis, letter in enumerate("XYZ")
    for sign in ("", "+", "-")
}
Table = Mapping[str, Any]


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
            frames or no rate, or where ezc3d is not installed.
    """
    try:
        import ezc3d
    except ImportError:
        raise ValueError(MISSING) from None
    check_structure(path)
    try:
        content = ezc3d.c3d(str(path))
        points, residuals = content["data"]["points"], content["data"]["meta_points"]["residuals"]
        parameters: Table = content["parameters"]
    except (ArithmeticError, LookupError, OSError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"ezc3d cannot read it: {in_one_line(error)}") from None
    positions = np.moveaxis(np.asarray(points, np.float64)[:3], 0, -1).swapaxes(0, 1)
    frames, count = positions.shape[:2]
    if not count:
        raise ValueError("no markers, only analog channels; wanted a C3D file of motion")
    if not frames:
        raise ValueError(f"no frames of its {count} markers")
    lost = (positions == 0.0).all(axis=-1) | ~np.isfinite(positions).all(axis=-1)
    if residuals.shape[1:] == (count, frames):
        lost |= residuals[0].T < 0
    table: Table = parameters.get("POINT", {})
    rate = _number(table, "RATE")
    if not SLOWEST <= rate <= FASTEST:
        raise ValueError(f"POINT:RATE is {rate:g} Hz; wanted {SLOWEST:g} to {FASTEST:g}")
    return Markers(
        names=_names(table, count),
        positions=np.where(lost[..., None], np.nan, positions),
        frame_time=1.0 / rate,
        metres_per_unit=UNITS.get(_text(table, "UNITS").lower()),
        right=_axis(table, "X_SCREEN"),
        up=_axis(table, "Y_SCREEN"),
        measures=_measures(parameters.get("PROCESSING", {})),
    )


def _values(table: Table, name: str) -> list[Any]:
    """What a parameter holds, as a flat list; empty if there is no such parameter."""
    entry = table.get(name, {})
    value = entry.get("value", []) if isinstance(entry, Mapping) else []
    return list(np.ravel(value)) if isinstance(value, np.ndarray) else list(value)


def _number(table: Table, name: str) -> float:
    values = _values(table, name)
    return float(values[0]) if values and not isinstance(values[0], str) else 0.0


def _text(table: Table, name: str) -> str:
    values = _values(table, name)
    return values[0].strip() if values and isinstance(values[0], str) else ""


def _axis(table: Table, name: str) -> str:
    axis = _text(table, name).upper()
    return axis if axis in AXES else ""


def _measures(table: Table) -> dict[str, float]:
    """Positive numbers only: a lab leaves 0 where nothing was measured."""
    numbers = {name.upper(): _number(table, name) for name in table if not name.startswith("__")}
    return {name: value for name, value in numbers.items() if 0 < value < np.inf}


def _names(table: Table, count: int) -> tuple[str, ...]:
    """A unique name for each point; a file with more than 255 has further lists of names."""
    labels: list[str] = []
    for number in range(1, count + 2):
        more = _values(table, "LABELS" if number == 1 else f"LABELS{number}")
        if not more:
            break
        labels += [str(label).strip() for label in more]
    names: list[str] = []
    for index in range(count):
        label = labels[index] if index < len(labels) else ""
        label = label or f"unnamed {index + 1}"
        names.append(label if label not in names else f"{label} ({index + 1})")
    return tuple(names)
