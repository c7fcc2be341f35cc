"""Files of clips: BVH, ASF with AMC, NumPy archives, the table of formats, and reference files."""

import hashlib
import json
import re
from dataclasses import fields, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.clips import Clip, formats, guesses, load_clip, save_clip
from fitting.clips.clip import INCH, Y_UP_FROM_Z_UP, Recording
from fitting.clips.edit import mask_marker_jumps
from fitting.clips.formats.asfamc import read_asfamc
from fitting.clips.formats.bvh import read_bvh
from fitting.clips.formats.npz import holds_base, read_base
from fitting.clips.load import ClipOptions
from fitting.motion.flat_animation import load_flat_animation
from fitting.synthetic import multi_limb, walker
from support.sample_clips import AMC, AMC_FILES, ASF, BVH, BVH_FILES, stair_walk

# The table of formats

NAMES = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
         "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
STANDING_CM = np.array([
    [0, 95, 0], [9, 90, 0], [9, 50, 2], [9, 9, 0], [9, 5, 12],
    [-9, 90, 0], [-9, 50, 2], [-9, 9, 0], [-9, 5, 12],
])  # fmt: skip


def read_points(path: Path) -> Recording:
    """Reads joint positions, one frame per line, below a line of joint names."""
    header, *lines = path.read_text().splitlines()
    names = tuple(header.split())
    points = np.array([line.split() for line in lines], float).reshape(len(lines), -1, 3)
    if points.shape[1] != len(names):
        raise ValueError(f"{path}:2: wanted {len(names)} points; got {points.shape[1]}")
    from_root = np.concatenate([points[:, :1], points[:, 1:] - points[:, :1]], axis=1)
    return Recording(
        names=names,
        parents=(-1, *[0] * (len(names) - 1)),
        offsets_ls=from_root[0],
        positions_ls=from_root,
        rotations_ls=np.tile([1.0, 0.0, 0.0, 0.0], (len(points), len(names), 1)),
        frame_time=1 / 60,
    )


def test_a_reader_in_the_table_makes_its_suffix_a_clip_format(tmp_path, monkeypatch):
    file, line = tmp_path / "standing.points", " ".join(map(str, STANDING_CM.ravel()))
    file.write_text("\n".join([" ".join(NAMES), *[line] * 10]))
    suffixes = ", ".join(formats.READERS)
    with pytest.raises(ValueError, match=f"wanted a {suffixes} or .npz file"):
        load_clip(file)
    monkeypatch.setattr(formats, "READERS", {**formats.READERS, ".points": read_points})
    clip = load_clip(file, scale=0.01)
    np.testing.assert_allclose(clip.positions_ws, np.tile(STANDING_CM / 100, (10, 1, 1)))
    assert (clip.fps, clip.up_axis, clip.dialect) == (60.0, "y", "jaxik")
    assert clip.rig.names == ("left", "right") and clip.stance_labels().all()
    with pytest.raises(ValueError, match=f"wanted a {suffixes}, .points or .npz file"):
        load_clip(file.with_suffix(".fbx"))
    for stated, up in (("y", "y"), ("z", "z"), (None, "y")):  # which is not guessed then
        recording = replace(read_points(file), up_axis=stated)
        monkeypatch.setattr(formats, "READERS", {".points": lambda path, r=recording: r})
        assert load_clip(file, scale=0.01).up_axis == up, stated
        assert load_clip(file, scale=0.01, up="y").up_axis == "y", stated
    with pytest.raises(ValueError, match="up_axis is 'x'; wanted 'y', 'z' or None"):
        replace(read_points(file), up_axis="x")


# BVH


@pytest.fixture
def write_bvh(tmp_path):
    def write(text: str | bytes):
        path = tmp_path / "clip.bvh"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def same(first, second) -> bool:
    fields = ("names", "parents", "offsets_ls", "positions_ls", "rotations_ls")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in fields)


HEAD, MOTION = BVH.split("MOTION\n")


VARIATIONS = (
    BVH.replace("\n", "\r\n"),
    HEAD.replace("\n", "\r\n") + "MOTION\r\n" + MOTION,
    BVH.rstrip("\n"),
    BVH.replace("  ", "\t"),
    BVH.replace("\n", " \n").replace("0\n", "0   \n"),
    BVH.replace("End Site", "End Site "),
    BVH.replace("Frames: 3", "Frames:\t3"),
    BVH.replace("Frame Time: 0.0083333", "Frame Time:  .0083333"),
    BVH.replace("}\n", "}\n\n"),
    BVH.replace("0 87 0 0", "0 87.0 -0 -0.0"),
    "\ufeff" + BVH,
    BVH.replace("Hips\n{", "Hips {"),
    BVH.replace("rotation", "Rotation").replace("MOTION", "Motion"),
)


