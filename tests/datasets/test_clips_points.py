"""Places of joints without rotations: tables and arrays, and what is wrong with them."""

import numpy as np
import pytest

from fitting.clips import load_clip, save_clip
from fitting.clips.formats.points_file import SMPL
from support.sample_clips import flat_floor, stair_walk

# Where the joints of a leg are among those of SMPL.
OF_SMPL = {"pelvis": 0, **{f"{side}_{joint}": n for side, places in (
    ("left", (1, 4, 7, 10)), ("right", (2, 5, 8, 11)),
) for joint, n in zip(("hip", "knee", "ankle", "toe"), places, strict=True)}}  # fmt: skip


@pytest.fixture(scope="module")
def body():
    return stair_walk(flat_floor, strides=2)


def errors(clip, body) -> np.ndarray:
    """How far pelvis and legs are from the body's, m, (frames, joints)."""
    joints = [[c.rig.pelvis, *(j for leg in c.rig.joints for j in leg)] for c in (clip, body)]
    places = [c.positions_ws[:, own] for c, own in zip((clip, body), joints, strict=True)]
    return np.linalg.norm(places[0] - places[1], axis=-1)


def table(body, unit: float, delimiter: str, name: str) -> str:
    """The joints of a body as text, a row a frame, with columns such as `left hip X (mm)`."""
    head = [
        name.format(joint.replace("_", " "), axis) for joint in body.joint_names for axis in "XYZ"
    ]
    rows = body.positions_ws.reshape(body.frame_count, -1) / unit
    lines = [[f"{value:.6f}" for value in row] for row in rows]
    times = [f"{frame / body.fps:.6f}" for frame in range(body.frame_count)]
    lines = [["Time", *head], *([time, *line] for time, line in zip(times, lines, strict=True))]
    return "\n".join(delimiter.join(line) for line in lines) + "\n"


def test_a_table_that_was_written_comes_back_with_its_legs(body, tmp_path):
    save_clip(tmp_path / "walk.csv", body)
    clip = load_clip(tmp_path / "walk.csv")
    assert errors(clip, body).max() < 1e-6 and (clip.fps, clip.mask) == (body.fps, None)
    np.testing.assert_allclose(clip.rig.thigh, body.rig.thigh, atol=1e-6)
    axes = np.einsum("lj,lj->l", clip.rig.knee_axis_ls, [(-1.0, 0.0, 0.0)] * 2)
    np.testing.assert_allclose(axes, 1.0, atol=1e-6)  # hinges from the bends of the legs
    text = "\n".join(clip.remarks)
    assert "how feet roll is a guess" in text and "scale guessed" not in text


def test_columns_may_have_units_and_gaps(body, tmp_path):
    text = table(body, 0.001, ";", "{} {} (mm)")
    lines = text.splitlines()
    lines[5] = ";".join(["" if n == 4 else cell for n, cell in enumerate(lines[5].split(";"))])
    (tmp_path / "walk.csv").write_text("\n".join([*lines, ""]))
    clip = load_clip(tmp_path / "walk.csv")
    assert clip.scale == 0.001 and clip.mask is not None
    assert np.flatnonzero(~clip.mask).tolist() == [4]
    assert errors(clip, body)[clip.mask].max() < 1e-6


def test_markers_of_a_trc_file_become_joints(body, tmp_path):
    names, count = body.joint_names, body.frame_count
    head = ["PathFileType\t4\t(X/Y/Z)\twalk.trc", "DataRate\tNumFrames\tNumMarkers\tUnits"]
    head += [f"{body.fps:.2f}\t{count}\t{len(names)}\tmm", "Frame#\tTime\t" + "\t\t\t".join(names)]
    head += ["\t\t" + "\t".join(f"{axis}{n + 1}" for n in range(len(names)) for axis in "XYZ"), ""]
    rows = [
        "\t".join([str(n + 1), f"{n / body.fps:.4f}", *(f"{1000 * x:.4f}" for x in row.ravel())])
        for n, row in enumerate(body.positions_ws)
    ]
    (tmp_path / "walk.trc").write_text("\n".join([*head, *rows, ""]))
    clip = load_clip(tmp_path / "walk.trc")
    assert errors(clip, body).max() < 1e-6 and (clip.fps, clip.scale) == (body.fps, 0.001)
    places = body.positions_ws.reshape(count, -1)
    swapped = load_clip(tmp_path / "walk.trc", joints={
        "pelvis": "pelvis", **{f"{joint}_{side}": f"{other}_{joint}" for side, other in (
            ("left", "right"), ("right", "left"),
        ) for joint in ("hip", "knee", "ankle", "toe")},
    })  # fmt: skip
    hip = swapped.positions_ws[:, swapped.joint_names.index("left_hip")]
    other = 3 * names.index("right_hip")
    np.testing.assert_allclose(hip, places[:, other : other + 3], atol=1e-6)


