"""Terrain files: formats, scenes, units, up axes, and files that are refused."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from fitting.datasets.terrain import mesh_files
from jaxik.world import terrain


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
    assert isinstance(surface, terrain.Mesh)
    corners = np.asarray(surface.vertices_ws)
    assert np.ptp(corners[:, 1]) < 1.5 < np.ptp(corners[:, 0]) < 20.0
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    assert corners[:, 1].min() <= height(ground, *middle[[0, 2]]) <= corners[:, 1].max()


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("ground.fbx", "x", "trimesh reads .*ply.*; not '.fbx'"),
        ("ground.ply", "not a ply", "cannot read it"),
        ("ground.obj", "v 0 0 0\nv 1 0 0\n", "needs triangles; the file holds PointCloud"),
        ("ground.stl", "solid nothing\nendsolid nothing\n", "needs triangles"),
        ("ground.off", "OFF\n3 1 0\n0 0 0\n1 0 nan\n0 0 1\n3 0 1 2\n", "vertices are not finite"),
    ],
)
def test_the_error_for_a_file_without_terrain_names_it(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"(?s){name}.*{message}"):
        mesh_files.load_terrain(tmp_path / name)


def test_the_error_for_a_missing_file_names_it(tmp_path):
    with pytest.raises(ValueError, match="nowhere.ply: there is no such file"):
        mesh_files.load_terrain(tmp_path / "nowhere.ply")


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
