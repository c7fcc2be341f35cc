"""Sentences and the picture about the worst two seconds."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from fitting.analysis.playback import Playback
from fitting.analysis.worst_window import find_worst_window
from fitting.report import worst_window_report
from fitting.report.plots import worst_window_plots
from fitting.report.plots.style import save
from support.playbacks import FRAMES, LEGS, error, playback


def describe(play: Playback) -> str:
    return " ".join(worst_window_report.describe(play, find_worst_window(play), LEGS))


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


@pytest.mark.parametrize(("weight", "state"), [(1.0, "stands"), (0.0, "swings")])
def test_the_text_says_whether_the_foot_stands_and_whether_its_target_was_in_reach(weight, state):
    stance, reached = np.ones((FRAMES, 2)), np.ones((FRAMES, 2))
    stance[123, 0] = weight
    reached[123:129, 0] = weight
    bent = error("knee", 123, 0.0, 0.1, 0.0, leg=0)
    text = describe(playback(bent, stance=stance, reached=reached))
    assert f"The foot {state} at that time, according to the captured contact labels." in text
    reach, part = ("within reach", "0 %") if weight else ("out of reach", "5 %")
    assert f"target of its ankle is {reach} then; targets are out of reach in {part} of" in text


def test_the_text_about_the_body_names_the_feet_that_stand_and_the_error_of_the_pelvis():
    contact = np.ones((FRAMES, 2))
    contact[:, 1] = 0.0
    unlabelled, unreached = np.zeros((FRAMES, 2)), np.zeros((FRAMES, 2))
    sunk = error("pelvis", slice(0, FRAMES), 0.0, 0.03, 0.0)
    text = describe(playback(sunk, stance=unlabelled, contact=contact, reached=unreached))
    assert "stand at that time, according to the system's contact weights: left." in text
    assert "The ankle's target is out of reach in 100 % of" in text
    assert "The pelvis is 3.0 cm too high on average." in text
    assert "No captured foot stands above known ground" in text


@pytest.mark.parametrize(("height", "side"), [(0.02, "in"), (-0.02, "above")])
def test_the_text_says_how_far_captured_soles_are_from_the_ground(height, side):
    stance = np.zeros((FRAMES, 2))
    stance[100:140, 1] = 1.0
    play = playback(error("ankle", 120, 0.0, 0.1, 0.0, leg=0), stance=stance)
    ground = play.ball_ground_ws + np.array([0.0, height, 0.0])
    ground[110, 1, 1] += height
    text = describe(dataclasses.replace(play, ball_ground_ws=ground))
    assert f"stand are 2.1 cm {side} the ground on average (2.1 cm rms; the right one" in text
    assert f"the right one 4.0 cm {side} it at 3.67 s)" in text


def test_an_acceleration_is_given_in_its_unit_and_a_perfect_fit_has_a_text_too():
    errors = np.zeros((FRAMES - 2, 2, 3))
    errors[149, 1] = [0.0, 30.0, 0.0]
    assert "30.0 m/s² off." in describe(playback({"smooth": errors}, sigmas={"smooth": 10.0}))
    assert "the residuals are 0.00 sigmas (rms)" in describe(playback())


def test_the_picture_shows_the_window_with_its_stances(tmp_path):
    stance, seen = np.zeros((FRAMES, 2)), np.ones(FRAMES, bool)
    stance[100:140, 1] = 1.0
    seen[130:133] = False
    play = playback(error("ankle", 120, 0.0, 0.1, 0.0, leg=0), seen=seen, stance=stance)
    window = find_worst_window(play)
    figure = worst_window_plots.worst_window(play, LEGS, window, "hill: the worst two seconds")
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
