"""Clips as BVH, GLB and CSV: they come back as they were, in the user's own skeleton.

Blender reads our files and writes some for us. As a module (`bpy`) it needs an older NumPy than
JAX, so it lives in an environment of its own, whose Python the variable BLENDER_PYTHON names:

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.15
    BLENDER_PYTHON=blender/bin/python python -m pytest tests/datasets/test_clip_writers.py
"""

import csv
import json
import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from fitting.clips import Clip, load_clip, save_clip
from fitting.clips.clip import local_from_world, world_from_local
from fitting.clips.edit import resample
from fitting.clips.formats.gltf_writer import bone_mesh
from fitting.ground.meshes import Mesh, load_terrain, mesh_of
from jaxik.world import terrain
from support import blender
from support.sample_clips import AMC, ASF, BVH, BVH_FILES, stair_walk

TOLERANCE = 1e-4  # m


@pytest.fixture
def bvh_file(tmp_path):
    (tmp_path / "walk.bvh").write_text(BVH)
    return tmp_path / "walk.bvh"


def moved(clip: Clip) -> Clip:
    """The clip with its joints turned and its root moved, all bones as long as they were."""
    random, count = np.random.default_rng(0), len(clip.parents)
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    turns = Rotation.from_rotvec(0.4 * random.standard_normal((count, 3)))
    for joint, name in enumerate(clip.joint_names):
        if not re.search(r"_end\d*$", name):
            rot = turns[joint] * Rotation.from_quat(rotations_ls[:, joint], scalar_first=True)
            rotations_ls[:, joint] = rot.as_quat(scalar_first=True)
    positions_ls[:, 0] += [0.3, 0.2, -0.1]
    return clip.with_motion(*world_from_local(clip.parents, positions_ls, rotations_ls))


def reloaded(path, clip: Clip) -> Clip:
    """What is read of a file, with the scale and axes that a BVH does not state."""
    if path.suffix != ".bvh":
        return load_clip(path)
    return load_clip(path, scale=clip.scale, up=clip.up_axis)


def error(clip: Clip, other: Clip) -> float:
    """Largest distance, m, between the joints of the first clip and the same ones of the other."""
    order = [other.joint_names.index(name) for name in clip.joint_names]
    return float(np.linalg.norm(other.positions_ws[:, order] - clip.positions_ws, axis=-1).max())


def hierarchy(text: str) -> list[list[str]]:
    """The words of each line before the motion, numbers as they compare."""

    def plain(word: str) -> str:
        number = re.fullmatch(r"-?[\d.]+(E-?\d+)?", word)
        return f"{float(word) + 0.0:.5f}" if number else word

    lines = text.replace("\r", "\n").upper().split("MOTION")[0].split("\n")
    return [[plain(word) for word in line.split()] for line in lines if line.split()]


@pytest.mark.parametrize("name", BVH_FILES)
def test_a_bvh_goes_back_into_its_own_hierarchy(mocap, tmp_path, name):
    clip = load_clip(mocap / "clips" / name).select(slice(0, 50))
    path, solved = tmp_path / "solved.bvh", moved(clip)
    save_clip(path, solved)
    back = reloaded(path, clip)
    assert error(solved, back) < TOLERANCE
    assert back.channels == clip.channels
    assert (back.fps, back.raw_frame_time) == (clip.fps, clip.raw_frame_time)
    texts = path.read_text(), (mocap / "clips" / name).read_text(errors="replace")
    ours, original = ([line for line in hierarchy(text) if line[0] != "OFFSET"] for text in texts)
    assert ours == original
    np.testing.assert_allclose(back.offsets_ls, clip.offsets_ls, atol=1e-6)


def test_joints_come_back_where_they_were_also_from_clips_that_were_no_bvh(bvh_file, tmp_path):
    for up in "yz":
        clip = moved(load_clip(bvh_file, up=up))
        for suffix in (".bvh", ".glb", ".npz"):
            path = tmp_path / f"out{suffix}"
            save_clip(path, clip)
            back = reloaded(path, clip)
            assert back.joint_names == clip.joint_names and back.fps == 120.0
            assert error(clip, back) < TOLERANCE, (up, suffix)
            turn = np.abs(np.sum(back.rotations_ws * clip.rotations_ws, axis=-1))
            np.testing.assert_allclose(turn, 1.0, atol=1e-6)
    # Other clips get a standard BVH in centimetres.
    (tmp_path / "walk.asf").write_text(ASF)
    (tmp_path / "walk.amc").write_text(AMC)
    for clip in (load_clip(tmp_path / "walk.amc"), stair_walk()):
        save_clip(tmp_path / "out.bvh", clip)
        text = (tmp_path / "out.bvh").read_text()
        assert "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation" in text
        back = load_clip(tmp_path / "out.bvh", scale=0.01, up="y")
        assert error(clip, back) < TOLERANCE and back.fps == clip.fps
        ends = set(range(len(back.parents))) - set(back.parents)
        assert text.count("End Site") == len(ends)


