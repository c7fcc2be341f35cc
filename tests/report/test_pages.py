"""Pages, words and pictures of fits and comparisons: whole, safe, with the motion as solved."""

import base64
import dataclasses
import json
import math
import re

import numpy as np
import pytest
import trimesh
from matplotlib.patches import StepPatch
from PIL import Image
from scipy import stats

from fitting.clips import load_clip
from fitting.ground import ground_path
from fitting.motion import worst_window
from fitting.motion.accuracy import ACCURACY, QUANTITIES
from fitting.motion.measures import BOUNDED, MEASURES, Cause, Extreme, Measures
from fitting.motion.playback import RESIDUAL_KINDS
from fitting.motion.worst_window import find_worst_window
from fitting.problem.scene import legs_ws
from fitting.report import document, formatting, motion_data, pages
from fitting.report.document import Document, Finding, Grid, Points, Section, Text
from fitting.report.style import save
from fitting.studies import animations, comparison
from fitting.studies.fit import fit_motions, fit_plots, fit_report, fit_tables
from fitting.studies.fit.fit import Fit
from fitting.studies.sample import sample_jobs
from fitting.studies.sample.sample_jobs import ComparedRun
from support import comparisons, runs
from support.comparisons import DEEP
from support.experiments import ROOT
from support.pages import Page
from support.playbacks import FRAMES, LEGS, error, playback


def test_every_figure_has_a_label_in_the_same_order_and_is_shown_in_its_unit():
    assert list(formatting.RESIDUALS) == list(RESIDUAL_KINDS)
    assert list(formatting.DIFFERENCES) == list(QUANTITIES)
    factors = {"%": 100, "cm": 100, "mm": 1000, "°": math.degrees(1), "degrees": math.degrees(1)}
    for table in (ACCURACY, MEASURES, formatting.RESIDUALS, formatting.DIFFERENCES):
        for column in table.values():
            assert column.factor == factors.get(column.unit.split()[0], 1), column
    for name, value, shown in (
        ("penetration_depth", 0.01234, "1.23"),
        ("reached", 0.875, "87.5"),
        ("pops", 12.0, "12"),
        ("slide", math.nan, "–"),
    ):
        assert MEASURES[name].format(value) == shown


# How feet are placed on their ground

NAN, NOTHING = math.nan, Extreme(math.nan, 0, "left")
UNKNOWN = Measures(**{**dict.fromkeys(MEASURES, NAN), "groundless": 1.0}, worst={"pop": NOTHING})
GOOD = dataclasses.replace(
    UNKNOWN,
    penetration=0.04,
    floating=0.02,
    contact=0.97,
    groundless=0.05,
    slide=0.011,
    pop=0.013,
    worst={
        "penetration": Extreme(0.031, 7, "left"),
        "floating": Extreme(0.022, 8, "right"),
        "contact": Extreme(0.031, 7, "left"),
        "slide": Extreme(0.044, 9, "left"),
        "pop": Extreme(0.013, 10, "right"),
    },
)
BOUNDS = {name: measure.bound for name, measure in BOUNDED.items()}


def test_the_table_says_how_often_how_far_and_where_and_what_is_unknown_is_null_in_json():
    heading, *rows = formatting.figures_table("feet on the ground", {"solved": GOOD})
    assert heading == ["feet on the ground", "solved"]
    assert rows == [
        ["penetration, % of frames", "4.0 · 3.1 cm, left, frame 7"],
        ["floating, % of frames", "2.0 · 2.2 cm, right, frame 8"],
        ["contact preservation, % of frames", "97.0 · 3.1 cm, left, frame 7"],
        ["without ground, % of soles", "5.0"],
        ["slide, cm a stance", "1.10 · 4.4 cm, left, frame 9"],
        ["pop, cm in 1/60 s", "1.3 · 1.3 cm, right, frame 10"],
    ]
    numbers = json.loads(json.dumps(UNKNOWN.numbers()))
    assert numbers["contact"] is None and numbers["groundless"] == 1.0
    assert numbers["worst"]["pop"] == {"value": None, "frame": 0, "leg": "left"}
    assert GOOD.numbers()["pop"] == pytest.approx(0.013)


