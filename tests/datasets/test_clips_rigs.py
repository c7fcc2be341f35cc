"""Joint roles, measured rigs, contact labels, and legs and roots of clips."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import load_clip
from fitting.datasets.clips.contacts import detect_stances, runs
from fitting.datasets.clips.formats.bvh import read_bvh
from fitting.datasets.clips.joint_roles import Trunk, find_roles, find_trunk, partners
from fitting.datasets.clips.kinematics import local_from_world, world_from_local
from fitting.datasets.clips.rigs import LegMotion, foot_axes, knee_axis, measure_soles
from jaxik.maths import quat
from jaxik.world.skeleton import Transform, forward_kinematics
from support.sample_clips import BVH, stair_walk

PARTS = ("pelvis", "hip", "knee", "ankle", "toe")


@pytest.fixture(scope="module")
def walk():
    return stair_walk()


@pytest.mark.parametrize(
    "names",
    [
        "root lfemur ltibia lfoot ltoes rfemur rtibia rfoot rtoes",
        "Hips LeftHip LeftKnee LeftAnkle LeftToe RightHip RightKnee RightAnkle RightToe",
        "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase RightUpLeg RightLeg RightFoot RightToeBase",
        "m:Hips mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase "
        "mixamorigRightUpLeg mixamorig:RightLeg mixamorig9:RightFoot mixamorig:RightToeBase",
        "hip lThigh lShin lFoot lToe rThigh rShin rFoot rToe",
        "Hips UpperLeg_L LowerLeg_L Foot_L Toes_L UpperLeg_R LowerLeg_R Foot_R Toes_R",
        "pelvis thigh_l calf_l foot_l ball_l thigh_r calf_r foot_r ball_r",
        "Pelvis L_Hip L_Knee L_Ankle L_Foot R_Hip R_Knee R_Ankle R_Foot",
    ],
)  # fmt: skip
def test_naming_conventions_are_recognised(names):
    roles = find_roles(tuple(names.split()), (-1, 0, 1, 2, 3, 0, 5, 6, 7))
    assert roles.pelvis == 0
    assert [(leg.name, leg.side, leg.joints) for leg in roles.legs] == [
        ("left", 1.0, (1, 2, 3, 4)),
        ("right", -1.0, (5, 6, 7, 8)),
    ]


@pytest.mark.parametrize(
    ("names", "parents", "trunk"),
    [
        ("Hips LowerBack Spine Neck Head", (-1, 0, 1, 2, 3), Trunk(1, 4)),
        ("hip abdomen chest neck head", (-1, 0, 1, 2, 3), Trunk(1, 4)),
        ("Root Pelvis mixamorig:Spine mixamorig:Head", (-1, 0, 1, 2), Trunk(2, 3)),
        ("Root Pelvis Waist Head", (-1, 0, 0, 2), Trunk(2, 3)),  # legs and spine side by side
        ("pelvis spine_01 neck_01", (-1, 0, 1), Trunk(1, None)),
        ("Hips Head", (-1, 0), Trunk(None, 1)),
        ("pelvis left_hip", (-1, 0), Trunk(None, None)),
    ],
)
def test_the_trunk_is_the_way_from_the_pelvis_to_the_head(names, parents, trunk):
    words = names.split()
    pelvis = 1 if words[0] == "Root" else 0
    assert find_trunk(tuple(words), parents, pelvis) == trunk


def test_the_error_for_a_missing_leg_lists_the_joints():
    with pytest.raises(ValueError, match=r"no pair of legs.*\['Hips', 'Tail'\].*MotionBuilder"):
        find_roles(("Hips", "Tail"), (-1, 0))
    feet = ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot")
    with pytest.raises(ValueError, match="neither toe nor end site: LeftFoot has no child"):
        find_roles(feet, (-1, 0, 1, 2, 0, 4, 5))


def test_any_number_of_legs_can_be_named():
    names, parents, joints = ["body"], [-1], {"pelvis": "body"}
    for leg in ("fl", "fr", "hl", "hr", "tail"):
        for index, part in enumerate(PARTS[1:]):
            names.append(f"{part}{leg}")
            parents.append(len(names) - 2 if index else 0)
            joints[f"{part}_{leg}"] = names[-1]
    roles = find_roles(tuple(names), tuple(parents), joints)
    assert [leg.side for leg in roles.legs] == [1, -1, 1, -1, 1]
    assert roles.legs[2].joints == (9, 10, 11, 12)


def test_the_end_of_a_suffix_decides_the_side_of_a_named_leg():
    suffixes = ("fore_left", "fore_right", "left", "r", "weft", "light")
    names, parents, joints = ["body"], [-1], {"pelvis": "body"}
    for leg in suffixes:
        for index, part in enumerate(PARTS[1:]):
            names.append(f"{part}{leg}")
            parents.append(len(names) - 2 if index else 0)
            joints[f"{part}_{leg}"] = names[-1]
    roles = find_roles(tuple(names), tuple(parents), joints)
    assert [leg.side for leg in roles.legs] == [1, -1, 1, -1, 0, 0]
    assert [leg.name for leg in roles.legs[:2]] == ["fore_left", "fore_right"]


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"pelvis": "Hips"}, "wanted pelvis and for each leg"),
        ({"pelvis": "Hips", "hip_l": "LeftUpLeg", "knee_l": "LeftLeg"}, "wanted pelvis and"),
        ({"pelvis": "Hips", "hip_l": "a", "knee_l": "b", "ankle_l": "c", "paw_l": "d"}, "paw_l"),
        ({"pelvis": "Hips", "hip_l": "Thigh", "knee_l": "LeftLeg", "ankle_l": "LeftFoot"},
         r"no joints named \['Thigh'\]; there are .*LeftUpLeg"),
    ],
)  # fmt: skip
def test_the_error_for_a_wrong_joint_map_says_what_is_wanted(tmp_path, joints, message):
    (tmp_path / "a.bvh").write_text(BVH)
    with pytest.raises(ValueError, match=message):
        load_clip(tmp_path / "a.bvh", joints=joints)


def test_partners_are_the_joints_of_the_other_side():
    names = (
        "lfemur", "rfemur", "lowerback", "root", "LeftLeg", "RightLeg", "Foot_L", "Foot_R",
             "LThumb", "RThumb", "left_hip", "right_hip", "head", "rig:l_hand", "rig:r_hand",
    )  # fmt: skip
    assert partners(names) == (1, 0, 2, 3, 5, 4, 7, 6, 9, 8, 11, 10, 12, 14, 13)


@pytest.mark.slow
def test_forward_kinematics_agrees_with_that_in_jax_and_is_inverted(tmp_path):
    (tmp_path / "a.bvh").write_text(BVH)
    recording = read_bvh(tmp_path / "a.bvh")
    positions_ws, rotations_ws = world_from_local(
        recording.parents, recording.positions_ls, recording.rotations_ls
    )
    clip = load_clip(tmp_path / "a.bvh", scale=1.0)
    world = forward_kinematics(
        clip.skeleton, jnp.asarray(recording.rotations_ls), jnp.asarray(recording.positions_ls)
    )
    assert np.abs(world.pos - positions_ws).max() < 1e-12
    assert np.abs(quat.angle(world.rot, jnp.asarray(rotations_ws))).max() < 1e-7
    assert np.array_equal(clip.positions_ws, positions_ws)
    back_pos, back_rot = local_from_world(recording.parents, positions_ws, rotations_ws)
    assert np.abs(back_pos - recording.positions_ls).max() < 1e-12
    assert np.abs(np.abs(np.sum(back_rot * recording.rotations_ls, axis=-1)) - 1).max() < 1e-14


def test_the_knee_axis_is_found_from_motion_or_for_a_stiff_knee_from_geometry():
    rng = np.random.default_rng(3)
    left = np.array([1.0, 0.0, 0.0])
    bend = np.linspace(0.3, 1.2, 40)
    for flexion in (bend, np.full(40, 0.6)):
        for skew in Rotation.random(5, rng):
            thigh = Rotation.from_rotvec(rng.normal(size=(40, 3)) * 0.3)
            shin = thigh * Rotation.from_rotvec(flexion[:, None] * left)
            hip = np.zeros((40, 3))
            knee = thigh.apply([0.0, -0.4, 0.0])
            ankle = knee + shin.apply([0.0, -0.4, 0.0])
            hip_rot, knee_rot, ankle_rot = (
                rot.as_quat(scalar_first=True) for rot in (thigh, shin * skew, shin)
            )
            left_ws = thigh.apply(left)
            leg = LegMotion(hip, knee, ankle, ankle, hip_rot, knee_rot, ankle_rot, left_ws)
            axis = knee_axis(leg)
            assert np.allclose(axis, skew.inv().apply(-left), atol=1e-6)


def test_the_rig_measured_from_a_synthetic_walk_is_the_true_one(walk):
    rig = walk.rig
    assert np.allclose(rig.knee_axis_ls, [[-1, 0, 0], [-1, 0, 0]], atol=1e-9)
    assert np.allclose(rig.ankle_from_foot, [[1, 0, 0, 0]] * 2, atol=1e-9)
    assert np.allclose(rig.thigh, 0.5) and np.allclose(rig.shin, 0.48)
    assert np.allclose(rig.foot, np.hypot(0.1, 0.05))
    assert rig.side.tolist() == [1, -1] and rig.names == ("left", "right")
    assert rig.thigh.dtype == np.float64


def test_a_positive_rotation_about_the_knee_axis_opens_the_knee(walk):
    pose, rig = walk.leg_pose_ws(), walk.rig
    opened = quat.multiply(pose.knee.rot, quat.from_axis_angle(rig.knee_axis_ls, jnp.array(0.1)))
    moved = pose.knee.pos + quat.rotate(
        opened, quat.unrotate(pose.knee.rot, pose.ankle.pos - pose.knee.pos)
    )
    reach = jnp.linalg.norm(moved - pose.hip.pos, axis=-1)
    before = jnp.linalg.norm(pose.ankle.pos - pose.hip.pos, axis=-1)
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
    assert np.allclose(root.rot, [1, 0, 0, 0], atol=1e-12)


def test_the_heading_is_continuous_beyond_half_a_turn(walk):
    yaw = np.linspace(0.0, 3 * np.pi, walk.frame_count)
    spin = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    positions = np.stack(
        [spin.apply(np.array(walk.positions_ws[:, joint])) for joint in range(9)], axis=1
    )
    rotated = walk.with_motion(positions, walk.rotations_ws).world_from_model()
    assert isinstance(rotated, Transform)
    assert np.sum(rotated.rot[1:] * rotated.rot[:-1], axis=-1).min() > 0.99
    assert np.allclose(rotated.rot[:, 0], np.cos(yaw / 2), atol=1e-9)


def test_a_lying_character_keeps_its_last_heading(walk):
    positions = np.array(walk.positions_ws)
    positions[100:110, [1, 5]] = positions[100:110, [0]] + [[0, 0.1, 0], [0, -0.1, 0]]
    root = walk.with_motion(positions, walk.rotations_ws).world_from_model()
    assert np.allclose(root.rot, [1, 0, 0, 0], atol=1e-9)


def test_detected_stances_of_a_synthetic_walk_are_the_true_ones(walk):
    detected = detect_stances(walk.joints_ws(3), walk.fps)
    assert (detected == walk.stance).mean() > 0.9
    assert len(runs(detected[:, 0])) == len(runs(walk.stance[:, 0]))


def test_a_foot_hanging_still_in_the_air_does_not_stand():
    height = np.interp(np.arange(120), [0, 40, 50, 70, 80, 120], [0, 0, 0.3, 0.3, 0, 0])
    ball = np.stack([0 * height, height, 0 * height], axis=-1)[:, None]
    detected = detect_stances(ball, 60.0)[:, 0]
    assert detected[:35].all() and detected[85:].all() and not detected[42:78].any()


def test_detected_stances_agree_with_the_labels_of_the_blocks_benchmark(mocap):
    clip = load_clip(mocap / "blocks/03_03.npz")
    listed = np.genfromtxt(
        mocap / "blocks/stances_03_03.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    labels = np.zeros((clip.frame_count, 2), bool)
    for stance in listed:
        labels[stance["first_frame"] : stance["last_frame"] + 1, "lr".index(stance["side"])] = True
    assert np.array_equal(labels, clip.stance_labels())
    detected = detect_stances(clip.joints_ws(3), clip.fps)
    assert (detected == labels).mean() > 0.99  # 0.9954 when written
    assert [len(runs(detected[:, leg])) for leg in (0, 1)] == [28, 26]


def test_a_character_that_always_lies_on_its_side_faces_z(walk):
    positions = np.array(walk.positions_ws)
    positions[:, [1, 5]] = positions[:, [0]] + [[0, 0.1, 0], [0, -0.1, 0]]
    root = walk.with_motion(positions, walk.rotations_ws).world_from_model()
    assert np.array_equal(root.rot, np.tile([1.0, 0.0, 0.0, 0.0], (walk.frame_count, 1)))


def test_the_rig_of_a_clip_without_legs_raises_an_error(walk):
    with pytest.raises(ValueError, match="stair walk was loaded without legs"):
        _ = replace(walk, measured_rig=None).rig


def test_heights_over_the_sole_are_those_of_a_flat_stance_over_the_floor():
    walk = stair_walk(lambda points: np.zeros(len(points)))
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


def test_a_knee_that_hardly_moves_is_remarked(tmp_path):
    path = tmp_path / "walk.bvh"
    path.write_text(BVH)  # whose right knee turns by 5, 9 and 3 degrees
    (remark,) = [text for text in load_clip(path).remarks if "knee" in text]
    assert remark.startswith("the right knee hardly moves, so its axis is a guess")
    path.write_text(BVH.replace("0 15 0 9 0", "0 15 0 29 0"))
    assert not any("knee" in text for text in load_clip(path).remarks)


def test_a_foot_of_one_point_below_a_pelvis_on_its_side_points_along_z():
    still, upright = np.zeros((2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    left_ws = np.tile([0.0, 1.0, 0.0], (2, 1))
    leg = LegMotion(still, still, still, still, upright, upright, upright, left_ws)
    np.testing.assert_allclose(foot_axes(leg, np.ones(2, bool)), [1.0, 0.0, 0.0, 0.0], atol=1e-12)
