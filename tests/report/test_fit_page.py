"""The page of a fit: whole in one file, safe, and with the motion as it was solved."""

import base64
import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from fitting.analysis import worst_window
from fitting.datasets import ground_patch
from fitting.datasets.clips import load_clip
from fitting.problem.scene import legs_ws
from fitting.report import worst_window_report
from fitting.report.page import fit_page, motion_data, posterior_section, rendering, sentences
from fitting.studies import run_folder
from fitting.studies.fit import Fit
from fitting.studies.motions import fit_motions
from support import runs
from support.experiments import ROOT
from support.pages import Page

HOSTILE = "</script><script>alert(1)</script>"
BESIDE = {"summary.md", "fit.json", "parameters.toml"}  # files that the page names


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    """An invented fit, whose names try to be HTML."""
    fitted = runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("experiment")))
    (scene,) = fitted.problem.data
    reference = dataclasses.replace(scene.reference, label=HOSTILE)
    scene = dataclasses.replace(scene, reference=reference)
    problem = dataclasses.replace(fitted.problem, data=(scene,))
    experiment = dataclasses.replace(fitted.experiment, name=f"walk {HOSTILE} & $x^$")
    return dataclasses.replace(fitted, experiment=experiment, problem=problem)


@pytest.fixture(scope="module")
def run(fitted, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    runs.write_run(folder, fitted)
    return folder


@pytest.fixture(scope="module")
def page(run) -> Page:
    return Page(run / run_folder.PAGE)


@pytest.fixture(scope="module")
def motions(fitted) -> fit_motions.ClipMotions:
    (data,), (result,) = fitted.clips, fitted.results
    return fit_motions.clip_motions(data, result, result)


def array(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def points(clip: dict[str, Any], skeleton: dict[str, Any]) -> np.ndarray:
    """Positions as the page's scripts have them, m: (frames, points, 3)."""
    root = array(skeleton["root"], "<f4").reshape(-1, 1, 3)
    offsets = array(skeleton["offsets"], "<i2").reshape(clip["frames"], skeleton["points"], 3)
    return root + skeleton["quantum"] * offsets


def test_the_page_is_one_small_file_that_loads_nothing(page, run):
    assert (run / run_folder.PAGE).stat().st_size < 1_000_000
    assert set(page.loads) == {"data:,", *BESIDE}
    addresses = set(re.findall(r"\w+://[^\s\"']+", page.html))
    assert addresses <= {"http://www.w3.org/2000/svg"}  # a name, which nothing loads
    assert not re.search(r"@import|url\(|\bfetch\(|\bimport\(|XMLHttpRequest", page.html)


def test_the_page_says_what_was_found(page, fitted):
    for row in fitted.summary["parameters"]:
        assert row["name"] in page.text
        assert f"{row['value']:.4g}" in page.text
        assert "{:.4g} to {:.4g}".format(*row["interval"]) in page.text
    assert "The clips determine 1 of 2 parameters; foot.max_pitch stays open." in page.text
    assert fitted.verdict.sentence.replace("`", "") in page.text
    (play,) = fitted.playbacks
    window = worst_window.find_worst_window(play)
    for line in worst_window_report.describe(play, window, ("left", "right")):
        assert line in page.text
    assert "leg.max_knee_angle 50.0 %" in page.text
    assert "never act in these clips: pelvis.limit." in page.text


def test_a_posterior_is_added_once_and_replaced(run, tmp_path):
    page = (run / run_folder.PAGE).read_text()
    (tmp_path / run_folder.PAGE).write_text(page)
    for count in (1, 2):
        lines = [f"chain {count} <b>"]
        first = ["`jaxik fit` <i>: **run** it"]
        posterior_section.insert(tmp_path, first, lines, [["parameter"], ["x"]])
    sampled = Page(tmp_path / run_folder.PAGE)
    assert "chain 2 <b>" in sampled.text and "chain 1" not in sampled.text
    assert "<code>jaxik fit</code> &lt;i&gt;: <strong>run</strong> it" in sampled.html
    assert sampled.headings.count("h2 Posterior") == 1
    assert sampled.data == Page(run / run_folder.PAGE).data
    (tmp_path / run_folder.PAGE).write_text("of another kind")
    posterior_section.insert(tmp_path, [], [], [["parameter"]])
    assert (tmp_path / run_folder.PAGE).read_text() == "of another kind"


def test_names_of_users_stay_text_and_headings_are_in_order(page):
    assert page.elements.count("script") == 2  # data and scripts of its own
    assert f"walk {HOSTILE} & $x^$" in page.text
    (clip,) = page.data["clips"]
    labels = {skeleton["key"]: skeleton["label"] for skeleton in clip["skeletons"]}
    assert labels["captured"] == HOSTILE
    levels = [int(heading[1]) for heading in page.headings]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in zip(levels, levels[1:], strict=False))
    assert {"h2 The motion", "h2 Parameters", "h2 Limits of the data"} <= set(page.headings)


def test_positions_on_the_page_are_those_of_the_motions(page, fitted):
    (clip,) = page.data["clips"]
    (scene,), (data,) = fitted.problem.data, fitted.clips
    ankles = np.asarray(legs_ws(scene, fitted.results[0]).ankle.pos)
    captured = data.reference.positions_ws
    corner = captured[0, 0] - points(clip, clip["skeletons"][2])[0, 0]
    for number, expected in ((3, ankles), (2, data.reference.joints_ws(2))):
        skeleton = clip["skeletons"][number]
        shown = points(clip, skeleton)[:, [legs[2] for legs in skeleton["legs"]]] + corner
        np.testing.assert_allclose(shown, expected, atol=1e-4)  # 0.1 mm


def test_soles_in_the_ground_are_those_of_the_placement(page, motions):
    (clip,) = page.data["clips"]
    for name, skeleton in zip(("animated", "fitted"), clip["skeletons"][::3], strict=True):
        marks = array(skeleton["inGround"], "u1").reshape(clip["frames"], -1)
        placement = getattr(motions, name).placement
        assert marks.any(axis=1).mean() == pytest.approx(placement.sunk_frames)
    assert motions.animated.in_ground.any()


def test_the_ground_on_the_page_is_that_of_the_mesh(page, fitted):
    (clip,) = page.data["clips"]
    ground, (data,) = clip["ground"], fitted.clips
    patch = ground_patch.around_path(data.reference, data.terrain)
    steps = array(ground["heights"], "<u2").reshape(ground["rows"], ground["columns"])
    known = steps != motion_data.HOLE
    heights = ground["low"] + ground["quantum"] * steps
    mesh = trimesh.load_mesh(ROOT / "data/terrains/uneven_walk.ply", process=False)
    random = np.random.default_rng(0)
    rows, columns = np.argwhere(known)[random.choice(known.sum(), 60, replace=False)].T
    across = patch.corner + ground["spacing"] * np.stack([columns, rows], axis=-1)
    origins = np.stack([across[:, 0], np.full(60, 50.0), across[:, 1]], axis=-1)
    hits, rays, _ = mesh.ray.intersects_location(origins, np.tile([0.0, -1.0, 0.0], (60, 1)))
    highest = np.full(60, -np.inf)
    np.maximum.at(highest, rays, hits[:, 1])
    lowest = np.nanmin(patch.heights)
    near = np.abs(heights[rows, columns] + lowest - highest) < 1e-3
    assert near.mean() > 0.95  # the other rays meet the edge of a step


def test_a_long_clip_is_shown_with_fewer_frames(fitted, motions, monkeypatch):
    (play,) = fitted.playbacks
    shown = fit_page.shown(motions, "captured", worst_window.find_worst_window(play))
    (whole,) = motion_data.pack([shown])
    assert motion_data.steps_between_frames([shown]) == [1]  # 30 Hz
    assert motion_data.steps_between_frames([shown], -1) == [8]  # one frame of seven is left
    monkeypatch.setattr(motion_data, "MAX_RATE", 15.0)
    assert motion_data.steps_between_frames([shown]) == [2]
    ground = 2 * motions.ground.heights.size
    spent = motion_data.MAX_BYTES - ground - 600  # by pictures
    (packed,) = motion_data.pack([shown], spent)
    step = -(-whole["frames"] // packed["frames"])
    assert step > 2, "grounds and pictures count"
    few, every = ((clip, clip["skeletons"][3]) for clip in (packed, whole))
    np.testing.assert_allclose(points(*few), points(*every)[::step], atol=1e-4)
    marks = [array(skeleton["inGround"], "u1").any() for _, skeleton in (few, every)]
    assert marks[0] == marks[1]  # what happens between two frames is kept


def test_many_grounds_are_coarser_and_stay_where_they_are():
    heights = np.arange(60_000.0).reshape(200, 300)
    patch = ground_patch.GroundPatch(np.zeros(2), 0.1, heights)
    (alone,) = motion_data.coarse_grounds([patch])
    assert alone.heights.shape == heights.shape and alone.spacing == patch.spacing
    coarse = motion_data.coarse_grounds([patch] * 40)
    assert sum(2 * each.heights.size for each in coarse) < 1.02 * motion_data.MAX_GROUND_BYTES
    assert coarse[0].heights[3, 4] == heights[9, 12] and coarse[0].spacing == pytest.approx(0.3)


def test_a_run_keeps_its_flat_animation_and_its_fitted_motion(run, fitted):
    (scene,), (data,) = fitted.problem.data, fitted.clips
    base, solved = (load_clip(run / name) for name in ("base.npz", "fitted.npz"))
    np.testing.assert_array_equal(base.positions_ws, data.base.positions_ws)
    ankles = np.asarray(legs_ws(scene, fitted.results[0]).ankle.pos)
    np.testing.assert_allclose(solved.joints_ws(2), ankles, atol=1e-9)
    problem = dataclasses.replace(fitted.problem, data=fitted.problem.data * 2)
    several = dataclasses.replace(fitted, clips=fitted.clips * 2, problem=problem)
    names = {"base_1.npz", "base_2.npz", "fitted_1.npz", "fitted_2.npz"}
    assert set(fit_motions.saved_clips(several)) == names


def test_many_names_become_a_number():
    texts = [sentences.listed(list("abcd"[:count])) for count in (1, 2, 3, 4)]
    assert texts == ["a", "a and b", "a, b and c", "a, b and 2 others"]


def test_data_cannot_end_its_script_element():
    assert "<" not in rendering.as_json({"a": "</script><!--"})
    with pytest.raises(ValueError, match="JSON"):
        rendering.as_json({"a": float("nan")})
