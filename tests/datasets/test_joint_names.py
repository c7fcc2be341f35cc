"""Names of joints: skeletons of well-known programs, ambiguous ones, and joint maps."""

from pathlib import Path

import pytest

from fitting.datasets.clips import load_clip
from fitting.datasets.clips.joint_roles import find_roles, find_trunk
from fitting.datasets.clips.joints.map_files import read_joint_map, template
from support.sample_clips import BVH

# Pelvis; hip, knee, ankle and toe of the left leg, with {} for what says left or right.
SKELETONS = {
    "Mixamo": "mixamorig:Hips mixamorig:{Left}UpLeg mixamorig:{Left}Leg mixamorig:{Left}Foot "
    "mixamorig:{Left}ToeBase",
    "Mixamo of one character": "Jane:Hips Jane:{Left}UpLeg Jane:{Left}Leg Jane:{Left}Foot "
    "Jane:{Left}ToeBase",
    "LAFAN1": "Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}Toe",
    "Unreal": "pelvis thigh_{l} calf_{l} foot_{l} ball_{l}",
    "Unity": "Hips {Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toes",
    "Unity spelled out": "Hips {Left}|Upper|Leg {Left}|Lower|Leg {Left}|Foot {Left}|Toes",
    "Rokoko": "Hips {Left}Thigh {Left}Shin {Left}Foot {Left}Toe",
    "Xsens": "Pelvis {Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toe",
    "Xsens BVH": "Hips {Left}Hip {Left}Knee {Left}Ankle {Left}Toe",
    "Bandai-Namco": "Hips UpperLeg_{L} LowerLeg_{L} Foot_{L} Toes_{L}",
    "SMPL": "Pelvis {L}_Hip {L}_Knee {L}_Ankle {L}_Foot",
    "SMPL of a file": "m_avg_Pelvis m_avg_{L}_Hip m_avg_{L}_Knee m_avg_{L}_Ankle m_avg_{L}_Foot",
    "SMPL-X": "pelvis {left}_hip {left}_knee {left}_ankle {left}_foot",
    "Biped": "Bip01|Pelvis Bip01|{L}|Thigh Bip01|{L}|Calf Bip01|{L}|Foot Bip01|{L}|Toe0",
    "Source": "ValveBiped.Bip01_Pelvis ValveBiped.Bip01_{L}_Thigh ValveBiped.Bip01_{L}_Calf "
    "ValveBiped.Bip01_{L}_Foot ValveBiped.Bip01_{L}_Toe0",
    "Rigify": "spine thigh.{L} shin.{L} foot.{L} toe.{L}",
    "Rigify, deforming": "DEF-spine DEF-thigh.{L} DEF-shin.{L} DEF-foot.{L} DEF-toe.{L}",
    "Vicon": "Pelvis {Left}Thigh {Left}Shank {Left}Foot {Left}Toe",
    "Reallusion": "CC_Base_Hip CC_Base_{L}_Thigh CC_Base_{L}_Calf CC_Base_{L}_Foot "
    "CC_Base_{L}_ToeBase",
    "Daz": "hip {l}ThighBend {l}Shin {l}Foot {l}Toe",
    "VRM": "J_Bip_C_Hips J_Bip_{L}_UpperLeg J_Bip_{L}_LowerLeg J_Bip_{L}_Foot J_Bip_{L}_ToeBase",
    "Kinect": "PELVIS HIP_{LEFT} KNEE_{LEFT} ANKLE_{LEFT} FOOT_{LEFT}",
    "ARKit": "hips_joint {left}_upLeg_joint {left}_leg_joint {left}_foot_joint "
    "{left}_toes_joint",
}  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7)


def skeleton(pattern: str) -> tuple[str, ...]:
    """Nine joints: a pelvis, a left leg and a right leg."""
    pelvis, *leg = pattern.split()
    both = [
        part.format(l=letter, L=letter.upper(), left=side, Left=side.title(), LEFT=side.upper())
        for letter, side in (("l", "left"), ("r", "right"))
        for part in leg
    ]
    return tuple(name.replace("|", " ") for name in (pelvis, *both))


