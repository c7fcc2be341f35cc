"""Terrain files: meshes, heightfields and pictures, units and axes, and files that are refused."""

import struct
import zlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image

from fitting.datasets.ground_path import RAYS, heights_under
from fitting.datasets.terrain.mesh_files import height_function, load_terrain, save_mesh
from jaxik.world import terrain
from jaxik.world.heightfield import Heightfield
from jaxik.world.surfaces import Mesh

ROOT = Path(__file__).resolve().parents[2]
LEVELS = (np.arange(5)[:, None] * 1000 + np.arange(7) * 10).astype(np.uint16)  # rows along z
FLAT = np.zeros((3, 2))


def ramp() -> trimesh.Trimesh:
    """One square metre that rises by half a metre along x."""
    corners = [[0, 0, 0], [1, 0.5, 0], [1, 0.5, 1], [0, 0, 1]]
    return trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)


def save_ramp(path: Path, **changes) -> None:
    """The ramp as a heightfield of three rows and two columns."""
    arrays = {"heights": [[0.0, 0.5]] * 3, "spacing": [1.0, 0.5], **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def heights(ground: terrain.Terrain, *points_xz: tuple[float, float]) -> np.ndarray:
    """Heights of the ground at these points, m; NaN where there is none."""
    return heights_under(ground, np.insert(np.array(points_xz), 1, 0.0, axis=1), 100.0)


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off", "glb"])
def test_all_common_formats_give_the_same_terrain(tmp_path, suffix):
    ramp().export(tmp_path / f"ramp.{suffix}")
    ground = load_terrain(tmp_path / f"ramp.{suffix}")
    np.testing.assert_allclose(heights(ground, (0.4, 0.3)), 0.2, atol=1e-6)


def test_a_scene_is_joined_where_its_transforms_put_its_meshes(tmp_path):
    scene = trimesh.Scene()
    for name, place in (("low", (0.0, 0.0, 0.0)), ("high", (3.0, 1.0, 0.0))):
        transform = trimesh.transformations.translation_matrix(place)
        scene.add_geometry(trimesh.creation.box((1.0, 0.2, 1.0)), name, transform=transform)
    scene.apply_scale(100.0)
    scene.export(tmp_path / "slabs.glb")
    ground = load_terrain(tmp_path / "slabs.glb", scale=0.01, offset=(0.0, 0.0, 7.0))
    found = heights(ground, (0.1, 7.2), (3.1, 6.8), (1.5, 7.0), (0.1, 0.2))
    np.testing.assert_allclose(found, [0.1, 1.1, np.nan, np.nan], atol=1e-5)


def test_a_mesh_with_z_up_is_turned_and_scaled_before_it_is_moved(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 100], [100, 0, 100], [0, 100, 100]], [[0, 1, 2]], process=False)
    mesh.export(tmp_path / "tile.ply")
    ground = load_terrain(tmp_path / "tile.ply", file_up="z", scale=0.01, offset=(5.0, 0.5, 0.0))
    found = height_function(ground)(np.array([[5.2, 0.0, -0.2], [5.2, 0.0, 0.2]]))
    np.testing.assert_allclose(found, [1.5, np.nan], atol=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "npz"])
def test_up_layer_and_dtype_reach_the_terrain_and_so_does_all_of_an_archive(tmp_path, suffix):
    path = tmp_path / f"ramp.{suffix}"
    if suffix == "ply":
        ramp().apply_translation([2.0, 0.1, 0.0]).apply_scale(100.0).export(path)
    else:
        levels, kind = np.array([[0, 50]] * 3, np.uint16), "triangulated"
        origin = [200.0, 10.0, 0.0]
        save_ramp(path, heights=levels, spacing=100, origin=origin, interpolation=kind)
    up, dtype = (0.0, 2.0, 0.0), jnp.float32
    ground = load_terrain(path, up=up, layer=4, scale=0.01, slack=0.1, dtype=dtype)
    (surface,) = ground.surfaces
    np.testing.assert_array_equal(ground.up_ws, [0.0, 1.0, 0.0])
    assert ground.up_ws.dtype == jnp.float32
    if isinstance(surface, Heightfield):
        assert surface.interpolation == "triangulated" and surface.heights.dtype == jnp.float32
    start = jnp.array([2.4, 5.0, 0.3], jnp.float32)
    on_layer, beside = (terrain.cast(ground, start, 9.0, terrain.layer_mask(n)) for n in (4, 0))
    assert on_layer.point[1] == pytest.approx(0.3, abs=1e-6)
    assert (on_layer.found, beside.found) == (1.0, 0.0)


def test_the_terrain_of_the_blocks_benchmark_is_in_metres_with_y_up(mocap):
    ground = load_terrain(mocap / "blocks" / "terrain.ply")
    (surface,) = ground.surfaces
    assert isinstance(surface, Mesh)
    corners = np.asarray(surface.vertices_ws)
    assert np.ptp(corners[:, 1]) < 1.5 < np.ptp(corners[:, 0]) < 20.0
    low, high = corners.min(axis=0), corners.max(axis=0)
    assert low[1] <= heights(ground, tuple((low + high)[[0, 2]] / 2)) <= high[1]


