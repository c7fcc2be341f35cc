"""Motion in and out against Blender, which reads our files and writes some for us.

Blender as a module (`bpy`) needs an older NumPy than JAX, so it lives in an environment of its own,
whose Python the variable BLENDER_PYTHON names:

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.15
    BLENDER_PYTHON=blender/bin/python python -m pytest tests/datasets/test_blender.py
"""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from fitting.datasets.clips import Clip, load_clip, save_clip
from fitting.datasets.clips.edit import resample
from support.sample_clips import stair_walk

SCRIPT = Path(__file__).parents[1] / "support" / "blender_scenes.py"
TOLERANCE = 1e-4  # m
SECONDS = 300.0


@pytest.fixture(scope="module")
def blender() -> str:
    """A Python that has Blender as a module."""
    python = os.environ.get("BLENDER_PYTHON")
    if python is None:
        pytest.skip("BLENDER_PYTHON names no Python with Blender as a module (bpy)")
    done = subprocess.run([python, "-c", "import bpy"], capture_output=True, text=True)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"status {done.returncode}"]
        pytest.skip(f"{python} cannot import bpy: {reason[0]}")
    return python


@pytest.fixture(scope="module")
def walk() -> Clip:
    return resample(stair_walk(), 30.0).select(slice(0, 40))


@pytest.fixture(scope="module")
def folder(blender, walk, tmp_path_factory) -> Path:
    """Our files, what Blender exports of them, and where it sees their joints."""
    folder = tmp_path_factory.mktemp("blender")
    files = [str(folder / name) for name in ("walk.bvh", "walk.glb")]
    for file in files:
        save_clip(file, walk)
    words = [blender, str(SCRIPT), *files, str(folder)]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS, env=environment)
    assert not done.returncode, done.stderr[-2000:]
    return folder


def error_of(clip: Clip, folder: Path, name: str, scale: float) -> float:
    """Largest distance, m, between joints of a clip and bones in Blender, all of which it has."""
    with np.load(folder / f"{name}.npz") as seen:
        names, heads = seen["names"].tolist(), seen["heads"] * scale
    assert len(heads) == clip.frame_count and set(names) <= set(clip.joint_names)
    order = [clip.joint_names.index(name) for name in names]
    return float(np.linalg.norm(heads - clip.positions_ws[:, order], axis=-1).max())


@pytest.mark.parametrize(("name", "scale"), [("imported.bvh", 0.01), ("imported.glb", 1.0)])
def test_blender_sees_our_joints_where_they_are(folder, walk, name, scale):
    assert error_of(walk, folder, name, scale) < TOLERANCE


def test_the_bones_that_blender_draws_follow_our_joints(folder, walk):
    vertices = np.load(folder / "body.npz")["vertices"]
    joints = walk.positions_ws[-1, sorted({parent for parent in walk.parents if parent >= 0})]
    off = np.linalg.norm(vertices - joints[:, None], axis=-1).min(axis=1)
    assert len(joints) == 7 and off.max() < TOLERANCE


@pytest.mark.parametrize("name", ["exported.bvh", "exported.glb", "dressed.glb", "dressed.gltf"])
def test_we_see_the_joints_of_blender_where_they_are(folder, walk, name):
    scale, options = 1.0, {}
    if name == "exported.bvh":
        scale, options = 0.01, {"scale": 0.01, "up": "z"}
    clip = load_clip(folder / name, **options)
    assert clip.fps == 30.0 and clip.dialect == "jaxik"
    assert set(walk.joint_names) <= set(clip.joint_names)
    assert error_of(clip, folder, name, scale) < TOLERANCE
    if name == "exported.bvh":  # comes back as it was
        order = [clip.joint_names.index(joint) for joint in walk.joint_names]
        error = np.linalg.norm(clip.positions_ws[:, order] - walk.positions_ws, axis=-1)
        assert error.max() < TOLERANCE


def test_one_of_several_actions_is_chosen_by_its_name(folder):
    with pytest.raises(ValueError, match="2 animations: .*'Still'.*choose one with animation="):
        load_clip(folder / "two.glb")
    assert load_clip(folder / "two.glb", animation="Still").frame_count == 40
