"""NumPy archives: saved clips, and files of the blocks benchmark."""

from dataclasses import fields, replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import load_clip, save_clip
from fitting.datasets.clips.edit import mask_pops
from support.sample_clips import stair_walk


@pytest.fixture(scope="module")
def walk():
    return replace(mask_pops(stair_walk()), remarks=("first", "second"))


def assert_same(clip, expected_clip):
    for field in fields(clip):
        first, second = getattr(clip, field.name), getattr(expected_clip, field.name)
        if field.name == "measured_rig":
            assert jax.tree.structure(first) == jax.tree.structure(second)
            for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
                assert a.dtype == b.dtype and np.array_equal(a, b)
        elif isinstance(first, np.ndarray):
            assert first.dtype == second.dtype and np.array_equal(first, second)
        else:
            assert type(first) is type(second) and first == second


def test_a_saved_clip_is_loaded_exactly(walk, tmp_path):
    save_clip(tmp_path / "clip.npz", walk)
    assert_same(load_clip(tmp_path / "clip.npz"), walk)
    bare = replace(walk, measured_rig=None, stance=None, mask=None, dialect=None, remarks=())
    save_clip(tmp_path / "clip.npz", bare)
    assert_same(load_clip(tmp_path / "clip.npz"), bare)


def test_heights_over_the_sole_are_measured_where_an_older_file_does_not_have_them(walk, tmp_path):
    save_clip(tmp_path / "clip.npz", walk)
    content = dict(np.load(tmp_path / "clip.npz"))
    heights = {name: content.pop(name) for name in ("rig_ankle_height", "rig_ball_height")}
    np.savez(tmp_path / "older.npz", **content)
    rig = load_clip(tmp_path / "older.npz").measured_rig
    assert np.array_equal(rig.ankle_height, heights["rig_ankle_height"])
    assert np.array_equal(rig.ball_height, heights["rig_ball_height"])


def test_a_save_that_fails_leaves_the_old_file_and_nothing_else(walk, tmp_path, monkeypatch):
    save_clip(tmp_path / "clip.npz", walk)
    before = (tmp_path / "clip.npz").read_bytes()

    def fail(file, **content):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(ValueError, match="clip.npz: cannot be written: disk full"):
        save_clip(tmp_path / "clip.npz", walk)
    assert [path.name for path in tmp_path.iterdir()] == ["clip.npz"]
    assert (tmp_path / "clip.npz").read_bytes() == before


def test_arrays_of_a_clip_are_read_only(walk):
    for array in (walk.positions_ws, walk.rotations_ws, walk.stance, walk.mask):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_archives_that_are_not_clips_are_refused(walk, tmp_path):
    path = tmp_path / "clip.npz"
    path.write_bytes(b"not an archive")
    with pytest.raises(ValueError, match="wanted a NumPy archive"):
        load_clip(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(ValueError, match=r"wanted a clip saved by save_clip.*\['a'\]"):
        load_clip(path)
    save_clip(path, walk)
    content = dict(np.load(path))
    for change, message in (
        ({"format": np.array("jaxik clip 9")}, "wanted the format"),
        ({"fps": None}, r"without the arrays \['fps'\]"),
        (
            {"positions_ws": content["positions_ws"] * np.nan},
            "positions_ws has numbers that are not",
        ),
    ):
        changed = {key: value for key, value in (content | change).items() if value is not None}
        np.savez(path, **changed)  # pyright: ignore[reportArgumentType]
        with pytest.raises(ValueError, match=message):
            load_clip(path)
    save_clip(path, walk)
    with pytest.raises(ValueError, match="only blocks files have the variant 'base'"):
        load_clip(path, variant="base")
    with pytest.raises(ValueError, match=r"\['fps'\] do not apply"):
        load_clip(path, fps=30.0)


def write_blocks(path, walk, **change):
    """Writes the walk as a blocks file whose base is the same motion 10 cm lower."""
    content = {"fps": np.array(walk.fps), "stance": walk.stance, "leg_lengths": np.ones((2, 2))}
    content["pelvis_rot"] = walk.rotations_ws[:, 0].astype(np.float32)
    content["foot_rot"] = walk.rotations_ws[:, [3, 7]].astype(np.float32)
    for prefix, lower in (("", 0.0), ("base_", 0.1)):
        content[f"{prefix}pelvis"] = walk.positions_ws[:, 0] - [0, lower, 0]
        for role, name in enumerate(("hip", "knee", "ankle", "ball")):
            content[prefix + name] = walk.joints_ws(role) - [0, lower, 0]
    np.savez(path, **{key: value for key, value in (content | change).items() if value is not None})


def test_a_blocks_file_has_a_captured_clip_and_a_base(walk, tmp_path):
    path = tmp_path / "blocks.npz"
    write_blocks(path, walk)
    for variant, lower in (("captured", 0.0), ("base", 0.1)):
        clip = load_clip(path, variant=variant)
        assert np.allclose(clip.positions_ws, walk.positions_ws - [0, lower, 0], atol=1e-12)
        assert np.abs(np.sum(clip.rotations_ws * walk.rotations_ws, axis=-1)).min() > 1 - 1e-12
        assert np.array_equal(clip.stance_labels(), walk.stance_labels())
        assert np.allclose(clip.rig.knee_axis_ls, [-1, 0, 0], atol=1e-9)


def test_blocks_files_with_wrong_arrays_are_refused(walk, tmp_path):
    path = tmp_path / "blocks.npz"
    write_blocks(path, walk)
    with pytest.raises(ValueError, match=r"no variant 'flat'; there are \['captured', 'base'\]"):
        load_clip(path, variant="flat")
    for change, message in (
        ({"knee": walk.joints_ws(1)[:5]}, r"knee is \(5, 2, 3\); wanted"),
        ({"foot_rot": None}, r"without the arrays \['foot_rot'\]"),
    ):
        write_blocks(path, walk, **change)
        with pytest.raises(ValueError, match=message):
            load_clip(path)


def test_the_blocks_benchmark_is_loaded_unchanged(mocap):
    raw = np.load(mocap / "blocks/03_03.npz")
    for variant, prefix in (("captured", ""), ("base", "base_")):
        clip = load_clip(mocap / "blocks/03_03.npz", variant=variant)
        assert np.array_equal(clip.positions_ws[:, 0], raw[f"{prefix}pelvis"])
        for role, name in enumerate(("hip", "knee", "ankle", "ball")):
            assert np.array_equal(clip.joints_ws(role), raw[prefix + name])
        assert np.allclose(clip.rig.thigh, raw["leg_lengths"][:, 0], atol=1e-6)
        assert np.allclose(clip.rig.shin, raw["leg_lengths"][:, 1], atol=1e-6)
        assert np.allclose(clip.rig.knee_axis_ls, [-1, 0, 0], atol=0.01)
        for leg, joints in enumerate(clip.rig.joints):  # bones point along -y of their joints
            rot = Rotation.from_quat(clip.rotations_ws[:, joints[0]], scalar_first=True)
            bone = np.array(clip.joints_ws(1)[:, leg] - clip.joints_ws(0)[:, leg])
            bone_ls = rot.inv().apply(bone)
            assert np.abs(bone_ls[:, [0, 2]]).max() < 1e-6 and bone_ls[:, 1].max() < 0
