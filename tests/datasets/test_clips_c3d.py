"""C3D files: joints from markers that were put on bodies whose joints are known."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.cli import main
from fitting.clips import load_clip
from fitting.clips.formats.c3d_file import read_markers
from fitting.clips.formats.markers import chord, guess_map, hip_centres
from fitting.clips.summary import as_text, describe
from support.c3d_files import DEC, INTEL, MEASURES, MIPS, plug_in_gait, write_bytes, write_c3d
from support.experiments import ROOT
from support.sample_clips import flat_floor, stair_walk

pytest.importorskip("ezc3d", reason="it writes the files, so that they are not read as we think")


TOLERANCE = 1e-5  # m: the file has 32 bits


@pytest.fixture(scope="module")
def body():
    return stair_walk(flat_floor, strides=2)


@pytest.fixture(scope="module")
def places(body):
    return plug_in_gait(body)


@pytest.fixture(scope="module")
def walk(places, tmp_path_factory):
    return write_c3d(tmp_path_factory.mktemp("c3d") / "walk.c3d", places, measures=MEASURES)


def errors(clip, body) -> np.ndarray:
    """How far the joints of the legs are from the body's, m, (frames, joints)."""
    mine, theirs = (
        c.positions_ws[:, [c.joint_names.index(name) for name in body.joint_names[1:]]]
        for c in (clip, body)
    )
    return np.linalg.norm(mine - theirs, axis=-1)


@pytest.mark.parametrize("unseen", [(), ("LHEE", "RHEE", "LPSI", "RPSI"), ("RHEE",)])
def test_joint_centres_and_rotations_are_those_of_the_body(places, body, tmp_path, unseen):
    seen = {name: np.full_like(p, np.nan) if name in unseen else p for name, p in places.items()}
    seen["SACR"] = (places["LPSI"] + places["RPSI"]) / 2
    clip = load_clip(write_c3d(tmp_path / "walk.c3d", seen, measures=MEASURES))
    assert errors(clip, body).max() < TOLERANCE
    assert (clip.fps, clip.up_axis, clip.scale, clip.mask) == (60.0, "z", 0.001, None)
    heels = " and ".join(name for name in unseen if name.endswith("HEE"))
    assert [r.partition(",")[0] for r in clip.remarks] == [f"without {heels}"] * bool(heels)
    np.testing.assert_allclose(clip.rig.thigh, 0.5, atol=TOLERANCE)
    np.testing.assert_allclose(clip.rig.shin, 0.48, atol=TOLERANCE)
    np.testing.assert_allclose(clip.rig.ball_height, body.rig.ball_height, atol=1e-4)
    for name in body.joint_names:  # whose own axes differ by a constant rotation
        mine, theirs = (
            Rotation.from_quat(c.rotations_ws[:, c.joint_names.index(name)], scalar_first=True)
            for c in (clip, body)
        )
        between = mine.inv() * theirs
        assert (between[0].inv() * between).magnitude().max() < 1e-3, name


def test_hips_lie_where_the_regression_says_and_a_chord_is_at_right_angles_to_its_joint():
    """A pelvis 240 mm wide and 150 mm deep: 0.24 · 150 + 9.9 = 45.9 mm back, 0.30 · 240 + 10.9 =
    82.9 mm down, 0.33 · 240 + 7.3 = 86.5 mm to the side."""
    corners = np.array([[0.12, 0, 0], [-0.12, 0, 0], [0, 0, -0.15]])[:, None]
    expected = [[[0.0865, -0.0829, -0.0459]], [[-0.0865, -0.0829, -0.0459]]]
    np.testing.assert_allclose(hip_centres(*corners), expected, atol=1e-12)
    # Legs of 3 and 4 on a diameter of 5: the centre is 3 from the marker and 4 from the hip.
    hip, knee, wand = (np.array([p]) for p in ([0.0, 5, 0], [0.0, 0, 0], [1.0, 2, 0]))
    np.testing.assert_allclose(chord(hip, knee, wand, 3.0), [[-2.4, 1.8, 0.0]], atol=1e-12)


