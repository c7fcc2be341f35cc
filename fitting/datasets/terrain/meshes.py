"""Triangle meshes as plain arrays, as terrain is made and saved here."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64


class Mesh(NamedTuple):
    """Triangles over vertices in world space, y up."""

    vertices: Float64[np.ndarray, "vertices 3"]
    """Metres."""
    faces: Int64[np.ndarray, "faces 3"]
    """Vertex indices, counterclockwise seen from above."""


def join(*meshes: Mesh) -> Mesh:
    """The meshes as one, without merging vertices."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def grid_faces(rows: int, columns: int) -> Int64[np.ndarray, "faces 3"]:
    """Two triangles for each cell of a grid of vertices, numbered row by row.

    They face up where rows follow each other along z and columns along x.
    """
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    near, far = corner, corner + columns
    first = np.stack([near, far, far + 1], axis=-1)
    second = np.stack([near, far + 1, near + 1], axis=-1)
    return np.concatenate([first, second]).astype(np.int64)