@pytest.mark.parametrize("program", SKELETONS)
def test_skeletons_of_well_known_programs_are_recognised(program):
    roles = find_roles(skeleton(SKELETONS[program]), PARENTS)
    assert roles.pelvis == 0
    assert [leg.joints for leg in roles.legs] == [(1, 2, 3, 4), (5, 6, 7, 8)]
    assert [leg.side for leg in roles.legs] == [1.0, -1.0]


def test_helpers_between_and_beside_the_joints_of_a_leg_are_left_out():
    names = ["root", "pelvis", "thigh_l", "thigh_twist_01_l", "calf_l", "foot_l", "ball_l"]
    names += ["thigh_r", "calf_r", "foot_r", "ball_r", "ik_foot_root", "ik_foot_l", "ik_foot_r"]
    parents = (-1, 0, 1, 2, 2, 4, 5, 1, 7, 8, 9, 0, 11, 11)
    roles = find_roles(tuple(names), parents)
    assert [names[joint] for joint in roles.legs[0].joints] == names[2:3] + names[4:7]


def test_of_two_possible_pelves_the_one_nearer_to_the_hips_is_taken():
    names = ("CC_Base_Hip", "CC_Base_Pelvis") + skeleton(SKELETONS["Reallusion"])[1:]
    for pair in (names, ("CC_Base_Pelvis", "CC_Base_Hip", *names[2:])):
        assert find_roles(pair, (-1, 0, 1, 2, 3, 4, 1, 6, 7, 8)).pelvis == 1


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}Toe", "x {L}_Thigh {L}_Calf {L}_Foot y"),
        ("A:Hips A:{Left}UpLeg A:{Left}Leg A:{Left}Foot t", "B:Hips B:{Left}UpLeg B:{Left}Leg "
         "B:{Left}Foot t"),
        ("DEF-spine DEF-thigh.{L} DEF-shin.{L} DEF-foot.{L} t",
         "my-spine my-thigh.{L} my-shin.{L} my-foot.{L} t"),
    ],
)  # fmt: skip
def test_two_possible_pairs_of_legs_are_refused_with_their_names(first, second):
    names = skeleton(first) + skeleton(second.replace("x ", "Pelvis ", 1))
    parents = PARENTS + (0, *(parent + 9 for parent in PARENTS[1:]))
    with pytest.raises(ValueError, match=r"the legs may be any of these: .*--joints") as error:
        find_roles(names, parents)
    assert repr(names[1]) in str(error.value) and repr(names[10]) in str(error.value)


def test_a_mechanism_is_not_taken_for_the_skeleton():
    names = skeleton(SKELETONS["Rigify, deforming"])
    names += tuple(name.replace("DEF", "ORG") for name in names)
    parents = PARENTS + (0, *(parent + 9 for parent in PARENTS[1:]))
    assert find_roles(names, parents).legs[0].joints == (1, 2, 3, 4)


@pytest.mark.parametrize(
    "words", ["Bip01_Pelvis Bip01_Spine Bip01_Neck Bip01_Head", "DEF-spine DEF-spine.001 x y"]
)
def test_the_trunk_is_found_behind_a_prefix(words):
    trunk = find_trunk(tuple(words.split()), (-1, 0, 1, 2), 0)
    assert trunk.spine == 1 and trunk.head == (3 if "Head" in words else None)


def test_a_bone_in_two_parts_is_as_long_as_both(tmp_path):
    path = tmp_path / "twisted.bvh"
    whole = "    JOINT LeftLeg\n    {\n      OFFSET 0 -42 0\n"
    twist = "    JOINT LeftTwist\n    {\n    OFFSET 0 -40 0\n    CHANNELS 0\n" + whole.replace(
        "-42", "-2"
    )
    text = BVH.replace(whole, twist).replace("  JOINT RightUpLeg", "  }\n  JOINT RightUpLeg")
    path.write_text(text)
    clip = load_clip(path)
    assert clip.scale == 0.01 and float(clip.rig.thigh[0]) == pytest.approx(0.42)


