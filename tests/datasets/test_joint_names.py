"""Names of joints: skeletons of well-known programs, ambiguous ones, and joint maps."""

from pathlib import Path

import pytest

from fitting.datasets.clips import load_clip
from fitting.datasets.clips.joint_roles import Trunk, find_roles, find_trunk, partners
from fitting.datasets.clips.joints.map_files import read_joint_map, template
from support.sample_clips import BVH

# A prefix; then pelvis, hip, knee, ankle and toe, with {} for what says left or right.
SKELETONS = {
    "ASF": ("", "root {l}femur {l}tibia {l}foot {l}toes"),
    "Poser": ("", "hip {l}Thigh {l}Shin {l}Foot {l}Toe"),
    "Mixamo": ("mixamorig:", "Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}ToeBase"),
    "Mixamo of one character": ("Jane:", "Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}ToeBase"),
    "LAFAN1": ("", "Hips {Left}UpLeg {Left}Leg {Left}Foot {Left}Toe"),
    "Unreal": ("", "pelvis thigh_{l} calf_{l} foot_{l} ball_{l}"),
    "Unity": ("", "Hips {Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toes"),
    "Unity spelled out": ("", "Hips {Left}|Upper|Leg {Left}|Lower|Leg {Left}|Foot {Left}|Toes"),
    "Rokoko": ("", "Hips {Left}Thigh {Left}Shin {Left}Foot {Left}Toe"),
    "Xsens": ("", "Pelvis {Left}UpperLeg {Left}LowerLeg {Left}Foot {Left}Toe"),
    "Xsens BVH": ("", "Hips {Left}Hip {Left}Knee {Left}Ankle {Left}Toe"),
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
    names = skeleton(*SKELETONS["Rigify, deforming"])
    mechanism = tuple(name.replace("DEF", "ORG") for name in names)
    assert find_roles(names + mechanism, TWICE).legs[0].joints == (1, 2, 3, 4)


def test_of_two_possible_pelves_the_one_nearer_to_the_hips_is_taken():
    legs = skeleton(*SKELETONS["Reallusion"])[1:]
    for pelves in (("CC_Base_Hip", "CC_Base_Pelvis"), ("CC_Base_Pelvis", "CC_Base_Hip")):
        assert find_roles(pelves + legs, (-1, 0, 1, 2, 3, 4, 1, 6, 7, 8)).pelvis == 1


def test_two_possible_pairs_of_legs_are_refused_with_their_names():
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


def test_the_error_for_a_missing_leg_lists_the_joints():
    with pytest.raises(ValueError, match=r"no pair of legs.*\['Hips', 'Tail'\].*MotionBuilder"):
        find_roles(("Hips", "Tail"), (-1, 0))
    feet = ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot")
    with pytest.raises(ValueError, match="neither toe nor end site: LeftFoot has no child"):
        find_roles(feet, (-1, 0, 1, 2, 0, 4, 5))


def test_the_trunk_is_the_way_from_the_pelvis_to_the_head():
    for names, parents, trunk in (
        ("Hips LowerBack Spine Neck Head", (-1, 0, 1, 2, 3), Trunk(1, 4)),
        ("hip abdomen chest neck head", (-1, 0, 1, 2, 3), Trunk(1, 4)),
        ("Root Pelvis mixamorig:Spine mixamorig:Head", (-1, 0, 1, 2), Trunk(2, 3)),
        ("Root Pelvis Waist Head", (-1, 0, 0, 2), Trunk(2, 3)),  # legs and spine side by side
        ("pelvis spine_01 neck_01", (-1, 0, 1), Trunk(1, None)),
        ("Hips Head", (-1, 0), Trunk(None, 1)),
        ("pelvis left_hip", (-1, 0), Trunk(None, None)),
        ("Bip01_Pelvis Bip01_Spine Bip01_Neck Bip01_Head", (-1, 0, 1, 2), Trunk(1, 3)),
        ("DEF-spine DEF-spine.001 x y", (-1, 0, 1, 2), Trunk(1, None)),
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


def test_partners_are_the_joints_of_the_other_side():
    pairs = "lfemur rfemur LeftLeg RightLeg Foot_L Foot_R LThumb RThumb left_hip right_hip "
    names = (*(pairs + "rig:l_hand rig:r_hand").split(), "lowerback", "root", "head")
    assert partners(names) == (1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 12, 13, 14)


# Joint maps


def test_the_error_for_a_wrong_joint_map_says_what_is_wanted(tmp_path):
    for joints, message in (
        ({"pelvis": "Hips"}, "wanted pelvis and for each leg"),
        ({"pelvis": "Hips", "hip_l": "LeftUpLeg", "knee_l": "LeftLeg"}, "wanted pelvis and"),
        ({"pelvis": "Hips", "hip_l": "a", "knee_l": "b", "ankle_l": "c", "paw_l": "d"}, "paw_l"),
        ({"pelvis": "Hips", "hip_l": "Thigh", "knee_l": "LeftLeg", "ankle_l": "LeftFoot"},
         r"no joints named \['Thigh'\]; there are .*LeftUpLeg"),
        ({"pelvis": "Hips", "hip_l": "LeftLeg", "knee_l": "LeftLeg", "ankle_l": "LeftFoot"},
         "the joint LeftLeg is both hip_l and knee_l"),
    ):  # fmt: skip
        (tmp_path / "a.bvh").write_text(BVH)
        with pytest.raises(ValueError, match=message):
            load_clip(tmp_path / "a.bvh", joints=joints)


def test_a_map_file_that_is_wrong_costs_one_line(tmp_path):
    for text, message in (
        ("pelvis = ", "not TOML"),
        ("pelvis = 3", "pelvis is 3; wanted the name of a joint"),
        ("[hip_left]\nx = 1", "hip_left is {'x': 1}; wanted the name of a joint"),
        ("pelwis = 'Hips'", "'pelwis' is no role; wanted pelvis, and hip_NAME"),
        ("hip_l = 'LeftUpLeg'", "there is no pelvis"),
    ):
        (tmp_path / "map.toml").write_text(text)
        with pytest.raises(ValueError, match=rf"map\.toml: {message}"):
            read_joint_map(tmp_path / "map.toml")


def test_a_bone_in_two_parts_is_as_long_as_both(tmp_path):
    whole = "    JOINT LeftLeg\n    {\n      OFFSET 0 -42 0\n"
    twist = "    JOINT LeftTwist\n    {\n    OFFSET 0 -40 0\n    CHANNELS 0\n"
    text = BVH.replace(whole, twist + whole.replace("-42", "-2"))
    path = tmp_path / "twisted.bvh"
    path.write_text(text.replace("  JOINT RightUpLeg", "  }\n  JOINT RightUpLeg"))
    clip = load_clip(path)
    assert clip.scale == 0.01 and float(clip.rig.thigh[0]) == pytest.approx(0.42)


OWN = {"hip": "Schenkel", "knee": "Knie", "ankle": "Foot_A"}


def own_names(tmp_path: Path, left: str = "Left", right: str = "Right") -> Path:
    """A clip whose joints no convention names."""
    text = BVH.replace("Left", left).replace("Right", right).replace("Hips", "Becken")
    for english, own in zip(("UpLeg", "Leg", "Foot"), OWN.values(), strict=True):
        text = text.replace(english, own)
    (tmp_path / "own.bvh").write_text(text)
    return tmp_path / "own.bvh"


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
    guessed = {
        f"{role}_{side}": side.title() + own
        for side in ("left", "right")
        for role, own in OWN.items()
    }
    toes = {"toe_left": "", "toe_right": ""}
    assert read_joint_map(map_file) == {"pelvis": "Becken", **guessed, **toes}
    assert load_clip(path, joints=map_file).rig.names == ("left", "right")


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


def test_the_template_of_a_recognised_skeleton_needs_no_change(tmp_path):
    (tmp_path / "walk.bvh").write_text(BVH)
    clip = load_clip(tmp_path / "walk.bvh")
    write_template(clip, tmp_path / "map.toml")
    named = load_clip(tmp_path / "walk.bvh", joints=tmp_path / "map.toml")
    assert named.rig.joints == clip.rig.joints and named.rig.pelvis == clip.rig.pelvis