# Heightfields


def test_clips_are_flattened_over_a_heightfield_as_over_its_mesh(tmp_path):
    save_ramp(tmp_path / "ramp.npz")
    ramp().export(tmp_path / "ramp.ply")
    field, mesh = (load_terrain(tmp_path / name) for name in ("ramp.npz", "ramp.ply"))
    (surface,) = field.surfaces
    assert isinstance(surface, Heightfield) and surface.interpolation == "bilinear"
    points = np.random.default_rng(0).uniform(-0.2, 1.2, (200, 3))
    found = height_function(field)(points)
    assert 50 < np.isfinite(found).sum() < 200
    np.testing.assert_allclose(found, height_function(mesh)(points), atol=1e-6)


def test_pictures_of_16_bits_and_arrays_have_metres_per_level_and_cell_and_holes(tmp_path):
    Image.fromarray(LEVELS).save(tmp_path / "hill.png")
    ground = load_terrain(tmp_path / "hill.png", cell=0.5, scale=0.001, offset=(10.0, 1.0, -2.0))
    points = [(10 + 0.5 * column, -2 + 0.5 * row) for row in range(4) for column in range(6)]
    expected = 1 + 0.001 * LEVELS[:4, :6].ravel()
    np.testing.assert_allclose(heights(ground, *points), expected, atol=1e-4)
    np.save(tmp_path / "hill.npy", np.where(LEVELS == 2030, np.nan, LEVELS / 1000))
    ground = load_terrain(tmp_path / "hill.npy", cell=2.0)
    np.testing.assert_allclose(heights(ground, (1.0, 3.0), (5.5, 3.5)), [1.505, np.nan], atol=1e-5)


def test_any_number_of_points_has_heights(tmp_path):
    x, z = np.meshgrid(np.arange(40), np.arange(30))
    np.save(tmp_path / "slope.npy", 0.1 * x - 0.2 * z)
    ground = load_terrain(tmp_path / "slope.npy", cell=1.0)
    for shape in ((0,), (1,), (RAYS,), (3, RAYS - 1)):
        points = np.random.default_rng(1).uniform([-5, 0, 1], [38, 0, 28], (*shape, 3))
        x, z = points[..., 0], points[..., 2]
        expected = np.where(x > 0, 0.1 * x - 0.2 * z, np.nan)
        np.testing.assert_allclose(heights_under(ground, points, 100.0), expected, atol=1e-4)
        starts = np.where(z < 10, 100.0, -100.0)
        expected = np.where(starts > 0, expected, np.nan)
        np.testing.assert_allclose(heights_under(ground, points, starts), expected, atol=1e-4)


# What is refused


def test_the_error_for_an_archive_that_is_no_heightfield_names_it(tmp_path):
    for changes, message in (
        ({"spacing": None}, "heights and spacing, with or without .*; the file has heights$"),
        ({"name": "hill"}, "the file has heights, name, spacing"),
        ({"heights": [0.0, 1.0]}, r"2 or more columns\); got \(2,\)"),
        ({"heights": [["low", "high"]] * 2}, "heights must be real numbers; got <U4"),
        ({"heights": [[0.0, np.inf]] * 2}, r"the first is heights\[0, 1\]; a hole is NaN"),
        ({"heights": FLAT + 1e300}, r"heights\[0, 0\]: 1e.300; wanted at most 1e.07 m"),
        ({"heights": np.array([None])}, "wanted a NumPy archive of plain arrays"),
        ({"spacing": [1.0, 0.0]}, "above 0"),
        ({"spacing": 1e-9}, "wanted 1e-06 m or more"),
        ({"spacing": 1e300}, "at most 1e.07 m from end to end"),
        ({"spacing": [1.0, 1e9]}, "at most 1e.07 m from end to end"),
        ({"origin": [0.0, 1e300, 0.0]}, "origin is three numbers of at most 1e.07 m"),
        ({"origin": [0.0, np.nan, 0.0]}, "origin is three numbers of at most 1e.07 m"),
        ({"interpolation": "cubic"}, "'bilinear' or 'triangulated'; got 'cubic'"),
    ):
        save_ramp(tmp_path / "hill.npz", **changes)
        with pytest.raises(ValueError, match=f"hill.npz: .*{message}"):
            load_terrain(tmp_path / "hill.npz")


CELL, BOTH = {"cell": 1.0}, {"cell": 1.0, "scale": 1.0}
WITHOUT_TERRAIN = {
    "text.obj": "v 0 0 0\nv 1 0 0\n",
    "text.stl": "solid nothing\nendsolid nothing\n",
    "text.off": "OFF\n3 1 0\n0 0 0\n1 0 nan\n0 0 1\n3 0 1 2\n",
    **dict.fromkeys(("text.ply", "text.npz", "text.npy", "text.png", "text.fbx"), "x"),
}