def own_names(tmp_path: Path, left: str = "Left", right: str = "Right") -> Path:
    """A clip whose joints no convention names."""
    path = tmp_path / "own.bvh"
    words = {"Hips": "Becken", "UpLeg": "Schenkel", "Leg": "Knie", "Foot": "Foot_A"}
    text = BVH.replace("Left", left).replace("Right", right)
    for english, own in words.items():
        text = text.replace(english, own)
    path.write_text(text)
    return path


def test_a_template_guesses_and_reads_back_as_a_map(tmp_path):
    path = own_names(tmp_path)
    clip = load_clip(path)
    assert clip.measured_rig is None
    assert any("jaxik inspect CLIP --joints" in remark for remark in clip.remarks)
    text = template(clip.joint_names, clip.parents, clip.source)
    assert "\n#  Becken\n#    LeftSchenkel\n#      LeftKnie\n#        LeftFoot_A" in text
    (tmp_path / "map.toml").write_text(text)
    assert read_joint_map(tmp_path / "map.toml") == {
        "pelvis": "Becken",
        **{
            f"{role}_{side}": f"{side.title()}{own}"
            for side in ("left", "right")
            for role, own in (("hip", "Schenkel"), ("knee", "Knie"), ("ankle", "Foot_A"))
        },
    } | {"toe_left": "", "toe_right": ""}
    assert load_clip(path, joints=tmp_path / "map.toml").rig.names == ("left", "right")


def test_what_a_template_cannot_guess_is_to_be_filled_in(tmp_path):
    path = own_names(tmp_path, "Nah", "Fern")
    clip = load_clip(path)
    text = template(clip.joint_names, clip.parents, clip.source)
    (tmp_path / "map.toml").write_text(text)
    assert 'pelvis = "Becken"' in text and 'knee_right = ""' in text
    with pytest.raises(ValueError, match="own.bvh: hip_left is empty; wanted the name of a joint"):
        load_clip(path, joints=tmp_path / "map.toml")
    for side, own in (("left", "Nah"), ("right", "Fern")):
        for role, part in (("hip", "Schenkel"), ("knee", "Knie"), ("ankle", "Foot_A")):
            text = text.replace(f'{role}_{side} = ""', f'{role}_{side} = "{own}{part}"')
    (tmp_path / "map.toml").write_text(text)
    named = load_clip(path, joints=tmp_path / "map.toml")
    assert named.rig.names == ("left", "right") and named.scale == 0.01


def test_the_template_of_a_recognised_skeleton_needs_no_change(tmp_path):
    (tmp_path / "walk.bvh").write_text(BVH)
    clip = load_clip(tmp_path / "walk.bvh")
    (tmp_path / "map.toml").write_text(template(clip.joint_names, clip.parents, clip.source))
    named = load_clip(tmp_path / "walk.bvh", joints=tmp_path / "map.toml")
    assert named.rig.joints == clip.rig.joints and named.rig.pelvis == clip.rig.pelvis


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pelvis = ", "not TOML"),
        ("pelvis = 3", "pelvis is 3; wanted the name of a joint"),
        ("[hip_left]\nx = 1", "hip_left is {'x': 1}; wanted the name of a joint"),
        ("pelwis = 'Hips'", "'pelwis' is no role; wanted pelvis, and hip_NAME"),
        ("hip_l = 'LeftUpLeg'", "there is no pelvis"),
    ],
)
def test_a_map_that_is_wrong_costs_one_line(text, message, tmp_path):
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"map\.toml: {message}"):
        read_joint_map(path)


def test_one_joint_in_two_roles_is_refused():
    joints = {"pelvis": "Hips", "hip_l": "a", "knee_l": "a", "ankle_l": "b"}
    with pytest.raises(ValueError, match="the joint a is both hip_l and knee_l"):
        find_roles(("Hips", "a", "b"), (-1, 0, 1), joints)
