"""Motion at other frame rates: what is played, how it is measured, and how far systems stay."""

import dataclasses
import json

import numpy as np
import pytest

from fitting.cli import main
from fitting.cli.parser import make_parser
from fitting.datasets import clips
from fitting.datasets.synthetic import walker
from fitting.datasets.synthetic.walker import WalkStyle
from fitting.datasets.terrain import mesh_files
from fitting.experiments.systems import preset_system
from fitting.report import comparison_report
from fitting.runtime.precision import in_float64, with_floats
from fitting.studies import frame_rates
from fitting.studies.animations import Animation, AnimationFiles, load_animation
from fitting.studies.frame_rates import every_frame, measure
from support.experiments import ROOT

GROUND = ROOT / "data" / "terrains" / "terraces.ply"
CAPTURED = ROOT.parent / "shared" / "mocap" / "blocks"
SECONDS = 3.0


@pytest.fixture(scope="module")
def animation() -> Animation:
    """A walk at 120 Hz over the first terraces."""
    clip = walker.walk(SECONDS, 120.0, 6, (), WalkStyle(knees=1.0))
    return Animation(clip, mesh_files.load_terrain(GROUND))


def raised_by_frame_time(animation, ik):
    """A result that needs no pipeline: everything is raised by ten times the frame time, m."""
    clip = animation.clip
    return None, clip.with_motion(
        clip.positions_ws + [0.0, 10.0 / clip.fps, 0.0], clip.rotations_ws
    )


def test_every_fourth_frame_is_played_with_the_strides_and_speeds_of_the_clip(animation):
    played = every_frame(animation, 4)
    own, frames = animation.frames, played.frames
    assert played.clip.fps == 30.0 and len(frames.dt) == 90
    np.testing.assert_allclose(frames.dt, 1 / 30, rtol=1e-6)
    np.testing.assert_array_equal(frames.stride.fraction, own.stride.fraction[::4])
    np.testing.assert_array_equal(frames.toe_speed, own.toe_speed[::4])
    np.testing.assert_array_equal(frames.pose.ankle.pos, own.pose.ankle.pos[::4])


def test_a_restart_between_two_frames_that_are_played_is_at_the_next_one(animation):
    restart = np.isin(np.arange(animation.clip.frame_count), [5, 8])
    cut = dataclasses.replace(
        animation, given_frames=dataclasses.replace(animation.frames, restart=restart)
    )
    restart = every_frame(cut, 4).frames.restart
    assert restart is not None
    np.testing.assert_array_equal(np.flatnonzero(restart), [2])


def test_differences_are_those_at_the_frames_of_both(animation, monkeypatch):
    monkeypatch.setattr(Animation, "solve", raised_by_frame_time)
    half, quarter = measure({"still": preset_system("ozz")}, animation, [60.0, 30.0])
    assert (half.system, half.fps, quarter.fps) == ("still", 60.0, 30.0)
    for joint in frame_rates.JOINTS:
        assert half.rms[joint] == pytest.approx(10 / 60 - 10 / 120)
        assert half.largest[joint] == pytest.approx(10 / 60 - 10 / 120)
        assert quarter.rms[joint] == pytest.approx(10 / 30 - 10 / 120)


@pytest.mark.parametrize("fps", [50.0, 240.0, 119.0])
def test_a_rate_of_which_the_clips_is_no_multiple_is_refused(animation, fps):
    with pytest.raises(ValueError, match=f"{fps:g} Hz; wanted a part .*: 120, 60, 40, 30, ... Hz"):
        measure({"ozz": preset_system("ozz")}, animation, [fps])


@pytest.mark.filterwarnings("always::fitting.report.placement_report.PlacementWarning")
def test_the_command_writes_the_table(animation, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(Animation, "solve", raised_by_frame_time)
    monkeypatch.setattr(Animation, "reached", lambda *_: np.ones((360, 2)))
    clips.save_clip(tmp_path / "walk.npz", animation.clip)
    words = ["compare", tmp_path / "walk.npz", "--terrain", GROUND, "--presets", "ozz"]
    words += ["--rates", "60,30", "-o", tmp_path / "out"]
    assert main.main([str(word) for word in words]) == 0
    row = "ozz 60 Hz 83.3 83.3 83.3 83.3 83.3"
    assert row in " ".join(capsys.readouterr().out.split())
    text = (tmp_path / "out" / comparison_report.TABLE).read_text()
    assert "## At other frame rates" in text
    assert "| ozz | 60 Hz | 83.3 | 83.3 | 83.3 | 83.3 | 83.3 |" in text
    numbers = json.loads((tmp_path / "out" / comparison_report.NUMBERS).read_text())["rates"]
    assert [entry["fps"] for entry in numbers] == [60.0, 30.0]


def test_a_rate_that_is_no_number_above_0_is_refused(capsys):
    with pytest.raises(SystemExit):
        make_parser().parse_args(["compare", "c", "--rates", "60,0"])
    assert "'0'; wanted a number of Hz from 1 to 1000" in capsys.readouterr().err


@in_float64
def differences(animation: Animation, rates: list[float], *presets: str) -> dict:
    """The largest rms of any joint, mm, by preset and rate."""
    systems = {name: with_floats(preset_system(name), np.float64) for name in presets}
    rows = measure(systems, animation, rates)
    return {(row.system, row.fps): 1000 * max(row.rms.values()) for row in rows}


@pytest.mark.slow
def test_stride_hardly_depends_on_the_frame_rate(animation):
    found = differences(animation, [60.0], "stride")
    assert found["stride", 60.0] < 2.5


@pytest.mark.slow
@pytest.mark.skipif(not CAPTURED.exists(), reason="needs captured clips")
def test_stride_hardly_depends_on_the_frame_rate_on_real_ground():
    files = AnimationFiles(CAPTURED / "03_03.npz", CAPTURED / "terrain.ply")
    found = differences(load_animation(files), [60.0, 30.0], "stride")
    assert found["stride", 60.0] < 2.0 and found["stride", 30.0] < 4.0
