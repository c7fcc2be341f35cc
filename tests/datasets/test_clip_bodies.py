"""Clips: joints by name, measured rigs, contact labels, roots, edits and summaries."""

import json
import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.clips import edit, load_clip, rigs, save_clip
from fitting.clips.clip import local_from_world, world_from_local
from fitting.clips.contacts import amplitude, detect_stances, runs
from fitting.clips.formats.bvh import read_bvh
from fitting.clips.joint_maps import (
    Trunk,
    find_roles,
    find_trunk,
    read_joint_map,
    template,
)
from fitting.clips.load import ClipOptions, draft_joint_map
from fitting.clips.rigs import LegMotion
from fitting.clips.summary import as_json, as_text, describe
from fitting.motion.flat_animation import load_flat_animation
from jaxik.world.skeleton import Transform, forward_kinematics
from support.bodies import without_t_pose
from support.sample_clips import BVH, flat_floor, stair_walk

# A prefix; then pelvis, hip, knee, ankle and toe, with {} for what says left or right.
SKELETONS = {
    "ASF": ("", "root {l}femur {l}tibia {l}foot {l}toes"),
    "Poser": ("", "hip {l}Thigh {l}Shin {l}Foot {l}Toe"),
    "Mixamo": ("mixamorig:", "Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}ToeBase"),
    "Mixamo of one character": ("Jane:", "Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}ToeBase"),
    "Biovision": ("", "Hips {Left}UpLeg {Left}LowLeg {Left}Foot {Left}Toe"),
    "LAFAN1": ("", "Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}Toe"),
    "Unreal": ("", "pelvis thigh_{l} calf_{l} foot_{l} ball_{l}"),
    "Unity": ("", "Hips {Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toes"),
    "Unity spelled out": ("", "Hips {Left}|Upper|Leg {Left}|Lower|Leg {Left}|Foot {Left}|Toes"),
    "Rokoko": ("", "Hips {Left}Thigh {Left}Shin {Left}Foot {Left}Toe"),
    "Xsens": ("", "Pelvis {Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toe"),
    "Xsens BVH": ("", "Hips {Left}Hip {Left}Knee {Left}Ankle {Left}Toe"),
    "MakeHuman": ("", "root upperleg01.{L} lowerleg01.{L} foot.{L} toe1-1.{L}"),
    "MakeHuman, 1.0": ("", "root UpLeg.{L} LoLeg.{L} Foot.{L} Toe.{L}"),
    "MakeHuman, LowLeg": ("", "Hips UpLeg_{L} LowLeg_{L} Foot_{L} Toe_{L}"),
    "MakeHuman, game engine": ("", "pelvis thigh_{l} calf_{l} foot_{l} ball_{l}"),
    "Bandai-Namco": ("", "Hips UpperLeg_{L} LowerLeg_{L} Foot_{L} Toes_{L}"),
    "SMPL": ("", "Pelvis {L}_Hip {L}_Knee {L}_Ankle {L}_Foot"),
    "SMPL of a file": ("m_avg_", "Pelvis {L}_Hip {L}_Knee {L}_Ankle {L}_Foot"),
    "SMPL-X": ("", "pelvis {left}_hip {left}_knee {left}_ankle {left}_foot"),
    "Biped": ("Bip01|", "Pelvis {L}|Thigh {L}|Calf {L}|Foot {L}|Toe0"),
    "Source": ("ValveBiped.Bip01_", "Pelvis {L}_Thigh {L}_Calf {L}_Foot {L}_Toe0"),
    "Rigify": ("", "spine thigh.{L} shin.{L} foot.{L} toe.{L}"),
    "Rigify, deforming": ("DEF-", "spine thigh.{L} shin.{L} foot.{L} toe.{L}"),
    "Vicon": ("", "Pelvis {Left}Thigh {Left}Shank {Left}Foot {Left}Toe"),
    "Reallusion": ("CC_Base_", "Hip {L}_Thigh {L}_Calf {L}_Foot {L}_ToeBase"),
    "Daz": ("", "hip {l}ThighBend {l}Shin {l}Foot {l}Toe"),
    "VRM": ("J_Bip_", "C_Hips {L}_UpperLeg {L}_LowerLeg {L}_Foot {L}_ToeBase"),
    "Kinect": ("", "PELVIS HIP_{LEFT} KNEE_{LEFT} ANKLE_{LEFT} FOOT_{LEFT}"),
    "ARKit": ("", "hips_joint {left}_upLeg_joint {left}_leg_joint {left}_foot_joint "
              "{left}_toes_joint"),
}  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7)
TWICE = PARENTS + (0, *(parent + 9 for parent in PARENTS[1:]))