def test_variations_of_the_syntax_change_nothing(write_bvh):
    plain = read_bvh(write_bvh(BVH))
    for text in VARIATIONS:
        assert text != BVH and same(plain, read_bvh(write_bvh(text))), text
    recording = read_bvh(write_bvh(BVH.replace("0 87 0 0 0 0", "1e-14 87 -0 0 -1E-14 0")))
    assert recording.positions_ls[0, 0, 0] == 1e-14


def test_the_rate_is_rounded_to_a_common_one_and_the_frame_time_is_kept(write_bvh):
    for frame_time, rate in (
        (".0083333", 120), ("0.008333", 120), ("0.0333333", 30), ("0.0417083750417", 24),
        ("0.04", 25), ("0.01666667", 60), ("0.1", 10),
    ):  # fmt: skip
        clip = load_clip(write_bvh(BVH.replace("0.0083333", frame_time)))
        assert clip.fps == pytest.approx(rate) and clip.raw_frame_time == float(frame_time)
        assert any("is unusual" in remark for remark in clip.remarks) == (rate == 10)
    assert load_clip(write_bvh(BVH), fps=48.0).fps == 48.0


def test_channels_are_those_of_each_joint_in_their_order(write_bvh):
    recording = read_bvh(write_bvh(BVH.replace("0 -20 0 40 0 0", "1 2 3 4 5 6")))
    for name, order, angles in (("LeftUpLeg", "ZXY", [1, 2, 3]), ("LeftLeg", "XYZ", [4, 5, 6])):
        expected = Rotation.from_euler(order, angles, degrees=True).as_quat(scalar_first=True)
        rotation = recording.rotations_ls[0, recording.names.index(name)]
        assert abs(rotation @ expected) == pytest.approx(1, abs=1e-14)
    channels = "Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    swapped = "Zrotation Xrotation Yrotation Xposition Yposition Zposition"
    text = BVH.replace("0 87 2 0 0 9 ", "0 0 9 0 87 2 ").replace("0 87 1 0 0 5 ", "0 0 5 0 87 1 ")
    text = text.replace("0 87 0 0 0 0 ", "0 0 0 0 87 0 ").replace(channels, swapped)
    assert same(read_bvh(write_bvh(BVH)), read_bvh(write_bvh(text)))
    # Of a position only the components that are listed replace the offset's.
    text = BVH.replace("CHANNELS 6 Xposition Yposition Zposition", "CHANNELS 4 Zposition")
    for z in range(3):
        text = text.replace(f"0 87 {z} ", f"{z} ")
    assert np.allclose(read_bvh(write_bvh(text)).positions_ls[:, 0], [[0, 90, z] for z in range(3)])


def test_positions_replace_the_offset_on_any_joint(write_bvh):
    """Six channels everywhere, with the travel on a child of the root."""
    six = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    text = f"HIERARCHY\nROOT joint_Root\n{{\nOFFSET 1 2 3\n{six}\n"
    text += f"JOINT Hips\n{{\nOFFSET 7 8 9\n{six}\n"
    frame = ""
    for side, left in (("L", 10), ("R", -10)):
        for name in ("UpperLeg", "LowerLeg", "Foot", "Toes"):
            text += f"JOINT {name}_{side}\n{{\nOFFSET 99 99 99\n{six}\n"
        frame += f" {left} 0 0 0 0 0  0 -42 0 0 0 0  0 -40 0 0 0 0  0 -5 12 0 0 0"
        text += "End Site\n{\nOFFSET 0 0 0\n}\n" + "}\n" * 4
    text += "}\n}\nMOTION\nFrames: 2\nFrame Time: 0.0333333\n"
    for z in (0, 50):
        text += f"0 0 0 0 0 0  0 90 {z} 0 0 0{frame}\n"
    clip = load_clip(write_bvh(text))
    assert clip.dialect == "Bandai" and clip.scale == 0.01
    assert np.allclose(clip.positions_ws[:, clip.rig.pelvis], [[0, 0.9, 0], [0, 0.9, 0.5]])
    assert np.allclose(clip.rig.thigh, 0.42) and np.allclose(clip.rig.shin, 0.40)
    ends, toes = (
        clip.positions_ws[:, [clip.joint_names.index(f"Toes_{side}{end}") for side in "LR"]]
        for end in ("_end", "")
    )
    assert np.array_equal(ends, toes)