def test_feet_that_are_badly_placed_are_a_warning_with_frames_and_the_likely_cause():
    off = dataclasses.replace(GOOD, contact=0.36)
    floor = "the root stays on the animation's floor where the ground rises (use --root"
    unit = "the terrain is in another unit of length: one of its units is 0.01 m (--terrain-sc"
    for cause, words in (
        (Cause("root"), floor),
        (Cause("units", 0.01), unit),
        (Cause("offset", -0.12), "all feet are 12 cm too low: check the clip's floor (--floor)"),
        (Cause("offset", 0.5), "all feet are 50 cm too high"),
        (Cause("missing"), "the terrain does not lie below the whole path"),
        (Cause("unknown"), "none of missing ground, units, root, floor and offset"),
    ):
        text, why = animations.warning_texts(off, BOUNDS, cause)
        assert text == (
            "contact preservation 36.0 % of frames (≥ 95.0), worst 3.1 cm, left, frame 7"
        )
        assert why.startswith(f"likely cause of feet off the ground: {words}")
    assert animations.warning_texts(GOOD, BOUNDS, None) == []
    (text,) = animations.warning_texts(UNKNOWN, BOUNDS, Cause("missing"))
    assert text.endswith("the terrain does not lie below the whole path")
    unlabelled = dataclasses.replace(GOOD, contact=NAN, floating=NAN, slide=NAN)
    (text,) = animations.warning_texts(unlabelled, BOUNDS, None)
    assert text.startswith("no foot of the animation ever stands; see ")
    worst = {**GOOD.worst, "pop": Extreme(0.124, 3, "left")}
    bad = dataclasses.replace(GOOD, slide=0.05, pop=0.124, worst=worst)
    assert animations.warning_texts(bad, BOUNDS, None) == [
        "pop 12.4 cm in 1/60 s (≤ 2.0), worst 12.4 cm, left, frame 3",
        "slide 5.00 cm a stance (≤ 2.00), worst 4.4 cm, left, frame 9",
    ]
    with pytest.warns(animations.PlacementWarning, match=r"^mec: pop 12.4 cm in 1/60 s"):
        animations.warn(dataclasses.replace(bad, slide=0.0), BOUNDS, None, "mec")


# The worst two seconds


def describe(play) -> str:
    return " ".join(fit_tables.describe_window(play, find_worst_window(play), LEGS))


def test_the_text_gives_direction_size_and_time_of_the_largest_error():
    for offset, direction in (
        ((0.01, 0.09, 0.02), "9.3 cm off, mostly too high (9.0 cm)"),
        ((0.01, -0.09, 0.02), "9.3 cm off, mostly too low (9.0 cm)"),
        ((0.0, 0.01, 0.05), "mostly too far ahead (5.0 cm)"),
        ((0.0, 0.01, -0.05), "mostly too far behind (5.0 cm)"),
        ((0.05, 0.01, 0.0), "mostly too far to the left (5.0 cm)"),
        ((-0.05, 0.01, 0.0), "mostly too far to the right (5.0 cm)"),
    ):
        text = describe(playback(error("ankle", 123, *offset, leg=1)))
        assert "The ankle position of the right leg is worst at 4.10 s: " in text
        assert direction in text
        assert "Ankle position makes up 100 % of their squares; knee position 0 %" in text
        assert "The right leg makes up 100 % of the squares of the legs." in text


def test_the_text_says_whether_the_foot_stands_and_whether_its_target_was_in_reach():
    bent = error("knee", 123, 0.0, 0.1, 0.0, leg=0)
    for weight, state, reach, part in (
        (1.0, "stands", "within reach", "0 %"),
        (0.0, "swings", "out of reach", "5 %"),
    ):
        stance, reached = np.ones((FRAMES, 2)), np.ones((FRAMES, 2))
        stance[123, 0] = weight
        reached[123:129, 0] = weight
        text = describe(playback(bent, stance=stance, reached=reached))
        assert f"The foot {state} at that time, according to the captured contact labels." in text
        assert f"target of its ankle is {reach} then; targets are out of reach in {part} of" in text