def test_frames_with_gaps_are_masked_and_nothing_is_measured_on_them(places, body, tmp_path):
    gaps = {name: place.copy() for name, place in places.items()}
    for name, frames in (("LTHI", slice(40, 50)), ("LASI", slice(5)), ("RTOE", slice(-3, None))):
        gaps[name][frames] = np.nan
    clip = load_clip(write_c3d(tmp_path / "gaps.c3d", gaps, measures=MEASURES))
    assert clip.mask is not None
    assert np.flatnonzero(~clip.mask).tolist() == [*range(5), *range(40, 50), *range(105, 108)]
    assert errors(clip, body)[clip.mask].max() < TOLERANCE
    assert np.isfinite(clip.positions_ws).all() and np.isfinite(clip.rotations_ws).all()
    np.testing.assert_allclose(clip.rig.shin, 0.48, atol=TOLERANCE)
    gone = {f"p{n}": place.copy() for n, place in enumerate(places.values())}
    for place in gone.values():
        place[:30] = place[-20:] = np.nan
    bare = load_clip(write_c3d(tmp_path / "gone.c3d", gone))
    assert np.flatnonzero(bare.observed).tolist() == [*range(30, 88)]
    warnings = describe(bare)["warnings"]
    assert "50 of 108 frames are masked, as no marker was seen" in warnings
    assert not [text for text in warnings if "T-pose" in text or "repeated" in text]
    text = as_text(describe(clip))
    assert "18 of 108 frames are masked" in text and "LTHI in 10, LASI in 5, RTOE in 3" in text


def test_bones_whose_length_jumps_have_swapped_markers_and_no_others(places, tmp_path):
    def remarks(places, joints=None) -> str:
        path = write_c3d(tmp_path / "bones.c3d", places, measures=MEASURES)
        return "\n".join(load_clip(path, joints=joints).remarks)

    swapped = {name: place.copy() for name, place in places.items()}
    for name, other in (("LANK", "RANK"), ("RANK", "LANK")):
        swapped[name][30:33] = places[other][30:33]
    assert "from left_knee to left_ankle the distance jumps in 2 frames" in remarks(swapped)
    # A marker on the shin is not an ankle: its distance from the toe changes with the foot.
    joints = {"pelvis": "LPSI + RPSI"}
    for side, letter in (("left", "L"), ("right", "R")):
        own = {"hip": "ASI", "knee": "KNE", "ankle": "TIB", "toe": "TOE"}
        joints |= {f"{role}_{side}": letter + ending for role, ending in own.items()}
    text = remarks(places, joints)
    assert "from left_ankle to left_toe it is" in text and "swapped" not in text


def test_units_axes_rate_and_names_are_the_files_own_or_guessed_with_a_remark(
    places, body, tmp_path
):
    named = {f"Bob:{name}": place for name, place in places.items()}
    stated = {"UNITS": "m", "X_SCREEN": "+X", "Y_SCREEN": "+Z"}
    options = {"measures": MEASURES, "rate": 120.0}
    path = write_c3d(tmp_path / "m.c3d", named, point=stated, unit=1.0, **options)
    clip = load_clip(path)
    assert errors(clip, body).max() < TOLERANCE
    assert (clip.scale, clip.fps) == (1.0, 120.0)
    downward = stated | {"Y_SCREEN": "-Z", "X_SCREEN": "-X"}
    path = write_c3d(tmp_path / "down.c3d", named, point=downward, unit=1.0, **options)
    assert any("the pelvis is not above" in remark for remark in load_clip(path).remarks)
    assert load_clip(path, up="z").up_axis == "z"
    path = write_c3d(tmp_path / "bare.c3d", places, point={})
    clip = load_clip(path)
    assert (clip.scale, clip.up_axis) == (0.001, "z")
    for remark in ("no unit is stated", "widths of the left knee and ankle"):
        assert any(remark in text for text in clip.remarks)
    assert 1e-4 < errors(clip, body).max() < 0.02
    assert load_clip(path, scale=0.002).rig.thigh[0] == pytest.approx(1.0, rel=0.05)


