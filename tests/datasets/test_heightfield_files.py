"""Heights as NumPy arrays and as pictures, and how any terrain is scaled and moved."""

import struct
import zlib

import numpy as np
import pytest
import trimesh
from PIL import Image

from fitting.datasets.ground_path import RAYS, heights_under
from fitting.datasets.terrain.mesh_files import TerrainOptions, height_function, load_terrain

LEVELS = (np.arange(5)[:, None] * 1000 + np.arange(7) * 10).astype(np.uint16)  # rows along z


def test_a_picture_of_16_bits_has_metres_per_level_and_cell(tmp_path):
    Image.fromarray(LEVELS).save(tmp_path / "hill.png")
    ground = load_terrain(tmp_path / "hill.png", cell=0.5, scale=0.001, offset=(10.0, 1.0, -2.0))
    x, z = np.meshgrid(np.arange(7) * 0.5, np.arange(5) * 0.5)
    points = np.stack([x + 10, 0 * x, z - 2], axis=-1).reshape(-1, 3)[:-1]
    inner = (x.ravel() < 2.9)[:-1] & (z.ravel() < 1.9)[:-1]
    height = heights_under(ground, points[inner], 100.0)
    np.testing.assert_allclose(height, 1 + 0.001 * LEVELS.ravel()[:-1][inner], atol=1e-4)


@pytest.mark.parametrize("shape", [(0,), (1,), (RAYS,), (3, RAYS - 1)])
def test_any_number_of_points_has_heights(tmp_path, shape):
    x, z = np.meshgrid(np.arange(40), np.arange(30))
    np.save(tmp_path / "slope.npy", 0.1 * x - 0.2 * z)
    ground = load_terrain(tmp_path / "slope.npy", cell=1.0)
    points = np.random.default_rng(1).uniform([-5, 0, 1], [38, 0, 28], (*shape, 3))
    expected = np.where(points[..., 0] > 0, 0.1 * points[..., 0] - 0.2 * points[..., 2], np.nan)
    np.testing.assert_allclose(heights_under(ground, points, 100.0), expected, atol=1e-4)
    starts = np.where(points[..., 2] < 10, 100.0, -100.0)
    expected = np.where(starts > 0, expected, np.nan)
    np.testing.assert_allclose(heights_under(ground, points, starts), expected, atol=1e-4)


def test_an_array_of_heights_has_a_cell_and_holes(tmp_path):
    heights = np.where(LEVELS == 2030, np.nan, LEVELS / 1000)
    np.save(tmp_path / "hill.npy", heights)
    height_under = height_function(load_terrain(tmp_path / "hill.npy", cell=2.0))
    np.testing.assert_allclose(height_under(np.array([[1.0, 0.0, 3.0]])), 1.505, atol=1e-5)
    assert np.isnan(height_under(np.array([[5.5, 0.0, 3.5]]))).all()


@pytest.mark.parametrize(
    ("file", "options", "message"),
    [
        ("hill.png", {"scale": 1.0}, "hill.png: how far are its heights apart. .*--terrain-cell"),
        ("hill.png", {"cell": 1.0}, "hill.png: how high is a level.* --terrain-scale.*Unreal"),
        ("hill.npy", {}, "hill.npy: how far are its heights apart"),
        ("hill.npz", {"cell": 1.0}, "hill.npz: an .npz states its spacing itself; got the cell 1"),
        ("hill.ply", {"cell": 1.0}, "hill.ply: a mesh has no cell; got 1"),
        ("hill.ply", {"cell": -1.0}, "cell is in metres, above 0; got -1"),
        ("hill.ply", {"offset": (1.0, 2.0)}, "offset is x, y and z in metres"),
        ("hill.ply", {"offset": (1.0, 2.0, np.nan)}, "offset is x, y and z in metres"),
        ("hill.npy", {"cell": 1.0, "file_up": "z"}, "a heightfield has y up"),
        (
            "colour.png",
            {"cell": 1.0, "scale": 1.0},
            "colour.png: wanted one channel .*; got a picture of mode 'RGB'",
        ),
        ("text.png", {"cell": 1.0, "scale": 1.0}, "text.png: wanted a PNG"),
        ("text.npy", {"cell": 1.0}, "text.npy: wanted a NumPy array"),
        ("objects.npy", {"cell": 1.0}, "objects.npy: wanted a NumPy array .*allow_pickle"),
        ("words.npy", {"cell": 1.0}, "words.npy: the array must be real numbers"),
    ],
)
def test_what_is_missing_or_wrong_is_said(file, options, message, tmp_path):
    Image.fromarray(LEVELS).save(tmp_path / "hill.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "colour.png")
    np.save(tmp_path / "hill.npy", LEVELS)
    np.save(tmp_path / "objects.npy", np.array([None]))
    np.save(tmp_path / "words.npy", np.array(["x"]))
    np.savez(tmp_path / "hill.npz", heights=LEVELS, spacing=1.0)
    trimesh.creation.box().export(tmp_path / "hill.ply")
    for name in ("text.png", "text.npy"):
        (tmp_path / name).write_text("x")
    with pytest.raises(ValueError, match=message):
        load_terrain(tmp_path / file, **options)


def png_that_says(columns: int, rows: int, filler: int = 0) -> bytes:
    """A picture of 16 bits whose header says this, with a few bytes of pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    header = struct.pack(">IIBBBBB", columns, rows, 16, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(bytes(100))), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts) + bytes(filler)


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ((100_000, 100_000), "hill.png: .*10000000000 pixels"),
        ((9000, 9000), "hill.png: says 9000 x 9000 pixels; wanted 67108864 at most"),
        ((2000, 2000), "hill.png: says 2000 x 2000 pixels, and has .* bytes"),
        ((20, 200), "hill.png: wanted a PNG"),  # small enough to be decoded, and cut short
    ],
)
def test_a_picture_is_not_believed_about_its_size(size, message, tmp_path):
    (tmp_path / "hill.png").write_bytes(png_that_says(*size))
    with pytest.raises(ValueError, match=message):
        load_terrain(tmp_path / "hill.png", cell=1.0, scale=1.0)


def test_a_scene_of_several_meshes_is_joined_where_its_transforms_put_them(tmp_path):
    slab = trimesh.creation.box((1.0, 0.2, 1.0))
    scene = trimesh.Scene()
    for name, place in (("low", (0.0, 0.0, 0.0)), ("high", (3.0, 1.0, 0.0))):
        scene.add_geometry(slab, name, transform=trimesh.transformations.translation_matrix(place))
    scene.apply_scale(100.0)
    scene.export(tmp_path / "slabs.glb")
    options = TerrainOptions(scale=0.01, offset=(0.0, 0.0, 7.0))
    height_under = height_function(load_terrain(tmp_path / "slabs.glb", **vars(options)))
    points = np.array([[0.1, 0.0, 7.2], [3.1, 0.0, 6.8], [1.5, 0.0, 7.0], [0.1, 0.0, 0.2]])
    np.testing.assert_allclose(height_under(points), [0.1, 1.1, np.nan, np.nan], atol=1e-5)


def test_a_mesh_with_z_up_is_turned_and_scaled_before_it_is_moved(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 100], [100, 0, 100], [0, 100, 100]], [[0, 1, 2]], process=False)
    mesh.export(tmp_path / "tile.ply")
    ground = load_terrain(tmp_path / "tile.ply", file_up="z", scale=0.01, offset=(5.0, 0.5, 0.0))
    height = height_function(ground)(np.array([[5.2, 0.0, -0.2], [5.2, 0.0, 0.2]]))
    np.testing.assert_allclose(height, [1.5, np.nan], atol=1e-6)
