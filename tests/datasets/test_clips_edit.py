"""Edits of clips, and their summaries."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fitting.datasets.clips import edit, load_clip
from fitting.datasets.clips.contacts import detect_stances
from fitting.datasets.clips.joint_roles import find_roles
from fitting.datasets.clips.rigs import measure_rig
from fitting.datasets.clips.summary import as_json, as_text, describe
from support.sample_clips import BVH, stair_walk


@pytest.fixture(scope="module")
def walk():
    return stair_walk()


def bones(clip) -> np.ndarray:
    joints = [joint for joint, parent in enumerate(clip.parents) if parent >= 0]
    parents = [clip.parents[joint] for joint in joints]
    return np.linalg.norm(clip.positions_ws[:, joints] - clip.positions_ws[:, parents], axis=-1)


@pytest.mark.parametrize("fps", [120.0, 50.0, 30.0, 24.0, 144.0])
def test_resampling_keeps_duration_and_bone_lengths(walk, fps):
    other = edit.resample(walk, fps)
    assert 0 <= walk.seconds - other.seconds < 1 / fps
    assert np.allclose(bones(other)[:, [1, 2, 5, 6]], bones(walk)[0, [1, 2, 5, 6]], atol=1e-12)
    time = np.arange(other.frame_count) * walk.fps / fps
    for axis in range(3):
        expected = np.interp(time, np.arange(walk.frame_count), walk.positions_ws[:, 4, axis])
        assert np.abs(other.positions_ws[:, 4, axis] - expected).max() < 2e-3


def test_half_the_rate_keeps_every_second_frame_and_the_same_rate_the_clip(walk):
    half = edit.resample(walk, 30.0)
    assert half.fps == 30.0 and half.frame_count == (walk.frame_count + 1) // 2
    assert np.allclose(half.positions_ws, walk.positions_ws[::2], atol=1e-12)
    assert np.array_equal(half.stance_labels(), walk.stance_labels()[::2])
    assert edit.resample(walk, walk.fps) is walk
    with pytest.raises(ValueError, match="fps is 0"):
        edit.resample(walk, 0.0)


def test_frames_interpolated_from_a_masked_one_are_masked(walk):
    mask = np.ones(walk.frame_count, bool)
    mask[7] = False
    fine = edit.resample(replace(walk, mask=mask), 120.0)
    assert np.flatnonzero(fine.mask == 0).tolist() == [13, 14, 15]


def test_a_faster_root_carries_the_same_poses_and_contacts_further(walk):
    fast = edit.at_speed(walk, 1.5)
    pelvis, before = (clip.positions_ws[:, clip.rig.pelvis] for clip in (fast, walk))
    np.testing.assert_allclose(
        pelvis - pelvis[0], (before - before[0]) * [1.5, 1.0, 1.5], atol=1e-12
    )
    np.testing.assert_allclose(
        fast.positions_ws - pelvis[:, None], walk.positions_ws - before[:, None], atol=1e-12
    )
    assert np.array_equal(fast.stance_labels(), walk.stance_labels())
    for factor in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=r"wanted a finite number above 0"):
            edit.at_speed(walk, factor)


def test_trim_keeps_both_ends(walk):
    cut = edit.trim(walk, 0.5, 1.0)
    assert cut.frame_count == 31
    assert np.array_equal(cut.positions_ws, walk.positions_ws[30:61])
    assert np.array_equal(cut.stance_labels(), walk.stance_labels()[30:61])
    assert edit.trim(walk).frame_count == walk.frame_count
    for start, end in ((-0.1, 1.0), (1.0, 0.5), (0.0, 99.0)):
        with pytest.raises(ValueError, match="wanted 0 <= start <= end <="):
            edit.trim(walk, start, end)


def with_t_pose(tmp_path, ramp: int):
    """The small BVH with 40 frames of motion, after a T-pose and a ramp of `ramp` frames."""
    phase = np.arange(40)[:, None] / 9
    still = 87 * np.eye(24)[1]
    hip, knee = np.eye(24)[[7, 9]]
    walk = still + hip * (5 * np.sin(phase) - 30) + knee * (60 + 5 * np.cos(phase))
    part = np.linspace(0.0, 1.0, ramp + 2)[:-1, None]
    frames = [*(still + part * (walk[0] - still)), *walk, walk[-1], walk[-1]]
    text = "\n".join(" ".join(map(str, frame)) for frame in frames)
    head = BVH.split("Frames:")[0]
    (tmp_path / "t.bvh").write_text(f"{head}Frames: {len(frames)}\nFrame Time: 0.0083333\n{text}")
    return load_clip(tmp_path / "t.bvh")


@pytest.mark.parametrize("ramp", [0, 4])
def test_a_t_pose_its_ramp_and_repeated_last_frames_are_dropped(tmp_path, walk, ramp):
    clip = with_t_pose(tmp_path, ramp)
    assert edit.motion_span(clip) == (1 + ramp, ramp + 40)
    moving = edit.drop_t_pose(clip)
    assert moving.frame_count == 40
    assert edit.drop_t_pose(moving) is moving
    warnings = describe(clip)["warnings"]
    assert f"starts with a T-pose; the motion begins at frame {1 + ramp}" in warnings
    assert "the last frame is repeated 2 times" in warnings
    for other in (walk, walk.select(np.zeros(5, int))):  # without T-pose, and without motion
        assert edit.drop_t_pose(other) is other


def test_a_popped_marker_is_masked(walk):
    positions = np.array(walk.positions_ws)
    positions[50, 7] += [0.0, 0.3, 0.0]
    popped = edit.mask_pops(walk.with_motion(positions, walk.rotations_ws))
    assert np.flatnonzero(edit.pops(popped)).tolist() == [49, 50, 51]
    assert np.flatnonzero(popped.mask == 0).tolist() == [49, 50, 51]
    assert not edit.pops(walk).any()
    again = edit.mask_pops(replace(walk, mask=popped.mask))
    assert again.mask is not None and (again.mask == popped.mask).all()
    assert any("markers pop in 3 frames" in warning for warning in describe(popped)["warnings"])


def test_a_clip_mirrored_twice_is_the_clip_and_without_symmetry_it_is_refused(walk):
    rig = replace(walk.measured_rig, thigh=walk.measured_rig.thigh + np.array([0.0, 0.1]))
    uneven = replace(walk, measured_rig=rig)
    once = edit.mirror(uneven)
    assert np.allclose(once.joints_ws(2)[:, 0], uneven.joints_ws(2)[:, 1] * [-1, 1, 1])
    assert np.allclose(once.rig.thigh, uneven.rig.thigh[::-1])
    assert np.array_equal(once.stance_labels(), uneven.stance_labels()[:, ::-1])
    assert once.rig.side.tolist() == [1, -1]
    twice = edit.mirror(once)
    assert np.array_equal(twice.positions_ws, uneven.positions_ws)
    assert np.array_equal(twice.rotations_ws, uneven.rotations_ws)
    assert np.array_equal(twice.rig.thigh, uneven.rig.thigh)
    names = tuple(name.replace("right_knee", "peg") for name in walk.joint_names)
    parents = tuple(0 if name == "peg" else walk.parents[j] for j, name in enumerate(names))
    with pytest.raises(ValueError, match="cannot be mirrored.*peg"):
        edit.mirror(replace(walk, joint_names=names, parents=parents))


def test_a_mirrored_clip_measures_as_its_mirrored_rig(mocap):
    clip = load_clip(mocap / "clips/cmu_asfamc/02_03.amc")
    once = edit.mirror(clip)
    roles = find_roles(once.joint_names, once.parents)
    positions, rotations = np.array(once.positions_ws), np.array(once.rotations_ws)
    again = measure_rig(roles, positions, rotations, detect_stances(once.joints_ws(3), once.fps))
    for name in ("knee_axis_ls", "thigh", "shin", "foot"):
        assert np.allclose(getattr(again, name), getattr(once.rig, name), atol=1e-6)
    gap = np.abs(np.sum(np.asarray(again.ankle_from_foot * once.rig.ankle_from_foot), axis=-1))
    assert gap.min() > 1 - 1e-9


def test_marker_pops_and_t_poses_of_the_reference_files(mocap):
    pops = edit.pops(load_clip(mocap / "blocks/03_03.npz"))
    assert pops.sum() == 52  # as facts.json counts them
    spans = {
        "cmu_bvh_mb/cmu_12_01_walk.bvh": (1, 523),
        "cmu_bvh_poser/03_01.bvh": (7, 432),
        "cmu_bvh_max/scaled_131_01.bvh": (0, 993),
        "cmu_asfamc/02_01.amc": (0, 342),
    }
    for file, span in spans.items():
        assert edit.motion_span(load_clip(mocap / "clips" / file)) == span


def test_a_clip_is_summarised_as_data_and_text(walk):
    summary = describe(walk)
    assert json.loads(as_json(summary)) == summary
    assert summary["joint_map"]["knee_left"] == "left_knee"
    legs = summary["legs"]
    assert (legs["left"]["contacts"], legs["left"]["contacts_from"]) == (3, "file")
    assert legs["right"]["thigh"] == pytest.approx(0.5)
    text = as_text(summary)
    for part in ("stair walk: 162 frames", "60 Hz", "y up", "hip left_hip", "stands 3 times"):
        assert part in text
    legless = describe(replace(walk, measured_rig=None, remarks=("no legs recognised",)))
    text = as_text(legless)
    assert "no legs recognised" in text and "hip" in text and legless["legs"] == {}
