"""Terrain files: formats, scenes, units, up axes, and files that are refused."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from fitting.datasets.terrain import mesh_files
from jaxik.world import terrain
from jaxik.world.heightfield import Heightfield
from jaxik.world.surfaces import Mesh

ROOT = Path(__file__).resolve().parents[2]


def ramp() -> trimesh.Trimesh:
    """One square metre that rises by half a metre along x."""
    corners = [[0, 0, 0], [1, 0.5, 0], [1, 0.5, 1], [0, 0, 1]]
    return trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)


def height(ground: terrain.Terrain, x: float, z: float) -> float:
    hit = terrain.cast(ground, jnp.array([x, 5.0, z]), jnp.inf)
    assert hit.found == 1.0
    return float(hit.point[1])


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off", "glb"])
def test_all_common_formats_give_the_same_terrain(tmp_path, suffix):
    path = tmp_path / f"ramp.{suffix}"
    ramp().export(path)
    assert height(mesh_files.load_terrain(path), 0.4, 0.3) == pytest.approx(0.2, abs=1e-6)


def test_the_transforms_of_a_scene_are_applied(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(ramp(), node_name="here", geom_name="ramp")
    scene.add_geometry(
        trimesh.creation.box((2.0, 2.0, 2.0)),
        geom_name="box",
        transform=trimesh.transformations.translation_matrix((10.0, 0.0, 0.0)),
    )
    scene.export(tmp_path / "scene.glb")
    ground = mesh_files.load_terrain(tmp_path / "scene.glb")
    assert height(ground, 0.5, 0.5) == pytest.approx(0.25, abs=1e-6)
    assert height(ground, 10.3, 0.4) == pytest.approx(1.0, abs=1e-6)


def test_a_file_with_z_up_is_rotated_and_scaled(tmp_path):
    centimetres = ramp()
    corners = centimetres.vertices.copy() * 100
    centimetres.vertices = np.stack([corners[:, 0], -corners[:, 2], corners[:, 1]], axis=-1)
    centimetres.export(tmp_path / "ramp.ply")
    ground = mesh_files.load_terrain(tmp_path / "ramp.ply", file_up="z", scale=0.01)
    assert height(ground, 0.4, 0.3) == pytest.approx(0.2, abs=1e-6)


def test_up_layer_dtype_and_slack_reach_the_terrain(tmp_path):
    ramp().export(tmp_path / "ramp.ply")
    ground = mesh_files.load_terrain(
        tmp_path / "ramp.ply", up=(0.0, 2.0, 0.0), layer=4, slack=0.1, dtype=jnp.float32
    )
    np.testing.assert_array_equal(ground.up_ws, [0.0, 1.0, 0.0])
    assert ground.up_ws.dtype == jnp.float32
    origin = jnp.array([0.5, 5.0, 0.5], jnp.float32)
    assert terrain.cast(ground, origin, 9.0, terrain.layer_mask(4)).found == 1.0
    assert terrain.cast(ground, origin, 9.0, terrain.layer_mask(0)).found == 0.0


def test_the_terrain_of_the_blocks_benchmark_is_in_metres_with_y_up(mocap):
    ground = mesh_files.load_terrain(mocap / "blocks" / "terrain.ply")
    (surface,) = ground.surfaces
    assert isinstance(surface, Mesh)
    corners = np.asarray(surface.vertices_ws)
    assert np.ptp(corners[:, 1]) < 1.5 < np.ptp(corners[:, 0]) < 20.0
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    assert corners[:, 1].min() <= height(ground, *middle[[0, 2]]) <= corners[:, 1].max()


def save_ramp(path, **changes) -> None:
    """The ramp as a heightfield of three rows and two columns."""
    arrays = {"heights": [[0.0, 0.5]] * 3, "spacing": [1.0, 0.5], **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def test_a_heightfield_is_read_from_an_archive(tmp_path):
    save_ramp(tmp_path / "ramp.npz")
    ground = mesh_files.load_terrain(tmp_path / "ramp.npz")
    (surface,) = ground.surfaces
    assert isinstance(surface, Heightfield)
    assert surface.interpolation == "bilinear"
    assert height(ground, 0.4, 0.3) == pytest.approx(0.2, abs=1e-12)
    assert terrain.cast(ground, jnp.array([1.1, 5.0, 0.3]), jnp.inf).found == 0.0


def test_all_of_an_archive_and_of_the_arguments_reaches_the_heightfield(tmp_path):
    save_ramp(
        tmp_path / "ramp.npz",
        heights=np.array([[0, 50]] * 3, np.uint16),
        spacing=100,
        origin=[200.0, 10.0, 0.0],
        interpolation="triangulated",
    )
    ground = mesh_files.load_terrain(
        tmp_path / "ramp.npz", up=(0.0, 3.0, 0.0), layer=4, scale=0.01, dtype=jnp.float32
    )
    (surface,) = ground.surfaces
    assert isinstance(surface, Heightfield)
    assert surface.interpolation == "triangulated"
    np.testing.assert_array_equal(ground.up_ws, [0.0, 1.0, 0.0])
    assert {ground.up_ws.dtype, surface.heights.dtype} == {jnp.dtype(jnp.float32)}
    origin = jnp.array([2.4, 5.0, 0.3], jnp.float32)
    hit = terrain.cast(ground, origin, 9.0, terrain.layer_mask(4))
    assert hit.point[1] == pytest.approx(0.3, abs=1e-6)
    assert terrain.cast(ground, origin, 9.0, terrain.layer_mask(0)).found == 0.0


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"spacing": None}, "heights and spacing, with or without .*; the file has heights$"),
        ({"name": "hill"}, "the file has heights, name, spacing"),
        ({"heights": [0.0, 1.0]}, r"2 or more columns\); got \(2,\)"),
        ({"heights": [["low", "high"]] * 2}, "heights must be real numbers; got <U4"),
        ({"heights": [[0.0, np.inf]] * 2}, r"the first is heights\[0, 1\]; a hole is NaN"),
        ({"spacing": [1.0, 0.0]}, "above 0"),
        ({"interpolation": "cubic"}, "'bilinear' or 'triangulated'; got 'cubic'"),
        ({"heights": np.array([None])}, "wanted a NumPy archive of plain arrays"),
    ],
)
def test_the_error_for_an_archive_that_is_no_heightfield_names_it(tmp_path, changes, message):
    save_ramp(tmp_path / "hill.npz", **changes)
    with pytest.raises(ValueError, match=f"hill.npz: .*{message}"):
        mesh_files.load_terrain(tmp_path / "hill.npz")


def test_a_heightfield_has_y_up(tmp_path):
    save_ramp(tmp_path / "hill.npz")
    with pytest.raises(ValueError, match="hill.npz: a heightfield has y up; got file_up 'z'"):
        mesh_files.load_terrain(tmp_path / "hill.npz", file_up="z")


def test_a_clip_is_no_terrain():
    with pytest.raises(ValueError, match="heightfield is the arrays .* the file has .*joint_names"):
        mesh_files.load_terrain(ROOT / "data" / "clips" / "uneven_walk_base.npz")


def test_clips_are_flattened_over_a_heightfield_as_over_its_mesh(tmp_path):
    save_ramp(tmp_path / "ramp.npz")
    ramp().export(tmp_path / "ramp.ply")
    points = np.random.default_rng(0).uniform(-0.2, 1.2, (200, 3))
    field, mesh = (
        mesh_files.height_function(mesh_files.load_terrain(tmp_path / name))(points)
        for name in ("ramp.npz", "ramp.ply")
    )
    assert 50 < np.isfinite(field).sum() < 200
    np.testing.assert_allclose(field, mesh, atol=1e-6)


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("ground.fbx", "x", "trimesh reads .*ply.*; not '.fbx'"),
        ("ground.ply", "not a ply", "cannot read it"),
        ("ground.obj", "v 0 0 0\nv 1 0 0\n", "needs triangles; the file holds PointCloud"),
        ("ground.stl", "solid nothing\nendsolid nothing\n", "needs triangles"),
        ("ground.npz", "no archive", "wanted a NumPy archive of plain arrays"),
        ("ground.off", "OFF\n3 1 0\n0 0 0\n1 0 nan\n0 0 1\n3 0 1 2\n", "vertices are not finite"),
    ],
)
def test_the_error_for_a_file_without_terrain_names_it(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"(?s){name}.*{message}"):
        mesh_files.load_terrain(tmp_path / name)


def test_the_error_for_a_missing_file_names_it(tmp_path):
    for name in ("nowhere.ply", "nowhere.npz"):
        with pytest.raises(ValueError, match=f"{name}: no such file"):
            mesh_files.load_terrain(tmp_path / name)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"up": (0.0, 0.0, 0.0)}, "up is a direction"),
        ({"layer": 32}, "from 0 to 31"),
        ({"scale": 0.0}, "scale is metres per unit"),
        ({"file_up": "x"}, "'y' or 'z'; got 'x'"),
    ],
)
def test_arguments_out_of_range_are_refused(tmp_path, arguments, message):
    ramp().export(tmp_path / "ramp.ply")
    with pytest.raises(ValueError, match=message):
        mesh_files.load_terrain(tmp_path / "ramp.ply", **arguments)


def test_a_written_mesh_far_from_the_origin_keeps_a_tenth_of_a_millimetre(tmp_path):
    vertices = np.array([[0.0123, 0.4567, 0.0], [1.0, 0.0, 0.8901], [0.0, 0.2345, 1.0]])
    for away in (0.0, 50_000.0):
        mesh_files.save_mesh(tmp_path / "hill.ply", vertices + away, np.array([[0, 1, 2]]))
        read = trimesh.load_scene(tmp_path / "hill.ply", process=False).to_mesh()
        np.testing.assert_allclose(read.vertices - away, vertices, atol=5e-5 + 1e-9)
