"""Heightfields as NumPy archives, which `load_terrain` reads beside meshes.

    heights         (rows, columns), m; rows along z, columns along x; NaN leaves holes
    spacing         m, between neighbours; two numbers are those along x and along z
    origin          (3), m, of row 0 and column 0 at height 0; where missing, zero
    interpolation   "bilinear" or "triangulated"; where missing, "bilinear"

`jaxik.world.terrain.heightfield` says more about each. `numpy.savez` writes such a file.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from fitting.datasets import archives
from fitting.runtime.validation import check_file

SUFFIX = ".npz"
REQUIRED = ("heights", "spacing")
OPTIONAL = ("origin", "interpolation")


class HeightfieldArrays(NamedTuple):
    """What an archive holds, as arguments of `jaxik.world.terrain.heightfield`."""

    heights: Float64[np.ndarray, "rows columns"]
    spacing: Float64[np.ndarray, "..."]
    origin: Float64[np.ndarray, "3"]
    interpolation: str


def read_heightfield(path: Path) -> HeightfieldArrays:
    """The arrays in an archive; their shapes and values are not checked.

    Raises:
        ValueError: no such file, no archive, other arrays in it, or arrays that are no numbers.
    """
    check_file(path)
    content = archives.read_arrays(path)
    if not set(REQUIRED) <= set(content) <= {*REQUIRED, *OPTIONAL}:
        raise ValueError(
            f"{path}: a heightfield is the arrays {' and '.join(REQUIRED)}, with or without "
            f"{' and '.join(OPTIONAL)}; the file has {', '.join(sorted(content))}"
        )
    interpolation = content.pop("interpolation", np.array("bilinear"))
    numbers = {"origin": np.zeros(3), **content}
    for name, array in numbers.items():
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{path}: {name} must be real numbers; got {array.dtype}")
    return HeightfieldArrays(
        **{name: array.astype(np.float64) for name, array in numbers.items()},
        interpolation=str(interpolation),
    )
