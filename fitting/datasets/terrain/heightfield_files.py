"""Heightfields as files, which `load_terrain` reads beside meshes.

`.npz`, as `numpy.savez` writes it; it states its own spacing:

    heights         (rows, columns), m; rows along z, columns along x; NaN leaves holes
    spacing         m, between neighbours; two numbers are those along x and along z
    origin          (3), m, of row 0 and column 0 at height 0; where missing, zero
    interpolation   "bilinear" or "triangulated"; where missing, "bilinear"

`.npy`, as `numpy.save` writes it: the heights alone. `.png`: a grey picture of 8 or 16 bits, whose
levels are heights; x goes right and z goes down in it. It may be stored in colours of 8 bits, as
long as all of them are grey and opaque. For both the user says how far neighbours
are apart, the cell, and for a picture also how many metres a level is.

`jaxik.world.terrain.heightfield` says more about each array.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from PIL import Image, ImageFile

from fitting.datasets import archives
from fitting.runtime.validation import QUOTED, check_file, in_one_line

ARCHIVE, ARRAY, PICTURE = ".npz", ".npy", ".png"
SUFFIXES = (ARCHIVE, ARRAY, PICTURE)
REQUIRED = ("heights", "spacing")
OPTIONAL = ("origin", "interpolation")
GREY = {"L": 1, "I;16": 2, "I;16B": 2, "I": 4}  # bytes a pixel, by Pillow's modes
COLOURED = {"P": 1, "LA": 2, "RGB": 3, "RGBA": 4}  # likewise; these may hold a grey picture
OPAQUE = 255
MOST_PIXELS = 2**26
MOST_PACKED = 1040  # bytes of a picture for each of its file: deflate reaches 1032


class HeightfieldArrays(NamedTuple):
    """What a file holds, as arguments of `jaxik.world.terrain.heightfield`."""

    heights: Float64[np.ndarray, "rows columns"]
    spacing: Float64[np.ndarray, "..."]
    origin: Float64[np.ndarray, "3"]
    interpolation: str


def read_heightfield(
    path: Path, scale: float | None = None, cell: float | None = None
) -> HeightfieldArrays:
    """The arrays in a file, in metres; their shapes and values are not checked.

    Args:
        path: its suffix, one of `SUFFIXES`, selects the format.
        scale: metres per unit of the file, or per level of a picture; None is 1, but for a picture.
        cell: m, between neighbours, of an `.npy` or a picture.

    Raises:
        ValueError: no such file, or not of its format; other arrays in it, or arrays that are no
            numbers; a scale or a cell is missing, or given where the file states it.
    """
    check_file(path)
    if path.suffix.lower() == ARCHIVE:
        if cell is not None:
            raise ValueError(f"{path}: an .npz states its spacing itself; got the cell {cell:g}")
        return _read_archive(path, 1.0 if scale is None else scale)
    if cell is None:
        raise ValueError(
            f"{path}: how far are its heights apart? Give --terrain-cell, in metres (cell=...)"
        )
    if path.suffix.lower() == PICTURE:
        if scale is None:
            raise ValueError(
                f"{path}: how high is a level of grey? Give --terrain-scale, in metres (scale=...):"
                " Unreal's landscapes have 1/128 = 0.0078125, Unity's their height / 65535"
            )
        heights = _read_picture(path)
    else:
        heights = _read_array(path)
    scaled = (1.0 if scale is None else scale) * heights
    return HeightfieldArrays(scaled, np.array(cell), np.zeros(3), "bilinear")


def _read_archive(path: Path, scale: float) -> HeightfieldArrays:
    content = archives.read_arrays(path)
    if not set(REQUIRED) <= set(content) <= {*REQUIRED, *OPTIONAL}:
        raise ValueError(
            f"{path}: a heightfield is the arrays {' and '.join(REQUIRED)}, with or without "
            f"{' and '.join(OPTIONAL)}; the file has {', '.join(sorted(content))}"
        )
    interpolation = content.pop("interpolation", np.array("bilinear"))
    numbers = {"origin": np.zeros(3), **content}
    arrays = {name: scale * _as_numbers(path, name, array) for name, array in numbers.items()}
    return HeightfieldArrays(**arrays, interpolation=str(interpolation))


def _read_array(path: Path) -> np.ndarray:
    try:
        archives.check_array_file(path)
        with path.open("rb") as file:
            heights = np.load(file, allow_pickle=False)
    except Exception as error:  # NumPy raises its own
        what = in_one_line(error, QUOTED)
        raise ValueError(f"{path}: wanted a NumPy array ({what})") from None
    return _as_numbers(path, "the array", heights)


def _as_numbers(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{path}: {name} must be real numbers; got {array.dtype}")
    with np.errstate(all="ignore"):  # what is not finite is refused later
        return array.astype(np.float64)


def _read_picture(path: Path) -> np.ndarray:
    """The levels of a picture, of which no more is decoded than its file has bytes for."""
    try:
        with Image.open(path, formats=["PNG"]) as picture:
            _check_picture(picture, path.stat().st_size)
            levels = picture if picture.mode in GREY else _as_grey(picture)
            return np.array(levels, np.float64)
    except (Image.DecompressionBombError, ValueError) as error:
        raise ValueError(f"{path}: {in_one_line(error, QUOTED)}") from None
    except Exception as error:  # Pillow has several of its own, SyntaxError among them
        raise ValueError(f"{path}: wanted a PNG ({in_one_line(error, QUOTED)})") from None


def _check_picture(picture: ImageFile.ImageFile, file_bytes: int) -> None:
    """ValueError unless it may be grey, and is as large as its file allows."""
    columns, rows = picture.size
    pixel_bytes = GREY | COLOURED
    if picture.mode not in pixel_bytes:
        raise ValueError(
            "wanted one channel of grey, of 8 or 16 bits; got a picture of mode "
            f"{picture.mode!r} in Pillow's words"
        )
    if picture.mode in COLOURED and "16" in str(picture.tile):  # of which Pillow keeps 8
        raise ValueError("has colours of 16 bits; save it as one channel of grey of 16 bits")
    if columns * rows > MOST_PIXELS:
        raise ValueError(f"says {columns} x {rows} pixels; wanted {MOST_PIXELS} at most")
    if math.prod((columns, rows, pixel_bytes[picture.mode])) > MOST_PACKED * file_bytes:
        raise ValueError(f"says {columns} x {rows} pixels, and has {file_bytes} bytes")


def _as_grey(picture: Image.Image) -> np.ndarray:
    """The one channel of a picture that is stored in colours.

    Raises:
        ValueError: a pixel is coloured or transparent; it names the first.
    """
    pixels = np.array(picture.convert("RGBA"))
    for wrong, what in (
        ((pixels[..., :1] != pixels[..., 1:3]).any(axis=-1), "coloured"),
        (pixels[..., 3] != OPAQUE, "transparent"),
    ):
        if wrong.any():
            row, column = (int(place) for place in np.argwhere(wrong)[0])
            raise ValueError(
                f"{wrong.sum()} of {wrong.size} pixels are {what}, first that of row {row}, column "
                f"{column}: {pixels[row, column].tolist()}; wanted grey alone, as heights"
            )
    return pixels[..., 0]