def test_numbers_of_a_bvh_are_its_own_and_do_not_jump_over_whole_turns(bvh_file, tmp_path):
    save_clip(tmp_path / "out.bvh", load_clip(bvh_file))
    first, second = (
        np.array([line.split() for line in path.read_text().splitlines()[-3:]], float)
        for path in (bvh_file, tmp_path / "out.bvh")
    )
    np.testing.assert_allclose(second, first, atol=1e-5)
    assert hierarchy((tmp_path / "out.bvh").read_text()) == hierarchy(BVH)
    assert "Frame Time: 0.0083333\n" in (tmp_path / "out.bvh").read_text()
    save_clip(tmp_path / "out.bvh", resample(load_clip(bvh_file), 60.0))
    assert load_clip(tmp_path / "out.bvh").fps == 60.0
    clip = load_clip(bvh_file)
    many = clip.select(np.zeros(200, int))
    yaw = Rotation.from_euler("y", np.linspace(0.0, 720.0, 200)[:, None], degrees=True)
    local = local_from_world(clip.parents, many.positions_ws, many.rotations_ws)
    local[1][:, 0] = yaw.as_quat(scalar_first=True)
    save_clip(tmp_path / "out.bvh", many.with_motion(*world_from_local(clip.parents, *local)))
    rows = (tmp_path / "out.bvh").read_text().splitlines()[-200:]
    angles = np.array([row.split() for row in rows], float)[:, 3:6]
    assert np.abs(np.diff(angles, axis=0)).max() < 4.0
    assert angles[-1, 2] == pytest.approx(720.0)


def test_a_joint_gets_the_channels_that_its_motion_needs_and_a_warning_says_so(tmp_path):
    hinge = BVH.replace("CHANNELS 3 Xrotation Yrotation Zrotation", "CHANNELS 1 Xrotation")
    head, _, numbers = hinge.partition("Frame Time: 0.0083333\n")
    kept = np.delete(np.arange(24), [10, 11, 19, 20])
    rows = np.array([row.split() for row in numbers.splitlines()])[:, kept]
    path = tmp_path / "hinge.bvh"
    path.write_text(head + "Frame Time: 0.0083333\n" + "\n".join(map(" ".join, rows)))
    clip = load_clip(path)
    save_clip(tmp_path / "same.bvh", clip)
    assert load_clip(tmp_path / "same.bvh").channels == clip.channels
    with pytest.warns(UserWarning, match="joints have other channels .*: LeftLeg, RightLeg$"):
        save_clip(tmp_path / "turned.bvh", moved(clip))
    back = reloaded(tmp_path / "turned.bvh", clip)
    knee = clip.joint_names.index("LeftLeg")
    assert back.channels is not None and back.channels[knee] == "Xrotation Zrotation Yrotation"
    assert error(moved(clip), back) < TOLERANCE
    stretched = clip.positions_ws.copy()
    stretched[1, knee] += [0.0, 0.01, 0.0]
    with pytest.warns(UserWarning, match="LeftLeg, LeftFoot$"):
        save_clip(tmp_path / "long.bvh", clip.with_motion(stretched, clip.rotations_ws))
    assert np.abs(reloaded(tmp_path / "long.bvh", clip).positions_ws - stretched).max() < TOLERANCE


