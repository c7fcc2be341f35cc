"""Characters of glTF files: their meshes are kept, followed and written again."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.clips import Clip, load_clip, save_clip
from fitting.clips.formats import gltf_model
from fitting.clips.formats.gltf import read_tree, rest_places
from fitting.clips.formats.gltf_document import Document
from fitting.report import bodies
from support.gltf_files import Gltf, skinned_walker, walker


def written(folder: Path, file: Gltf) -> Path:
    path = folder / "walk.gltf"
    path.write_text(file.text())
    return path


def character(folder: Path) -> Gltf:
    return skinned_walker(rest_places(read_tree(Document.read(written(folder, walker())))))


@pytest.fixture
def clip(tmp_path) -> Clip:
    return load_clip(written(tmp_path, character(tmp_path)))


def skinned(clip: Clip, frame: int) -> np.ndarray:
    """The four vertices of each joint of a clip in a frame, m."""
    surface = gltf_model.surface(clip)
    assert surface is not None
    slots = surface.followed[:, 0]
    joints = np.array(surface.joints)[slots]
    corners = np.column_stack([surface.vertices, np.ones(len(slots))])
    own = np.einsum("vij,vj->vi", surface.binds[slots], corners)
    turned = Rotation.from_quat(clip.rotations_ws[frame, joints], scalar_first=True).apply(own)
    return (clip.positions_ws[frame, joints] + turned)[np.argsort(slots)].reshape(-1, 4, 3)


def test_a_mesh_below_a_scaled_armature_follows_the_joints_in_metres(clip):
    for frame in (0, 7):
        squares = skinned(clip, frame)
        np.testing.assert_allclose(squares.mean(axis=1), clip.positions_ws[frame], atol=1e-6)
        radii = np.linalg.norm(squares - clip.positions_ws[frame][:, None], axis=-1)
        np.testing.assert_allclose(radii, 0.01 * np.sqrt(2.0), atol=1e-6)


def test_a_written_file_keeps_all_but_the_animation(clip, tmp_path):
    moved = clip.with_motion(clip.positions_ws + [0.1, 0.3, 0.0], clip.rotations_ws)
    save_clip(tmp_path / "moved.glb", moved, ground=(np.eye(3), np.array([[0, 1, 2]])))
    again = load_clip(tmp_path / "moved.glb")
    np.testing.assert_allclose(again.positions_ws, moved.positions_ws, atol=1e-6)
    assert np.abs(np.sum(again.rotations_ws * moved.rotations_ws, axis=-1)).min() > 1 - 1e-6
    np.testing.assert_allclose(skinned(again, 5), skinned(clip, 5) + [0.1, 0.3, 0.0], atol=1e-6)
    old, new = json.loads((tmp_path / "walk.gltf").read_text()), again.model.header
    assert new["skins"] == old["skins"] and new["meshes"][:1] == old["meshes"]
    assert [material["name"] for material in new["materials"]] == ["cloth", "terrain"]
    assert [animation["name"] for animation in new["animations"]] == ["walk"]
    save_clip(tmp_path / "twice.glb", again)
    assert (tmp_path / "twice.glb").stat().st_size < 2 * (tmp_path / "moved.glb").stat().st_size


@pytest.mark.parametrize("change", ["uneven", "mirrored", "ours", "no mesh"])
def test_what_cannot_be_kept_loads_without_its_mesh(tmp_path, change):
    file = character(tmp_path)
    scale = {"uneven": [0.01, 0.01, 0.02], "mirrored": [-0.01] * 3}.get(change, [0.01] * 3)
    file.header["nodes"][0]["scale"] = scale
    if change == "ours":
        file.header["asset"]["generator"] = gltf_model.GENERATOR
    if change == "no mesh":
        del file.header["nodes"][-1]["mesh"]
    assert load_clip(written(tmp_path, file)).model is None


def test_units_and_axes_that_are_not_the_files_lose_the_mesh(tmp_path):
    path = written(tmp_path, character(tmp_path))
    assert load_clip(path, scale=1.1).model is None
    assert load_clip(path, up="z").model is None


def test_a_mesh_that_cannot_be_read_is_still_written(tmp_path):
    file = character(tmp_path)
    file.header["meshes"][0]["primitives"][0]["attributes"].pop("JOINTS_0")
    clip = load_clip(written(tmp_path, file))
    assert clip.model is not None and gltf_model.surface(clip) is None
    save_clip(tmp_path / "out.glb", clip)
    assert load_clip(tmp_path / "out.glb").model.header["meshes"] == file.header["meshes"]


def test_a_large_mesh_becomes_small_and_joints_keep_their_own_vertices(clip, monkeypatch):
    monkeypatch.setattr(gltf_model, "MOST_VERTICES", 20)
    surface = gltf_model.surface(clip)
    assert surface is not None and 9 <= len(surface.vertices) <= 20
    assert set(surface.followed[:, 0]) == set(range(9))
    assert surface.triangles.size == 0 or surface.triangles.max() < len(surface.vertices)


def test_a_packed_weight_loses_nothing(clip):
    surface = gltf_model.surface(clip)
    assert surface is not None
    thirds = surface._replace(weights=np.full_like(surface.weights, 0.25))
    assert set(bodies._weights(thirds).sum(axis=1)) == {bodies.FULL}
    skin = bodies.pack_skin(clip)
    assert skin is not None and skin.joints == tuple(range(9))
    assert skin.content["above"] == list(clip.parents)