def skeleton(prefix: str, pattern: str) -> tuple[str, ...]:
    """Nine joints: a pelvis, a left leg and a right leg."""
    pelvis, *leg = pattern.split()
    both = [
        part.format(l=letter, L=letter.upper(), left=side, Left=side.title(), LEFT=side.upper())
        for letter, side in (("l", "left"), ("r", "right"))
        for part in leg
    ]
    return tuple((prefix + name).replace("|", " ") for name in (pelvis, *both))


def test_skeletons_of_well_known_programs_are_recognised():
    skeletons = {program: skeleton(*words) for program, words in SKELETONS.items()}
    mixed = list(skeletons["Mixamo"])
    mixed[0], mixed[5], mixed[7] = "m:Hips", "mixamorigRightUpLeg", "mixamorig9:RightFoot"
    for program, names in (skeletons | {"mixed": tuple(mixed)}).items():
        roles = find_roles(names, PARENTS)
        assert roles.pelvis == 0, program
        assert [(leg.name, leg.side, leg.joints) for leg in roles.legs] == [
            ("left", 1.0, (1, 2, 3, 4)),
            ("right", -1.0, (5, 6, 7, 8)),
        ], program


def test_helpers_between_and_beside_the_joints_of_a_leg_and_a_mechanism_are_left_out():
    names = ["root", "pelvis", "thigh_l", "thigh_twist_01_l", "calf_l", "foot_l", "ball_l"]
    names += ["thigh_r", "calf_r", "foot_r", "ball_r", "ik_foot_root", "ik_foot_l", "ik_foot_r"]
    parents = (-1, 0, 1, 2, 2, 4, 5, 1, 7, 8, 9, 0, 11, 11)
    roles = find_roles(tuple(names), parents)
    assert [names[joint] for joint in roles.legs[0].joints] == names[2:3] + names[4:7]
    names = ["root", "spine05", "pelvis.L", "pelvis.R"]  # MakeHuman's bones are in two parts
    for side in "LR":
        names += [f"{bone}.{side}" for bone in ("upperleg01", "upperleg02", "lowerleg01")]
        names += [f"{bone}.{side}" for bone in ("lowerleg02", "foot", "toe1-1", "toe2-1")]
    parents = (-1, 0, 0, 0, 2, 4, 5, 6, 7, 8, 8, 3, 11, 12, 13, 14, 15, 15)
    roles = find_roles(tuple(names), parents)
    assert (roles.pelvis, roles.legs[1].joints) == (0, (11, 13, 15, 16))
    names = skeleton(*SKELETONS["Rigify, deforming"])
    mechanism = tuple(name.replace("DEF", "ORG") for name in names)
    assert find_roles(names + mechanism, TWICE).legs[0].joints == (1, 2, 3, 4)
    legs = skeleton(*SKELETONS["Reallusion"])[1:]  # of two pelves the nearer to the hips counts
    for pelves in (("CC_Base_Hip", "CC_Base_Pelvis"), ("CC_Base_Pelvis", "CC_Base_Hip")):
        assert find_roles(pelves + legs, (-1, 0, 1, 2, 3, 4, 1, 6, 7, 8)).pelvis == 1


def test_no_pair_of_legs_or_two_possible_ones_are_refused_with_the_names_of_joints():
    upper_legs = "Hips {Left}UpLeg {Left}Leg {Left}Foot t"
    thighs = "spine thigh.{L} shin.{L} foot.{L} t"
    for first, second in (
        (("", upper_legs), ("", "Pelvis {L}_Thigh {L}_Calf {L}_Foot y")),
        (("A:", upper_legs), ("B:", upper_legs)),
        (("DEF-", thighs), ("my-", thighs)),
    ):
        names = skeleton(*first) + skeleton(*second)
        with pytest.raises(ValueError, match="the legs may be any of these: .*--joints") as error:
            find_roles(names, TWICE)
        assert repr(names[1]) in str(error.value) and repr(names[10]) in str(error.value)
    with pytest.raises(ValueError, match=r"no pair of legs.*\['Hips', 'Tail'\].*MotionBuilder"):
        find_roles(("Hips", "Tail"), (-1, 0))