def test_the_text_about_the_body_names_standing_feet_and_a_perfect_fit_has_a_text_too():
    contact = np.ones((FRAMES, 2))
    contact[:, 1] = 0.0
    unlabelled, unreached = np.zeros((FRAMES, 2)), np.zeros((FRAMES, 2))
    sunk = error("pelvis", slice(0, FRAMES), 0.0, 0.03, 0.0)
    text = describe(playback(sunk, stance=unlabelled, contact=contact, reached=unreached))
    assert "stand at that time, according to the system's contact weights: left." in text
    assert "The ankle's target is out of reach in 100 % of" in text
    assert "The pelvis is 3.0 cm too high on average." in text
    assert "No captured foot stands above known ground" in text
    errors = np.zeros((FRAMES - 2, 2, 3))
    errors[149, 1] = [0.0, 30.0, 0.0]
    assert "30.0 m/s² off." in describe(playback({"smooth": errors}, sigmas={"smooth": 10.0}))
    assert "the residuals are 0.00 sigmas (rms)" in describe(playback())


def test_the_text_says_how_far_captured_soles_are_from_the_ground():
    stance = np.zeros((FRAMES, 2))
    stance[100:140, 1] = 1.0
    play = playback(error("ankle", 120, 0.0, 0.1, 0.0, leg=0), stance=stance)
    for height, side in ((0.02, "in"), (-0.02, "above")):
        ground = play.ball_ground_ws + np.array([0.0, height, 0.0])
        ground[110, 1, 1] += height
        text = describe(dataclasses.replace(play, ball_ground_ws=ground))
        assert f"stand are 2.1 cm {side} the ground on average (2.1 cm rms; the right one" in text
        assert f"the right one 4.0 cm {side} it at 3.67 s)" in text


def test_the_picture_shows_the_window_with_its_stances(tmp_path):
    stance, seen = np.zeros((FRAMES, 2)), np.ones(FRAMES, bool)
    stance[100:140, 1] = 1.0
    seen[130:133] = False
    play = playback(error("ankle", 120, 0.0, 0.1, 0.0, leg=0), seen=seen, stance=stance)
    window = find_worst_window(play)
    figure = fit_plots.worst_window(play, LEGS, window, "hill: the worst two seconds")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    names = ["Left ankle", "Right ankle", "Pelvis", "Left knee", "Right knee"]
    assert [title.partition(",")[0].partition(" (")[0] for title in titles] == names
    assert figure.axes[0].get_xlim() == (play.time[window.start], play.time[window.end])
    heights = [line.get_ydata() for line in figure.axes[0].lines[:2]]
    assert np.ptp(np.asarray(heights[1])) == pytest.approx(10.0), "the fitted ankle, cm"
    bands = [len(axes.patches) for axes in figure.axes]
    assert bands == [1, 2, 1, 1, 2], "frames that were not seen, and the right foot's stance"
    save(tmp_path / "worst.png", figure)
    with Image.open(tmp_path / "worst.png") as picture:
        assert 1000 < picture.width < 2000 and 1000 < picture.height < 2500


def test_the_moments_that_differ_most_are_shown_of_clips_that_are_held_out_too():
    errors = error("ankle", slice(118, 121), 0.0, 0.06, 0.08, leg=0)
    errors |= error("pelvis", 200, 0.0, 0.09, 0.0) | error("knee", 250, 0.0, 0.03, 0.0, leg=1)
    unseen = np.zeros(FRAMES, bool)
    for play in (playback(errors), playback(errors, seen=unseen, held_out=~unseen)):
        figure = fit_plots.moments(play, LEGS, "hill: where it differs most")
        titles = [axes.get_title(loc="left") for axes in figure.axes]
        assert titles == ["3.93 s: left ankle 10.0 cm off", "6.67 s: pelvis 9.0 cm off"]
        lines = [np.asarray(line.get_ydata()) for line in figure.axes[0].lines]
        left, _ = [heights for heights in lines if len(heights) == 4][-2:]  # drawn last: solved
        assert left[2] == pytest.approx(play.after.ankle[118, 0, 1])


