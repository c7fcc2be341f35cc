"""BVH files with the variations found in circulation, and malformed ones."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import load_clip
from fitting.datasets.clips.formats.bvh import read_bvh
from support.sample_clips import BVH


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


@pytest.mark.parametrize(
    ("frame_time", "rate"),
    [(".0083333", 120), ("0.008333", 120), ("0.0333333", 30), ("0.0417083750417", 24),
     ("0.04", 25), ("0.01666667", 60), ("0.1", 10)],
)  # fmt: skip
def test_the_rate_is_rounded_to_a_common_one_and_the_frame_time_is_kept(
    write_bvh, frame_time, rate
):
    clip = load_clip(write_bvh(BVH.replace("0.0083333", frame_time)))
    assert clip.fps == pytest.approx(rate)
    assert clip.raw_frame_time == float(frame_time)
    assert load_clip(write_bvh(BVH), fps=48.0).fps == 48.0
    assert any("not a usual" in remark for remark in clip.remarks) == (rate == 10)


def test_each_joint_has_its_own_rotation_order(write_bvh):
    recording = read_bvh(write_bvh(BVH.replace("0 -20 0 40 0 0", "1 2 3 4 5 6")))
    for name, order, angles in (("LeftUpLeg", "ZXY", [1, 2, 3]), ("LeftLeg", "XYZ", [4, 5, 6])):
        expected = Rotation.from_euler(order, angles, degrees=True).as_quat(scalar_first=True)
        rotation = recording.rotations_ls[0, recording.names.index(name)]
        assert abs(rotation @ expected) == pytest.approx(1, abs=1e-14)


def test_rotations_may_be_listed_before_positions(write_bvh):
    channels = "Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    swapped = "Zrotation Xrotation Yrotation Xposition Yposition Zposition"
    text = BVH.replace("0 87 2 0 0 9 ", "0 0 9 0 87 2 ").replace("0 87 1 0 0 5 ", "0 0 5 0 87 1 ")
    text = text.replace("0 87 0 0 0 0 ", "0 0 0 0 87 0 ").replace(channels, swapped)
    assert same(read_bvh(write_bvh(BVH)), read_bvh(write_bvh(text)))


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


def test_only_the_listed_components_of_a_position_are_replaced(write_bvh):
    text = BVH.replace("CHANNELS 6 Xposition Yposition Zposition", "CHANNELS 4 Zposition")
    for z in range(3):
        text = text.replace(f"0 87 {z} ", f"{z} ")
    assert np.allclose(read_bvh(write_bvh(text)).positions_ls[:, 0], [[0, 90, z] for z in range(3)])


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


def test_feet_of_zero_length_point_where_the_pelvis_does(write_bvh):
    clip = load_clip(write_bvh(BVH.replace("OFFSET 0 -5 12", "OFFSET 0 0 0")))
    assert np.allclose(clip.rig.foot, 0.0)
    assert np.isfinite(np.asarray(clip.rig.ankle_from_foot)).all()


def test_errors_name_file_and_line(write_bvh):
    for old, new, line, message in (
        ("HIERARCHY", "HIERARCHIE", 1, "wanted HIERARCHY"),
        ("Frames: 3", "Frames: 4", 51, "frame 4 of 4 declared; got 'the end of the file'"),
        ("Frames: 3", "Frames: three", 46, "whole number"),
        ("Frame Time: 0.0083333", "Frame Time: 0", 47, "above 0 s"),
        ("Frame Time: 0.0083333", "Rate: 120", 47, "Frame Time"),
        ("0 87 1 0 0 5", "0 87 1 0 0", 49, "wanted 24 numbers of frame 2, there are 23"),
        ("0 87 1 0 0 5", "0 87 1 0 0 5,0", 49, "could not convert.*5,0"),
        ("0 87 1 0 0 5", "0 87 1 0 0 nan", 49, "finite"),
        ("OFFSET 10 0 0", "OFFSET 10 0", 8, "wanted 3 numbers of OFFSET"),
        ("CHANNELS 3 Zrot", "CHANNELS 4 Zrot", 9, "a count and as many"),
        ("JOINT LeftLeg", "JONT LeftLeg", 10, "in LeftUpLeg.*JONT LeftLeg"),
        ("JOINT LeftLeg", "JOINT Hips", 10, "not taken yet"),
        ("ROOT Hips\n", "JOINT Hips\n", 2, "wanted one ROOT"),
        ("ROOT Hips\n{", "ROOT Hips\n", 4, "wanted {"),
        ("}\nMOTION", "MOTION", 44, "in Hips"),
    ):
        assert old in BVH
        with pytest.raises(ValueError, match=rf"clip\.bvh:{line}: .*{message}"):
            load_clip(write_bvh(BVH.replace(old, new, 1)))


def test_files_that_are_not_motion_are_refused(write_bvh, tmp_path):
    for content in (bytes(range(256)), b""):
        with pytest.raises(ValueError, match=r"clip\.bvh:1: wanted HIERARCHY"):
            load_clip(write_bvh(content))
    with pytest.raises(ValueError, match="no such file"):
        load_clip(tmp_path / "none.bvh")


def test_frames_too_many_and_bodies_without_size_or_upright_pelvis_get_a_remark(write_bvh):
    clip = load_clip(write_bvh(BVH.replace("Frames: 3", "Frames: 2")))
    assert clip.frame_count == 2
    assert any("2 frames are declared and 3 found" in remark for remark in clip.remarks)
    head = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n}\n"
    clip = load_clip(write_bvh(head + "MOTION\nFrames: 1\nFrame Time: 0.01\n0 0 0\n"))
    assert clip.scale == 1.0 and any("no bone has a length" in note for note in clip.remarks)
    lying = re.sub(r"\n0 87 (\d) 0 0 \d", r"\n0 87 \1 90 0 0", BVH)  # along x
    clip = load_clip(write_bvh(lying))
    assert any("not above the feet" in remark for remark in clip.remarks)


def test_what_no_body_or_argument_can_be_is_refused_but_bounds_give_way_to_arguments(write_bvh):
    for old, new, arguments, message in (
        ("0 87 1 0 0 5", "0 1e308 1 0 0 5", {},
         r"Hips is at \(0, 1e\+308, 1\) in frame 1; wanted at most 1e\+12 units of the file"),
        ("0 87 1 0 0 5", "0 1e9 1 0 0 5", {},
         r"Hips is at .* in frame 1; wanted at most 1e\+06 m, at 0.01 m per unit"),
        ("Frame Time: 0.0083333", "Frame Time: 1e21", {},
         r"1e-21 frames per second; wanted 0.001 to 100000; give fps="),
        ("", "", {"scale": 10.0}, "left thigh is 420 m long; wanted at most 100; give another "),
        ("", "", {"scale": -1.0}, "scale is -1"),
        ("", "", {"fps": 0.0}, "fps is 0"),
        ("", "", {"up": "x"}, "wanted 'y'"),
        ("", "", {"variant": "base"}, "variant 'base'"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            load_clip(write_bvh(BVH.replace(old, new, 1)), **arguments)  # pyright: ignore[reportArgumentType]
    far = write_bvh(BVH.replace("0 87 1 0 0 5", "0 1e9 1 0 0 5", 1))
    assert load_clip(far, scale=1e-4).positions_ws.max() == pytest.approx(1e5, rel=1e-3)
    slow = write_bvh(BVH.replace("Frame Time: 0.0083333", "Frame Time: 1e21", 1))
    assert load_clip(slow, fps=30.0).fps == 30.0


def test_a_leg_without_a_thigh_is_none_and_says_so(write_bvh):
    clip = load_clip(write_bvh(BVH.replace("OFFSET 0 -42 0", "OFFSET 0 0 0", 1)))
    assert clip.measured_rig is None
    assert any("the left thigh has no length" in remark for remark in clip.remarks)
    with pytest.raises(ValueError, match="without legs"):
        _ = clip.rig
