"""Terrain files: reads meshes and heightfields as `jaxik.world.terrain.Terrain`; writes meshes.

Heightfields (`jaxik.world.terrain.heightfield` says more) come as `.npz`, which states its spacing:

    heights         (rows, columns), m; rows along z, columns along x; NaN leaves holes
    spacing         m, between neighbours; two numbers are those along x and along z
    origin          (3), m, of row 0 and column 0 at height 0; where missing, zero
    interpolation   "bilinear" or "triangulated"; where missing, "bilinear"

as `.npy`, the heights alone, or as `.png`: a grey picture of 8 or 16 bits, whose levels are
heights; x goes right and z goes down in it. It may be stored in colours of 8 bits, as long as all
of them are grey and opaque. For both the user says how far neighbours are apart, the cell, and for
a picture also how many metres a level is.
"""

import io
import logging
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
import trimesh
from jax.typing import DTypeLike
from jaxtyping import ArrayLike, Float, Float64, Int, Int64
from PIL import Image, ImageFile
from trimesh.exchange.load import mesh_formats
from trimesh.resolvers import FilePathResolver

from fitting.clips.formats import gltf, gltf_document, npz
from fitting.runtime.declarations import key
from fitting.runtime.validation import QUOTED, check_file, error_context, in_one_line
from jaxik.world import surfaces, terrain
from jaxik.world.heightfield import Heightfield
from jaxik.world.terrain import Terrain

MESH_SUFFIXES = (".ply", ".obj", ".stl")  # of the formats that `save_mesh` writes
FAR = 512.0  # m; further from the origin, 32 bits do not hold a tenth of a millimetre
WITH_MATERIALS = ("obj", *gltf.KINDS)  # whose images need not be read
# A vertex of a text format with a number that is none.
NOT_FINITE = re.compile(
    rb"^[ \t]*(?:v|vertex)?[\d.e+\- \t]*\b(?:nan|inf|infinity)\b.*", re.IGNORECASE | re.MULTILINE
)
# A file with z up is rotated about x, as glTF exporters do: (x, y, z) becomes (x, z, -y).
_WORLD_FROM_FILE = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}

ARCHIVE, ARRAY, PICTURE = ".npz", ".npy", ".png"
SUFFIXES = (ARCHIVE, ARRAY, PICTURE)
REQUIRED = ("heights", "spacing")
OPTIONAL = ("origin", "interpolation")
# Bytes a pixel, by Pillow's modes: of grey pictures, and of others that may hold one.
GREY = {"L": 1, "I;16": 2, "I;16B": 2, "I": 4}
COLOURED = {"P": 1, "LA": 2, "RGB": 3, "RGBA": 4}
OPAQUE = 255
ABOVE = 100.0  # m, at which rays start
MOST_PIXELS = 2**26
MOST_PACKED = 1040  # bytes of a picture for each of its file: deflate reaches 1032


@dataclass(frozen=True, kw_only=True)
class TerrainOptions:
    """How the numbers of a terrain's file become metres with y up; without any, it has both."""

    file_up: Literal["y", "z"] = key("y", "Up axis of the terrain's file.")
    terrain_scale: float | None = key(None, "Metres per unit of the terrain's file.", "", 1e-9, 1e6)
    terrain_offset: tuple[float, float, float] | None = key(
        None, "By which the terrain is moved.", "m", -1e6, 1e6
    )
    terrain_cell: float | None = key(
        None, "Between two heights of a terrain whose file does not say it.", "m", 1e-3, 1e4
    )

    @property
    def offset(self) -> tuple[float, float, float]:
        """m, by which the terrain is moved."""
        return self.terrain_offset or (0.0, 0.0, 0.0)

    def load(self, path: Path) -> Terrain:
        """The terrain of a file; errors are those of `load_terrain`."""
        up, scale, cell = self.file_up, self.terrain_scale, self.terrain_cell
        return load_terrain(path, file_up=up, scale=scale, offset=self.offset, cell=cell)


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
            or PNG, as the module says.
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
            are not finite, arrays that are not a heightfield, an `up` of zero length, or another
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
    if path.suffix.lower() in SUFFIXES:
        if file_up != "y":
            raise ValueError(f"{path}: a heightfield has y up; got file_up {file_up!r}")
        field = read_heightfield(path, scale, cell)
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
            f"{path}: wanted a heightfield ({', '.join(SUFFIXES)}) or a mesh that trimesh reads "
            f"({', '.join(formats)}); not {path.suffix!r}"
        )
    options: dict[str, Any] = {"skip_materials": True} if kind in WITH_MATERIALS else {}
    content = path.read_bytes()  # of a file, trimesh would try to read as much as a header says
    try:
        _check_whole(kind, content)
        content = gltf.checked(kind, content, path.parent)
        with _silent_trimesh():
            # Unprocessed, as trimesh would otherwise merge and drop vertices.
            resolver = FilePathResolver(str(path))
            scene = trimesh.load_scene(
                io.BytesIO(content), file_type=kind, resolver=resolver, process=False, **options
            )
            mesh = scene.to_mesh()
    except gltf_document.RefusalError as error:
        raise ValueError(f"{path}: {in_one_line(error, QUOTED)}") from None
    except ImportError:  # of a package that guesses encodings, which is not required
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


def height_function(surface: terrain.Terrain) -> Callable[[np.ndarray], np.ndarray]:
    """A function from points (points, 3), m, to the height of the highest ground below them, m.

    The terrain has y up. The height is NaN where there is no ground.
    """

    def height_under(points_ws: np.ndarray) -> np.ndarray:
        hit = _cast_down(surface, points_ws)
        return np.where(hit.found > 0, np.asarray(hit.point)[..., 1], np.nan)

    return height_under


def normal_function(surface: terrain.Terrain) -> Callable[[np.ndarray], np.ndarray]:
    """A function from points (points, 3), m, to the unit normal of the highest ground below them.

    The terrain has y up. The normal is the up axis where there is no ground.
    """

    def normal_under(points_ws: np.ndarray) -> np.ndarray:
        hit = _cast_down(surface, points_ws)
        return np.where(hit.found[:, None] > 0, hit.normal, [0.0, 1.0, 0.0])

    return normal_under


def _cast_down(surface: terrain.Terrain, points_ws: np.ndarray) -> terrain.Hit:
    origins = jnp.asarray(points_ws) * jnp.array([1.0, 0.0, 1.0]) + jnp.array([0, ABOVE, 0])
    return terrain.cast(surface, origins, jnp.asarray(2 * ABOVE))


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
        vertices, triangles, _ = surface.on_host()
        return Mesh(vertices.astype(np.float64), triangles.astype(np.int64))
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
    content = npz.read_arrays(path)
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
    return _as_numbers(path, "the array", npz.read_array(path))


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
