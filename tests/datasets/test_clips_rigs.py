"""Measured rigs, contact labels, and legs and roots of clips."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import load_clip
from fitting.datasets.clips.contacts import detect_stances, runs
from fitting.datasets.clips.formats.bvh import read_bvh
from fitting.datasets.clips.kinematics import local_from_world, world_from_local
from fitting.datasets.clips.rigs import (
    LegMotion,
    foot_axes,
    knee_axis,
    left_directions,
    measure_soles,
)
from jaxik.world.skeleton import Transform, forward_kinematics
from support.sample_clips import BVH, flat_floor, stair_walk

UPRIGHT = [1.0, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def walk():
    return stair_walk()


def test_forward_kinematics_agrees_with_that_in_jax_and_is_inverted(tmp_path):
    (tmp_path / "a.bvh").write_text(BVH)
    recording = read_bvh(tmp_path / "a.bvh")
    local = recording.positions_ls, recording.rotations_ls
    positions_ws, rotations_ws = world_from_local(recording.parents, *local)
    clip = load_clip(tmp_path / "a.bvh", scale=1.0)
    world = jax.jit(forward_kinematics)(clip.skeleton, *map(jnp.asarray, reversed(local)))
    assert np.abs(world.pos - positions_ws).max() < 1e-12
    assert np.abs(np.abs(np.sum(world.rot * rotations_ws, axis=-1)) - 1).max() < 1e-14
    assert np.array_equal(clip.positions_ws, positions_ws)
    back_pos, back_rot = local_from_world(recording.parents, positions_ws, rotations_ws)
    assert np.abs(back_pos - recording.positions_ls).max() < 1e-12
    assert np.abs(np.abs(np.sum(back_rot * recording.rotations_ls, axis=-1)) - 1).max() < 1e-14


def test_the_knee_axis_is_found_from_motion_or_for_a_stiff_knee_from_geometry():
    rng = np.random.default_rng(3)
    left = np.array([1.0, 0.0, 0.0])
    for flexion in (np.linspace(0.3, 1.2, 40), np.full(40, 0.6)):
        for skew in Rotation.random(5, rng):
            thigh = Rotation.from_rotvec(rng.normal(size=(40, 3)) * 0.3)
            shin = thigh * Rotation.from_rotvec(flexion[:, None] * left)
            knee = thigh.apply([0.0, -0.4, 0.0])
            ankle = knee + shin.apply([0.0, -0.4, 0.0])
            rotations = [rot.as_quat(scalar_first=True) for rot in (thigh, shin * skew, shin)]
            places = np.zeros((40, 3)), knee, ankle, ankle
            leg = LegMotion(*places, *rotations, left_ws=thigh.apply(left))
            assert np.allclose(knee_axis(leg), skew.inv().apply(-left), atol=1e-6)


def test_the_rig_measured_from_a_synthetic_walk_is_the_true_one(walk):
    rig = walk.rig
    assert np.allclose(rig.knee_axis_ls, [[-1, 0, 0], [-1, 0, 0]], atol=1e-9)
    assert np.allclose(rig.ankle_from_foot, [UPRIGHT] * 2, atol=1e-9)
    assert np.allclose(rig.thigh, 0.5) and np.allclose(rig.shin, 0.48)
    assert np.allclose(rig.foot, np.hypot(0.1, 0.05))
    assert rig.side.tolist() == [1, -1] and rig.names == ("left", "right")
    assert rig.thigh.dtype == np.float64
    for leg, (_, knee, _, _) in enumerate(rig.joints):  # a positive rotation opens the knee
        hips, knees, ankles = (walk.joints_ws(role)[:, leg] for role in range(3))
        rot = Rotation.from_quat(walk.rotations_ws[:, knee], scalar_first=True)
        opened = rot * Rotation.from_rotvec(0.1 * np.asarray(rig.knee_axis_ls[leg]))
        moved = knees + opened.apply(rot.inv().apply(ankles - knees))
        reach, before = (np.linalg.norm(end - hips, axis=-1) for end in (moved, ankles))
        assert (reach > before)[before < 0.95].all()


def test_leg_poses_have_the_default_precision_of_jax(walk):
    assert walk.leg_pose_ws().knee.pos.shape == (walk.frame_count, 2, 3)
    assert walk.leg_pose_ws().knee.pos.dtype == jnp.float64
    with jax.enable_x64(False):
        assert walk.leg_pose_ws().knee.rot.dtype == jnp.float32
        assert walk.rig.thigh.dtype == jnp.float32
        assert walk.world_from_model().pos.dtype == jnp.float32


def test_the_model_root_is_on_the_floor_below_the_pelvis_and_faces_forward(walk):
    root = walk.world_from_model(floor=0.25)
    assert np.allclose(root.pos[:, 1], 0.25)
    assert np.allclose(root.pos[:, [0, 2]], walk.positions_ws[:, 0][:, [0, 2]])
    assert np.allclose(root.rot, UPRIGHT, atol=1e-12)


def test_the_heading_is_continuous_beyond_half_a_turn(walk):
    yaw = np.linspace(0.0, 3 * np.pi, walk.frame_count)
    spin = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    positions = [spin.apply(np.array(walk.positions_ws[:, joint])) for joint in range(9)]
    rotated = walk.with_motion(np.stack(positions, axis=1), walk.rotations_ws).world_from_model()
    assert isinstance(rotated, Transform)
    assert np.sum(rotated.rot[1:] * rotated.rot[:-1], axis=-1).min() > 0.99
    assert np.allclose(rotated.rot[:, 0], np.cos(yaw / 2), atol=1e-9)


@pytest.mark.parametrize("frames", [slice(100, 110), slice(None)], ids=["a while", "always"])
def test_a_character_that_lies_on_its_side_keeps_its_last_heading_or_faces_z(walk, frames):
    positions = np.array(walk.positions_ws)
    positions[frames, [1, 5]] = positions[frames, [0]] + [[0, 0.1, 0], [0, -0.1, 0]]
    root = walk.with_motion(positions, walk.rotations_ws).world_from_model()
    assert np.allclose(root.rot, UPRIGHT, atol=1e-9)


def test_left_is_where_left_hips_are_or_the_x_axis_of_a_pelvis_with_legs_on_one_side():
    turned = Rotation.from_euler("y", [[0.0], [90.0]], degrees=True).as_quat(scalar_first=True)
    hips_ws = np.array([[[0.0, 1.0, 0.2], [0.0, 1.0, -0.2]]] * 2)
    both = left_directions(hips_ws, np.array([1.0, -1.0]), turned)
    np.testing.assert_allclose(both, [[0, 0, 1], [0, 0, 1]], atol=1e-12)
    alone = left_directions(hips_ws, np.array([1.0, 1.0]), turned)
    np.testing.assert_allclose(alone, [[1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_detected_stances_of_a_synthetic_walk_are_the_true_ones(walk):
    detected = detect_stances(walk.joints_ws(3), walk.fps)
    assert (detected == walk.stance).mean() > 0.9
    assert len(runs(detected[:, 0])) == len(runs(walk.stance[:, 0]))
    # A foot that hangs still in the air does not stand.
    height = np.interp(np.arange(120), [0, 40, 50, 70, 80, 120], [0, 0, 0.3, 0.3, 0, 0])
    ball = np.stack([0 * height, height, 0 * height], axis=-1)[:, None]
    detected = detect_stances(ball, 60.0)[:, 0]
    assert detected[:35].all() and detected[85:].all() and not detected[42:78].any()


def test_detected_stances_agree_with_the_labels_of_the_blocks_benchmark(mocap):
    clip = load_clip(mocap / "blocks/03_03.npz")
    labels = np.zeros((clip.frame_count, 2), bool)
    for stance in np.genfromtxt(
        mocap / "blocks/stances_03_03.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    ):
        labels[stance["first_frame"] : stance["last_frame"] + 1, "lr".index(stance["side"])] = True
    assert np.array_equal(labels, clip.stance_labels())
    detected = detect_stances(clip.joints_ws(3), clip.fps)
    assert (detected == labels).mean() > 0.99  # 0.9954 when written
    assert [len(runs(detected[:, leg])) for leg in (0, 1)] == [28, 26]


def test_heights_over_the_sole_are_those_of_a_flat_stance_over_the_floor():
    walk = stair_walk(flat_floor)
    assert np.allclose(walk.rig.ankle_height, 0.05, atol=1e-12)
    assert np.allclose(walk.rig.ball_height, 0.0, atol=1e-12)
    assert not walk.remarks
    higher = walk.positions_ws + [0.0, 0.3, 0.0]
    raised = measure_soles(walk.rig, higher, walk.rotations_ws, walk.stance_labels(), 0.3)
    assert raised.measured.all() and np.allclose(raised.ankle, 0.05, atol=1e-12)


def test_on_stairs_or_without_a_stance_heights_over_the_sole_are_those_of_feet_so_long(walk):
    for stance in (walk.stance, np.zeros_like(walk.stance)):
        soles = measure_soles(walk.measured_rig, walk.positions_ws, walk.rotations_ws, stance)
        assert not soles.measured.any()
        assert np.allclose(soles.ball, 0.45 * np.hypot(0.1, 0.05))
        assert np.allclose(soles.ankle - soles.ball, 0.05)
    assert len([remark for remark in walk.remarks if "no level floor" in remark]) == 2
    with pytest.raises(ValueError, match="stair walk was loaded without legs"):
        _ = replace(walk, measured_rig=None).rig


def test_a_knee_that_hardly_moves_is_remarked(tmp_path):
    path = tmp_path / "walk.bvh"
    path.write_text(BVH)  # whose right knee turns by 5, 9 and 3 degrees
    (remark,) = [text for text in load_clip(path).remarks if "knee" in text]
    assert remark.startswith("the right knee hardly moves, so its axis is a guess")
    path.write_text(BVH.replace("0 15 0 9 0", "0 15 0 29 0"))
    assert not any("knee" in text for text in load_clip(path).remarks)


def test_a_foot_of_one_point_below_a_pelvis_on_its_side_points_along_z():
    still, upright = np.zeros((2, 3)), np.tile(UPRIGHT, (2, 1))
    left_ws = np.tile([0.0, 1.0, 0.0], (2, 1))
    leg = LegMotion(still, still, still, still, upright, upright, upright, left_ws)
    np.testing.assert_allclose(foot_axes(leg, np.ones(2, bool)), UPRIGHT, atol=1e-12)
