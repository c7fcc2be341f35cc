"""NumPy archives: saved clips, and files of the blocks benchmark."""

from dataclasses import fields, replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import load_clip, save_clip
from fitting.datasets.clips.edit import mask_pops
from fitting.datasets.synthetic import multi_limb, speed_profile, walker
from support.sample_clips import stair_walk

ROLES = ("hip", "knee", "ankle", "ball")


@pytest.fixture(scope="module")
def walk():
    return replace(mask_pops(stair_walk()), remarks=("first", "second"))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "clip.npz"


@pytest.fixture
def content(walk, path):
    """The arrays of the saved walk."""
    save_clip(path, walk)
    return dict(np.load(path))


def write(path, arrays) -> None:
    """An archive of the arrays that are not None."""
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


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


def test_a_saved_clip_is_loaded_exactly_and_its_arrays_are_read_only(walk, path):
    bare = replace(walk, measured_rig=None, stance=None, mask=None, dialect=None, remarks=())
    climber = multi_limb.climb(0.5)  # on four limbs
    sliding = walker.walk(3.0, 10.0, events=[speed_profile.Slide(0.5, 2.5)])
    for clip in (walk, bare, climber, sliding):
        save_clip(path, clip)
        assert_same(load_clip(path), clip)
    for array in (walk.positions_ws, walk.rotations_ws, walk.stance, walk.mask):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_heights_over_the_sole_are_measured_where_an_older_file_does_not_have_them(content, path):
    heights = {name: content.pop(name) for name in ("rig_ankle_height", "rig_ball_height")}
    write(path, content)
    rig = load_clip(path).measured_rig
    assert np.array_equal(rig.ankle_height, heights["rig_ankle_height"])
    assert np.array_equal(rig.ball_height, heights["rig_ball_height"])


def test_a_save_that_fails_leaves_the_old_file_and_nothing_else(walk, path, monkeypatch):
    save_clip(path, walk)
    before = path.read_bytes()

    def fail(file, **content):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(ValueError, match="clip.npz: cannot be written: disk full"):
        save_clip(path, walk)
    assert list(path.parent.iterdir()) == [path] and path.read_bytes() == before


def test_archives_that_are_not_clips_are_refused(content, path):
    for options, message in (
        ({"variant": "base"}, "only blocks files have the variant 'base'"),
        ({"fps": 30.0}, r"\['fps'\] do not apply"),
    ):
        with pytest.raises(ValueError, match=message):
            load_clip(path, **options)  # pyright: ignore[reportArgumentType]
    nowhere = content["positions_ws"] * np.nan
    for arrays, message in (
        ({"a": np.zeros(3)}, r"wanted a clip saved by save_clip.*\['a'\]"),
        (content | {"format": np.array("jaxik clip 9")}, "wanted the format"),
        (content | {"fps": None}, r"without the arrays \['fps'\]"),
        (content | {"positions_ws": nowhere}, "positions_ws has numbers that are not"),
    ):
        write(path, arrays)
        with pytest.raises(ValueError, match=message):
            load_clip(path)
    path.write_bytes(b"not an archive")
    with pytest.raises(ValueError, match="wanted a NumPy archive"):
        load_clip(path)


def blocks(walk) -> dict[str, np.ndarray]:
    """The walk as a blocks file whose base is the same motion 10 cm lower."""
    arrays = {"fps": np.array(walk.fps), "stance": walk.stance, "leg_lengths": np.ones((2, 2))}
    arrays["pelvis_rot"] = walk.rotations_ws[:, 0].astype(np.float32)
    arrays["foot_rot"] = walk.rotations_ws[:, [3, 7]].astype(np.float32)
    for prefix, lower in (("", 0.0), ("base_", 0.1)):
        arrays[f"{prefix}pelvis"] = walk.positions_ws[:, 0] - [0, lower, 0]
        for role, name in enumerate(ROLES):
            arrays[prefix + name] = walk.joints_ws(role) - [0, lower, 0]
    return arrays


def test_a_blocks_file_has_a_captured_clip_and_a_base(walk, path):
    write(path, blocks(walk))
    for variant, lower in (("captured", 0.0), ("base", 0.1)):
        clip = load_clip(path, variant=variant)
        assert np.allclose(clip.positions_ws, walk.positions_ws - [0, lower, 0], atol=1e-12)
        assert np.abs(np.sum(clip.rotations_ws * walk.rotations_ws, axis=-1)).min() > 1 - 1e-12
        assert np.array_equal(clip.stance_labels(), walk.stance_labels())
        assert np.allclose(clip.rig.knee_axis_ls, [-1, 0, 0], atol=1e-9)
    with pytest.raises(ValueError, match=r"no variant 'flat'; there are \['captured', 'base'\]"):
        load_clip(path, variant="flat")
    for change, message in (
        ({"knee": walk.joints_ws(1)[:5]}, r"knee is \(5, 2, 3\); wanted"),
        ({"foot_rot": None}, r"without the arrays \['foot_rot'\]"),
    ):
        write(path, blocks(walk) | change)
        with pytest.raises(ValueError, match=message):
            load_clip(path)


def test_the_blocks_benchmark_is_loaded_unchanged(mocap):
    raw = np.load(mocap / "blocks/03_03.npz")
    for variant, prefix in (("captured", ""), ("base", "base_")):
        clip = load_clip(mocap / "blocks/03_03.npz", variant=variant)
        assert np.array_equal(clip.positions_ws[:, 0], raw[f"{prefix}pelvis"])
        for role, name in enumerate(ROLES):
            assert np.array_equal(clip.joints_ws(role), raw[prefix + name])
        lengths = np.stack([clip.rig.thigh, clip.rig.shin], axis=-1)
        assert np.allclose(lengths, raw["leg_lengths"], atol=1e-6)
        assert np.allclose(clip.rig.knee_axis_ls, [-1, 0, 0], atol=0.01)
        for leg, joints in enumerate(clip.rig.joints):  # bones point along -y of their joints
            rot = Rotation.from_quat(clip.rotations_ws[:, joints[0]], scalar_first=True)
            bone = rot.inv().apply(clip.joints_ws(1)[:, leg] - clip.joints_ws(0)[:, leg])
            assert np.abs(bone[:, [0, 2]]).max() < 1e-6 and bone[:, 1].max() < 0
