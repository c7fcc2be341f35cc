"""Terrain files: anything trimesh reads becomes a `jaxik.world.terrain.Terrain`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import ArrayLike, Float, Int

from jaxik.world import terrain

MESHES = (".ply", ".obj", ".stl")  # what `save_mesh` writes
# Rows give our x, y, z from the file's. A file with z up is tipped forward about x, as glTF
# exporters do: its x stays, its z is our y and its y points to our -z.
_WORLD_FROM_FILE = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}


def load_terrain(
    path: str | Path,
    *,
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int = 0,
    file_up: str = "y",
    scale: float = 1.0,
    slack: float = 0.0,
    dtype=None,
) -> terrain.Terrain:
    """The triangles of a file as terrain.

    A scene of several geometries becomes one mesh, each placed by its transform. Vertices keep the
    file's order where it has one geometry.

    Args:
        path: PLY, OBJ, STL, GLB, OFF or whatever else trimesh reads.
        up: the direction against which rays run, in our world; need not be unit.
        layer: 0 to 31, for all triangles.
        file_up: the file's up axis. "z" turns the mesh into our world: (x, y, z) to (x, z, -y).
        scale: metres per unit of the file; 0.01 for centimetres.
        slack: m, see `jaxik.world.terrain.mesh`.
        dtype: of the floats; None takes JAX's default.

    Raises:
        ValueError: a file that is not there, that trimesh cannot read or that holds no triangle;
            vertices that are not finite; an `up` of no length; another `file_up`, `scale`, `layer`.
    """
    if file_up not in _WORLD_FROM_FILE:
        known = " or ".join(repr(axis) for axis in _WORLD_FROM_FILE)
        raise ValueError(f"file_up is the file's up axis, {known}; got {file_up!r}")
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"scale is metres per unit, above 0; got {scale}")
    vertices, triangles = _read(Path(path))
    try:
        return terrain.mesh(
            scale * vertices @ _WORLD_FROM_FILE[file_up].T,
            triangles,
            up=up,
            layer=layer,
            slack=slack,
            dtype=dtype,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def check_mesh_name(path: str | Path) -> None:
    """ValueError for a name whose suffix says no format of `save_mesh`."""
    if Path(path).suffix.lower() not in MESHES:
        raise ValueError(f"{path}: wanted a name that ends in {', '.join(MESHES)}")


def save_mesh(
    path: str | Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> None:
    """Writes triangles, m, y up, which `load_terrain` reads; the same bytes always.

    A PLY is text; its vertices are kept to a tenth of a millimetre.

    Args:
        path: its suffix, of `MESHES`, says the format.
        vertices: m.
        faces: their vertices, counterclockwise seen from above.
    """
    check_mesh_name(path)
    if Path(path).suffix.lower() != ".ply":
        trimesh.Trimesh(vertices, faces, process=False).export(path)
        return
    lines = [
        "ply", "format ascii 1.0", f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
        *(" ".join(f"{value:.4f}" for value in vertex) for vertex in np.round(vertices, 4) + 0.0),
        *(f"3 {a} {b} {c}" for a, b, c in faces),
    ]  # fmt: skip
    Path(path).write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")


def embree_tracer(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Any:
    """Embree over these triangles, a tracer of `trimesh.ray`; None where it is not installed."""
    if not trimesh.ray.has_embree:
        return None
    whole = trimesh.Trimesh(vertices, faces, process=False)
    return trimesh.ray.ray_pyembree.RayMeshIntersector(whole)  # pyright: ignore


def _read(
    path: Path,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "triangles 3"]]:
    """Vertices and triangles of all geometries of a file, in the file's world and unit."""
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file")
    formats = sorted(trimesh.available_formats())
    if not path.name.lower().endswith(tuple(f".{name}" for name in formats)):
        raise ValueError(f"{path}: trimesh reads {', '.join(formats)}; not {path.suffix!r}")
    try:
        # Unprocessed: trimesh would merge and drop vertices, and a row must stay a row.
        scene = trimesh.load_scene(path, process=False)
        whole = scene.to_mesh()
    except Exception as error:  # each format's reader fails in its own way
        raise ValueError(f"{path}: trimesh cannot read it: {error}") from error
    if not len(whole.faces):
        held = ", ".join(type(held).__name__ for held in scene.geometry.values()) or "nothing"
        raise ValueError(f"{path}: terrain needs triangles; the file holds {held}")
    return np.array(whole.vertices, np.float64), np.array(whole.faces, np.int64)


def height_function(
    ground: terrain.Terrain, above: float = 100.0
) -> Callable[[np.ndarray], np.ndarray]:
    """Height of the highest ground under points (points, 3), m; NaN where there is none.

    Args:
        ground: with y up.
        above: m, where the rays start over the points.
    """

    def under(points_ws: np.ndarray) -> np.ndarray:
        origins = jnp.asarray(points_ws) * jnp.array([1.0, 0.0, 1.0]) + jnp.array([0, above, 0])
        hit = terrain.cast(ground, origins, jnp.asarray(2 * above))
        return np.where(hit.found > 0, np.asarray(hit.point)[..., 1], np.nan)

    return under
