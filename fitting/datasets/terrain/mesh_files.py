"""Terrain files: reads meshes and heightfields as `jaxik.world.terrain.Terrain`; writes meshes."""

import io
import logging
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
import trimesh
from jax.typing import DTypeLike
from jaxtyping import ArrayLike, Float, Int
from trimesh.exchange.load import mesh_formats
from trimesh.resolvers import FilePathResolver

from fitting.datasets import gltf_checks
from fitting.runtime.validation import QUOTED, check_file, error_context, in_one_line
from jaxik.world import terrain

from . import heightfield_files

MESH_SUFFIXES = (".ply", ".obj", ".stl")  # of the formats that `save_mesh` writes
FAR = 512.0  # m; further from the origin, 32 bits do not hold a tenth of a millimetre
WITH_MATERIALS = ("obj", *gltf_checks.KINDS)  # whose images need not be read
# A vertex of a text format with a number that is none.
NOT_FINITE = re.compile(
    rb"^[ \t]*(?:v|vertex)?[\d.e+\- \t]*\b(?:nan|inf|infinity)\b.*", re.IGNORECASE | re.MULTILINE
)
# A file with z up is rotated about x, as glTF exporters do: (x, y, z) becomes (x, z, -y).
_WORLD_FROM_FILE = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}


@dataclass(frozen=True)
class TerrainOptions:
    """How the numbers of a terrain's file become metres with y up.

    The fields are arguments of `load_terrain`: `load_terrain(path, **vars(options))`.
    """

    file_up: str = "y"
    """Up axis of a mesh's file, "y" or "z"."""
    scale: float | None = None
    """Metres per unit of the file, or per level of a picture; None is 1, but for a picture."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, world space, by which the terrain is then moved."""
    cell: float | None = None
    """m, between neighbours of a heightfield whose file does not say it."""


AS_IS = TerrainOptions()
"""The file is in metres, with y up."""


def load_terrain(
    path: str | Path,
    *,
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int = 0,
    file_up: str = "y",
    scale: float | None = None,
    offset: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
    cell: float | None = None,
    slack: float = 0.0,
    dtype: DTypeLike | None = None,
) -> terrain.Terrain:
    """The mesh or heightfield of a file as terrain, in metres with y up.

    A scene of several geometries becomes one mesh, with each geometry's transform applied. Vertices
    of a single geometry keep the file's order.

    Args:
        path: PLY, OBJ, STL, GLB, OFF or whatever else trimesh reads; or a heightfield as NPZ, NPY
            or PNG, see `heightfield_files`.
        up: direction opposite to the rays that probe the ground, and of a heightfield's heights;
            world space, any length.
        layer: 0 to 31, of all triangles.
        file_up: the file's up axis, "y" or "z"; with "z", (x, y, z) becomes (x, z, -y). A
            heightfield has y up.
        scale: metres per unit of the file, 0.01 for centimetres, or per level of a picture; None is
            1, but for a picture.
        offset: m, world space, by which the terrain is moved when it is in metres with y up.
        cell: m, between neighbours of an NPY or PNG.
        slack: m, of a mesh; see `jaxik.world.terrain.mesh`.
        dtype: of the floats; None takes JAX's default.

    Raises:
        ValueError: no such file, a file that cannot be read or that has no triangles, vertices that
            are not finite, arrays that are no heightfield, an `up` of zero length, or another
            argument out of range.
    """
    if file_up not in _WORLD_FROM_FILE:
        known = " or ".join(repr(axis) for axis in _WORLD_FROM_FILE)
        raise ValueError(f"file_up is the file's up axis, {known}; got {file_up!r}")
    for name, value in (("scale", scale), ("cell", cell)):
        if value is not None and not (np.isfinite(value) and value > 0):
            unit = "metres per unit" if name == "scale" else "in metres"
            raise ValueError(f"{name} is {unit}, above 0; got {value}")
    moved = np.asarray(offset, np.float64)
    if moved.shape != (3,) or not np.isfinite(moved).all():
        raise ValueError(f"offset is x, y and z in metres; got {offset}")
    path = Path(path)
    if path.suffix.lower() in heightfield_files.SUFFIXES:
        if file_up != "y":
            raise ValueError(f"{path}: a heightfield has y up; got file_up {file_up!r}")
        field = heightfield_files.read_heightfield(path, scale, cell)
        with error_context(path):
            return terrain.heightfield(
                _as_dtype(field.heights, dtype),
                field.spacing,
                field.origin + moved,
                up=up,
                layer=layer,
                interpolation=field.interpolation,
            )
    if cell is not None:
        raise ValueError(f"{path}: a mesh has no cell; got {cell:g}")
    vertices, triangles = _read(path)
    with np.errstate(all="ignore"):  # what is not finite, or too far away, is refused below
        unit = 1.0 if scale is None else scale
        vertices_ws = _as_dtype(unit * vertices @ _WORLD_FROM_FILE[file_up].T + moved, dtype)
    with error_context(path):
        return terrain.mesh(vertices_ws, triangles, up=up, layer=layer, slack=slack)


