"""All reference files against an independent reading of them, `facts.json`."""

import hashlib
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import Clip, load_clip
from fitting.datasets.clips.recording import Y_UP_FROM_Z_UP
from support.sample_clips import AMC_FILES, BVH_FILES

TOLERANCE = 1e-4  # of body height, and of a rotation matrix
FILES = [*AMC_FILES, *BVH_FILES]


@pytest.fixture(scope="module")
def facts(mocap) -> dict[str, dict]:
    return {fact["file"]: fact for fact in json.loads((mocap / "clips/facts.json").read_text())}


@pytest.fixture(scope="module", params=FILES)
def case(request, mocap, facts) -> tuple[Clip, dict]:
    path, fact = mocap / "clips" / request.param, facts[request.param]
    assert hashlib.sha256(path.read_bytes()).hexdigest() == fact["sha256"]
    return load_clip(path), fact


def test_all_reference_files_are_tested(facts):
    assert sorted(facts) == sorted(FILES)


def listed(fact: dict, key: str):
    """Frame, joint and expected number of each entry."""
    for frame, joints in fact.get(key, {}).items():
        for name, expected in joints.items():
            yield int(frame), name, np.array(expected)


def test_positions_and_rotations_agree_with_the_reference(case):
    clip, fact = case
    axes = Y_UP_FROM_Z_UP if fact["up_axis"] == "z" else np.eye(3)
    suffixes = {"positions": "", "bone_start_positions": "", "bone_end_positions": "_end"}
    for key, suffix in suffixes.items():
        for frame, name, expected in listed(fact, key):
            if name + suffix in clip.joint_names or not suffix:
                joint = clip.joint_names.index(name + suffix)
                error = clip.positions_ws[frame, joint] - clip.scale * axes @ expected
                assert np.abs(error).max() <= TOLERANCE * clip.body_height, (key, name)
    for frame, name, expected in listed(fact, "world_rotations"):
        rot = clip.rotations_ws[frame, clip.joint_names.index(name)]
        matrix = Rotation.from_quat(rot, scalar_first=True).as_matrix()
        assert np.abs(matrix - axes @ expected @ axes.T).max() < TOLERANCE, name


def test_frames_rate_scale_and_up_axis_are_recognised(case):
    clip, fact = case
    assert clip.frame_count == fact["n_frames"]
    assert clip.fps == fact.get("fps", fact.get("fps_nominal"))
    assert clip.raw_frame_time == pytest.approx(fact.get("frame_time", 1 / 120), rel=1e-12)
    assert clip.up_axis == fact["up_axis"]
    if fact["scale_to_m"] is not None:
        assert clip.scale == pytest.approx(fact["scale_to_m"])


def test_legs_are_recognised_and_measured(case):
    clip, fact = case
    if fact["joint_map"] is None:
        with pytest.raises(ValueError, match="no pair of legs.*Hips.*Head_end"):
            _ = clip.rig
        return
    rig = clip.rig
    assert clip.joint_names[rig.pelvis] == fact["joint_map"]["pelvis"]
    for joints, letter in zip(rig.joints, "lr", strict=True):
        for joint, part in zip(joints, ("hip", "knee", "ankle", "ball"), strict=True):
            expected = fact["joint_map"][f"{part}_{letter}"]
            if expected is None:  # no toe joint: the foot's end site
                expected = fact["joint_map"][f"tip_{letter}"].replace("/End Site", "_end")
            assert clip.joint_names[joint] == expected
    for name in ("thigh", "shin", "foot") if "bone_lengths_m" in fact else ():
        expected = [fact["bone_lengths_m"][f"{name}_{letter}"] for letter in "lr"]
        assert np.allclose(getattr(rig, name), expected, atol=1e-6)


def test_knees_open_about_their_measured_axis_and_standing_feet_are_level_and_point_ahead(case):
    clip, fact = case
    if fact["joint_map"] is None:
        return
    rig = clip.rig
    ahead = np.cross(clip.left_ws(), [0.0, 1.0, 0.0])
    for leg, (hip, knee, ankle, _) in enumerate(rig.joints):
        rot = Rotation.from_quat(clip.rotations_ws[:, knee], scalar_first=True)
        axis_ws = rot.apply(np.array(rig.knee_axis_ls[leg]))
        p = clip.positions_ws
        flexing = np.cross(p[:, knee] - p[:, hip], p[:, ankle] - p[:, knee])
        bent = np.linalg.norm(flexing, axis=-1) > 0.05 * np.median(np.linalg.norm(flexing, axis=-1))
        assert np.mean(np.sum(flexing[bent] * axis_ws[bent], axis=-1) < 0) > 0.98
        if "poser" not in fact["file"]:  # whose feet slide
            foot = Rotation.from_quat(np.asarray(rig.ankle_from_foot[leg]), scalar_first=True)
            rot = Rotation.from_quat(clip.rotations_ws[:, ankle], scalar_first=True) * foot
            assert np.median(rot.apply([0.0, 1.0, 0.0])[:, 1]) > 0.8
            assert np.median(np.sum(rot.apply([0.0, 0.0, 1.0]) * ahead, axis=-1)) > 0.75
    if fact["format"] == "ASF/AMC":  # hinge about x of axes rotated by 20 degrees about z
        axes_ls = [[-np.cos(np.radians(20)), sign * np.sin(np.radians(20)), 0] for sign in (-1, 1)]
        assert np.allclose(rig.knee_axis_ls, axes_ls, atol=1e-6)
