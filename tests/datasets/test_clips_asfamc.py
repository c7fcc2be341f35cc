"""ASF and AMC files: rotation order, axes, limits over several lines, and malformed files."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import load_clip
from fitting.datasets.clips.formats.asfamc import read_asfamc
from support.sample_clips import AMC, ASF


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


def test_crlf_radians_and_a_missing_last_newline_change_nothing(pair):
    plain = read_asfamc(*pair())
    crlf = read_asfamc(*pair(ASF.replace("\n", "\r\n"), AMC.replace("\n", "\r\n").rstrip()))
    assert np.array_equal(plain.rotations_ls, crlf.rotations_ls)
    radians = AMC.replace(":DEGREES", ":RADIANS")
    for degrees in ("10 20 30", "5 6 7", "5 6 8", "40", "50"):
        words = " ".join(str(np.radians(float(word))) for word in degrees.split())
        radians = radians.replace(f" {degrees}\n", f" {words}\n")
    assert np.allclose(plain.rotations_ls, read_asfamc(*pair(amc=radians)).rotations_ls)


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
        ("dof rx ry rz", "dof rx ry l", "a.asf:18: wanted degrees of freedom"),
        ("axis 10 20 30 XYZ", "axis 10 20 30 XXZ", "a.asf:17: wanted an axis order"),
        ("name ltibia", "name lfemur", "a.asf:30: wanted a bone name that is not taken"),
        ("root lfemur", "root rfemur", "a.asf:39: no bone named rfemur; there are"),
        ("    lfemur ltibia\n", "", "bones not connected to the root in :hierarchy: ['ltibia'"),
        ("  begin\n    id 1", "    id 1", "a.asf:12: wanted begin"),
        ("lfemur 5 6 7", "lfemur 5 6", "a_01.amc:6: wanted 3 finite numbers of lfemur"),
        ("lfemur 5 6 7", "lfemur 5 6 7x", "a_01.amc:6: wanted 3 numbers of lfemur"),
        ("lfemur 5 6 7", "lfemur 5 6 nan", "lfemur has numbers that are not finite in frame 1"),
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
