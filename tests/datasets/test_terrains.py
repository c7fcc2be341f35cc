"""Terrains: read from files, and reconstructed from clips."""

import json
import struct
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.interpolate import RBFInterpolator
from trimesh.exchange.gltf import export_gltf

from fitting import clips
from fitting.cli import main
from fitting.clips import contacts, edit
from fitting.ground import reconstruction
from fitting.ground.ground_path import RAYS, heights_under
from fitting.ground.meshes import height_function, load_terrain, save_mesh
from fitting.ground.reconstruction import Footprints, Grid, Prediction
from fitting.report import style
from fitting.studies import terrain_report
from fitting.synthetic import footsteps
from jaxik.world import terrain
from jaxik.world.heightfield import Heightfield
from jaxik.world.surfaces import Mesh
from support.commands import refusal
from support.experiments import ROOT
from support.sample_clips import flat_floor, stair_walk

LEVELS = (np.arange(5)[:, None] * 1000 + np.arange(7) * 10).astype(np.uint16)  # rows along z


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


def test_meshes_of_all_formats_are_turned_scaled_joined_and_moved(tmp_path):
    for suffix in ("ply", "obj", "stl", "off", "glb"):
        ramp().export(tmp_path / f"ramp.{suffix}")
        ground = load_terrain(tmp_path / f"ramp.{suffix}")
        np.testing.assert_allclose(heights(ground, (0.4, 0.3)), 0.2, atol=1e-6)
    edges = (
        "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header"  # last, two a line
    )
    whole = WITHOUT_TERRAIN["cut.ply"].replace("face 2", "face 1").replace("end_header", edges)
    (tmp_path / "edges.ply").write_text(whole + "2 0\n")
    assert heights(load_terrain(tmp_path / "edges.ply"), (0.2, 0.2)) == 0.0
    scene = trimesh.Scene()
    for name, place in (("low", (0.0, 0.0, 0.0)), ("high", (3.0, 1.0, 0.0))):
        transform = trimesh.transformations.translation_matrix(place)
        scene.add_geometry(trimesh.creation.box((1.0, 0.2, 1.0)), name, transform=transform)
    scene.apply_scale(100.0)
    scene.export(tmp_path / "slabs.glb")
    ground = load_terrain(tmp_path / "slabs.glb", scale=0.01, offset=(0.0, 0.0, 7.0))
    found = heights(ground, (0.1, 7.2), (3.1, 6.8), (1.5, 7.0), (0.1, 0.2))
    np.testing.assert_allclose(found, [0.1, 1.1, np.nan, np.nan], atol=1e-5)
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


def test_pictures_and_arrays_have_metres_per_level_and_cell_under_any_number_of_points(tmp_path):
    Image.fromarray(LEVELS).save(tmp_path / "hill.png")
    ground = load_terrain(tmp_path / "hill.png", cell=0.5, scale=0.001, offset=(10.0, 1.0, -2.0))
    points = [(10 + 0.5 * column, -2 + 0.5 * row) for row in range(4) for column in range(6)]
    expected = 1 + 0.001 * LEVELS[:4, :6].ravel()
    np.testing.assert_allclose(heights(ground, *points), expected, atol=1e-4)
    small = (LEVELS % 200).astype(np.uint8)
    for mode in ("L", "LA", "P", "RGB", "RGBA"):  # the same grey, whatever it is stored as
        Image.fromarray(small).convert(mode).save(tmp_path / "grey.png")
        ground = load_terrain(tmp_path / "grey.png", cell=0.5, scale=0.001)
        expected = 0.001 * small[:4, :6].ravel()
        corners = [(0.5 * column, 0.5 * row) for row in range(4) for column in range(6)]
        np.testing.assert_allclose(heights(ground, *corners), expected, atol=1e-6)
    np.save(tmp_path / "hill.npy", np.where(LEVELS == 2030, np.nan, LEVELS / 1000))
    ground = load_terrain(tmp_path / "hill.npy", cell=2.0)
    np.testing.assert_allclose(heights(ground, (1.0, 3.0), (5.5, 3.5)), [1.505, np.nan], atol=1e-5)
    x, z = np.meshgrid(np.arange(40), np.arange(30))
    with (tmp_path / "slope.npy").open("wb") as file:  # with a header of the second version
        np.lib.format.write_array(file, 0.1 * x - 0.2 * z, (2, 0))
    ground = load_terrain(tmp_path / "slope.npy", cell=1.0)
    for shape in ((0,), (1,), (RAYS,), (3, RAYS - 1)):
        points = np.random.default_rng(1).uniform([-5, 0, 1], [38, 0, 28], (*shape, 3))
        x, z = points[..., 0], points[..., 2]
        expected = np.where(x > 0, 0.1 * x - 0.2 * z, np.nan)
        np.testing.assert_allclose(heights_under(ground, points, 100.0), expected, atol=1e-4)
        starts = np.where(z < 10, 100.0, -100.0)
        expected = np.where(starts > 0, expected, np.nan)
        np.testing.assert_allclose(heights_under(ground, points, starts), expected, atol=1e-4)