def test_channels_and_rest_pose_outlive_an_archive_and_a_glb(bvh_file, tmp_path):
    clip = load_clip(bvh_file)
    rest = np.tile([0.8, 0.6, 0.0, 0.0], (len(clip.parents), 1))
    save_clip(tmp_path / "clip.npz", replace(clip, rest_rotations_ls=rest))
    back = load_clip(tmp_path / "clip.npz")
    assert back.channels == clip.channels
    np.testing.assert_array_equal(back.rest_rotations_ls, rest)
    content = dict(np.load(tmp_path / "clip.npz"))
    content["channels"][1] = "Xrotation sideways"
    np.savez(tmp_path / "odd.npz", **content)
    with pytest.raises(ValueError, match="odd.npz: channels has 'sideways'; wanted such as Xpos"):
        load_clip(tmp_path / "odd.npz")
    save_clip(tmp_path / "out.glb", clip)
    back = load_clip(tmp_path / "out.glb")
    np.testing.assert_allclose(back.offsets_ls, clip.offsets_ls, atol=1e-6)
    assert back.rest_rotations_ls is not None
    np.testing.assert_allclose(np.abs(back.rest_rotations_ls[:, 0]), 1.0)
    save_clip(tmp_path / "again.glb", back)
    assert error(clip, load_clip(tmp_path / "again.glb")) < TOLERANCE


def test_bind_matrices_undo_the_rest_pose(tmp_path):
    clip = stair_walk()
    turn = Rotation.from_euler("xyz", [30.0, 40.0, 50.0], degrees=True)
    rest = np.tile(turn.as_quat(scalar_first=True), (len(clip.parents), 1))
    save_clip(tmp_path / "out.glb", replace(clip, rest_rotations_ls=rest))
    content = (tmp_path / "out.glb").read_bytes()
    header = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    view = header["bufferViews"][header["accessors"][0]["bufferView"]]
    start = content.index(b"BIN\0") + 4 + view["byteOffset"]
    inverse = np.frombuffer(content, "<f4", 16 * len(clip.parents), start).reshape(-1, 4, 4)
    local = np.array(clip.offsets_ls[None]), rest[None]
    (places,), (rotations,) = world_from_local(clip.parents, *local)
    matrix = np.tile(np.eye(4), (len(clip.parents), 1, 1))
    matrix[:, :3, :3] = Rotation.from_quat(rotations, scalar_first=True).as_matrix()
    matrix[:, :3, 3] = places
    product = inverse.transpose(0, 2, 1) @ matrix
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(4), matrix.shape), atol=1e-5)


def test_bones_lead_from_joint_to_joint_and_are_closed_outwards():
    places = np.array([[0.0, 1, 0], [0.2, 1, 0], [0.2, 0.5, 0.1], [0.2, 0.5, 0.1]])
    vertices, faces, owners = bone_mesh(places, (-1, 0, 1, 2))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0 and owners.tolist() == [0] * 6 + [1] * 6
    np.testing.assert_allclose(vertices[[0, 5, 6, 11]], places[[0, 1, 1, 2]])
    for point in (vertices[1:5], vertices[7:11]):
        assert np.ptp(point, axis=0).max() < 0.1
    lonely, _, owners = bone_mesh(places[:1], (-1,))
    assert np.ptp(lonely[:, 1]) == pytest.approx(0.1) and set(owners) == {0}


def test_the_ground_lies_beside_the_motion_a_heightfield_as_triangles_without_holes(tmp_path):
    hill = Mesh(np.array([[0.0, 0, 0], [0, 1, 2], [3, 0, 0]]), np.array([[0, 1, 2]]))
    save_clip(tmp_path / "out.glb", stair_walk(), ground=hill)
    save_clip(tmp_path / "bare.glb", stair_walk())
    assert error(stair_walk(), load_clip(tmp_path / "out.glb")) < TOLERANCE
    seen = trimesh.load_scene(tmp_path / "out.glb")
    assert sorted(seen.geometry) == ["body", "terrain"]
    ground = seen.geometry["terrain"]
    np.testing.assert_allclose(ground.vertices[ground.faces[0]], hill.vertices)
    read = mesh_of(load_terrain(tmp_path / "out.glb"))  # without the character
    assert len(read.faces) == 1
    np.testing.assert_allclose(read.vertices[read.faces[0]], hill.vertices)
    with pytest.raises(ValueError, match="bare.glb"):
        load_terrain(tmp_path / "bare.glb")
    heights = np.array([[0.0, 0.1, np.nan], [0.3, 0.4, 0.5]])
    field = terrain.heightfield(heights, (0.5, 2.0), (1.0, 2.0, 3.0))
    mesh = mesh_of(field.moved(jnp.array([0.0, 1.0, 0.0])))
    corners = {tuple(np.round(point, 9)) for face in mesh.faces for point in mesh.vertices[face]}
    assert corners == {(1, 3.0, 3), (1.5, 3.1, 3), (1, 3.3, 5), (1.5, 3.4, 5)}
    normals = np.cross(*np.moveaxis(np.diff(mesh.vertices[mesh.faces], axis=1), 1, 0))
    assert len(mesh.faces) == 2 and (normals[:, 1] > 0).all()