def _as_dtype(array: Float[np.ndarray, "..."], dtype: DTypeLike | None) -> np.ndarray:
    return array if dtype is None else array.astype(dtype)


def check_mesh_name(path: str | Path) -> None:
    """ValueError unless the suffix is that of a format of `save_mesh`."""
    if Path(path).suffix.lower() not in MESH_SUFFIXES:
        raise ValueError(f"{path}: wanted a name that ends in {', '.join(MESH_SUFFIXES)}")


def save_mesh(
    path: str | Path, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> None:
    """Writes a mesh that `load_terrain` reads. The same mesh always gives the same bytes.

    A PLY is written as text, with vertices rounded to a tenth of a millimetre.

    Args:
        path: its suffix, one of `MESH_SUFFIXES`, selects the format.
        vertices: m, y up.
        faces: vertex indices, counterclockwise seen from above.

    Raises:
        ValueError: another suffix.
    """
    check_mesh_name(path)
    if Path(path).suffix.lower() != ".ply":
        trimesh.Trimesh(vertices, faces, process=False).export(path)
        return
    number = "float" if np.abs(vertices).max(initial=0.0) < FAR else "double"
    lines = [
        "ply", "format ascii 1.0", f"element vertex {len(vertices)}",
        *(f"property {number} {axis}" for axis in "xyz"),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
        *(" ".join(f"{value:.4f}" for value in vertex) for vertex in np.round(vertices, 4) + 0.0),
        *(f"3 {a} {b} {c}" for a, b, c in faces),
    ]  # fmt: skip
    Path(path).write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")


@runtime_checkable
class RayTracer(Protocol):
    """What is used of a ray intersector of `trimesh.ray`."""

    def intersects_location(
        self, ray_origins: np.ndarray, ray_directions: np.ndarray, multiple_hits: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hit points (hits, 3), and for each the index of its ray and of its triangle."""
        ...

    def intersects_first(self, ray_origins: np.ndarray, ray_directions: np.ndarray) -> np.ndarray:
        """Index of the first triangle that each ray hits; -1 for none."""
        ...


def embree_tracer(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> RayTracer | None:
    """Embree, a fast ray tracer, over these triangles; None where it is not installed."""
    if not trimesh.ray.has_embree:
        return None
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)  # pyright: ignore


def _read(path: Path) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "triangles 3"]]:
    """Vertices and triangles of all geometries of a file, in its own unit and axes."""
    check_file(path)
    formats = sorted(mesh_formats())  # no archives: they may hold anything
    kind = path.suffix.lower().removeprefix(".")
    if kind not in formats:
        raise ValueError(
            f"{path}: wanted a heightfield ({', '.join(heightfield_files.SUFFIXES)}) or a mesh "
            f"that trimesh reads "
            f"({', '.join(formats)}); not {path.suffix!r}"
        )
    options: dict[str, Any] = {"skip_materials": True} if kind in WITH_MATERIALS else {}
    content = path.read_bytes()  # of a file, trimesh would try to read as much as a header says
    try:
        _check_whole(kind, content)
        content = gltf_checks.checked(kind, content, path.parent)
        with _silent_trimesh():
            # Unprocessed, as trimesh would otherwise merge and drop vertices.
            resolver = FilePathResolver(str(path))
            scene = trimesh.load_scene(
                io.BytesIO(content), file_type=kind, resolver=resolver, process=False, **options
            )
            mesh = scene.to_mesh()
    except gltf_checks.RefusalError as error:
        raise ValueError(f"{path}: {in_one_line(error, QUOTED)}") from None
    except ImportError:  # of a package that guesses encodings, which is no requirement
        raise ValueError(
            f"{path}: trimesh cannot read it: neither a whole binary file nor text in UTF-8"
        ) from None
    except Exception as error:  # each format's reader fails in its own way
        raise ValueError(f"{path}: trimesh cannot read it: {in_one_line(error, QUOTED)}") from None
    if not len(mesh.faces):
        content = ", ".join(type(each).__name__ for each in scene.geometry.values()) or "nothing"
        raise ValueError(f"{path}: terrain needs triangles; the file holds {content}")
    vertices = np.array(mesh.vertices, np.float64)
    if vertices.shape[1:] != (3,):
        raise ValueError(f"{path}: its vertices have {vertices.shape[-1]} coordinates; wanted 3")
    known = np.isfinite(vertices).all(axis=-1)
    if not known.all():
        first = int(np.argmin(known))
        place, got = f"{path}: vertex {first}", str(vertices[first].tolist())
        if line := NOT_FINITE.search(content):
            number = content.count(b"\n", 0, line.start()) + 1
            place, got = f"{path}:{number}", repr(line[0].decode(errors="replace").strip())
        raise ValueError(f"{place}: wanted finite coordinates; got {got}")
    return vertices, np.array(mesh.faces, np.int64)


def _check_whole(kind: str, content: bytes) -> None:
    """ValueError for a text that ends too early: trimesh would take the triangles that are there.

    Binary files that do fail by themselves, and an OBJ does not say what it holds.
    """
    announced, rows, has_faces_last = 0, [], False
    if kind == "ply" and b"format ascii" in (head := content.partition(b"end_header")[0]):
        rows = content.partition(b"end_header")[2].splitlines()
        elements = [part.split() for part in head.split(b"element ")[1:]]
        counts = [int(words[1]) for words in elements]
        announced, last = (
            sum(counts),
            [words for words, n in zip(elements, counts, strict=True) if n],
        )
        has_faces_last = bool(last) and last[-1][2:4] == [b"property", b"list"]
    elif kind == "off":
        lines = [line.partition(b"#")[0] for line in content.splitlines()]
        head, *rows = b"\n".join(lines).partition(b"OFF")[2].strip().splitlines() or [b""]
        counts = [int(word) for word in head.split()[:2]]
        announced, has_faces_last = sum(counts), counts[1:] > [0]
    elif kind == "stl" and content.lstrip()[:5].lower() == b"solid" and b"\0" not in content:
        if b"endsolid" not in content.lower():
            raise ValueError("the file is cut off: it has no endsolid")
    rows = [row for row in rows if row.strip()]
    if len(rows) < announced:
        raise ValueError(
            f"the file is cut off: its head announces {announced} lines of vertices and faces, "
            f"there are {len(rows)}"
        )
    if has_faces_last:
        corners = rows[announced - 1].split()
        if len(corners) <= int(corners[0]):
            raise ValueError(f"the file is cut off in line {announced} after its head")


@contextmanager
def _silent_trimesh() -> Iterator[None]:
    """Keeps trimesh from printing what it thinks of a file."""
    log, nowhere = logging.getLogger("trimesh"), logging.NullHandler()
    before, log.propagate = log.propagate, False
    log.addHandler(nowhere)
    try:
        yield
    finally:
        log.removeHandler(nowhere)
        log.propagate = before


def height_function(
    surface: terrain.Terrain, above: float = 100.0
) -> Callable[[np.ndarray], np.ndarray]:
    """A function from points (points, 3), m, to the height of the highest ground below them, m.

    The height is NaN where there is no ground.

    Args:
        surface: terrain with y up.
        above: m, height at which the rays start.
    """

    def height_under(points_ws: np.ndarray) -> np.ndarray:
        hit = _cast_down(surface, points_ws, above)
        return np.where(hit.found > 0, np.asarray(hit.point)[..., 1], np.nan)

    return height_under


def normal_function(
    surface: terrain.Terrain, above: float = 100.0
) -> Callable[[np.ndarray], np.ndarray]:
    """A function from points (points, 3), m, to the unit normal of the highest ground below them.

    The normal is the up axis where there is no ground; see `height_function`.
    """

    def normal_under(points_ws: np.ndarray) -> np.ndarray:
        hit = _cast_down(surface, points_ws, above)
        return np.where(hit.found[:, None] > 0, hit.normal, [0.0, 1.0, 0.0])

    return normal_under


def _cast_down(surface: terrain.Terrain, points_ws: np.ndarray, above: float) -> terrain.Hit:
    origins = jnp.asarray(points_ws) * jnp.array([1.0, 0.0, 1.0]) + jnp.array([0, above, 0])
    return terrain.cast(surface, origins, jnp.asarray(2 * above))