def test_the_error_for_an_archive_that_is_no_heightfield_names_it(tmp_path):
    for changes, message in (
        ({"spacing": None}, "heights and spacing, with or without .*; the file has heights$"),
        ({"name": "hill"}, "the file has heights, name, spacing"),
        ({"heights": [0.0, 1.0]}, r"2 or more columns\); got \(2,\)"),
        ({"heights": [["low", "high"]] * 2}, "heights must be real numbers; got <U4"),
        ({"heights": [[0.0, np.inf]] * 2}, r"the first is heights\[0, 1\]; a hole is NaN"),
        ({"heights": [[1e300, 0.0]] * 3}, r"heights\[0, 0\]: 1e.300; wanted at most 1e.07 m"),
        ({"heights": np.array([None])}, "wanted a NumPy archive of plain arrays"),
        ({"spacing": 1e-9}, "wanted 1e-06 m or more"),
        ({"spacing": 1e300}, "at most 1e.07 m from end to end"),
        ({"spacing": [1.0, 1e9]}, "at most 1e.07 m from end to end"),
        ({"origin": [0.0, 1e300, 0.0]}, "origin is three numbers of at most 1e.07 m"),
    ):
        save_ramp(tmp_path / "hill.npz", **changes)
        with pytest.raises(ValueError, match=f"hill.npz: .*{message}"):
            load_terrain(tmp_path / "hill.npz")


CELL, BOTH = {"cell": 1.0}, {"cell": 1.0, "scale": 1.0}
WITHOUT_TERRAIN = {
    "text.obj": "v 0 0 0\nv 1 0 0\n",
    "text.stl": "solid nothing\nendsolid nothing\n",
    "text.off": "OFF\n3 1 0\n0 0 0\n1 0 nan\n0 0 1\n3 0 1 2\n",
    "nan.obj": "# ground\nv 0 0 0\nv 1 -inf 0\nv 0 0 1\nf 1 3 2\n",
    "nan.stl": "solid a\nfacet normal 0 1 0\nouter loop\nvertex 0 0 0\nvertex 0 0 1\n"
    "vertex 1 NaN 0\nendloop\nendfacet\nendsolid a\n",
    "nan.ply": "ply\nformat ascii 1.0\ncomment ours\nelement vertex 3\nproperty float x\n"
    "property float y\nproperty float z\nelement face 1\n"
    "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 nan\n0 0 1\n3 0 2 1\n",
    "cut.ply": "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 0 1\n3 0 2 1\n",
    "cut.off": "OFF  # of two triangles\n3 2 0\n0 0 0\n1 0 0\n0 0 1\n3 0 2 1\n",
    "short.off": "OFF\n3 2 0\n0 0 0\n1 0 0\n0 0 1\n3 0 2 1\n3 1 2\n",
    "cut.stl": "solid a\nfacet normal 0 1 0\nouter loop\nvertex 0 0 0\nvertex 0 0 1\n",
    **dict.fromkeys(("text.ply", "text.npz", "text.npy", "text.png", "text.fbx"), "x"),
}