def test_the_trunk_is_the_way_from_the_pelvis_to_the_head():
    for names, parents, trunk in (
        ("Hips LowerBack Spine Neck Head", (-1, 0, 1, 2, 3), Trunk(1, 4, (1, 2, 3))),
        ("hip abdomen chest neck head", (-1, 0, 1, 2, 3), Trunk(1, 4, (1, 2, 3))),
        ("Root Pelvis mixamorig:Spine mixamorig:Head", (-1, 0, 1, 2), Trunk(2, 3, (2,))),
        ("Root Pelvis Waist Head", (-1, 0, 0, 2), Trunk(2, 3, (2,))),  # legs and spine side by side
        ("pelvis spine_01 neck_01", (-1, 0, 1), Trunk(1, None, (1,))),
        ("Hips Head", (-1, 0), Trunk(None, 1)),
        ("pelvis left_hip", (-1, 0), Trunk(None, None)),
        ("Bip01_Pelvis Bip01_Spine Bip01_Neck Bip01_Head", (-1, 0, 1, 2), Trunk(1, 3, (1, 2))),
        ("DEF-spine DEF-spine.001 x y", (-1, 0, 1, 2), Trunk(1, None, (1,))),
    ):
        assert find_trunk(tuple(names.split()), parents, int(names.startswith("Root"))) == trunk


def test_any_number_of_legs_can_be_named_and_the_end_of_a_suffix_decides_the_side():
    sides = {"fl": 1, "fr": -1, "fore_left": 1, "fore_right": -1, "left": 1, "r": -1}
    sides |= {"tail": 1, "weft": 0, "light": 0}
    names, parents, joints = ["body"], [-1], {"pelvis": "body"}
    for leg in sides:
        for part in ("hip", "knee", "ankle", "toe"):
            joints[f"{part}_{leg}"] = f"{part}{leg}"
            parents.append(0 if part == "hip" else len(names) - 1)
            names.append(f"{part}{leg}")
    legs = find_roles(tuple(names), tuple(parents), joints).legs
    assert [leg.side for leg in legs] == list(sides.values())
    assert [leg.name for leg in legs[2:6]] == ["fore_left", "fore_right", "left", "right"]
    assert legs[2].joints == (9, 10, 11, 12)