def test_normal_residuals_are_drawn_beside_the_density_of_the_normal_distribution():
    knees = {"knee": np.random.default_rng(1).normal(0.0, 0.03, (FRAMES, 2, 3))}
    _, _, _, axes, *_ = fit_plots.noise(playback(knees), "are the residuals noise?").axes
    across, density = map(np.asarray, axes.lines[0].get_data())
    np.testing.assert_allclose(density, stats.norm.pdf(across))
    (steps,) = axes.patches
    assert isinstance(steps, StepPatch)
    heights, edges, _ = steps.get_data()
    np.testing.assert_allclose(heights, stats.norm.pdf((edges[1:] + edges[:-1]) / 2), atol=0.06)


HOSTILE = "</script><script>alert(1)</script>"
BESIDE = {"summary.md", "fit.json", "parameters.toml"}  # files that the page names


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """An invented fit, whose names try to be HTML."""
    fitted = runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("experiment")))
    (scene,) = fitted.problem.data
    reference = dataclasses.replace(scene.reference, label=HOSTILE)
    scene = dataclasses.replace(scene, reference=reference)
    problem = dataclasses.replace(fitted.problem, data=(scene,))
    experiment = dataclasses.replace(fitted.experiment, name=f"walk {HOSTILE} & $x^$")
    return dataclasses.replace(fitted, experiment=experiment, problem=problem)