def test_what_is_missing_or_wrong_is_said(tmp_path):
    Image.fromarray(LEVELS).save(tmp_path / "hill.png")
    colour = Image.new("RGB", (4, 4))
    colour.putpixel((1, 2), (9, 0, 0))
    colour.save(tmp_path / "colour.png")
    colour.quantize().save(tmp_path / "palette.png")
    Image.new("RGBA", (4, 4)).save(tmp_path / "clear.png")
    Image.new("1", (4, 4)).save(tmp_path / "ink.png")
    (tmp_path / "deep.png").write_bytes(png_that_says(4, 4, colour_type=2))
    for name, array in (("hill", LEVELS), ("objects", np.array([None])), ("words", ["x"])):
        np.save(tmp_path / f"{name}.npy", array)
    save_ramp(tmp_path / "hill.npz")
    ramp().export(tmp_path / "hill.ply")
    broken = [[0.0, 0.0, 0.0], [1.0, np.nan, 0.0], [0.0, 0.0, 1.0]]
    trimesh.Trimesh(broken, [[0, 2, 1]], process=False).export(tmp_path / "nan.glb")
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
        ("colour.png", BOTH, r"colour.png: 1 of 16 .* coloured, .* row 2, column 1: \[9, 0"),
        ("palette.png", BOTH, "palette.png: 1 of 16 pixels are coloured, first that of row 2"),
        ("clear.png", BOTH, "clear.png: 16 of 16 pixels are transparent, first that of row 0"),
        ("deep.png", BOTH, "deep.png: has colours of 16 bits; save it as one channel of grey"),
        ("ink.png", BOTH, "ink.png: wanted one channel .*; got a picture of mode '1'"),
        ("objects.npy", CELL, "objects.npy: wanted a NumPy array .*allow_pickle"),
        ("words.npy", CELL, "words.npy: the array must be real numbers"),
        ("text.png", BOTH, "text.png: wanted a PNG"),
        ("text.npy", CELL, "text.npy: wanted a NumPy array"),
        ("text.npz", {}, "text.npz: wanted a NumPy archive of plain arrays"),
        ("text.fbx", {}, "text.fbx: wanted .*trimesh reads .*ply.*; not '.fbx'"),
        ("text.ply", {}, "text.ply: .*cannot read it"),
        ("text.obj", {}, "text.obj: .*needs triangles; the file holds PointCloud"),
        ("text.stl", {}, "text.stl: .*needs triangles"),
        ("text.off", {}, r"text.off:4: wanted finite coordinates; got '1 0 nan'"),
        ("nan.obj", {}, r"nan.obj:3: wanted finite coordinates; got 'v 1 -inf 0'"),
        ("nan.stl", {}, r"nan.stl:6: wanted finite coordinates; got 'vertex 1 NaN 0'"),
        ("nan.ply", {}, r"nan.ply:12: wanted finite coordinates; got '1 0 nan'"),
        ("nan.glb", {}, r"nan.glb: vertex 1: wanted finite coordinates; got \[1.0, nan, 0.0\]"),
        ("cut.ply", {}, "cut.ply: .*head announces 5 lines of vertices and faces, there are 4"),
        ("cut.off", {}, "cut.off: .*head announces 5 lines of vertices and faces, there are 4"),
        ("short.off", {}, "short.off: .*the file is cut off in line 5 after its head"),
        ("cut.stl", {}, "cut.stl: .*the file is cut off: it has no endsolid"),
        ("nowhere.ply", {}, "nowhere.ply: no such file"),
        ("nowhere.npz", {}, "nowhere.npz: no such file"),
        (ROOT / "data" / "clips" / "uneven_walk_base.npz", {}, "the file has .*joint_names"),
    ):
        with pytest.raises(ValueError, match=f"(?s){message}"):
            load_terrain(tmp_path / file, **options)  # pyright: ignore[reportArgumentType]


def test_what_is_missing_or_compressed_in_a_gltf_is_said(tmp_path):
    files = export_gltf(trimesh.Scene(ramp()))
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    path = tmp_path / "ground.gltf"
    draco = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    for place, value, message in (
        ("asset", {"version": "2.0"}, ""),
        ("buffers.1.uri", "gone.bin", "buffer 1 is in .gone.bin.: no such file; put that file be"),
        ("buffers.1.uri", "../gltf_buffer_1.bin", "wanted a file beside this one"),
        ("meshes.0.primitives.0.extensions", draco,
         r"mesh 0 is compressed \(KHR_draco_mesh_compression\); export it without compression"),
        ("bufferViews.1.extensions", {"EXT_meshopt_compression": {}},
         r"bufferView 1 is compressed \(EXT_meshopt_compression\); export it without"),
        ("accessors.1.sparse", {"count": 1}, "accessor 1 is sparse, which is not supported"),
    ):  # fmt: skip
        header = item = json.loads(files["model.gltf"])
        *keys, last = (int(word) if word.isdecimal() else word for word in place.split("."))
        for key in keys:
            item = item[key]
        item[last] = value
        path.write_text(json.dumps(header))
        if not message:
            assert len(load_terrain(path).surfaces) == 1
            continue
        with pytest.raises(ValueError, match=f"ground.gltf: [^:]*{message}") as error:
            load_terrain(path)
        assert "\n" not in str(error.value) and "trimesh" not in str(error.value)


