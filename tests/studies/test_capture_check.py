"""What is said of clips before any solving, and what becomes of clips on flat ground."""

import json
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fitting.cli import main
from fitting.clips import Clip, save_clip
from fitting.clips.stances import stances_of, with_stances
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import ClipData
from fitting.ground.coverage import relief
from fitting.ground.meshes import load_terrain
from fitting.motion.flat_animation import flatten_clip
from fitting.report import pages
from fitting.studies.fit import capture_check, run_folder
from jaxik.world.terrain import Terrain
from support.experiments import write
from support.sample_clips import flat_floor, stair_walk
from support.small_studies import HALF_SECOND

FLAT = "under all stances is flat .they differ by"


@pytest.fixture(scope="module")
def floor(tmp_path_factory):
    path = tmp_path_factory.mktemp("ground") / "floor.ply"
    corners = np.array([[-9.0, 0.0, -9.0], [9.0, 0.0, -9.0], [9.0, 0.0, 9.0], [-9.0, 0.0, 9.0]])
    trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False).export(path)
    return path


def data(clip: Clip, terrain: Terrain) -> ClipData:
    return ClipData(clip, clip, terrain)


def moved(by: Callable[[np.ndarray], np.ndarray], strides: int = 5) -> Clip:
    """A walk on a floor, each frame moved by what its number over that of the last one gives."""
    clip = stair_walk(flat_floor, strides)
    along = np.linspace(0.0, 1.0, clip.frame_count)
    return clip.with_motion(clip.positions_ws + by(along)[:, None], clip.rotations_ws)


def test_a_floor_that_is_tilted_a_little_is_flat_and_steps_and_slopes_are_not():
    random = np.random.default_rng(0)
    places = random.uniform(-2, 2, (12, 2))
    for heights, expected in (
        (np.full(12, 0.3), 0.0),
        (0.3 + places @ [np.tan(np.radians(1.5)), 0.0], 0.0),
        (places @ [0.1, 0.0], np.ptp(places @ [0.1, 0.0])),
        (0.1 * (np.arange(12) == 3), 0.1),
    ):
        assert relief(places, heights) == pytest.approx(expected, abs=0.02)
    assert relief(places[:3], np.array([0.0, 0.1, 0.0])) == pytest.approx(0.1)
    assert np.isinf(relief(places[:0], np.zeros(0)))


@pytest.mark.parametrize(
    ("clip", "said"),
    [
        (moved(lambda t: np.outer(t, [0.0, 0.0, 0.0])), [FLAT]),
        (moved(lambda t: np.outer(t, [0.0, 0.03, 0.0])), [FLAT, "drifts.*rises by [23]"]),
        (moved(lambda t: np.outer(t, [2.0, 0.0, 0.0])), [FLAT, "slide by 1?[0-9]"]),
        (moved(lambda t: np.outer(t, [0.0, 0.0, 0.0]), 1), [FLAT, "feet stand 3 times"]),
    ],
)
def test_what_is_wrong_with_a_capture_is_said_in_cm(floor, clip, said):
    data = ClipData(clip, clip, load_terrain(floor))
    check = capture_check.check([data])
    assert check.flat and len(check.lines) == len(said), check.lines
    for line, words in zip(check.lines, said, strict=True):
        assert re.search(words, line), line


def test_gaps_and_slow_frames_are_said_of_the_clip_that_has_them(floor):
    terrain, clip = load_terrain(floor), stair_walk(flat_floor, 5)
    seen = np.arange(clip.frame_count) % 100 > 30
    gaps, slow = replace(clip, mask=seen), replace(clip, fps=20.0, source="slow")
    lines = capture_check.check([ClipData(c, c, terrain) for c in (clip, gaps, slow)]).lines
    assert [line for line in lines if "not observed" in line and "0.5" in line]
    assert [line for line in lines if line.startswith("slow: 20 Hz is too slow")]


def test_the_flat_animation_of_a_clip_on_flat_ground_is_the_clip_itself():
    walk = stair_walk(flat_floor, 5)
    bob = 0.02 * np.sin(np.arange(walk.frame_count) / 5)
    positions = walk.positions_ws.copy()
    pelvis = [walk.rig.pelvis, *(joints[0] for joints in walk.rig.joints)]
    positions[:, pelvis, 1] += bob[:, None]
    flat = flatten_clip(walk.with_motion(positions, walk.rotations_ws), flat_floor)
    np.testing.assert_allclose(flat.positions_ws[:, walk.rig.pelvis], positions[:, pelvis[0]])
    stairs = flatten_clip(stair_walk(), lambda points: points[:, 1])
    assert np.ptp(stairs.positions_ws[:, walk.rig.pelvis, 1]) < 1e-12