def test_the_error_for_a_wrong_joint_map_says_what_is_wanted(tmp_path):
    path, map_file, pelvis = tmp_path / "a.bvh", tmp_path / "map.toml", {"pelvis": "Hips"}
    path.write_text(BVH)
    for joints, message in (
        (pelvis, "wanted pelvis and for each leg"),
        (pelvis | {"hip_l": "LeftUpLeg", "knee_l": "LeftLeg"}, "wanted pelvis and"),
        (pelvis | {"hip_l": "a", "knee_l": "b", "ankle_l": "c", "paw_l": "d"}, "paw_l"),
        (pelvis | {"hip_l": "Thigh", "knee_l": "LeftLeg", "ankle_l": "LeftFoot"},
         r"no joints named \['Thigh'\]; there are .*LeftUpLeg"),
        (pelvis | {"hip_l": "LeftLeg", "knee_l": "LeftLeg", "ankle_l": "LeftFoot"},
         "the joint LeftLeg is both hip_l and knee_l"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            load_clip(path, joints=joints)
    for text, message in (
        ("pelvis = ", "not TOML"),
        ("pelvis = 3", "pelvis is 3; wanted the name of a joint"),
        ("[hip_left]\nx = 1", "hip_left is {'x': 1}; wanted the name of a joint"),
        ("pelwis = 'Hips'", "'pelwis' is not a role; wanted pelvis, and hip_NAME"),
        ("hip_l = 'LeftUpLeg'", "there is no pelvis"),
    ):
        map_file.write_text(text)
        with pytest.raises(ValueError, match=rf"map\.toml: {message}"):
            read_joint_map(map_file)


def test_a_bone_in_two_parts_is_as_long_as_both(tmp_path):
    whole = "    JOINT LeftLeg\n    {\n      OFFSET 0 -42 0\n"
    twist = "    JOINT LeftTwist\n    {\n    OFFSET 0 -40 0\n    CHANNELS 0\n"
    text = BVH.replace(whole, twist + whole.replace("-42", "-2"))
    path = tmp_path / "twisted.bvh"
    path.write_text(text.replace("  JOINT RightUpLeg", "  }\n  JOINT RightUpLeg"))
    clip = load_clip(path)
    assert clip.scale == 0.01 and float(clip.rig.thigh[0]) == pytest.approx(0.42)


def test_a_foot_that_ends_at_its_ankle_gets_the_ball_of_a_persons_and_a_remark(tmp_path):
    path, map_file = tmp_path / "leaf.bvh", tmp_path / "map.toml"
    text = re.sub(r"\s*End Site\s*{[^}]*}", "", BVH).partition("0 87 0")[0]
    path.write_text(text + 3 * ("0 82 0 0 0 30 " + 18 * "0 " + "\n"))  # it faces 30° to the left
    clip = load_clip(path)
    map_file.write_text(draft_joint_map(path, ClipOptions()))
    assert "_end" not in map_file.read_text() and "no map is needed" in map_file.read_text()
    assert len(clip.joint_names) == 9 and (clip.channels or ())[7:] == ("", "")
    ahead = 0.15 * 0.82 * np.array([0.5 * 0.9539, -0.3, 0.8660 * 0.9539])
    for loaded in (clip, load_clip(path, joints=map_file)):
        for leg, side in enumerate(("Left", "Right")):
            ankle, ball = loaded.rig.joints[leg][2:]
            assert loaded.joint_names[ball] == f"{side}Foot_end"
            foot = loaded.positions_ws[:, ball] - loaded.positions_ws[:, ankle]
            np.testing.assert_allclose(foot, np.tile(ahead, (3, 1)), atol=1e-4)
            remark = f"the {side.lower()} foot ends at {side}Foot; its ball is taken to be 0.123 m"
            assert any(remark in text for text in loaded.remarks)
    save_clip(tmp_path / "again.bvh", clip)  # in which the ends are there
    assert load_clip(tmp_path / "again.bvh").joint_names[4] == "LeftFoot_end"


OWN = {"hip": "Schenkel", "knee": "Knie", "ankle": "Foot_A"}


def own_names(folder: Path, left: str = "Left", right: str = "Right") -> Path:
    """A clip whose joints no convention names."""
    text = BVH.replace("Left", left).replace("Right", right).replace("Hips", "Becken")
    for english, own in zip(("UpLeg", "Leg", "Foot"), OWN.values(), strict=True):
        text = text.replace(english, own)
    (folder / "own.bvh").write_text(text)
    return folder / "own.bvh"


def write_template(clip, path: Path) -> str:
    text = template(clip.joint_names, clip.parents, clip.source)
    path.write_text(text)
    return text


def test_a_template_guesses_and_reads_back_as_a_map(tmp_path):
    path, map_file = own_names(tmp_path), tmp_path / "map.toml"
    clip = load_clip(path)
    assert clip.measured_rig is None
    assert any("jaxik inspect CLIP --joints" in remark for remark in clip.remarks)
    text = write_template(clip, map_file)
    assert "\n#  Becken\n#    LeftSchenkel\n#      LeftKnie\n#        LeftFoot_A" in text
    expected = {"pelvis": "Becken", "toe_left": "", "toe_right": ""}
    for side in ("left", "right"):
        expected |= {f"{role}_{side}": side.title() + own for role, own in OWN.items()}
    assert read_joint_map(map_file) == expected
    assert load_clip(path, joints=map_file).rig.names == ("left", "right")
    path.write_text(BVH)  # a recognised skeleton, whose template needs no change
    clip = load_clip(path)
    write_template(clip, map_file)
    named = load_clip(path, joints=map_file)
    assert named.rig.joints == clip.rig.joints and named.rig.pelvis == clip.rig.pelvis


def test_what_a_template_cannot_guess_is_to_be_filled_in(tmp_path):
    path, map_file = own_names(tmp_path, "Nah", "Fern"), tmp_path / "map.toml"
    text = write_template(load_clip(path), map_file)
    assert 'pelvis = "Becken"' in text and 'knee_right = ""' in text
    with pytest.raises(ValueError, match="own.bvh: hip_left is empty; wanted the name of a joint"):
        load_clip(path, joints=map_file)
    for side, name in (("left", "Nah"), ("right", "Fern")):
        for role, own in OWN.items():
            text = text.replace(f'{role}_{side} = ""', f'{role}_{side} = "{name}{own}"')
    map_file.write_text(text)
    named = load_clip(path, joints=map_file)
    assert named.rig.names == ("left", "right") and named.scale == 0.01


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


def test_axes_of_knees_pelvis_and_feet_are_found_from_motion_or_else_from_geometry():
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
            assert np.allclose(rigs.knee_axis(leg), skew.inv().apply(-left), atol=1e-6)
    # Left is where left hips are, or the x axis of a pelvis with legs on one side.
    turned = Rotation.from_euler("y", [[0.0], [90.0]], degrees=True).as_quat(scalar_first=True)
    hips_ws = np.array([[[0.0, 1.0, 0.2], [0.0, 1.0, -0.2]]] * 2)
    both = rigs.left_directions(hips_ws, np.array([1.0, -1.0]), turned)
    np.testing.assert_allclose(both, [[0, 0, 1], [0, 0, 1]], atol=1e-12)
    alone = rigs.left_directions(hips_ws, np.array([1.0, 1.0]), turned)
    np.testing.assert_allclose(alone, [[1, 0, 0], [0, 0, -1]], atol=1e-12)
    # A foot of one point below a pelvis on its side points along z.
    still, upright = np.zeros((2, 3)), np.tile(UPRIGHT, (2, 1))
    left_ws = np.tile([0.0, 1.0, 0.0], (2, 1))
    leg = LegMotion(still, still, still, still, upright, upright, upright, left_ws)
    np.testing.assert_allclose(rigs.foot_axes(leg, np.ones(2, bool)), UPRIGHT, atol=1e-12)


def test_a_rig_is_measured_or_a_remark_says_that_a_knee_hardly_moves(walk, tmp_path):
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
    path = tmp_path / "walk.bvh"
    path.write_text(BVH)  # whose right knee turns by 5, 9 and 3 degrees
    (remark,) = [text for text in load_clip(path).remarks if "knee" in text]
    assert remark.startswith("the right knee hardly moves, so its axis is a guess")
    path.write_text(BVH.replace("0 15 0 9 0", "0 15 0 29 0"))
    assert not any("knee" in text for text in load_clip(path).remarks)


def test_heights_over_the_sole_are_those_of_a_flat_stance_or_else_those_of_feet_so_long(walk):
    floor_walk = stair_walk(flat_floor)
    assert np.allclose(floor_walk.rig.ankle_height, 0.05, atol=1e-12)
    assert np.allclose(floor_walk.rig.ball_height, 0.0, atol=1e-12) and not floor_walk.remarks
    higher, rotations = floor_walk.positions_ws + [0.0, 0.3, 0.0], floor_walk.rotations_ws
    raised = rigs.measure_soles(floor_walk.rig, higher, rotations, floor_walk.stance_labels(), 0.3)
    assert raised.measured.all() and np.allclose(raised.ankle, 0.05, atol=1e-12)
    middle = np.median(walk.joints_ws(3)[walk.stance][:, 1])
    unlabelled = replace(walk, stance=np.zeros_like(walk.stance))
    # On stairs, without a stance, and far over the floor.
    for clip, floor in ((walk, 0.0), (walk, middle), (unlabelled, 0.0), (floor_walk, -0.3)):
        moved = clip.positions_ws, clip.rotations_ws, clip.stance_labels()
        soles = rigs.measure_soles(clip.rig, *moved, floor)
        assert not soles.measured.any()
        assert np.allclose(soles.ball, 0.45 * np.hypot(0.1, 0.05))
        assert np.allclose(soles.ankle - soles.ball, 0.05)
    assert len([remark for remark in walk.remarks if "never stands flat" in remark]) == 2
    with pytest.raises(ValueError, match="stair walk was loaded without legs"):
        _ = replace(walk, measured_rig=None).rig


@pytest.mark.parametrize("offset, taken", [(0.0, 0.02), (0.06, 0.45 * 0.1118), (-0.04, 0.0)])
def test_feet_off_their_floor_are_said_to_be_and_soles_can_be_given(tmp_path, offset, taken):
    """The balls of these feet are 0.02 m over their soles, and 0.05 m below their ankles."""
    flat = stair_walk(lambda points: np.full(len(points), 0.02 + offset))
    path = tmp_path / "walk.bvh"
    save_clip(path, replace(flat, stance=None))
    place = "over" if offset > 0 else "in"
    for sole, height in ((None, taken), (0.02, 0.02)):
        clip = load_clip(path, sole=sole)
        assert np.allclose(clip.rig.ball_height, height, atol=1e-3)
        assert np.allclose(clip.rig.ankle_height, height + 0.05, atol=1e-3)
        said = [text for text in clip.remarks if "sole" in text]
        over = 0.02 + offset - height
        start = f"standing feet are {100 * abs(over):.1f} cm {place} the floor at height 0 m in all"
        assert len(said) == (offset != 0.0) and all(text.startswith(start) for text in said), said
        assert all(f"Then give --floor {over:.3f}" in text for text in said)
    laid = load_flat_animation(path, offset)
    assert np.allclose(laid.rig.ball_height, 0.02, atol=1e-3)
    assert not any("sole" in text for text in laid.remarks)
    for sole in (-0.01, np.nan):
        with pytest.raises(ValueError, match=f"sole is {sole}; wanted a number of metres"):
            load_clip(path, sole=sole)


def test_a_foot_is_flat_where_its_heel_is_low_and_not_where_it_is_still_on_its_toes():
    heel = np.concatenate([np.full(20, 0.04), np.linspace(0.04, 0.1, 10), np.full(20, 0.1)])
    ankle_height = np.tile(np.append(heel, 0.2), 4)
    ankle_height[-51:-1] = 0.1  # a whole stance on toes
    still = np.zeros(len(ankle_height))
    ankle = np.stack([still, ankle_height, still], axis=-1)
    ankle[:, 0] += 1e-4 * np.sin(3.0 * np.arange(len(ankle))) * (ankle_height < 0.05)
    toe = ankle * [1.0, 0.0, 1.0] + [0.0, 0.0, 0.12]
    flat = rigs.flat_frames(ankle, toe, ankle_height < 0.15)
    assert flat.sum() >= 15 and np.array_equal(np.unique(ankle_height[flat]), [0.04])
    two = slice(-102, None)  # stances, of which neither is the rule
    flat = rigs.flat_frames(ankle[two], toe[two], ankle_height[two] < 0.15)
    assert np.array_equal(np.unique(ankle_height[two][flat]), [0.04, 0.1])


def test_the_model_root_is_below_the_pelvis_and_faces_forward_whatever_the_pelvis_does(walk):
    root = walk.world_from_model(floor=0.25)
    assert np.allclose(root.pos[:, 1], 0.25)
    assert np.allclose(root.pos[:, [0, 2]], walk.positions_ws[:, 0][:, [0, 2]])
    assert np.allclose(root.rot, UPRIGHT, atol=1e-12)
    assert walk.leg_pose_ws().knee.pos.shape == (walk.frame_count, 2, 3)
    assert walk.leg_pose_ws().knee.pos.dtype == walk.rig.thigh.dtype == jnp.float64
    with jax.enable_x64(False):
        assert walk.leg_pose_ws().knee.rot.dtype == walk.rig.thigh.dtype == jnp.float32
        assert walk.world_from_model().pos.dtype == jnp.float32
    # Its heading is continuous, and kept while the character lies on its side.
    yaw = np.linspace(0.0, 3 * np.pi, walk.frame_count)  # beyond half a turn
    spin = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    positions = [spin.apply(np.array(walk.positions_ws[:, joint])) for joint in range(9)]
    rotated = walk.with_motion(np.stack(positions, axis=1), walk.rotations_ws).world_from_model()
    assert isinstance(rotated, Transform)
    assert np.sum(rotated.rot[1:] * rotated.rot[:-1], axis=-1).min() > 0.99
    assert np.allclose(rotated.rot[:, 0], np.cos(yaw / 2), atol=1e-9)
    for frames in (slice(100, 110), slice(None)):  # from the start on it faces z
        positions = np.array(walk.positions_ws)
        positions[frames, [1, 5]] = positions[frames, [0]] + [[0, 0.1, 0], [0, -0.1, 0]]
        root = walk.with_motion(positions, walk.rotations_ws).world_from_model()
        assert np.allclose(root.rot, UPRIGHT, atol=1e-9), frames


def test_detected_stances_of_a_synthetic_walk_are_the_true_ones(walk):
    detected = detect_stances(walk.joints_ws(3), walk.fps)
    assert (detected == walk.stance).mean() > 0.9
    assert len(runs(detected[:, 0])) == len(runs(walk.stance[:, 0]))
    # A foot that hangs still in the air does not stand.
    height = np.interp(np.arange(120), [0, 40, 50, 70, 80, 120], [0, 0, 0.3, 0.3, 0, 0])
    ball = np.stack([0 * height, height, 0 * height], axis=-1)[:, None]
    detected = detect_stances(ball, 60.0)[:, 0]
    assert detected[:35].all() and detected[85:].all() and not detected[42:78].any()


@pytest.mark.parametrize("noise", [0.005, 0.01, 0.02])  # m
def test_noise_of_captured_feet_neither_hides_stances_nor_splits_them(walk, noise):
    balls_ws = walk.joints_ws(3)
    noisy_ws = balls_ws + noise * np.random.default_rng(1).standard_normal(balls_ws.shape)
    assert amplitude(noisy_ws) == pytest.approx(noise, rel=0.1) and amplitude(balls_ws) < 1e-4
    detected, true = (detect_stances(balls, walk.fps) for balls in (noisy_ws, balls_ws))
    assert (detected == true).mean() > 0.9
    assert [len(runs(each[:, 0])) for each in (detected, true)] == [len(runs(true[:, 0]))] * 2
    assert amplitude(balls_ws[:4]) == 0.0  # of a clip too short to show it


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


@pytest.fixture(scope="module")
def flat_walk():
    return stair_walk(flat_floor)


@pytest.mark.parametrize("factor", [1e-9, 0.6, 1.4, 2.0])
def test_feet_under_a_root_that_goes_too_far_or_not_at_all_stand_and_can_be_put_right(
    flat_walk, tmp_path, factor
):
    """A factor of 1e-9 is a cycle in place."""
    path = tmp_path / "walk.bvh"
    save_clip(path, replace(edit.at_speed(flat_walk, factor), stance=None))
    pelvis_ws = flat_walk.positions_ws[:, flat_walk.rig.pelvis]
    walked = np.linalg.norm(pelvis_ws[-1] - pelvis_ws[0])
    speed = abs(factor - 1.0) * walked / flat_walk.seconds
    true = detect_stances(flat_walk.joints_ws(3), flat_walk.fps)
    in_place = factor < 0.1
    direction = "forward" if factor > 1.0 else "back"
    slide = f"standing feet slide {direction} by {100 * speed:.0f} cm/s (sure: "
    in_words = f"in place: standing feet move back at {speed:.2f} m/s (sure: "
    for travel, moved in ((None, in_place), ("auto", in_place), ("stances", True), ("none", False)):
        clip = load_clip(path, travel=travel)
        assert (clip.stance_labels() == true).mean() > 0.98, travel
        (remark,) = [text for text in clip.remarks if "standing feet" in text]
        assert remark.startswith(in_words if in_place else slide), remark
        assert ("give --travel stances" in remark) == (not moved), remark
        root_ws = clip.positions_ws[:, clip.rig.pelvis]
        distance = np.linalg.norm(root_ws[-1] - root_ws[0])
        assert distance == pytest.approx(walked * (1.0 if moved else factor), abs=0.02), travel


def test_travel_is_one_of_three_words_and_needs_feet_that_stand(flat_walk, tmp_path):
    path = tmp_path / "walk.bvh"
    save_clip(path, flat_walk.select(slice(0, 2)))
    with pytest.raises(ValueError, match="travel is 'walk'; wanted one of auto, stances, none"):
        load_clip(path, travel="walk")
    assert any(text.startswith("no foot ever stands, neither") for text in load_clip(path).remarks)
    with pytest.raises(ValueError, match="no foot ever stands, from which travel could follow"):
        load_clip(path, travel="stances")


def test_resampling_keeps_duration_bones_and_frames_and_trimming_both_ends(walk):
    for fps in (120.0, 50.0, 30.0, 24.0, 144.0):
        other = edit.resample(walk, fps)
        assert other.fps == fps and 0 <= walk.seconds - other.seconds < 1 / fps
        for role, length in enumerate((walk.rig.thigh, walk.rig.shin)):
            bones = other.joints_ws(role + 1) - other.joints_ws(role)
            assert np.allclose(np.linalg.norm(bones, axis=-1), length, atol=1e-12), fps
        time = np.arange(other.frame_count) * walk.fps / fps
        for axis in range(3):
            expected = np.interp(time, np.arange(walk.frame_count), walk.positions_ws[:, 4, axis])
            assert np.abs(other.positions_ws[:, 4, axis] - expected).max() < 2e-3, fps
    half = edit.resample(walk, 30.0)
    assert np.allclose(half.positions_ws, walk.positions_ws[::2], atol=1e-12)
    assert np.array_equal(half.stance_labels(), walk.stance_labels()[::2])
    assert edit.resample(walk, walk.fps) is walk
    with pytest.raises(ValueError, match="fps is 0"):
        edit.resample(walk, 0.0)
    fine = edit.resample(replace(walk, mask=np.arange(walk.frame_count) != 7), 120.0)
    assert np.flatnonzero(fine.mask == 0).tolist() == [13, 14, 15]  # all that come from frame 7
    # Trimming keeps both ends.
    cut = edit.trim(walk, 0.5, 1.0)
    assert cut.frame_count == 31
    assert np.array_equal(cut.positions_ws, walk.positions_ws[30:61])
    assert np.array_equal(cut.stance_labels(), walk.stance_labels()[30:61])
    assert edit.trim(walk).frame_count == walk.frame_count
    for start, end in ((-0.1, 1.0), (1.0, 0.5), (0.0, 99.0)):
        with pytest.raises(ValueError, match="wanted 0 <= start <= end <="):
            edit.trim(walk, start, end)


def test_a_faster_root_carries_the_same_poses_and_contacts_further(walk):
    fast = edit.at_speed(walk, 1.5)
    pelvis, before = (clip.positions_ws[:, [clip.rig.pelvis]] for clip in (fast, walk))
    further = (before - before[0]) * [1.5, 1.0, 1.5]
    np.testing.assert_allclose(pelvis - pelvis[0], further, atol=1e-12)
    poses = walk.positions_ws - before
    np.testing.assert_allclose(fast.positions_ws - pelvis, poses, atol=1e-12)
    assert np.array_equal(fast.stance_labels(), walk.stance_labels())
    for factor in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=r"wanted a finite number above 0"):
            edit.at_speed(walk, factor)


@pytest.mark.parametrize("ramp", [0, 4])
def test_a_t_pose_its_ramp_and_repeated_last_frames_are_dropped(tmp_path, walk, ramp):
    """The small BVH with 40 frames of motion, after a T-pose and a ramp."""
    phase = np.arange(40)[:, None] / 9
    still = 87 * np.eye(24)[1]
    hip, knee = np.eye(24)[[7, 9]]
    motion = still + hip * (5 * np.sin(phase) - 30) + knee * (60 + 5 * np.cos(phase))
    part = np.linspace(0.0, 1.0, ramp + 2)[:-1, None]
    frames = [*(still + part * (motion[0] - still)), *motion, motion[-1], motion[-1]]
    text = "\n".join(" ".join(map(str, frame)) for frame in frames)
    head = f"{BVH.split('Frames:')[0]}Frames: {len(frames)}\nFrame Time: 0.0083333\n"
    (tmp_path / "t.bvh").write_text(head + text)
    clip = load_clip(tmp_path / "t.bvh")
    assert edit.motion_span(clip) == (1 + ramp, ramp + 40)
    assert edit.motion_span(without_t_pose(clip)) == (0, 39)
    warnings = describe(clip)["warnings"]
    assert f"starts with a T-pose; the motion begins at frame {1 + ramp}" in warnings
    assert "the last frame is repeated 2 times" in warnings
    bare = np.zeros_like(walk.rotations_ws)  # as of markers, in which no T-pose shows
    bare[..., 0] = 1.0
    jump = np.eye(walk.frame_count)[0][:, None, None] * np.eye(3)[0] * np.arange(9.0)[:, None]
    jumping = walk.with_motion(walk.positions_ws + jump, bare)
    for other in (walk, walk.select(np.zeros(5, int)), jumping):
        assert edit.motion_span(other) == (0, other.frame_count - 1)


def test_a_marker_that_jumps_is_masked(walk):
    positions = np.array(walk.positions_ws)
    positions[50, 7] += [0.0, 0.3, 0.0]
    jumping = edit.mask_marker_jumps(walk.with_motion(positions, walk.rotations_ws))
    assert np.flatnonzero(edit.marker_jumps(jumping)).tolist() == [49, 50, 51]
    assert np.flatnonzero(jumping.mask == 0).tolist() == [49, 50, 51]
    assert not edit.marker_jumps(walk).any()
    again = edit.mask_marker_jumps(replace(walk, mask=jumping.mask))
    assert again.mask is not None and (again.mask == jumping.mask).all()
    assert any("markers jump in 3 frames" in warning for warning in describe(jumping)["warnings"])


def test_the_mirror_image_of_a_body_is_measured_as_the_mirror_image_of_its_rig(mocap):
    clip = load_clip(mocap / "clips/cmu_asfamc/02_03.amc")
    flip, turn = np.array([-1.0, 1.0, 1.0]), np.array([1.0, 1.0, -1.0, -1.0])
    roles = find_roles(clip.joint_names, clip.parents)
    other = replace(roles, legs=tuple(replace(leg, side=-leg.side) for leg in roles.legs))
    stances = detect_stances(clip.joints_ws(3), clip.fps)
    rig = rigs.measure_rig(other, clip.positions_ws * flip, clip.rotations_ws * turn, stances)
    for name, sign in (("knee_axis_ls", turn[1:]), ("thigh", 1), ("shin", 1), ("foot", 1)):
        assert np.allclose(getattr(rig, name), sign * getattr(clip.rig, name), atol=1e-6)
    gap = np.sum(np.asarray(rig.ankle_from_foot * clip.rig.ankle_from_foot) * turn, axis=-1)
    assert np.abs(gap).min() > 1 - 1e-9


def test_marker_pops_and_t_poses_of_the_reference_files(mocap):
    jumps = edit.marker_jumps(load_clip(mocap / "blocks/03_03.npz"))
    assert jumps.sum() == 52  # as facts.json counts them
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