def with_z_up(text: str) -> str:
    """The file with (x, y, z) as (x, -z, y)."""
    text = re.sub(
        r"OFFSET (\S+) (\S+) (\S+)",
        lambda found: f"OFFSET {found[1]} {-float(found[3])} {found[2]}",
        text,
    )
    text = text.replace("Xposition Yposition Zposition", "Xposition Zposition Yposition")
    swaps = {"Zrotation": "Yrotation", "Yrotation": "Zrotation"}
    return re.sub("[YZ]rotation", lambda found: swaps[found[0]], text)


def test_z_up_files_are_rotated_to_y_up(write_bvh):
    motion = "0 87 0 0 0 0 0 -20 0 40 0 0 0 0 0 0 10 0 5 0 0 0 0 0"
    still = f"{HEAD}MOTION\nFrames: 1\nFrame Time: 0.01\n{motion}"
    upright, lying = load_clip(write_bvh(still)), load_clip(write_bvh(with_z_up(still)))
    assert (upright.up_axis, lying.up_axis) == ("y", "z")
    assert np.allclose(lying.positions_ws, upright.positions_ws, atol=1e-12)
    as_stated = load_clip(write_bvh(with_z_up(still)), up="y")
    assert np.allclose(as_stated.positions_ws[0, 0], [0, 0, 0.87])


def test_errors_name_file_and_line(write_bvh, tmp_path):
    for old, new, line, message in (
        ("HIERARCHY", "HIERARCHIE", 1, "wanted HIERARCHY"),
        (BVH, "", 1, "wanted HIERARCHY"),
        ("Frames: 3", "Frames: 4", 51, "frame 4 of 4 declared; got 'the end of the file'"),
        ("Frames: 3", "Frames: three", 46, "whole number"),
        ("Frame Time: 0.0083333", "Frame Time: 0", 47, "above 0 s"),
        ("Frame Time: 0.0083333", "Rate: 120", 47, "Frame Time"),
        ("0 87 1 0 0 5", "0 87 1 0 0", 49, "wanted 24 numbers of frame 2, there are 23"),
        ("0 87 1 0 0 5", "0 87 1 0 0 5,0", 49, "Yrotation of Hips in frame 2; got '5,0'"),
        ("0 87 1 0 0 5", "0 87 nan 0 0 5", 49, "Zposition of Hips in frame 2; got 'nan'"),
        ("OFFSET 10 0 0", "OFFSET 10 inf 0", 8, "number as y in OFFSET of LeftUpLeg; got 'inf'"),
        ("OFFSET 10 0 0", "OFFSET 10 0", 8, "wanted 3 numbers of OFFSET"),
        ("OFFSET 10 0 0", "OFFSET 10 0 0\nOFFSET 9 0 0", 9, "wanted OFFSET of LeftUpLeg once"),
        ("OFFSET 10 0 0", "", 24, "wanted OFFSET of LeftUpLeg before its end"),
        ("CHANNELS 3 Zrot", "CHANNELS 4 Zrot", 9, "a count and as many"),
        ("3 Zrotation Xr", "3 Zrotation Zr", 9, "wanted each channel once"),
        ("JOINT LeftLeg", "CHANNELS 0\nJOINT LeftLeg", 10, "wanted CHANNELS of LeftUpLeg once"),
        ("JOINT LeftLeg", "JONT LeftLeg", 10, "in LeftUpLeg.*JONT LeftLeg"),
        ("JOINT LeftLeg", "JOINT Hips", 10, "not taken yet"),
        ("ROOT Hips\n", "JOINT Hips\n", 2, "wanted one ROOT"),
        ("ROOT Hips\n{", "ROOT Hips\n", 4, "wanted {"),
        ("}\nMOTION", "MOTION", 44, "in Hips"),
    ):
        assert old in BVH
        with pytest.raises(ValueError, match=rf"clip\.bvh:{line}: .*{message}"):
            load_clip(write_bvh(BVH.replace(old, new, 1)))
    with pytest.raises(ValueError, match=r"clip\.bvh:1: wanted HIERARCHY"):
        load_clip(write_bvh(bytes(range(256))))
    with pytest.raises(ValueError, match="no such file"):
        load_clip(tmp_path / "none.bvh")


