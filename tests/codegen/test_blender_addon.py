"""The add-on for Blender: its zip, its files against our readers, and what it bakes in Blender.

Blender lives in an environment of its own, as for `tests/datasets/test_clip_writers.py`, and is
asked by `support/blender_addon.py`.
"""

import json
import os
import re
import runpy
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.cli import main
from fitting.clips import load_clip, save_clip
from fitting.experiment.systems import preset_names
from fitting.ground.meshes import load_terrain, mesh_of
from fitting.studies.exports import ADDON
from support import blender
from support.commands import refusal
from support.experiments import ROOT

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
TOLERANCE = 1e-4  # m


@pytest.fixture(scope="module")
def exchange():
    """The module of the add-on that needs no Blender."""
    return SimpleNamespace(**runpy.run_path(str(ADDON / "exchange.py")))


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("addon")
    assert main.main(["export", "--as", "blender-addon", "-o", str(folder / "new")]) == 0
    (path,) = (folder / "new").iterdir()
    return path


def test_the_command_writes_an_extension_that_blender_installs_from_disk(archive):
    with zipfile.ZipFile(archive) as content:
        texts = {name: content.read(name).decode() for name in content.namelist()}
    manifest = tomllib.loads(texts["blender_manifest.toml"])
    assert manifest["version"] == metadata.version("jaxik")
    assert manifest["id"] == "jaxik" and manifest["blender_version_min"] == "4.2.0"
    assert set(manifest["permissions"]) == {"files", "clipboard"}
    assert all(len(reason) <= 64 for reason in manifest["permissions"].values())
    assert texts["python.txt"] == sys.executable
    for name in set(texts) - {"blender_manifest.toml", "python.txt"}:
        compile(texts[name], name, "exec")
    assert "def register()" in texts["__init__.py"]


def test_the_command_says_what_the_add_on_does_not_take(tmp_path, capsys):
    (tmp_path / "file").touch()
    for words, message in (
        ([tmp_path, "--as", "blender-addon", "-o", tmp_path / "new"], "takes only -o"),
        (["--as", "blender-addon", "--legs", "2", "-o", tmp_path / "new"], "takes only -o"),
        (["--as", "blender-addon", "-o", tmp_path / "file"], "is a file"),
        (["--as", "c", "-o", tmp_path / "new"], "there is no SOURCE"),
    ):
        assert message in refusal(["export", *words], tmp_path, capsys)


def test_the_panel_offers_all_presets():
    text = (ADDON / "addon.py").read_text(encoding="utf-8")
    systems = re.search(r"^SYSTEMS = \[(.*?)^\]", text, re.DOTALL | re.MULTILINE)
    assert systems is not None
    offered = re.findall(r'^    \("(.+?)"', systems[1], re.MULTILINE)
    assert sorted(offered) == preset_names()


def test_a_motion_is_read_by_us_as_it_was_written(exchange, tmp_path):
    rng = np.random.default_rng(1)
    names, parents = ["a bone", 'b"é', "c.L", "d", "e"], [-1, 0, 1, -1, 3]
    turns = Rotation.random(7 * 5, rng).as_matrix().reshape(7, 5, 3, 3)
    motion = exchange.Motion(names, parents, rng.normal(size=(7, 5, 3)), turns)
    rest = motion._replace(positions=motion.positions[:1], rotations=turns[:1])
    exchange.write_clip(tmp_path / "clip.glb", exchange.y_up(motion, 0.5), rest, 24.0)
    clip = load_clip(tmp_path / "clip.glb")
    assert clip.fps == 24.0
    order = [clip.joint_names.index(name) for name in names]
    assert [clip.joint_names[parent] for parent in np.array(clip.parents)[order][[1, 2, 4]]] == [
        "a bone", 'b"é', "d"
    ]  # fmt: skip
    x, y, z = np.moveaxis(motion.positions, -1, 0) * 0.5
    assert np.allclose(clip.positions_ws[:, order], np.stack([x, z, -y], -1), atol=1e-6)
    read = motion._replace(
        positions=clip.positions_ws[:, order],
        rotations=exchange.matrices(clip.rotations_ws[:, order]),
    )
    back = exchange.z_up(read, 0.5)
    assert np.allclose(back.positions, motion.positions, atol=2e-6)
    assert np.allclose(back.rotations, motion.rotations, atol=1e-5)