def test_arrays_of_22_joints_are_those_of_smpl(body, tmp_path):
    places = np.zeros((body.frame_count, 22, 3))
    for name, place in OF_SMPL.items():
        places[:, place] = body.positions_ws[:, body.joint_names.index(name)]
    np.save(tmp_path / "walk.npy", places)
    clip = load_clip(tmp_path / "walk.npy", fps=body.fps)
    assert errors(clip, body).max() < 1e-6 and clip.joint_names[0] == "pelvis"
    text = "\n".join(load_clip(tmp_path / "walk.npy").remarks)
    assert "its 22 joints are taken for those of SMPL" in text
    assert "no frame rate is stated: taken as 30 Hz" in text
    assert len(SMPL) == len(set(SMPL)) == 24


def test_an_archive_names_its_joints_and_states_its_rate(body, tmp_path):
    names = [name.upper() for name in body.joint_names]
    np.savez(tmp_path / "a.npz", positions=body.positions_ws, names=names, fps=body.fps)
    clip = load_clip(tmp_path / "a.npz", scale=1.0)
    assert errors(clip, body).max() < 1e-6 and clip.fps == body.fps
    np.savez(tmp_path / "b.npz", positions=body.positions_ws)
    assert "named by number, from 0" in "\n".join(load_clip(tmp_path / "b.npz").remarks)
    numbers = {"pelvis": body.joint_names.index("pelvis")}
    for leg in ("left", "right"):
        for joint in ("hip", "knee", "ankle", "toe"):
            numbers[f"{joint}_{leg}"] = body.joint_names.index(f"{leg}_{joint}")
    mapped = load_clip(tmp_path / "b.npz", joints={role: str(n) for role, n in numbers.items()})
    assert errors(mapped, body).max() < 1e-6


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "", "line 1: no point in the columns ['']"),
        ("a.csv", "time,hip\n0,1\n", "line 1: no point in the columns ['time', 'hip']"),
        ("a.csv", "a_x,a_y,a_z\n1,2,3\n1,b,3\n", "line 3: 'b' is not a number"),
        ("a.csv", "a_x,a_y,a_z\n1,2,3,4\n", "line 2: 4 cells; wanted 3"),
        ("a.csv", "a_x,a_y,a_z\n", "no frames below its head"),
        ("a.trc", "bla\n", "1 lines that begin with 'bla'; wanted PathFileType"),
        ("a.trc", "PathFileType\n\n\n\n\n1\n", "line 4: no names of markers"),
        ("a.trc", "PathFileType\nUnits\nmm\nF\tT\ta\t\t\ta\n\n1\t0\t1\n", "2 points are named"),
        ("a.npy", "bla", "wanted a NumPy array"),
        ("a.npy", np.zeros((3, 4)), "holds float64 (3, 4); wanted numbers (frames, joints, 3)"),
        ("a.npz", {"positions": np.zeros((3, 4))}, "positions is (3, 4); wanted"),
    ],
)  # fmt: skip
def test_a_file_that_holds_no_points_says_what_is_wrong(name, content, message, tmp_path):
    path = tmp_path / name
    if isinstance(content, str):
        path.write_text(content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    else:
        np.save(path, content)
    with pytest.raises(ValueError) as raised:
        load_clip(path)
    assert str(path) in str(raised.value) and message in str(raised.value)