def test_a_csv_has_the_time_and_all_joints_by_name(tmp_path):
    clip = stair_walk()
    save_clip(tmp_path / "out.csv", clip)
    header, *rows = csv.reader((tmp_path / "out.csv").read_text().splitlines())
    expected = "time_s root_x_m root_y_m root_z_m root_qw root_qx root_qy root_qz"
    assert " ".join(header[:8]) == expected
    table = np.array(rows, float)
    np.testing.assert_allclose(table[:, 0], np.arange(clip.frame_count) / 60.0, atol=1e-6)
    column = header.index("left_knee_x_m")
    knee = clip.positions_ws[:, clip.joint_names.index("left_knee")]
    np.testing.assert_allclose(table[:, column : column + 3], knee, atol=1e-6)


def test_a_clip_that_a_format_cannot_hold_is_refused(tmp_path):
    clip = stair_walk()
    with pytest.raises(ValueError, match=r"out.fbx: wanted a name that ends in .npz, .bvh, .glb"):
        save_clip(tmp_path / "out.fbx", clip)
    two_roots = replace(clip, parents=(-1, -1, *clip.parents[2:]))
    with pytest.raises(ValueError, match=r"out.bvh: a BVH file has one root; .*'left_hip'\]"):
        save_clip(tmp_path / "out.bvh", two_roots)
    save_clip(tmp_path / "out.glb", two_roots)
    assert len(load_clip(tmp_path / "out.glb").joint_names) < len(clip.joint_names)
    assert not (tmp_path / "out.bvh").exists()


# Motion in and out against Blender


@pytest.fixture(scope="module")
def strides() -> Clip:
    return resample(stair_walk(), 30.0).select(slice(0, 40))


@pytest.fixture(scope="module")
def folder(strides, tmp_path_factory) -> Path:
    """Our files, what Blender exports of them, and where it sees their joints."""
    python = blender.python()
    folder = tmp_path_factory.mktemp("blender")
    files = [str(folder / name) for name in ("walk.bvh", "walk.glb")]
    for file in files:
        save_clip(file, strides)
    script = Path(__file__).parents[1] / "support" / "blender_scenes.py"
    words = [python, str(script), *files, str(folder)]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, env=environment)
    assert not done.returncode, done.stderr[-2000:]
    return folder


def error_in_blender(clip: Clip, folder: Path, name: str, scale: float) -> float:
    """Largest distance, m, between joints of a clip and bones in Blender, all of which it has."""
    with np.load(folder / f"{name}.npz") as seen:
        names, heads = seen["names"].tolist(), seen["heads"] * scale
    assert len(heads) == clip.frame_count and set(names) <= set(clip.joint_names)
    order = [clip.joint_names.index(name) for name in names]
    return float(np.linalg.norm(heads - clip.positions_ws[:, order], axis=-1).max())


def test_blender_sees_our_joints_where_they_are_and_draws_bones_along_them(folder, strides):
    for name, scale in (("imported.bvh", 0.01), ("imported.glb", 1.0)):
        assert error_in_blender(strides, folder, name, scale) < TOLERANCE, name
    vertices = np.load(folder / "body.npz")["vertices"]
    joints = strides.positions_ws[-1, sorted({parent for parent in strides.parents if parent >= 0})]
    off = np.linalg.norm(vertices - joints[:, None], axis=-1).min(axis=1)
    assert len(joints) == 7 and off.max() < TOLERANCE


def test_we_see_the_joints_and_actions_of_blender(folder, strides):
    for name in ("exported.bvh", "exported.glb", "dressed.glb", "dressed.gltf"):
        is_bvh = name == "exported.bvh"
        clip = load_clip(folder / name, **({"scale": 0.01, "up": "z"} if is_bvh else {}))
        assert clip.fps == 30.0 and clip.dialect == "jaxik"
        assert set(strides.joint_names) <= set(clip.joint_names)
        assert error_in_blender(clip, folder, name, 0.01 if is_bvh else 1.0) < TOLERANCE, name
        if is_bvh:  # comes back as it was
            assert error(strides, clip) < TOLERANCE
    with pytest.raises(ValueError, match="2 animations: .*'Still'.*choose one with animation="):
        load_clip(folder / "two.glb")
    assert load_clip(folder / "two.glb", animation="Still").frame_count == 40
