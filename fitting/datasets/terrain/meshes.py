"""Triangle meshes as plain arrays, as terrain is made and saved here."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxik.world import surfaces
from jaxik.world.heightfield import Heightfield
from jaxik.world.terrain import Terrain


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


def mesh_of(terrain: Terrain) -> Mesh:
    """The triangles of all meshes and heightfields of a terrain; without the holes of the latter.

    A cell of a heightfield becomes two triangles, also where its heights are bilinear.

    Raises:
        ValueError: a surface is neither.
    """
    return join(*map(_mesh_of_surface, terrain.surfaces))


def _mesh_of_surface(surface: surfaces.AbstractSurface) -> Mesh:
    if isinstance(surface, surfaces.Mesh):
        vertices = np.asarray(surface.vertices_ws, np.float64)
        if surface.offset_ws is not None:
            vertices = vertices + np.asarray(surface.offset_ws)
        return Mesh(vertices, np.asarray(surface.triangles, np.int64))
    if not isinstance(surface, Heightfield):
        raise ValueError(f"a {type(surface).__name__} has no triangles; wanted a mesh")
    heights = np.asarray(surface.heights, np.float64)
    rows, columns = heights.shape
    width, depth = np.asarray(surface.spacing, np.float64)
    x, z = np.meshgrid(width * np.arange(columns), depth * np.arange(rows))
    points = np.stack([x, heights, z], axis=-1).reshape(-1, 3)
    vertices = np.asarray(surface.origin_ws, np.float64) + points @ np.asarray(surface.axes_ws)
    faces = grid_faces(rows, columns)
    known = np.isfinite(heights.reshape(-1))
    cells = known[faces].all(axis=-1).reshape(2, -1).all(axis=0)
    return Mesh(np.where(known[:, None], vertices, 0.0), faces[np.tile(cells, 2)])
