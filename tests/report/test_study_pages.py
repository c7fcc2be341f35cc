"""Pages of comparisons and other studies: what they say first, and that names stay text."""

import dataclasses
import math

import numpy as np
import pytest
from PIL import Image

from fitting.report import comparison_report
from fitting.report.page import pictures
from fitting.report.page.comparisons import compare_page, compare_sentences, runs_page
from fitting.report.page.study_page import Finding, Grid, Section, StudyPage, Text
from fitting.studies import run_folder
from fitting.studies.motions import comparison_motions
from fitting.studies.posterior.run_comparison import ComparedRun
from support import comparisons
from support.comparisons import DEEP
from support.pages import Page

HOSTILE = "</script><script>alert(1)</script>"


@pytest.fixture(scope="module")
def compared():
    return comparisons.invented_comparison(comparisons.walk(), title=f"walk {HOSTILE}")


@pytest.fixture(scope="module")
def motions(compared):
    return comparison_motions.of_comparison(compared)


@pytest.fixture(scope="module")
def page(compared, tmp_path_factory) -> Page:
    folder = tmp_path_factory.mktemp("compared")
    Image.new("RGB", (1700, 900), "white").save(folder / comparison_report.FIGURE)
    compare_page.write(folder, compared)
    return Page(folder / run_folder.PAGE)


def test_a_comparison_begins_with_the_system_that_is_worst(page, compared):
    assert page.text.startswith(
        f" walk {HOSTILE} Foot IK systems compared on one clip walk {HOSTILE} "
        "1 of 2 beyond a limit ◐ Worst is deep: its standing feet are 2 cm or more off the "
        "ground in 100.0 % of their frames"
    )
    assert "close places standing feet best" in page.text
    assert (
        f"Closest to the captured motion is close, whose ankles are 0.0 cm away (rms), furthest "
        f"is deep with {100 * DEEP:.1f} cm; without foot IK" in page.text
    )


def test_a_comparison_shows_the_animation_every_system_and_the_capture(page, motions):
    (clip,) = page.data["clips"]
    labels = [skeleton["label"] for skeleton in clip["skeletons"]]
    assert labels == ["flat animation", "close", "deep", "captured"]
    assert clip["watched"] == "motion deep"
    assert [skeleton["worst"] is None for skeleton in clip["skeletons"]] == [False] * 3 + [True]
    assert page.elements.count("img") == 1 and len(page.html) < 1_000_000
    assert page.elements.count("script") == 2
    loads = {load for load in page.loads if not load.startswith("data:")}
    assert loads == {"compare.md", "compare.json", "compare.png"}
    assert {"h2 Limits of the data", "h2 What was asked"} <= set(page.headings)
    assert motions.accuracy["deep"].ankle == pytest.approx(DEEP)


def test_where_feet_are_furthest_off_is_the_worst_window(motions, compared):
    feet, _ = compared.animation.place(compared.clips["close"])
    gap = np.zeros((400, 2))
    gap[150:160, 0] = -0.3
    gap[30:60, 1] = 9.0  # a moving foot, which may be above the ground
    stance = np.zeros((400, 2), bool)
    height = np.repeat(gap[..., None], 2, axis=-1)
    feet = dataclasses.replace(feet, height=height, stance=stance)
    start, end = comparison_motions.worst_seconds(feet, 60.0)
    assert start <= 150 and end >= 159 and end - start == 120
    assert comparison_motions.worst_seconds(feet, 600.0) == (0, 399)


def test_limits_say_which_fault_is_worst(motions):
    placed = motions.motions["close"].placement
    pop = dataclasses.replace(placed.pop, value=0.0)
    still = dataclasses.replace(placed, sunk=0.0, floating=0.0, slide=-0.01, pop=pop)
    popping = dataclasses.replace(still, pop=dataclasses.replace(placed.pop, value=0.1))
    excess, words = compare_sentences.faults(popping)[0]
    assert excess == pytest.approx(2.0 / placed.size) and words.startswith("its feet pop by up to")
    assert compare_sentences.beyond({"a": still, "b": popping}) == ["b"]
    unknown = dataclasses.replace(still, sunk=math.nan, groundless=1.0)
    assert "no ground under 100.0 %" in compare_sentences.faults(unknown)[0].words


def test_no_system_is_praised_that_is_worse_than_the_animation(compared, motions):
    worse = {**motions.accuracy, "as animated": motions.accuracy["close"]}
    far = dataclasses.replace(motions, accuracy=worse)
    last = compare_sentences.findings(compared, far)[2]
    assert last.bad and last.text.startswith("No system comes closer to the captured motion")


def test_what_went_badly_comes_first_and_marks_are_not_html(tmp_path):
    StudyPage(
        kind="a test",
        title=HOSTILE,
        verdict="bad",
        good=False,
        findings=[Finding("good `a` **b**"), Finding("bad <i>", bad=True), Finding("good too")],
        sections=[Section("Table", [Grid([["x", "y"], ["1!", "2!"]], "numbers"), Text("`t`")])],
        asked=[["What", HOSTILE]],
    ).write(tmp_path)
    page = Page(tmp_path / run_folder.PAGE)
    assert "bad ◐ bad <i> good a b good too" in page.text
    assert "<li>good <code>a</code> <strong>b</strong></li>" in page.html
    assert '<td class="miss">2!</td>' in page.html and page.elements.count("script") == 2
    assert page.elements.count("canvas") == 0 and page.data == {"clips": []}


def test_pictures_become_small_enough_and_missing_ones_are_left_out(tmp_path, monkeypatch):
    noise = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    (picture,) = pictures.embed(tmp_path, {"noise.png": "noise", "no.png": "none"})
    assert (picture.width, picture.height) == (60, 40)
    monkeypatch.setattr(pictures, "MAX_BYTES", 1_000)
    (picture,) = pictures.embed(tmp_path, {"noise.png": "noise"})
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
        findings = runs_page.findings(runs)
        found = [finding.bad for finding in findings if finding.text.startswith(first)]
        assert len(findings) == 3 and found == [bad], first
