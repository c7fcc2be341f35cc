"""Reads NumPy files that somebody else may have made: plain arrays of a bounded size."""

import math
import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from fitting.runtime.validation import QUOTED, in_one_line, why_unreadable

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
MAX_BYTES = 2**31  # of all arrays together, unpacked


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays in an archive. Nothing is unpickled.

    Raises:
        ValueError: no archive, something else than plain arrays in it, or arrays that take more
            than `MAX_BYTES`, of which none is read then.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            for entry in archive.infolist() if size <= MAX_BYTES else ():
                _check_claim(archive, entry)
        if size <= MAX_BYTES:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return {name: _with_common_floats(array) for name, array in arrays.items()}
    except Exception as error:  # zipfile, zlib and NumPy each raise their own
        what = in_one_line(error, QUOTED)
        raise ValueError(f"{path}: wanted a NumPy archive of plain arrays ({what})") from None
    raise ValueError(f"{path}: its arrays take {size} bytes; wanted {MAX_BYTES} at most")


def check_array_file(path: Path) -> None:
    """ValueError for an `.npy` that is no plain array, or claims to be longer than it is."""
    with path.open("rb") as file:
        _check_header(file, path.name, path.stat().st_size)


def _with_common_floats(array: np.ndarray) -> np.ndarray:
    """The array, with 64 bits where it has floats of another width than 32 or 64."""
    if array.dtype.kind != "f" or array.dtype in (np.float32, np.float64):
        return array
    with np.errstate(over="ignore"):  # infinity is refused later
        return array.astype(np.float64)


def _check_claim(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    with archive.open(entry) as file:
        _check_header(file, entry.filename, entry.file_size)


def _check_header(file: IO[bytes], name: str, size: int) -> None:
    """ValueError for an array that says that it is longer than it is: NumPy would make room."""
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"{name} is no plain array")
    shape, _, dtype = HEADERS[version](file)
    if (claim := math.prod(shape) * dtype.itemsize) > size:
        raise ValueError(f"{name} says {claim} bytes and has {size}")


def array_names(path: Path) -> list[str]:
    """The names of the arrays in an archive; none if it is no archive."""
    if why_unreadable(path):
        return []
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return list(arrays.files)
    except Exception:  # reading the arrays will report what is wrong
        return []