def test_joints_may_be_centres_in_the_file_or_means_of_markers_that_a_map_names(
    places, body, tmp_path
):
    at = {name: body.positions_ws[:, joint] for joint, name in enumerate(body.joint_names)}
    modelled = dict(places)
    for side, letter in (("left", "L"), ("right", "R")):
        for joint, ending in (("hip", "HJC"), ("knee", "KJC"), ("ankle", "AJC")):
            modelled[letter + ending] = at[f"{side}_{joint}"] + [0.0, 0.0, 0.01]
        del modelled[f"{letter}THI"], modelled[f"{letter}TIB"]
    clip = load_clip(write_c3d(tmp_path / "centres.c3d", modelled))
    off = errors(clip, body).reshape(-1, 2, 4)
    np.testing.assert_allclose(off[..., :3], 0.01, atol=TOLERANCE)
    lines = ['pelvis = "LASI + RASI + LPSI + RPSI"']
    own = {name: places[name] for name in ("LASI", "RASI", "LPSI", "RPSI")}
    for joint in body.joint_names[1:]:
        side, role = joint.split("_")
        own[f"{side} {role} in"] = at[joint] - [0.03, 0, 0]
        own[f"{side}{role}out"] = at[joint] + [0.03, 0, 0]
        lines.append(f'{role}_{side} = "{side} {role} in + {side}{role}out"')
    path, map_file = write_c3d(tmp_path / "own.c3d", own), tmp_path / "map.toml"
    map_file.write_text("\n".join(lines))
    clip = load_clip(path, joints=map_file)
    assert errors(clip, body).max() < TOLERANCE and clip.dialect == "by hand"
    bare = load_clip(path)
    assert set(own) <= set(bare.joint_names) and bare.measured_rig is None
    assert any("no set of markers recognised" in remark for remark in bare.remarks)
    lines[1] = 'hip_left = "LASI + nobody"'
    map_file.write_text("\n".join(lines))
    with pytest.raises(ValueError, match="own.c3d: hip_left .* no marker 'nobody'; there are"):
        load_clip(path, joints=map_file)
    with pytest.raises(ValueError, match="there is no pelvis; a joint map names it"):
        load_clip(path, joints={"hip_left": "LASI"})


def test_a_map_of_markers_is_drafted_by_how_their_names_begin_and_no_map_of_an_npz(walk, capsys):
    assert main.main(["inspect", str(walk), "--joints"]) == 0
    draft = capsys.readouterr().out
    assert 'pelvis = "LASI + RASI + LPSI + RPSI"' in draft and 'toe_right = "RTOE"' in draft
    assert "#LTHI" in draft
    archive = ROOT / "data" / "clips" / "uneven_walk.npz"
    assert main.main(["inspect", str(archive), "--joints"]) == main.MISTAKE
    assert "takes no joint map" in capsys.readouterr().err
    draft = guess_map(("LKNE", "LKNEM", "LANK", "LTIO"))  # of which one is a joint's centre
    assert (draft["knee_left"], draft["ankle_left"]) == ("LKNE + LKNEM", "LTIO")
    draft = guess_map(("lateral_ankle", "LKNE", "left_toe", "R.KNE", "Bob:RANK"))
    assert (draft["ankle_left"], draft["knee_left"], draft["toe_left"]) == ("", "LKNE", "left_toe")
    assert (draft["knee_right"], draft["ankle_right"]) == ("R.KNE", "Bob:RANK")


def points(frames: int = 40) -> np.ndarray:
    """Places of three markers, of which one goes out of sight and one is never seen."""
    places = np.arange(9.0 * frames).reshape(frames, 3, 3) - 50.5
    places[5:9, 0] = places[:, 2] = np.nan
    return places


@pytest.mark.parametrize("processor", [INTEL, DEC, MIPS])
@pytest.mark.parametrize("scale", [-1.0, 0.5])
def test_numbers_of_every_processor_are_read_as_floats_and_as_integers(tmp_path, processor, scale):
    stated = {"POINT": {"LABELS": ["LKNE", "RKNE", "SACR"], "UNITS": ["cm"]}}
    path = write_bytes(tmp_path / "numbers.c3d", points(), stated, processor, scale, samples=4)
    markers = read_markers(path)
    np.testing.assert_array_equal(markers.positions, points())
    assert markers.names == ("LKNE", "RKNE", "SACR") and markers.metres_per_unit == 0.01
    assert markers.frame_time == 1 / 60