def png_that_says(columns: int, rows: int, colour_type: int = 0) -> bytes:
    """A picture of 16 bits whose header says this, with a few bytes of pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    header = struct.pack(">IIBBBBB", columns, rows, 16, colour_type, 0, 0, 0)
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


@pytest.fixture
def coarse_search(monkeypatch):
    """Searches for grids in large steps, for tests that do not need the grid."""
    monkeypatch.setattr(reconstruction, "PITCH_STEP", 0.15)
    monkeypatch.setattr(reconstruction, "HEADING_STEP", np.radians(15.0))
    monkeypatch.setattr(reconstruction, "LATTICE", (-1, 0, 1))


def slope(points: np.ndarray) -> np.ndarray:
    """Ground height, m, that falls by 10 cm per metre of z."""
    return 0.3 - 0.1 * points[:, 2]


def test_stances_are_at_the_balls_with_the_ground_a_sole_below_even_if_a_marker_pops():
    clip = stair_walk(slope)
    stances = reconstruction.find_stances(clip, sole=0.02)
    assert len(stances.leg) == 6 or len(stances.leg) == 7
    assert (np.diff(stances.first) >= 0).all() and stances.used.all()
    points_ws = np.insert(stances.points, 1, 0.0, axis=1)
    np.testing.assert_allclose(stances.heights, slope(points_ws) - 0.02, atol=0.002)
    ((first, last), *_) = contacts.runs(clip.stance_labels()[:, 0])
    positions = clip.positions_ws.copy()  # in which a marker jumps
    positions[first + 2 : last - 2 : 3, clip.rig.joints[0][3]] += [0.0, 0.2, 0.0]
    jumping = clip.with_motion(positions, clip.rotations_ws)
    heights = reconstruction.find_stances(jumping, sole=0.02).heights
    np.testing.assert_allclose(heights, stances.heights, atol=0.002)
    positions[100:] += [1e6 / 2, 0.0, 0.0]
    with pytest.raises(ValueError, match="stances are up to 5e.05 m apart; wanted at most 1000"):
        reconstruction.reconstruct(replace(clip, positions_ws=positions))


@pytest.mark.slow
def test_the_memory_for_stances_grows_with_their_number_and_not_its_square():
    clip = edit.resample(stair_walk(slope, strides=6), 10.0)
    repeats = 100
    motion = (np.concatenate([part] * repeats) for part in (clip.positions_ws, clip.rotations_ws))
    long = replace(clip.with_motion(*motion), stance=np.tile(clip.stance_labels(), (repeats, 1)))
    tracemalloc.start()
    stances = reconstruction.find_stances(long, 0.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(stances.leg) > 1000 and peak < 10 * long.positions_ws.nbytes


def test_a_stance_on_toes_is_used_only_if_no_flat_one_is_near(monkeypatch):
    """The third one of the left foot, 5 cm above the floor."""
    floor_walk = stair_walk(flat_floor, strides=6)
    first, last = contacts.runs(floor_walk.stance_labels()[:, 0])[2]
    _, _, ankle, toe = floor_walk.rig.joints[0]
    lift = np.zeros_like(floor_walk.positions_ws)
    lift[first : last + 1, toe, 1] = 0.05
    lift[first : last + 1, ankle, 1] = 0.05
    raised = floor_walk.with_motion(floor_walk.positions_ws + lift, floor_walk.rotations_ws)
    assert not reconstruction.find_stances(raised, 0.0).toes.any()
    lift[first : last + 1, ankle, 1] = 0.12
    clip = floor_walk.with_motion(floor_walk.positions_ws + lift, floor_walk.rotations_ws)
    stances = reconstruction.find_stances(clip, 0.0)
    (on_toes,) = np.flatnonzero(stances.toes)
    assert stances.leg[on_toes] == 0 and stances.used[on_toes]  # others are 30 cm away or more
    monkeypatch.setattr(reconstruction, "NEAR", 0.5)
    used = reconstruction.find_stances(clip, 0.0).used
    np.testing.assert_array_equal(used, np.arange(len(stances.leg)) != on_toes)


# Footprints on known ground.

TILTED = Grid(0.45, np.radians(20.0), (0.1, 0.3))


def block_heights(grid: Grid, points: np.ndarray) -> np.ndarray:
    """Heights of arbitrary blocks at points, m: from 0 to 35 cm in steps of 5."""
    i, j = grid.cells(points).T
    return 0.05 * ((3 * i + 5 * j + i * j) % 8)


def block_footprints(grid: Grid, count: int = 60, outliers: int = 3) -> Footprints:
    """Feet scattered over 3 m by 3 m of blocks, none with its heel inside a higher one.

    The first ones are outliers, 6 cm too high.
    """
    rng = np.random.default_rng(4)
    balls = rng.uniform(-1.5, 1.5, (20 * count, 2))
    heading = rng.uniform(0.0, 2.0 * np.pi, len(balls))
    ankles = balls - 0.1 * np.stack([np.sin(heading), np.cos(heading)], axis=-1)
    possible = np.flatnonzero(block_heights(grid, ankles) <= block_heights(grid, balls))[:count]
    heights = block_heights(grid, balls[possible]) + rng.normal(0.0, 0.003, count)
    heights[:outliers] += 0.06
    return Footprints(balls[possible], heights, ankles[possible])


def hill_footprints(count: int = 30) -> Footprints:
    """Feet scattered over a smooth hill."""
    balls = np.random.default_rng(1).uniform(-2.0, 2.0, (count, 2))
    heights = 0.3 * np.exp(-np.sum(balls**2, axis=-1))
    return Footprints(balls, heights, balls)


def test_cells_lie_between_their_corners_and_quarter_turns_have_one_canonical_form():
    inside = np.array([[2.0, -3.0], [0.0, 0.0], [-1.0, 4.0]])
    np.testing.assert_array_equal(TILTED.cells(TILTED.points(inside + [0.01, 0.99])), inside)
    corners = TILTED.points(np.array([[0.0, 0.0], [1.0, 0.0]]))
    ahead = np.array([np.cos(TILTED.heading), np.sin(TILTED.heading)])
    np.testing.assert_allclose(corners[1] - corners[0], 0.45 * ahead)
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    for quarters in (-2, -1, 0, 1, 2, 3):
        heading = TILTED.heading + quarters * np.pi / 2
        (corner,) = corners[:1] @ reconstruction._uv_from_xz(heading).T
        grid = reconstruction._canonical(TILTED.pitch, heading, corner)
        assert grid.heading == pytest.approx(TILTED.heading)
        np.testing.assert_allclose(grid.origin, TILTED.origin, atol=1e-9)
        np.testing.assert_array_equal(grid.cells(points), TILTED.cells(points))


@pytest.mark.slow
def test_an_unknown_grid_is_found(monkeypatch):
    monkeypatch.setattr(reconstruction, "PITCHES", (0.35, 0.7))
    monkeypatch.setattr(reconstruction, "COARSE_BEST", 4)
    angle = np.radians(-13.0)
    feet, rot = block_footprints(TILTED), reconstruction._uv_from_xz(angle).T
    heights, heading = block_heights(TILTED, feet.balls) + 1.0, TILTED.heading - angle
    balls, ankles = (points @ rot + [4.0, -7.0] for points in (feet.balls, feet.ankles))
    feet = Footprints(balls, feet.heights + 1.0, ankles)
    ranked = reconstruction.search(feet)
    surface = reconstruction.fit_blocks(ranked, feet)
    assert surface.grid.pitch == pytest.approx(TILTED.pitch, rel=0.02)
    assert surface.grid.heading == pytest.approx(heading, abs=np.radians(2.0))
    assert ranked.pitches[0] <= TILTED.pitch <= ranked.pitches[1]
    step = np.radians(1.0)  # about that of the lattice from which the range is taken
    assert ranked.headings[0] - step <= heading <= ranked.headings[1] + step
    error = np.abs(surface.heights(feet.balls) - heights)[3:]
    assert np.median(error) < 0.003 and np.mean(error < 0.01) > 0.9


def test_a_block_without_footprints_has_the_mean_height_of_its_neighbours():
    square = Grid(1.0, 0.0, (0.0, 0.0))
    cells, tops = np.array([[0, 0], [1, 0], [4, 0]]), np.array([0.1, 0.3, 0.5])
    surface = reconstruction.LevelBlocks(square, cells, tops, np.array([1, 2, 1]))
    points = np.array([[0.5, 0.5], [0.5, 1.5], [2.5, 0.5], [3.5, 0.5], [9.5, 0.5]])
    np.testing.assert_allclose(surface.heights(points), [0.1, 0.2, 0.3, 0.5, 0.5])
    np.testing.assert_array_equal(surface.supported(points), [True, False, False, False, False])


def test_a_plane_is_robust_to_an_outlier_and_level_across_a_line_of_feet():
    feet = hill_footprints()
    heights = 0.2 + feet.balls @ [0.1, -0.05]
    heights[3] += 0.4
    surface = reconstruction.fit_plane(replace(feet, heights=heights))
    assert surface.slope == pytest.approx((0.1, -0.05), abs=1e-3)
    assert surface.level == pytest.approx(0.2, abs=2e-3)
    balls = np.stack([np.zeros(8), np.linspace(0.0, 5.0, 8)], axis=-1)
    surface = reconstruction.fit_plane(Footprints(balls, 0.1 * balls[:, 1], balls))
    assert surface.slope == pytest.approx((0.0, 0.1), abs=1e-4)


def test_a_plate_leaves_one_out_and_is_smoother_over_noisier_heights():
    feet = hill_footprints(12)
    errors = reconstruction._leave_one_out_error(feet.balls, feet.heights)
    for smoothing in (1e-6, 0.01, 1.0):
        predicted = [
            RBFInterpolator(others.balls, others.heights, smoothing=smoothing)(feet.balls[[i]])[0]
            for i, others in enumerate(map(feet.without, range(12)))
        ]
        expected = np.sum((predicted - feet.heights) ** 2)
        assert errors(smoothing) == pytest.approx(expected, rel=1e-6)
    feet = hill_footprints(60)
    noisy = replace(feet, heights=np.random.default_rng(2).normal(0.0, 0.01, 60))
    assert (
        reconstruction.fit_thin_plate(feet).smoothing
        < 0.01
        < reconstruction.fit_thin_plate(noisy).smoothing
    )
    with pytest.raises(ValueError, match="all stances are in a line"):
        reconstruction.fit_thin_plate(Footprints(feet.balls * [1.0, 0.0], feet.heights, feet.balls))


def tilted_blocks() -> reconstruction.LevelBlocks:
    ranked = reconstruction.RankedGrids((TILTED,), np.zeros(1), (0.4, 0.5), (0.3, 0.4))
    return reconstruction.fit_blocks(ranked, block_footprints(TILTED))


def test_a_mesh_has_the_heights_of_its_surface_and_a_bounded_number_of_cells(tmp_path):
    plane, plate = (
        reconstruction.fit_plane(hill_footprints()),
        reconstruction.fit_thin_plate(hill_footprints()),
    )
    low, high = np.array([-2.0, -1.5]), np.array([2.0, 2.5])
    for surface, suffix in ((plane, "ply"), (plate, "obj"), (tilted_blocks(), "stl")):
        path, mesh = tmp_path / f"ground.{suffix}", surface.mesh(low, high)
        save_mesh(path, mesh.vertices, mesh.faces)
        points = np.random.default_rng(3).uniform(low, high, (500, 2))
        if isinstance(surface, reconstruction.LevelBlocks):
            inner = np.abs(np.mod(surface.grid.coordinates(points), 1.0) - 0.5).max(axis=1) < 0.49
            points = points[inner]
        found = heights_under(load_terrain(path), np.insert(points, 1, 0.0, axis=1), 9.0)
        tolerance = 0.005 if surface is plate else 1e-4
        np.testing.assert_allclose(found, surface.heights(points), atol=tolerance)
    # Too many cells are refused with their number.
    for surface in (tilted_blocks(), reconstruction.fit_thin_plate(hill_footprints())):
        surface.mesh(np.zeros(2), np.full(2, 9.0))
        for size in (1e3, 1e6):
            with pytest.raises(ValueError, match="[0-9]{7,} cells; wanted at most 2000000"):
                surface.mesh(np.zeros(2), np.full(2, size))


def test_the_mesh_of_blocks_has_vertical_risers_between_blocks():
    surface = tilted_blocks()
    mesh = surface.mesh(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    corners = np.round(mesh.vertices, 6)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.abs(normals[:, 1]) > 1e-9
    assert (normals[flat, 1] > 0).all() and np.ptp(corners[flat, :, 1], axis=1).max() < 1e-9
    assert (np.linalg.norm(normals, axis=-1) > 1e-6).all() and 0.2 < flat.mean() < 0.6
    # A riser faces the lower block: just in front of it the ground is at the riser's foot.
    middle = corners[~flat].mean(axis=1)
    away = normals[~flat] / np.linalg.norm(normals[~flat], axis=-1, keepdims=True)
    lower = surface.heights((middle + 0.01 * away)[:, [0, 2]])
    upper = surface.heights((middle - 0.01 * away)[:, [0, 2]])
    np.testing.assert_allclose(lower, corners[~flat, :, 1].min(axis=1), atol=1e-5)
    np.testing.assert_allclose(upper, corners[~flat, :, 1].max(axis=1), atol=1e-5)


def test_the_simplest_kind_that_is_not_clearly_worse_is_chosen():
    rng = np.random.default_rng(5)

    def with_errors(sizes: list[float]) -> dict[str, Prediction]:
        kinds = zip(reconstruction.SURFACE_KINDS, sizes, strict=True)
        none = np.zeros(40, bool)
        return {kind: Prediction(rng.normal(0.0, size, 40), none) for kind, size in kinds}

    almost, smooth, blocks = [0.01, 0.0098, 0.0099], [0.1, 0.01, 0.0099], [0.1, 0.05, 0.01]
    for kind, sizes in (("plane", almost), ("smooth", smooth), ("blocks", blocks)):
        assert reconstruction.choose(with_errors(sizes)) == kind


def test_a_stance_is_predicted_from_the_others_only():
    feet = hill_footprints()
    with_outlier = replace(feet, heights=np.where(np.arange(30) == 7, 1.0, 0.0))
    prediction = reconstruction.leave_one_out(reconstruction.fit_plane, with_outlier)
    assert prediction.errors[7] == pytest.approx(-1.0, abs=1e-6) and not prediction.alone.any()
    grid = reconstruction.RankedGrids(
        (Grid(1e-3, 0.0, (0.0, 0.0)),), np.zeros(1), (0.0, 1.0), (0.0, 1.0)
    )
    unsupported = reconstruction.leave_one_out(
        lambda feet: reconstruction.fit_blocks(grid, feet), feet
    )
    assert unsupported.alone.all() and np.isnan(unsupported.rms_shared) and unsupported.rms > 0.0


def test_a_synthetic_slope_is_a_plane_also_of_a_bounded_number_of_stances(
    monkeypatch, coarse_search
):
    walk = stair_walk(slope, strides=6)
    ground = reconstruction.reconstruct(walk, sole=0.0)
    assert ground.chosen == "plane" and ground.predictions["plane"].rms < 0.003
    assert isinstance(ground.surface, reconstruction.Plane)
    assert ground.surface.slope == pytest.approx((0.0, -0.1), abs=0.003)
    assert reconstruction.reconstruct(stair_walk(slope), kind="smooth").chosen == "smooth"
    monkeypatch.setattr(reconstruction, "MOST_STANCES", 5)
    ground = reconstruction.reconstruct(walk)
    count = len(ground.stances.used)
    (used,) = np.nonzero(ground.stances.used)
    assert count > 8 and len(used) == 5 and used[0] == 0 and used[-1] == count - 1
    assert np.ptp(np.diff(used)) <= 1
    assert len(ground.predictions["plane"].errors) == 5
    text = terrain_report.count_stances(ground)
    assert text == f"{count} stances; surfaces are fitted to 5 of all, evenly chosen"
    figure = terrain_report.plan(ground, 0.5, walk.rig.names, "title")
    panels = {axes.get_ylabel(): axes.lines for axes in figure.axes}
    drawn = {tuple(np.asarray(line.get_ydata())) for line in panels["error, cm"]}
    assert drawn >= {tuple(100 * each.errors) for each in ground.predictions.values()}
    shares = [list(np.asarray(line.get_ydata())) for line in panels["stances within this error, %"]]
    assert shares == [pytest.approx([0, 20, 40, 60, 80, 100, 100])] * 3


@pytest.mark.parametrize("sole, height", [(None, 0.0), (0.03, -0.01)])
def test_ground_lies_a_sole_below_the_balls_as_the_rig_has_it_or_as_it_is_given(
    coarse_search, sole, height
):
    walk = stair_walk(lambda points: np.full(len(points), 0.02), strides=4)
    ground = reconstruction.reconstruct(walk, sole=sole)
    assert ground.sole == pytest.approx(0.02 if sole is None else sole, abs=1e-6)
    points = ground.stances.points
    np.testing.assert_allclose(ground.surface.heights(points), height, atol=1e-3)


def test_the_terrain_of_the_uneven_walk_is_reconstructed_as_smooth(coarse_search):
    walk = clips.load_clip(ROOT / "data" / "clips" / "uneven_walk.npz")
    ground = reconstruction.reconstruct(walk, sole=footsteps.BALL_HEIGHT)
    assert ground.chosen == "smooth"
    true = load_terrain(ROOT / "data" / "terrains" / "uneven_walk.ply")
    points_ws = np.insert(ground.stances.points, 1, 0.0, axis=1)
    expected = height_function(true)(points_ws)
    error = ground.surface.heights(ground.stances.points) - expected
    assert np.sqrt(np.mean(error**2)) < 0.04


@pytest.mark.slow
def test_the_blocks_of_subject_03_are_reconstructed_within_a_centimetre(mocap):
    """Compares heights in the middle of each cell of `terrain_subject03.json`.

    Both assume the ball joint 5.5 cm above the ground. Three of the file's 23 cells are known from
    stances on toes only.
    """
    reference = json.loads((mocap / "blocks" / "terrain_subject03.json").read_text())
    sole = reference["ball_joint_height_above_surface"]
    known = Grid(reference["cell_size"], reference["yaw_rad"], tuple(reference["origin"]))
    cells = np.array([[cell["i"], cell["j"]] for cell in reference["cells"]])
    heights = np.array([cell["height"] for cell in reference["cells"]])
    clean = np.array([cell["n_clean"] > 0 for cell in reference["cells"]])
    clip = clips.load_clip(mocap / "clips" / "cmu_asfamc" / "03_03.amc")
    assert np.allclose(clip.rig.ball_height, sole, atol=0.01)  # as estimated from the feet
    ground = reconstruction.reconstruct(clip, sole=sole)
    assert ground.chosen == "blocks" and isinstance(ground.surface, reconstruction.LevelBlocks)
    error = ground.surface.heights(known.points(cells + 0.5)) - heights
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert np.sqrt(np.mean(error[clean] ** 2)) < 0.006
    grid = ground.surface.grid
    assert grid.pitch == pytest.approx(0.60, abs=0.02)
    assert grid.heading == pytest.approx(known.heading, abs=np.radians(2.0))
    assert ground.grids.pitches[0] < 0.60 < ground.grids.pitches[1]
    assert len(ground.surface.tops) == 23
    prediction = ground.predictions["blocks"]
    assert prediction.rms_shared < 0.012 and prediction.alone.sum() <= 10
    assert prediction.rms < min(ground.predictions[kind].rms for kind in ("plane", "smooth"))


def test_a_captured_floor_is_reconstructed_as_a_plane(mocap, coarse_search):
    clip = clips.load_clip(mocap / "clips" / "cmu_asfamc" / "02_01.amc")
    ground = reconstruction.reconstruct(clip)
    assert ground.chosen == "plane" and ground.predictions["plane"].rms < 0.008


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("input") / "walk.npz"
    clips.save_clip(path, stair_walk(slope, strides=4))
    return path


def test_the_command_writes_a_mesh_its_numbers_and_a_picture(clip, tmp_path, capsys, coarse_search):
    out = tmp_path / "hill.obj"
    words = ["terrain", clip, "-o", out, "--sole", "0.01", "--model", "blocks", "--margin", "0.5"]
    assert main.main([str(word) for word in words]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"hill.obj", "hill.json", "hill.png"}
    numbers, text = json.loads((tmp_path / "hill.json").read_text()), capsys.readouterr().out
    assert (numbers["chosen"], numbers["ball_over_sole"]) == ("blocks", 0.01)
    assert set(numbers["tested"]) == set(numbers["grounds"]) == set(reconstruction.SURFACE_KINDS)
    for row in numbers["stances"]:
        assert row["height"] == pytest.approx(0.29 - 0.1 * row["z"], abs=0.003)
        assert set(row["errors"]) == set(reconstruction.SURFACE_KINDS)
    for kind, prediction in numbers["tested"].items():
        rms = np.sqrt(np.mean([row["errors"][kind] ** 2 for row in numbers["stances"]]))
        assert prediction["rms"] == pytest.approx(rms, abs=2e-4)
    assert f"{len(numbers['stances'])} stances\n" in text and "blocks (chosen)" in text
    assert text.endswith(f"written to {out}\n")
    (surface,) = load_terrain(out).surfaces
    assert isinstance(surface, Mesh)
    z = np.asarray(surface.vertices_ws)[:, 2]
    stances_z = [row["z"] for row in numbers["stances"]]
    assert z.min() <= min(stances_z) - 0.5 and max(stances_z) + 0.5 <= z.max()


def test_what_cannot_be_reconstructed_or_written_costs_one_line_and_leaves_no_files(
    clip, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("taken.json").mkdir()
    short = clips.load_clip(clip).select(slice(0, 40))
    clips.save_clip("short.npz", short)
    for walk, out, message in (
        (clip, "a.glb", "a.glb: wanted a name that ends in .ply, .obj, .stl"),
        (clip, "taken.ply", "taken.json: cannot be written: it is a folder"),
        ("short.npz", "a.ply", "stances; reconstruction needs 4 or more"),
    ):
        assert message in refusal(["terrain", walk, "-o", out], tmp_path, capsys)
    with pytest.raises(ValueError, match="no foot ever stands; wanted 4"):
        reconstruction.reconstruct(replace(short, stance=np.zeros((40, 2), bool)))


def test_an_interrupt_leaves_no_files(clip, tmp_path, monkeypatch, coarse_search):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(style, "save", interrupt)
    words = ["terrain", str(clip), "-o", str(tmp_path / "a.ply")]
    assert main.main(words) == main.INTERRUPTED
    assert not list(tmp_path.iterdir())
