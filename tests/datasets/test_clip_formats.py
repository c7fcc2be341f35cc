"""The table of clip formats: what a new reader must do, and what it gets for it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fitting.datasets.clips import formats, load_clip
from fitting.datasets.clips.recording import Recording

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


@pytest.fixture
def points_file(tmp_path):
    """A character that stands for ten frames, in centimetres."""
    line = " ".join(map(str, STANDING_CM.ravel()))
    (tmp_path / "standing.points").write_text("\n".join([" ".join(NAMES), *[line] * 10]))
    return tmp_path / "standing.points"


def test_a_reader_in_the_table_makes_its_suffix_a_clip_format(points_file, monkeypatch):
    suffixes = ", ".join(formats.READERS)
    with pytest.raises(ValueError, match=f"wanted a {suffixes} or .npz file"):
        load_clip(points_file)
    monkeypatch.setattr(formats, "READERS", {**formats.READERS, ".points": read_points})
    clip = load_clip(points_file, scale=0.01)
    np.testing.assert_allclose(clip.positions_ws, np.tile(STANDING_CM / 100, (10, 1, 1)))
    assert (clip.fps, clip.up_axis, clip.dialect) == (60.0, "y", "jaxik")
    assert clip.rig.names == ("left", "right") and clip.stance_labels().all()
    with pytest.raises(ValueError, match=f"wanted a {suffixes}, .points or .npz file"):
        load_clip(points_file.with_suffix(".fbx"))


@pytest.mark.parametrize(("stated", "up"), [("y", "y"), ("z", "z"), (None, "y")])
def test_an_up_axis_that_the_file_states_is_not_guessed(points_file, monkeypatch, stated, up):
    recording = dataclasses.replace(read_points(points_file), up_axis=stated)
    monkeypatch.setattr(formats, "READERS", {".points": lambda path: recording})
    assert load_clip(points_file, scale=0.01).up_axis == up
    assert load_clip(points_file, scale=0.01, up="y").up_axis == "y"
    with pytest.raises(ValueError, match="up_axis is 'x'; wanted 'y', 'z' or None"):
        dataclasses.replace(recording, up_axis="x")