@pytest.fixture(scope="module")
def run(fitted, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    runs.write_run(folder, fitted)
    return folder


@pytest.fixture(scope="module")
def page(run) -> Page:
    return Page(run / pages.PAGE)


@pytest.fixture(scope="module")
def motions(fitted) -> fit_motions.ClipMotions:
    (data,), (result,) = fitted.clips, fitted.results
    return fit_motions.clip_motions(data, result, result)


def array(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def points(clip: dict, skeleton: dict) -> np.ndarray:
    """Positions as the page's scripts have them, m: (frames, points, 3)."""
    root = array(skeleton["root"], "<f4").reshape(-1, 1, 3)
    offsets = array(skeleton["offsets"], "<i2").reshape(clip["frames"], skeleton["points"], 3)
    return root + skeleton["quantum"] * offsets


def test_the_page_is_one_small_file_that_loads_nothing_and_in_which_names_of_users_stay_text(page):
    assert len(page.html.encode()) < 1_000_000
    assert set(page.loads) == {"data:,", *BESIDE}
    addresses = set(re.findall(r"\w+://[^\s\"']+", page.html))
    assert addresses <= {"http://www.w3.org/2000/svg"}  # a name, which nothing loads
    assert not re.search(r"@import|url\(|\bfetch\(|\bimport\(|XMLHttpRequest", page.html)
    assert page.elements.count("script") == 2  # data and scripts of its own
    assert f"walk {HOSTILE} & $x^$" in page.text
    (clip,) = page.data["clips"]
    labels = {skeleton["key"]: skeleton["label"] for skeleton in clip["skeletons"]}
    assert labels["captured"] == HOSTILE
    levels = [int(heading[1]) for heading in page.headings]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in zip(levels, levels[1:], strict=False))
    assert {"h2 The motion", "h2 Parameters", "h2 Limits of the data"} <= set(page.headings)


def test_the_page_says_what_was_found(page, fitted):
    for row in fitted.summary["parameters"]:
        assert row["name"] in page.text
        assert f"{row['value']:.4g}" in page.text
        assert "{:.4g} to {:.4g}".format(*row["interval"]) in page.text
    assert "The clips determine 1 of 2 parameters; foot.max_pitch stays open." in page.text
    assert fitted.verdict.sentence.replace("`", "") in page.text
    (play,) = fitted.playbacks
    window = worst_window.find_worst_window(play)
    for line in fit_tables.describe_window(play, window, ("left", "right")):
        assert line in page.text
    assert "leg.max_knee_angle 50.0 %" in page.text
    assert "never act in these clips: pelvis.limit." in page.text


def test_the_page_has_the_noise_of_a_kind_that_the_second_clip_lacks(fitted, monkeypatch):
    monkeypatch.setattr(Fit, "playbacks", (playback(sigmas={"contact": 0.25}), playback()))
    asked = dict(fit_report._setup(dataclasses.replace(fitted)))
    assert asked["Noise, m and rad"] == "ankle 0.02, knee 0.03, pelvis 0.02, contact 0.25"


def test_a_stored_document_is_written_again_with_more_sections(run, tmp_path, monkeypatch):
    report = document.load(run)
    assert report is not None and document.load(tmp_path) is None
    monkeypatch.setattr(motion_data, "FORMAT", "another version's")
    without_view = document.load(run)
    assert report.view is not None and without_view is not None and without_view.view is None
    monkeypatch.undo()
    report.write(tmp_path)
    for name in ("summary.md", pages.PAGE):
        assert (tmp_path / name).read_text() == (run / name).read_text(), name
    warning = Text("`jaxik fit` <i>: **run** it")
    section = Section("Posterior", [warning, Grid([["parameter"], ["x"]], "x")])
    dataclasses.replace(report, sections=[*report.sections, section]).write(tmp_path)
    sampled = Page(tmp_path / pages.PAGE)
    assert "<code>jaxik fit</code> &lt;i&gt;: <strong>run</strong> it" in sampled.html
    assert sampled.headings.count("h2 Posterior") == 1
    assert sampled.data == Page(run / pages.PAGE).data
    for damage in ('{"format": 1}', (run / document.STORED).read_text().replace("Text", "Tax")):
        (tmp_path / document.STORED).write_text(damage)
        with pytest.raises(ValueError, match=r"report.json: not a report: .*; delete it"):
            document.load(tmp_path)


def test_positions_and_soles_on_the_page_are_those_of_the_motions(page, fitted, motions):
    (clip,) = page.data["clips"]
    (scene,), (data,) = fitted.problem.data, fitted.clips
    ankles = np.asarray(legs_ws(scene, fitted.results[0]).ankle.pos)
    captured = data.reference.positions_ws
    corner = captured[0, 0] - points(clip, clip["skeletons"][2])[0, 0]
    for number, expected in ((3, ankles), (2, data.reference.joints_ws(2))):
        skeleton = clip["skeletons"][number]
        shown = points(clip, skeleton)[:, [legs[2] for legs in skeleton["legs"]]] + corner
        np.testing.assert_allclose(shown, expected, atol=1e-4)  # 0.1 mm
    assert motions.animated.in_ground.any()
    for name, skeleton in zip(("animated", "fitted"), clip["skeletons"][::3], strict=True):
        gap = motion_data.TENTH * array(skeleton["gap"], "<i2").reshape(clip["frames"], -1)
        marks = gap < -clip["visibleDepth"]
        measured = getattr(motions, name).measures
        assert marks.any(axis=1).mean() == pytest.approx(measured.penetration)


def test_the_ground_on_the_page_is_that_of_the_mesh(page, fitted):
    (clip,) = page.data["clips"]
    ground, (data,) = clip["ground"], fitted.clips
    patch = ground_path.around_path(data.reference, data.terrain)
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


def test_a_long_clip_has_fewer_frames_and_many_grounds_are_coarser(fitted, motions, monkeypatch):
    (play,) = fitted.playbacks
    shown = fit_report.viewed_clip(motions, "captured", worst_window.find_worst_window(play))
    (whole,) = motion_data.pack([shown])
    assert motion_data.steps_between_frames([shown]) == [1]  # 30 Hz
    assert motion_data.steps_between_frames([shown], -1) == [16]  # one frame of sixteen is left
    monkeypatch.setattr(motion_data, "MAX_RATE", 15.0)
    assert motion_data.steps_between_frames([shown]) == [2]
    ground = 2 * motions.ground.heights.size
    spent = motion_data.MAX_BYTES - ground - 1400  # by pictures
    (packed,) = motion_data.pack([shown], spent)
    step = -(-whole["frames"] // packed["frames"])
    assert step > 2, "grounds and pictures count"
    few, every = ((clip, clip["skeletons"][3]) for clip in (packed, whole))
    np.testing.assert_allclose(points(*few), points(*every)[::step], atol=1e-4)
    lowest = [array(skeleton["gap"], "<i2").min() for _, skeleton in (few, every)]
    assert lowest[0] == lowest[1]  # what happens between two frames is kept
    heights = np.arange(60_000.0).reshape(200, 300)
    patch = ground_path.GroundPatch(np.zeros(2), 0.1, heights)
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


def test_many_names_become_a_number_and_data_cannot_end_its_script_element():
    texts = [formatting.listed(list("abcd"[:count])) for count in (1, 2, 3, 4)]
    assert texts == ["a", "a and b", "a, b and c", "a, b and 2 others"]
    assert "<" not in pages.as_json({"a": "</script><!--"})
    with pytest.raises(ValueError, match="JSON"):
        pages.as_json({"a": float("nan")})


# Comparisons and other studies


@pytest.fixture(scope="module")
def compared():
    return comparisons.invented_comparison(comparisons.walk(), title=f"walk {HOSTILE}")


def test_a_comparison_begins_with_the_worst_system_and_shows_all_of_them(
    compared, tmp_path, undrawn
):
    comparison.document(compared).write(tmp_path)
    page = Page(tmp_path / pages.PAGE)
    assert page.text.startswith(
        f" walk {HOSTILE} Foot IK systems compared on one clip walk {HOSTILE} "
        "1 of 2 beyond a bound ◐ Worst is deep: "
    )
    assert "penetration 100.0 % of frames (≤ 5.0), worst 10" in page.text
    cause = compared.causes["deep"]
    assert compared.causes["close"] is None and cause is not None
    assert f"; {cause.sentence}." in page.text
    assert "close keeps standing feet on the ground best" in page.text
    assert (
        f"Closest to the captured motion is close, whose ankles are 0.0 cm away (rms), furthest "
        f"is deep with {100 * DEEP:.1f} cm; without foot IK" in page.text
    )
    (clip,) = page.data["clips"]
    labels = [skeleton["label"] for skeleton in clip["skeletons"]]
    assert labels == ["flat animation", "close", "deep", "captured"]
    assert clip["watched"] == "motion deep"
    assert [skeleton["worst"] is None for skeleton in clip["skeletons"]] == [False] * 3 + [True]
    assert page.elements.count("img") == 1 and len(page.html) < 1_000_000
    assert page.elements.count("script") == 2
    loads = {load for load in page.loads if not load.startswith("data:")}
    assert loads == {"compare.md", "compare.json", "compare.png"}
    assert {"h2 Limits of the data", "h2 Setup"} <= set(page.headings)
    assert compared.accuracy["deep"].ankle == pytest.approx(DEEP)


def test_where_feet_are_furthest_off_is_the_worst_window(compared):
    feet = compared.motions["close"].soles
    gap = np.zeros((400, 2))
    gap[150:160, 0] = -0.3
    gap[30:60, 1] = 9.0  # a moving foot, which may be above the ground
    stance = np.zeros((400, 2), bool)
    stance[150:160, 0] = True  # a standing foot counts in the ground as well
    height = np.repeat(gap[..., None], 2, axis=-1)
    feet = dataclasses.replace(feet, height=height, stance=stance)
    start, end = comparison.worst_seconds(feet, 60.0)
    assert start <= 150 and end >= 159 and end - start == 120
    assert comparison.worst_seconds(feet, 600.0) == (0, 399)


def test_the_worst_is_named_and_no_system_praised_that_is_worse_than_the_animation(compared):
    placed = compared.motions["close"].measures
    still = dataclasses.replace(placed, penetration=0.0, contact=1.0, slide=-0.01, pop=0.0)
    popping = dataclasses.replace(still, pop=3.0 * compared.bounds["pop"])
    (first, *others) = popping.against(compared.bounds)
    assert first.excess == pytest.approx(3.0) and first.words.startswith("pop ")
    assert not any(other.is_beyond for other in others)
    motions = {
        name: dataclasses.replace(compared.motions["close"], measures=measures)
        for name, measures in (("close", still), ("deep", popping))
    }
    other = dataclasses.replace(compared, motions=compared.motions | motions)
    assert comparison.beyond(other) == ["deep"]
    captured = {comparison.ANIMATED: compared.motions["close"]}
    far = dataclasses.replace(compared, motions=compared.motions | captured)
    last = comparison.findings(far)[2]
    assert last.bad and last.text.startswith("No system comes closer to the captured motion")


def test_what_went_badly_comes_first_and_what_says_nothing_is_left_out(tmp_path):
    Document(
        file="summary.md",
        kind="a test",
        title=HOSTILE,
        verdict="bad",
        good=False,
        findings=[Finding("good `a` **b**"), Finding("bad <i>", bad=True), Finding("good too")],
        sections=[
            Section("Table", [Grid([["x", "y"], ["1!", "2!"]], "numbers"), Text("`t`")]),
            Section("Nothing", [Grid([["x", "y"]], "none"), Points([]), Text("")]),
        ],
        setup=[["What", HOSTILE]],
    ).write(tmp_path)
    page = Page(tmp_path / pages.PAGE)
    assert "bad ◐ bad <i> good a b good too" in page.text
    assert "<li>good <code>a</code> <strong>b</strong></li>" in page.html
    assert '<td class="miss">2!</td>' in page.html and page.elements.count("script") == 2
    assert page.elements.count("canvas") == 0 and page.data == {"clips": []}
    text = (tmp_path / "summary.md").read_text()
    findings = "- bad <i>\n- good `a` **b**\n- good too"
    assert text.startswith(f"# {HOSTILE}\n\na test: **bad**.\n\n{findings}\n\n## Table")
    assert page.headings == [f"h1 {HOSTILE}", "h2 Table", "h2 Setup"]


def test_pictures_become_small_enough(tmp_path, monkeypatch):
    noise = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    (picture,) = pages.embed(tmp_path, {"noise.png": "noise"}).values()
    assert (picture.width, picture.height) == (60, 40)
    monkeypatch.setattr(pages, "MAX_BYTES", 1_000)
    (picture,) = pages.embed(tmp_path, {"noise.png": "noise"}).values()
    assert picture.size <= 1_000 and picture.width < 40
    assert picture.width / picture.height == pytest.approx(1.5, abs=0.2)


def test_runs_that_cannot_be_told_apart_are_said_so():
    for behind, unreliable, first, bad in (
        (5.0, 0, "`a` predicts best; `b` is 5.0 ± 1.0 below.", False),
        (1.5, 0, "The motion does not tell `a`, which predicts best, from `b`", True),
        (5.0, 2, "The figures are not fully reliable", True),
    ):
        other = ComparedRun("b", -10.0 - behind, 2.0, behind, 1.0, 4.0, unreliable, {1: -9.0})
        runs = [ComparedRun("a", -10.0, 2.0, 0.0, 0.0, 3.0, 0, {1: -10.0}), other]
        findings = sample_jobs.findings(runs)
        found = [finding.bad for finding in findings if finding.text.startswith(first)]
        assert len(findings) == 3 and found == [bad], first