def test_what_is_missing_or_wrong_is_said(tmp_path):
    Image.fromarray(LEVELS).save(tmp_path / "hill.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "colour.png")
    for name, array in (("hill", LEVELS), ("objects", np.array([None])), ("words", ["x"])):
        np.save(tmp_path / f"{name}.npy", array)
    save_ramp(tmp_path / "hill.npz")
    ramp().export(tmp_path / "hill.ply")
    for name, text in WITHOUT_TERRAIN.items():
        (tmp_path / name).write_text(text)
    for file, options, message in (
        ("hill.png", {"scale": 1.0}, "hill.png: how far are its heights apart. .*--terrain-cell"),
        ("hill.png", CELL, "hill.png: how high is a level.* --terrain-scale.*Unreal"),
        ("hill.npy", {}, "hill.npy: how far are its heights apart"),
        ("hill.npz", CELL, "hill.npz: an .npz states its spacing itself; got the cell 1"),
        ("hill.npz", {"file_up": "z"}, "hill.npz: a heightfield has y up; got file_up 'z'"),
        ("hill.npy", {"file_up": "z", **CELL}, "a heightfield has y up"),
        ("hill.ply", CELL, "hill.ply: a mesh has no cell; got 1"),
        ("hill.ply", {"cell": -1.0}, "cell is in metres, above 0; got -1"),
        ("hill.ply", {"offset": (1.0, 2.0)}, "offset is x, y and z in metres"),
        ("hill.ply", {"offset": (1.0, 2.0, np.nan)}, "offset is x, y and z in metres"),
        ("hill.ply", {"up": (0.0, 0.0, 0.0)}, "up is a direction"),
        ("hill.ply", {"layer": 32}, "from 0 to 31"),
        ("hill.ply", {"scale": 0.0}, "scale is metres per unit"),
        ("hill.ply", {"file_up": "x"}, "'y' or 'z'; got 'x'"),
        ("colour.png", BOTH, "colour.png: wanted one channel .*; got a picture of mode 'RGB'"),
        ("objects.npy", CELL, "objects.npy: wanted a NumPy array .*allow_pickle"),
        ("words.npy", CELL, "words.npy: the array must be real numbers"),
        ("text.png", BOTH, "text.png: wanted a PNG"),
        ("text.npy", CELL, "text.npy: wanted a NumPy array"),
        ("text.npz", {}, "text.npz: wanted a NumPy archive of plain arrays"),
        ("text.fbx", {}, "text.fbx: wanted .*trimesh reads .*ply.*; not '.fbx'"),
        ("text.ply", {}, "text.ply: .*cannot read it"),
        ("text.obj", {}, "text.obj: .*needs triangles; the file holds PointCloud"),
        ("text.stl", {}, "text.stl: .*needs triangles"),
        ("text.off", {}, "text.off: .*vertices are not finite"),
        ("nowhere.ply", {}, "nowhere.ply: no such file"),
        ("nowhere.npz", {}, "nowhere.npz: no such file"),
        (ROOT / "data" / "clips" / "uneven_walk_base.npz", {}, "the file has .*joint_names"),
    ):
        with pytest.raises(ValueError, match=f"(?s){message}"):
            load_terrain(tmp_path / file, **options)  # pyright: ignore[reportArgumentType]


def png_that_says(columns: int, rows: int) -> bytes:
    """A picture of 16 bits whose header says this, with a few bytes of pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    header = struct.pack(">IIBBBBB", columns, rows, 16, 0, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(bytes(100))), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_a_picture_is_not_believed_about_its_size(tmp_path):
    for size, message in (
        ((100_000, 100_000), "hill.png: .*10000000000 pixels"),
        ((9000, 9000), "hill.png: says 9000 x 9000 pixels; wanted 67108864 at most"),
        ((2000, 2000), "hill.png: says 2000 x 2000 pixels, and has .* bytes"),
        ((20, 200), "hill.png: wanted a PNG"),  # small enough to be decoded, and cut short
    ):
        (tmp_path / "hill.png").write_bytes(png_that_says(*size))
        with pytest.raises(ValueError, match=message):
            load_terrain(tmp_path / "hill.png", cell=1.0, scale=1.0)


def test_a_written_mesh_far_from_the_origin_keeps_a_tenth_of_a_millimetre(tmp_path):
    vertices = np.array([[0.0123, 0.4567, 0.0], [1.0, 0.0, 0.8901], [0.0, 0.2345, 1.0]])
    for away in (0.0, 50_000.0):
        save_mesh(tmp_path / "hill.ply", vertices + away, np.array([[0, 1, 2]]))
        read = trimesh.load_scene(tmp_path / "hill.ply", process=False).to_mesh()
        np.testing.assert_allclose(read.vertices - away, vertices, atol=5e-5 + 1e-9)
