"""How feet are placed on their ground, in words."""

import dataclasses
import json

import numpy as np
import pytest

from fitting.analysis.misplacement import Cause
from fitting.analysis.placement import Extreme, Placement
from fitting.report import placement_report

NAN = float("nan")
GOOD = Placement(
    sunk=0.01,
    floating=0.02,
    sunk_swing=0.03,
    sunk_frames=0.04,
    groundless=0.05,
    deepest=Extreme(0.031, 7, "left"),
    highest=Extreme(0.022, 8, "right"),
    slide=0.011,
    largest_slide=Extreme(0.044, 9, "left"),
    pop=Extreme(0.033, 10, "right"),
)
NOTHING = Extreme(NAN, 0, "left")
UNKNOWN = Placement(NAN, NAN, NAN, NAN, 1.0, NOTHING, NOTHING, NAN, NOTHING, NOTHING)


def test_the_table_says_how_often_how_far_and_where():
    heading, _, *rows = placement_report.text(GOOD).splitlines()
    assert heading == "feet and ground, 2 cm or more   frames  largest"
    assert rows == [
        "standing feet in the ground     1.0 %   3.1 cm, left, frame 7",
        "standing feet above the ground  2.0 %   2.2 cm, right, frame 8",
        "moving feet in the ground       3.0 %",
        "any foot in the ground          4.0 %",
        "no ground under the sole        5.0 %",
        "slide in a stance, median       1.1 cm  4.4 cm, left, frame 9",
        "pop in 1/60 s                           3.3 cm, right, frame 10",
    ]
    assert "nan" not in placement_report.text(UNKNOWN)


def test_feet_within_all_limits_are_no_warning():
    assert placement_report.warning_texts(GOOD, None) == []


def test_feet_off_the_ground_are_a_warning_with_frames_and_the_likely_cause():
    sunk = dataclasses.replace(GOOD, sunk=0.62)
    floor = "the root stays on the animation's floor where the ground rises (use --root"
    unit = "the terrain is in another unit of length: one of its units is 0.01 m"
    for cause, words in (
        (Cause("root"), floor),
        (Cause("units", 0.01), unit),
        (Cause("offset", -0.12), "all feet are 12 cm too low: check the clip's floor (--floor)"),
        (Cause("offset", 0.5), "all feet are 50 cm too high"),
        (Cause("missing"), "the terrain does not lie below the path"),
        (Cause("unknown"), "none of missing ground, units, root, floor and offset"),
    ):
        (text,) = placement_report.warning_texts(sunk, cause)
        assert "in the ground in 62.0 % of their frames (deepest: 3.1 cm, left, frame 7)" in text
        assert "above it in 2.0 % (highest: 2.2 cm, right, frame 8)" in text
        assert f"likely cause: {words}" in text


def test_missing_ground_slides_and_pops_are_warnings():
    (text,) = placement_report.warning_texts(UNKNOWN, Cause("missing"))
    assert text.startswith("there is no ground under 100.0 % of the soles; likely cause: ")
    bad = dataclasses.replace(GOOD, slide=0.05, pop=Extreme(0.124, 3, "left"))
    assert placement_report.warning_texts(bad, None) == [
        "standing feet slide by 5.0 cm a stance more than animated (most: 4.4 cm, left, frame 9)",
        "feet pop in 1/60 s (most: 12.4 cm, left, frame 3)",
    ]
    with pytest.warns(placement_report.PlacementWarning, match="^mec: feet pop in 1/60 s"):
        placement_report.warn(dataclasses.replace(bad, slide=0.0), None, "mec")


def test_what_is_unknown_is_null_in_json(tmp_path):
    numbers = json.loads(json.dumps(placement_report.numbers(UNKNOWN)))
    assert numbers["sunk"] is None and numbers["groundless"] == 1.0
    assert numbers["deepest"] == {"value": None, "frame": 0, "leg": "left"}
    assert np.isclose(placement_report.numbers(GOOD)["pop"]["value"], 0.033)
