"""What the arrays of an archive have to be: kind, shape, and values that a clip can have."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

Arrays = Mapping[str, np.ndarray]
Kind = Literal["text", "integer", "number", "switch", "label"]

DTYPES: dict[Kind, str] = {
    "text": "U",
    "integer": "iu",
    "number": "fiu",
    "switch": "b",
    "label": "bfiu",
}
WORDS = {"U": "text", "i": "integers", "u": "integers", "f": "numbers", "b": "switches"}
NOT_UNIT = 0.01  # off a length of 1, at most


@dataclass(frozen=True)
class Wanted:
    """An array of an archive."""

    kind: Kind
    shape: tuple[int | str, ...] = ()
    """Names stand for sizes that are the same in all arrays of the archive."""
    low: float = -np.inf
    high: float = np.inf
    unit: bool = False
    """Whether the last axis holds unit vectors or unit quaternions."""
    distinct: bool = False
    may_be_empty: bool = False
    optional: bool = False


def check_arrays(path: Path, content: Arrays, wanted: Mapping[str, Wanted]) -> dict[str, int]:
    """The sizes of the named axes.

    Args:
        path: of the archive, for messages.
        content: its arrays.
        wanted: what they have to be, those first that give the axes their sizes.

    Raises:
        ValueError: an array is missing, or is something else; it says which, and what was wanted.
    """
    required = {name for name, array in wanted.items() if not array.optional}
    if missing := sorted(required - set(content)):
        raise ValueError(f"{path}: without the arrays {missing}; it has {sorted(content)}")
    sizes: dict[str, int] = {}
    for name, array in wanted.items():
        if name in content and (problem := _problem(content[name], array, sizes)):
            raise ValueError(f"{path}: {name} {problem}")
    return sizes


def _problem(array: np.ndarray, wanted: Wanted, sizes: dict[str, int]) -> str:
    """What is wrong with an array, empty if nothing is; adds to the sizes."""
    if array.dtype.kind not in DTYPES[wanted.kind]:
        kind = WORDS.get(array.dtype.kind, str(array.dtype))
        return f"holds {kind}; wanted {WORDS[DTYPES[wanted.kind][0]]}"
    if array.ndim == len(wanted.shape):
        named = zip(wanted.shape, array.shape, strict=True)
        for axis, size in named:
            if isinstance(axis, str):
                sizes.setdefault(axis, size)
    expected = tuple(
        sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in wanted.shape
    )
    if array.shape != expected:
        return f"is {array.shape}; wanted {_words(wanted.shape)}, here {_words(expected)}"
    if 0 in array.shape and not wanted.may_be_empty:
        return f"is empty, {array.shape}; wanted {_words(wanted.shape)}"
    if array.dtype.kind in "fiu":
        return _problem_of_values(array, wanted)
    if wanted.distinct and len(np.unique(array)) < array.size:
        values, counts = np.unique(array, return_counts=True)
        return f"has {str(values[counts > 1][0])!r} more than once"
    return ""


def _problem_of_values(array: np.ndarray, wanted: Wanted) -> str:
    unknown = ~np.isfinite(array)
    if unknown.any():
        value = array[unknown].flat[0]
        return f"has {value:g}{_place(unknown, wanted)}; wanted finite numbers"
    outside = (array < wanted.low) | (array > wanted.high)
    if outside.any():
        value = array[outside].flat[0]
        return f"has {value:g}{_place(outside, wanted)}; wanted {wanted.low:g} to {wanted.high:g}"
    if wanted.unit:
        lengths = np.linalg.norm(np.clip(array, -2.0, 2.0), axis=-1)  # without overflow
        off = np.abs(lengths - 1) > NOT_UNIT
        if off.any():
            return f"has a length of {lengths[off].flat[0]:.4g}{_place(off, wanted)}; wanted 1"
    return ""


def _place(chosen: np.ndarray | np.bool_, wanted: Wanted) -> str:
    """Where the first of the chosen entries is, and what the axes are."""
    if chosen.ndim == 0:
        return ""
    place = [int(index) for index in np.argwhere(chosen)[0]]
    return f" at {place} of {_words(wanted.shape[: chosen.ndim])}"


def _words(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))})" if shape else "a single value"