def test_footholds_that_do_not_agree_with_the_ground_are_named_unless_they_are_left_out(floor):
    clip = stair_walk(flat_floor, 5)
    listed = stances_of(clip)
    second = listed["left"][1]
    positions, leg = clip.positions_ws.copy(), clip.rig.names.index("left")
    raised = slice(round(second.start * clip.fps), round(second.end * clip.fps) + 1)
    positions[raised, clip.rig.joints[leg], 1] += 0.05  # as if it stood on a box
    wrong = clip.with_motion(positions, clip.rotations_ws)
    terrain = load_terrain(floor)
    feet = capture_check.footholds(data(wrong, terrain))
    assert [(foot.leg, foot.stance) for foot in feet] == [
        (leg, stance) for leg in listed for stance in listed[leg]
    ]
    (foot,) = [foot for foot in feet if foot.disagrees]
    assert (foot.leg, foot.stance) == ("left", second)
    assert foot.gap == pytest.approx(0.05, abs=0.005)
    named = r"1 of 11 footholds do not agree .*left from 0.9 to 1.4 s is [45]\.\d cm over it"
    assert any(re.search(named, line) for line in capture_check.check([data(wrong, terrain)]).lines)

    others = [replace(each, left_out=each == second) for each in listed["left"]]
    without = with_stances(wrong, {**listed, "left": tuple(others)})
    assert [foot.disagrees for foot in capture_check.footholds(data(without, terrain))].count(True)
    assert not re.search("footholds", "".join(capture_check.check([data(without, terrain)]).lines))


def test_an_offset_that_all_footholds_have_is_no_disagreement_and_missing_ground_is(floor):
    clip, terrain = stair_walk(flat_floor, 5), load_terrain(floor)
    by = [[0.0, 0.06, 0.0]]
    high = clip.with_motion(clip.positions_ws + by, clip.rotations_ws)
    assert not any(foot.disagrees for foot in capture_check.footholds(data(high, terrain)))
    aside = clip.with_motion(clip.positions_ws + [[0.0, 0.0, 7.7]], clip.rotations_ws)
    off = [foot for foot in capture_check.footholds(data(aside, terrain)) if foot.disagrees]
    assert off and all(np.isnan(foot.gap) for foot in off)
    assert off[0].text.endswith("s has no ground below it")
    none = with_stances(clip, {"left": (), "right": ()})
    assert capture_check.footholds(data(none, terrain)) == ()


@pytest.mark.slow
def test_what_a_preset_does_to_flat_clips_is_said_and_what_stops_it_is_free(
    tmp_path, floor, capsys
):
    """The pelvis of ozz follows feet whose swings its rays put on the floor."""
    clip, draft = tmp_path / "walk.npz", tmp_path / "draft"
    save_clip(clip, stair_walk(flat_floor, 5))
    command = ["init", str(clip), "--terrain", str(floor), "--preset", "ozz", "-o", str(draft)]
    assert main.main(command) == 0
    text = capsys.readouterr().out
    assert "under all stances is flat" in text and "ozz as it comes, for this body" in text
    assert "ozz as it comes does not leave these feet alone, as it must on flat ground" in text
    free = load_experiment(draft / "experiment.toml").free
    assert {"pelvis.half_life", "leg.weight"} <= set(free) and len(free) <= 5


@pytest.mark.slow
def test_where_nothing_is_free_the_system_is_judged_as_it_comes(tmp_path, capsys):
    path, run = write(tmp_path, clips=HALF_SECOND, free=""), tmp_path / "run"
    assert main.main(["fit", str(path), "-o", str(run)]) == 4
    text = capsys.readouterr().out
    assert "Does not fit: " in text and "Nothing is free: this is the system as it comes." in text
    numbers = json.loads((run / run_folder.FIT).read_text())
    assert numbers["parameters"] == [] and numbers["distances"]["kept"] == "fitted"
    assert (run / pages.PAGE).exists() and (run / run_folder.PARAMETERS).exists()
    assert main.main(["sample", str(run)]) == 2
    assert "nothing was free" in capsys.readouterr().err