@pytest.mark.parametrize(
    ("parameters", "word_3"),
    [
        ({"ANALOG": {"USED": 6}}, 6),  # without a rate
        ({"ANALOG": {"USED": 6}}, 0),
        ({"ANALOG": {"RATE": 60.0}}, 6),
        ({"ANALOG": {"USED": 6, "RATE": 240.0}}, 6),  # four times as many as there are
        ({"ANALOG": {"USED": 3, "RATE": 120.0}}, 0),
        ({"ANALOG": {"USED": 6, "RATE": 60.0, "OFFSET": 0.5}}, 6),  # no integer
        ({"": {"IS_STATIC": 1}, "ANALOG": {"USED": 6, "RATE": 60.0}}, 6),
    ],
)
def test_what_is_wrong_about_analog_values_and_groups_moves_no_marker(tmp_path, parameters, word_3):
    path = tmp_path / "analog.c3d"
    write_bytes(path, points(), parameters, samples=6, word_3=word_3)
    np.testing.assert_array_equal(read_markers(path).positions, points())


def test_what_a_model_has_computed_is_no_marker(tmp_path, capsys):
    labels = ["LKNE", "LKneeAngles", "Sum", "LKJC", "Ann:LNormalisedGRF", "Push"]
    groups = ["MODELED_MARKERS", "MARKER_UNITS", "REACTIONS", "REACTION_UNITS"]
    lists = {"SCALARS": ["Sum"], "REACTIONS": ["Push"], "MODELED_MARKERS": ["LKJC"]}
    stated = {"POINT": {"LABELS": labels, "TYPE_GROUPS": groups, **lists}}
    places = np.arange(90.0).reshape(5, 6, 3)
    path = write_bytes(tmp_path / "model.c3d", places, stated)
    markers = read_markers(path)
    assert markers.names == ("LKNE", "LKJC")
    np.testing.assert_array_equal(markers.positions, places[:, [0, 3]])
    assert any("left out: LKneeAngles, Ann:LNormalisedGRF" in r for r in load_clip(path).remarks)
    assert main.main(["inspect", str(path), "--joints"]) == 0
    assert 'knee_left = "LKJC"' in capsys.readouterr().out
    write_bytes(path, places[:, :1], {"POINT": {"LABELS": ["LHipMoment"]}})
    with pytest.raises(ValueError, match="no markers, only 1 angles, forces and the like"):
        load_clip(path)


def test_files_without_motion_are_refused_in_one_line(walk, places, tmp_path):
    path = tmp_path / "odd.c3d"
    content = walk.read_bytes()
    for damaged, message in (
        (b"", "0 bytes that begin with nothing; wanted a C3D file"),
        (content[:700], "wanted a C3D file"),
        (content[:4000], "the file has 4000"),
        (content.replace(struct.pack("<f", 60.0), bytes(4)), "POINT:RATE is 0 Hz; wanted"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=message):
            load_clip(path)
    write_bytes(path, points(), {"ANALOG": {"USED": 7, "RATE": 60.0}}, samples=6, word_3=5)
    with pytest.raises(ValueError, match="5 analog values a frame in the header, and 7 by ANALOG"):
        load_clip(path)
    rare = {name: place.copy() for name, place in places.items()}
    for seen, name in enumerate(("LKNE", "RANK", "LTOE")):  # in so many frames
        rare[name][seen:] = np.nan
    message = "the 16 markers that are needed; least often seen are LKNE, RANK, LTOE$"
    with pytest.raises(ValueError, match=f"no frame has all of {message}"):
        load_clip(write_c3d(tmp_path / "rare.c3d", rare))
    two = {f"{who}:{name}": place for who in ("Ann", "Bob") for name, place in places.items()}
    with pytest.raises(ValueError, match=r"2 subjects wear .*\['Ann', 'Bob'\]"):
        load_clip(write_c3d(tmp_path / "two.c3d", two))