@pytest.fixture(scope="module")
def baked(archive, tmp_path_factory) -> Path:
    """What Blender has done with the add-on."""
    python = blender.python()
    folder = tmp_path_factory.mktemp("blender")
    save_clip(folder / "walk.bvh", load_clip(BASE).select(slice(0, 60)))
    ground = mesh_of(load_terrain(GROUND))
    np.savez(folder / "ground.npz", vertices=ground.vertices, faces=ground.faces)
    script = Path(__file__).parents[1] / "support" / "blender_addon.py"
    words = [archive, folder / "walk.bvh", folder / "ground.npz", sys.executable, folder]
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(folder / "user")}
    command = [python, str(script), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=environment)
    assert not done.returncode, done.stdout[-2000:] + done.stderr[-2000:]
    return folder


@pytest.fixture
def answers(baked) -> dict:
    return json.loads((baked / "answers.json").read_text())


def off(baked: Path, case: str, solved: Path, spelled: dict[str, str]) -> tuple[float, float]:
    """How far bones are from joints at most, and how far the bake has moved them, m."""
    with np.load(baked / f"{case}.npz") as bones, np.load(solved) as joints:
        names, known = bones["names"].tolist(), joints["joint_names"].tolist()
        order = [known.index(spelled.get(name, name)) for name in names]
        assert len(order) >= 9
        distance = np.linalg.norm(bones["after"] - joints["positions_ws"][:, order], axis=-1)
        return float(distance.max()), float(np.abs(bones["after"] - bones["before"]).max())


@pytest.mark.filterwarnings("ignore::fitting.studies.animations.PlacementWarning")
def test_in_blender_joints_are_where_jaxik_run_puts_them(baked, tmp_path):
    words = ["run", baked / "walk.bvh", "--terrain", GROUND, "--preset", "ozz", "--scale", "0.01"]
    assert main.main([str(word) for word in [*words, "-o", tmp_path / "own.npz"]]) == 0
    error, moved = off(baked, "plain", tmp_path / "own.npz", {})
    assert error < TOLERANCE and moved > 0.1


def test_in_blender_a_rig_in_centimetres_with_bones_of_its_own_is_baked_as_exactly(baked, answers):
    error, moved = off(baked, "dressed", baked / "dressed_solved.npz", {})
    assert error < TOLERANCE and moved > 0.1
    seen = answers["dressed"]
    assert seen["muted"] and seen["size"] == [0.01] * 3
    assert seen["unknown"].startswith("the names of the bones do not say which are legs")
    assert seen["incomplete"].endswith("there is no pelvis") and seen["found"] == "L my hip"


def test_in_blender_any_motion_is_baked_onto_any_bones(answers):
    seen = answers["tangled"]
    assert seen["off"] < TOLERANCE and seen["turned"] < 1e-4 and seen["moved"] > 10
    assert seen["muted"] == [["bone 13", "IK"]] and len(seen["keyed"]) < 14


def test_in_blender_a_bake_is_taken_back_whole_and_begins_with_the_animation(answers):
    seen = answers["plain"]
    assert seen["names"] == ["walk", "walk on ground"] and seen["kept"] and seen["frame"] == 7
    assert seen["again"] == 0.0 and seen["undone"] == ["walk"]
    properties = seen["properties"]
    contacts = [properties.pop(f"jaxik_contact_{side}") for side in ("left", "right")]
    assert sorted(contacts) == [0.0, 1.0] and list(properties) == ["jaxik_pelvis"]
    assert 0.05 < np.abs(properties["jaxik_pelvis"]).max() < 0.5


def test_in_blender_a_window_stays_alive_and_a_cancelled_bake_has_changed_nothing(answers):
    seen = answers["windowed"]
    assert seen["cancelled"] == [["CANCELLED"], "walk"]
    assert seen["ended"] == [["FINISHED"], "walk on ground"]
    assert seen["events"] > seen["frames"] / 2 > 10  # no event takes on more than two frames


def test_in_blender_one_line_says_what_cannot_be_used(answers):
    said = answers["refusals"]
    assert said.pop("actions") == 1
    assert "preferences have the command that installs it" in said["a Python without jaxik"]
    assert said["no Python"].startswith("/nowhere/python cannot be run: ")
    assert said["at rest"] == "walk shows its rest position; set it to Pose Position"
    assert said["no action"] == "walk has no active action; choose one in the Action Editor"
    assert said["no faces"].startswith("Ground has no faces")
    assert said["no ground"].endswith("Choose a ground")
    assert all(len(line.splitlines()) == 1 for line in said.values())