def test_what_no_body_or_argument_can_be_is_refused_but_bounds_give_way_to_arguments(write_bvh):
    for old, new, arguments, message in (
        ("0 87 1 0 0 5", "0 1e308 1 0 0 5", {},
         r"Hips is at \(0, 1e\+308, 1\) in frame 1; wanted at most 1e\+12 units of the file"),
        ("0 87 1 0 0 5", "0 1e9 1 0 0 5", {},
         r"Hips is at .* in frame 1; wanted at most 1e\+06 m, at 0.01 m per unit"),
        ("Frame Time: 0.0083333", "Frame Time: 1e21", {},
         r"1e-21 frames per second; wanted 0.001 to 100000; give fps="),
        ("", "", {"scale": 10.0}, "left thigh is 420 m long; wanted at most 100; give --s.*: 0.01"),
        ("", "", {"scale": -1.0}, "scale is -1"),
        ("", "", {"fps": 0.0}, "fps is 0"),
        ("", "", {"up": "x"}, "wanted 'y'"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            load_clip(write_bvh(BVH.replace(old, new, 1)), **arguments)  # pyright: ignore[reportArgumentType]
    far = write_bvh(BVH.replace("0 87 1 0 0 5", "0 1e9 1 0 0 5", 1))
    assert load_clip(far, scale=1e-4).positions_ws.max() == pytest.approx(1e5, rel=1e-3)
    slow = write_bvh(BVH.replace("Frame Time: 0.0083333", "Frame Time: 1e21", 1))
    assert load_clip(slow, fps=30.0).fps == 30.0


def test_frames_too_many_and_bodies_that_are_odd_get_a_remark(write_bvh):
    head = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n}\n"
    lying = re.sub(r"\n0 87 (\d) 0 0 \d", r"\n0 87 \1 90 0 0", BVH)  # along x
    no_legs = BVH.replace("Leg", "Bone")
    for text, frame_count, has_legs, remark in (
        (BVH.replace("Frames: 3", "Frames: 2"), 2, True, "2 frames are declared and 3 found"),
        (head + "MOTION\nFrames: 1\nFrame Time: 0.01\n0 0 0\n", 1, False, "no bone has a length"),
        (no_legs, 3, False, "guessed: 0.01 m per unit; doubtful, as no legs are recognised; give"),
        (no_legs, 3, False, "up axis guessed: y; doubtful, as no legs are recognised; give --up"),
        (lying, 3, True, "not above the feet"),
        (BVH, 3, True, "legs of 82 units, taken as centimetres, are 0.820 m; sure, as in no other"),
        (BVH, 3, True, "up axis guessed: y; sure, as the pelvis is 0.7"),
        (
            BVH.replace("OFFSET 0 -42 0", "OFFSET 0 -94 0"),
            3,
            True,
            "are 1.340 m; doubtful, as people's are 0.6 to 1.1 m, children's from 0.4 m; give "
            "--scale (scale=... in Python) if you know better: 0.00627 makes them an adult's, 0.84",
        ),
        (BVH.replace("OFFSET 0 -42 0", "OFFSET 0 0 0", 1), 3, False, "left thigh has no length"),
    ):
        clip = load_clip(write_bvh(text))
        assert any(remark in said for said in clip.remarks), remark
        assert clip.frame_count == frame_count and (clip.measured_rig is not None) == has_legs
        assert clip.scale == (1.0 if frame_count == 1 else 0.01)
    with pytest.raises(ValueError, match="without legs"):
        _ = clip.rig
    clip = load_clip(write_bvh(BVH.replace("OFFSET 0 -5 12", "OFFSET 0 0 0")))  # feet of no length
    assert np.allclose(clip.rig.foot, 0.0)
    assert not any("doubtful" in said for said in clip.remarks)
    assert np.isfinite(np.asarray(clip.rig.ankle_from_foot)).all()


@pytest.mark.parametrize(
    ("leg", "scale", "remark"),
    [
        (82.0, 0.01, r"centimetres, are 0.820 m; sure, as in no other usual unit are they a pers"),
        (15.0, INCH / 0.45, "ASF units, are 0.847 m; sure"),
        (41.0, INCH, r"inches, are 1.041 m; not sure, as in centimetres they are 0.410 m, a ch"),
        (50.0, INCH, r"inches, are 1.270 m; doubtful, .*: 0.01, for centimetres, makes them 0.5"),
        (21.68, INCH / 0.45, r"1.224 m; doubtful, .*: 0.0254, for inches, makes them 0.551 m, and "
         "0.0387 makes them an adult's, 0.84 m$"),
        (0.3, 1.0, r"metres, are 0.300 m; doubtful, .* better: 2.8 makes them an adult's, 0.84 m$"),
    ],
)  # fmt: skip
def test_a_guessed_unit_says_how_sure_it_is_and_what_else_it_may_be(leg, scale, remark):
    guessed, text = guesses.guess(leg)
    assert guessed == scale and re.search(f"legs of {leg:g} units, taken as .*{remark}", text)


def test_a_stated_unit_is_doubted_where_it_makes_no_person():
    assert [guesses.doubt(leg, 1.0) for leg in (0.4, 0.84, 1.1)] == ["", "", ""]
    for leg, remedy in ((84.0, "0.01, for centimetres, makes them 0.840 m"), (1.25, "0.672 makes")):
        text = guesses.doubt(leg, 1.0)
        assert text.startswith(f"the legs are {leg:g} m long by the scale that the file states; do")
        assert f"give --scale (scale=... in Python) if you know better: {remedy}" in text


# ASF and AMC


@pytest.fixture
def pair(tmp_path):
    def write(asf: str = ASF, amc: str = AMC):
        (tmp_path / "a.asf").write_text(asf)
        (tmp_path / "a_01.amc").write_text(amc)
        return tmp_path / "a_01.amc", tmp_path / "a.asf"

    return write


def test_a_bone_rotates_by_c_m_c_inverse_about_its_start(pair):
    recording = read_asfamc(*pair())
    assert recording.names == ("root", "lfemur", "ltibia", "lfoot", "lfoot_end")
    assert recording.parents == (-1, 0, 1, 2, 3)
    assert np.allclose(recording.positions_ls[:, 0], [[1, 3, 3], [1, 3, 4]])
    bones = [[0, 0, 0], [0, -7, 0], [0, -8, 0], [0, 0, 2]]
    assert np.allclose(recording.positions_ls[0, 1:], bones)
    rest = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    femur = rest * Rotation.from_euler("xyz", [5, 6, 7], degrees=True) * rest.inv()
    knee = np.array([np.cos(np.radians(20)), np.sin(np.radians(20)), 0.0])
    tibia = Rotation.from_rotvec(np.radians(40) * knee)
    for joint, expected in ((1, femur), (2, tibia)):
        cosine = recording.rotations_ls[0, joint] @ expected.as_quat(scalar_first=True)
        assert abs(cosine) > 1 - 1e-14
    assert np.allclose(recording.rotations_ls[:, 3], [1, 0, 0, 0])  # no degrees of freedom
    assert recording.metres_per_unit == pytest.approx(0.0254 / 0.45)
    # Carriage returns, radians and a missing last newline change nothing.
    crlf = read_asfamc(*pair(ASF.replace("\n", "\r\n"), AMC.replace("\n", "\r\n").rstrip()))
    assert np.array_equal(recording.rotations_ls, crlf.rotations_ls)
    for words in ("deg degrees", "degrees", "DEG"):  # the first counts
        again = read_asfamc(*pair(ASF.replace("angle deg", f"angle {words}")))
        assert np.array_equal(recording.rotations_ls, again.rotations_ls), words
    radians = AMC.replace(":DEGREES", ":RADIANS")
    for degrees in ("10 20 30", "5 6 7", "5 6 8", "40", "50"):
        words = " ".join(str(np.radians(float(word))) for word in degrees.split())
        radians = radians.replace(f" {degrees}\n", f" {words}\n")
    assert np.allclose(recording.rotations_ls, read_asfamc(*pair(amc=radians)).rotations_ls)


def test_the_skeleton_is_found_beside_the_motion_unless_it_is_named(pair, tmp_path):
    amc, asf = pair()
    one_leg = {"pelvis": "root", "hip_l": "lfemur", "knee_l": "ltibia", "ankle_l": "lfoot"}
    assert load_clip(amc, joints=one_leg).rig.names == ("left",)
    assert load_clip(amc, asf=asf).measured_rig is None  # one leg is not a pair
    asf.rename(tmp_path / "b.asf")
    assert load_clip(amc).frame_count == 2  # the only skeleton there
    (tmp_path / "c.asf").write_text(ASF)
    with pytest.raises(ValueError, match=r"wanted a_01\.asf or a\.asf .*b\.asf.*c\.asf"):
        load_clip(amc)


def test_errors_in_a_skeleton_or_motion_name_file_and_line(pair):
    for old, new, message in (
        ("direction 0 -1 0", "direction 0 -1", "a.asf:15: wanted 3 finite numbers of direction"),
        ("length 7", "length long", "a.asf:16: wanted 1 numbers of length"),
        ("length 0.45", "length 0", "a.asf:4: wanted a length unit above 0"),
        ("angle deg", "angle grad", "a.asf:5: wanted an angle out of ('deg', 'degrees', 'rad', '"),
        ("    length 7\n", "", "a.asf:21: wanted length before its end; got 'lfemur'"),
        ("length 7", "length 7\nlength 8", "a.asf:17: wanted length once in a bone"),
        ("2\nroot", "4\nroot", "a_01.amc:8: wanted frame 2 after frame 1; got '4'"),
        ("dof rx ry rz", "dof rx ry l", "a.asf:18: wanted degrees of freedom"),
        ("axis 10 20 30 XYZ", "axis 10 20 30 XXZ", "a.asf:17: wanted an axis order"),
        ("name ltibia", "name lfemur", "a.asf:30: wanted a bone name that is not taken"),
        ("root lfemur", "root rfemur", "a.asf:39: no bone named rfemur; there are"),
        ("    lfemur ltibia\n", "", "bones not connected to the root in :hierarchy: ['ltibia'"),
        ("  begin\n    id 1", "    id 1", "a.asf:12: wanted begin"),
        ("lfemur 5 6 7", "lfemur 5 6", "a_01.amc:6: wanted 3 finite numbers of lfemur"),
        ("lfemur 5 6 7", "lfemur 5 6 7x", "a_01.amc:6: wanted 3 numbers of lfemur"),
        ("lfemur 5 6 7", "lfemur 5 6 nan", "3 finite numbers of lfemur in frame 1; got '5 6 nan'"),
        ("lfemur 5 6 7\n", "", "a_01.amc:4: wanted all bones in frame 1; without ['lfemur']"),
        ("lfemur 5 6 8\n", "", "a_01.amc:8: wanted all bones in frame 2"),
        ("lfemur 5 6 7", "lfemur 5 6 7\nlfemur 5 6 7", "a_01.amc:7: wanted lfemur once"),
        ("lfemur 5 6 7", "rfemur 5 6 7", "a.asf out of ['root', 'lfemur', 'ltibia']"),
        ("1\nroot", "root", "a_01.amc:4: wanted a frame number"),
        (AMC, ":DEGREES\n", "wanted frames"),
    ):
        assert (old in ASF) != (old in AMC)
        with pytest.raises(ValueError, match=re.escape(message)):
            read_asfamc(*pair(ASF.replace(old, new, 1), AMC.replace(old, new, 1)))


# NumPy archives: saved clips, and joint positions


ROLES = ("hip", "knee", "ankle", "ball")


@pytest.fixture(scope="module")
def walk():
    return replace(mask_marker_jumps(stair_walk()), remarks=("first", "second"))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "clip.npz"


def write(path, arrays) -> None:
    """An archive of the arrays that are not None."""
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def assert_same(clip, expected):
    for field in fields(clip):
        (a, tree), (b, expected_tree) = (
            jax.tree.flatten(getattr(each, field.name)) for each in (clip, expected)
        )
        assert tree == expected_tree, field.name
        for leaf, other in zip(a, b, strict=True):
            assert type(leaf) is type(other) and np.array_equal(leaf, other), field.name
            assert np.asarray(leaf).dtype == np.asarray(other).dtype, field.name


def test_a_clip_is_loaded_as_it_was_saved_or_not_saved_at_all(walk, path, monkeypatch):
    bare = replace(walk, measured_rig=None, stance=None, mask=None, dialect=None, remarks=())
    climber = multi_limb.climb(0.5)  # on four limbs
    sliding = walker.walk(3.0, 10.0, events=[walker.Slide(0.5, 2.5)])
    for clip in (walk, bare, climber, sliding):
        save_clip(path, clip)
        assert_same(load_clip(path), clip)
    for array in (walk.positions_ws, walk.rotations_ws, walk.stance, walk.mask):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    # An older file has no heights over the sole, which are measured then.
    save_clip(path, walk)
    write(path, dict(np.load(path)) | {"rig_ankle_height": None, "rig_ball_height": None})
    assert_same(load_clip(path), walk)
    # A save that fails leaves the old file and nothing else.
    save_clip(path, walk)
    before = path.read_bytes()

    def fail(file, **content):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(ValueError, match="clip.npz: cannot be written: disk full"):
        save_clip(path, walk)
    assert list(path.parent.iterdir()) == [path] and path.read_bytes() == before


def test_archives_that_are_not_clips_are_refused(walk, path):
    save_clip(path, walk)
    content = dict(np.load(path))
    with pytest.raises(ValueError, match=r"\['fps'\] do not apply"):
        load_clip(path, fps=30.0)
    nowhere = content["positions_ws"].copy()
    nowhere[3, 2, 1] = np.nan
    for arrays, message in (
        ({"a": np.zeros(3)}, r"wanted a clip saved by save_clip.*\['a'\]"),
        (content | {"format": np.array("jaxik clip 9")}, "wanted the format"),
        (content | {"fps": None}, r"without the arrays \['fps'\]"),
        (content | {"positions_ws": nowhere}, r"has nan at \[3, 2, 1\] of \(frames, joints, 3\)"),
    ):
        write(path, arrays)
        with pytest.raises(ValueError, match=message):
            load_clip(path)
    path.write_bytes(b"not an archive")
    with pytest.raises(ValueError, match="wanted a NumPy archive"):
        load_clip(path)


def positions(walk) -> dict[str, np.ndarray]:
    """The walk as joint positions, with the same motion 10 cm lower as its flat animation."""
    arrays = {"fps": np.array(walk.fps), "stance": walk.stance, "leg_lengths": np.ones((2, 2))}
    arrays["pelvis_rot"] = walk.rotations_ws[:, 0].astype(np.float32)
    arrays["foot_rot"] = walk.rotations_ws[:, [3, 7]].astype(np.float32)
    for prefix, lower in (("", 0.0), ("base_", 0.1)):
        arrays[f"{prefix}pelvis"] = walk.positions_ws[:, 0] - [0, lower, 0]
        for role, name in enumerate(ROLES):
            arrays[prefix + name] = walk.joints_ws(role) - [0, lower, 0]
    return arrays


def test_an_archive_of_positions_has_a_captured_clip_and_a_flat_animation(walk, path):
    write(path, positions(walk))
    assert holds_base(path)
    for load, lower in ((load_clip, 0.0), (read_base, 0.1)):
        clip = load(path)
        assert np.allclose(clip.positions_ws, walk.positions_ws - [0, lower, 0], atol=1e-12)
        assert np.abs(np.sum(clip.rotations_ws * walk.rotations_ws, axis=-1)).min() > 1 - 1e-12
        assert np.array_equal(clip.stance_labels(), walk.stance_labels())
        assert np.allclose(clip.rig.knee_axis_ls, [-1, 0, 0], atol=1e-9)
    with pytest.raises(ValueError, match="clip.npz: scale is of no use: an .npz states all but"):
        load_flat_animation(path, options=ClipOptions(scale=0.01))
    for change, message in (
        ({"knee": walk.joints_ws(1)[:5]}, r"knee is \(5, 2, 3\); wanted"),
        ({"foot_rot": None}, r"without the arrays \['foot_rot'\]"),
    ):
        write(path, positions(walk) | change)
        with pytest.raises(ValueError, match=message):
            load_clip(path)
    alone = {key: a for key, a in positions(walk).items() if not key.startswith("base_")}
    write(path, alone)
    assert not holds_base(path)
    assert np.array_equal(load_flat_animation(path).positions_ws, load_clip(path).positions_ws)


def test_the_blocks_benchmark_is_loaded_unchanged(mocap):
    raw = np.load(mocap / "blocks/03_03.npz")
    for load, prefix in ((load_clip, ""), (read_base, "base_")):
        clip = load(mocap / "blocks/03_03.npz")
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


# All reference files against an independent reading of them, `facts.json`

TOLERANCE = 1e-4  # of body height, and of a rotation matrix


@pytest.fixture(scope="module")
def facts(mocap) -> list[tuple[Clip, dict]]:
    """Each clip, and what is known of it."""
    facts = json.loads((mocap / "clips/facts.json").read_text())
    assert sorted(fact["file"] for fact in facts) == sorted([*AMC_FILES, *BVH_FILES])
    paths = [mocap / "clips" / fact["file"] for fact in facts]
    for path, fact in zip(paths, facts, strict=True):
        assert hashlib.sha256(path.read_bytes()).hexdigest() == fact["sha256"]
    return list(zip(map(load_clip, paths), facts, strict=True))


def listed(fact: dict, key: str):
    """Frame, joint and expected number of each entry."""
    for frame, joints in fact.get(key, {}).items():
        for name, expected in joints.items():
            yield int(frame), name, np.array(expected)


def test_positions_and_rotations_agree_with_the_reference(facts):
    for clip, fact in facts:
        axes = Y_UP_FROM_Z_UP if fact["up_axis"] == "z" else np.eye(3)
        suffixes = {"positions": "", "bone_start_positions": "", "bone_end_positions": "_end"}
        for key, suffix in suffixes.items():
            for frame, name, expected in listed(fact, key):
                if name + suffix in clip.joint_names or not suffix:
                    joint = clip.joint_names.index(name + suffix)
                    error = clip.positions_ws[frame, joint] - clip.scale * axes @ expected
                    case = fact["file"], key, name
                    assert np.abs(error).max() <= TOLERANCE * clip.body_height, case
        for frame, name, expected in listed(fact, "world_rotations"):
            rot = clip.rotations_ws[frame, clip.joint_names.index(name)]
            matrix = Rotation.from_quat(rot, scalar_first=True).as_matrix()
            error = np.abs(matrix - axes @ expected @ axes.T).max()
            assert error < TOLERANCE, (fact["file"], name)


def test_frames_rate_scale_axis_and_legs_are_recognised_and_measured(facts):
    for clip, fact in facts:
        assert clip.frame_count == fact["n_frames"], fact["file"]
        assert clip.fps == fact.get("fps", fact.get("fps_nominal")), fact["file"]
        assert clip.raw_frame_time == pytest.approx(fact.get("frame_time", 1 / 120), rel=1e-12)
        assert clip.up_axis == fact["up_axis"], fact["file"]
        if fact["scale_to_m"] is not None:
            assert clip.scale == pytest.approx(fact["scale_to_m"]), fact["file"]
        if fact["joint_map"] is None:
            with pytest.raises(ValueError, match="no pair of legs.*Hips.*Head_end"):
                _ = clip.rig
            continue
        rig = clip.rig
        assert clip.joint_names[rig.pelvis] == fact["joint_map"]["pelvis"], fact["file"]
        for joints, letter in zip(rig.joints, "lr", strict=True):
            for joint, part in zip(joints, ("hip", "knee", "ankle", "ball"), strict=True):
                expected = fact["joint_map"][f"{part}_{letter}"]
                if expected is None:  # no toe joint: the foot's end site
                    expected = fact["joint_map"][f"tip_{letter}"].replace("/End Site", "_end")
                assert clip.joint_names[joint] == expected, fact["file"]
        for name in ("thigh", "shin", "foot") if "bone_lengths_m" in fact else ():
            expected = [fact["bone_lengths_m"][f"{name}_{letter}"] for letter in "lr"]
            assert np.allclose(getattr(rig, name), expected, atol=1e-6), fact["file"]


def test_knees_open_about_their_measured_axis_and_standing_feet_are_level_and_point_ahead(facts):
    for clip, fact in facts:
        if fact["joint_map"] is None:
            continue
        rig, p = clip.rig, clip.positions_ws
        ahead = np.cross(clip.left_ws(), [0.0, 1.0, 0.0])
        for leg, (hip, knee, ankle, _) in enumerate(rig.joints):
            rot = Rotation.from_quat(clip.rotations_ws[:, knee], scalar_first=True)
            axis_ws = rot.apply(np.array(rig.knee_axis_ls[leg]))
            flexing = np.cross(p[:, knee] - p[:, hip], p[:, ankle] - p[:, knee])
            sizes = np.linalg.norm(flexing, axis=-1)
            bent = sizes > 0.05 * np.median(sizes)
            opening = np.sum(flexing[bent] * axis_ws[bent], axis=-1) < 0
            assert opening.mean() > 0.98, fact["file"]
            if "poser" not in fact["file"]:  # whose feet slide
                foot = Rotation.from_quat(np.asarray(rig.ankle_from_foot[leg]), scalar_first=True)
                rot = Rotation.from_quat(clip.rotations_ws[:, ankle], scalar_first=True) * foot
                assert np.median(rot.apply([0.0, 1.0, 0.0])[:, 1]) > 0.8, fact["file"]
                along = np.sum(rot.apply([0.0, 0.0, 1.0]) * ahead, axis=-1)
                assert np.median(along) > 0.75, fact["file"]
        if fact["format"] == "ASF/AMC":  # hinge about x of axes rotated by 20 degrees about z
            sin, cos = np.sin(np.radians(20)), np.cos(np.radians(20))
            assert np.allclose(rig.knee_axis_ls, [[-cos, -sin, 0], [-cos, sin, 0]], atol=1e-6)


@pytest.mark.parametrize("kind", [np.float16, np.longdouble])
def test_an_archive_with_floats_of_another_width_is_read_in_64_bits(kind, tmp_path):
    clip = walker.walk(0.5, 30.0)
    save_clip(tmp_path / "a.npz", clip)
    with np.load(tmp_path / "a.npz") as archive:
        arrays = dict(archive)
    floats = {name: array for name, array in arrays.items() if array.dtype.kind == "f"}
    changed = {name: array.astype(kind) for name, array in floats.items()}
    np.savez(tmp_path / "b.npz", **(arrays | changed))
    again = load_clip(tmp_path / "b.npz")
    assert again.positions_ws.dtype == again.rotations_ws.dtype == np.float64
    tolerance = 1e-2 if kind is np.float16 else 1e-12
    np.testing.assert_allclose(again.positions_ws, clip.positions_ws, atol=tolerance)
    for name in ("thigh", "shin", "knee_axis_ls"):
        here, there = (np.asarray(getattr(rig, name)) for rig in (clip.rig, again.rig))
        np.testing.assert_allclose(there, here, atol=tolerance)
