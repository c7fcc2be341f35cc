"""The worst two seconds of playbacks whose errors are known."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from fitting.analysis import worst_window
from fitting.analysis.playback import RESIDUAL_KINDS, Motion, Playback
from fitting.analysis.worst_window import find_worst_window
from fitting.problem.scene import Sigmas
from support.playbacks import FRAMES, SHAPES, error, playback


def test_the_worst_window_knows_every_kind_of_residual():
    sigmas = {field.name for field in dataclasses.fields(Sigmas)} - {"correlation"}
    assert set(SHAPES) == set(RESIDUAL_KINDS) == sigmas
    assert set(worst_window.PER_LEG) == set(RESIDUAL_KINDS) - {"pelvis", "body"}


def test_the_window_is_the_two_seconds_with_the_largest_residuals():
    errors = error("pelvis", slice(150, 200), 0.0, -0.06, 0.0)["pelvis"]
    errors += error("pelvis", slice(20, 80), 0.0, -0.02, 0.0)["pelvis"]
    window = find_worst_window(playback({"pelvis": errors}))
    assert window.end - window.start == 60 and window.start <= 150 and window.end >= 199
    # In 50 of 61 frames one of the fifteen residuals is three sigmas.
    assert window.rms == pytest.approx(np.sqrt(50 * 9 / (61 * 15)))
    assert window.clip_rms == pytest.approx(np.sqrt((50 * 9 + 60) / (FRAMES * 15)))
    assert window.fractions == {"pelvis": 1.0, "ankle": 0.0, "knee": 0.0}
    assert window.leg is None and window.size == pytest.approx(0.06)
    assert window.pelvis == pytest.approx(-0.06 * 50 / 61)


def shortened(value: Any) -> Any:
    """The first forty frames of what has some."""
    if isinstance(value, dict):
        return {name: shortened(each) for name, each in value.items()}
    if isinstance(value, Motion):
        return Motion(**shortened(vars(value)))
    is_series = isinstance(value, np.ndarray) and value.ndim and len(value) >= FRAMES - 2
    return value[: len(value) - FRAMES + 40] if is_series else value


def test_the_window_of_a_shorter_clip_is_the_whole_clip():
    long = playback(error("ankle", 5, 0.1, 0.0, 0.0, leg=0))
    short = Playback(**{name: shortened(value) for name, value in vars(long).items()})
    window = find_worst_window(short)
    assert (window.start, window.end, window.frame) == (0, 39, 5)


def test_frames_that_were_not_seen_do_not_count_however_large_their_errors():
    seen = np.ones(FRAMES, bool)
    seen[200:280] = False
    errors = error("ankle", slice(200, 280), 0.0, 5.0, 0.0, leg=1)["ankle"]
    errors += error("ankle", slice(60, 70), 0.0, 0.0, 0.04, leg=0)["ankle"]
    play = playback({"ankle": errors}, seen=seen)
    window = find_worst_window(play)
    assert window.start <= 60 and window.end >= 69 and window.leg == 0
    assert window.size == pytest.approx(0.04)
    # If a single seen frame were enough, the window around it would be the worst.
    single = dataclasses.replace(play, seen=seen | (np.arange(FRAMES) == 240))
    assert find_worst_window(single).start <= 60


def test_the_squares_are_divided_among_kinds_and_legs():
    errors = error("ankle", slice(100, 110), 0.0, 0.04, 0.0, leg=1)  # 40 squared sigmas
    errors |= error("knee", slice(100, 110), 0.0, 0.03, 0.0, leg=0)  # 10
    errors |= error("pelvis", slice(100, 110), 0.02, 0.0, 0.0)  # 10
    window = find_worst_window(playback(errors))
    assert list(window.fractions) == ["ankle", "knee", "pelvis"] and window.kind == "ankle"
    np.testing.assert_allclose(list(window.fractions.values()), [4 / 6, 1 / 6, 1 / 6])
    np.testing.assert_allclose(window.leg_fractions, [0.2, 0.8])


def test_targets_out_of_reach_are_counted_within_the_window():
    reached = np.ones((FRAMES, 2))
    reached[123:129, 0] = 0.0
    reached[200:300] = 0.0  # outside the window
    play = playback(error("knee", 123, 0.0, 0.1, 0.0, leg=0), reached=reached)
    assert find_worst_window(play).out_of_reach == pytest.approx(6 / 122)


@pytest.mark.parametrize("height", [0.02, -0.02])
def test_the_gap_of_captured_soles_is_measured_while_they_stand_in_the_window(height):
    stance = np.zeros((FRAMES, 2))
    stance[100:140, 1] = 1.0
    play = playback(error("ankle", 120, 0.0, 0.1, 0.0, leg=0), stance=stance)
    ground = play.ball_ground_ws + np.array([0.0, height, 0.0])
    ground[110, 1, 1] += height
    ground[200, 1, 1] += 9.0  # outside the window
    play = dataclasses.replace(play, ball_ground_ws=ground)
    window = find_worst_window(play)
    inside = np.arange(window.start, window.end + 1)
    count = int(np.sum((100 <= inside) & (inside < 140)))
    gap = window.sole_gap
    assert gap is not None and gap.frames == count
    assert gap.mean == pytest.approx(-height * (count + 1) / count)
    assert gap.rms == pytest.approx(0.02 * np.sqrt((count + 3) / count))
    assert (gap.largest, gap.frame, gap.leg) == (pytest.approx(-2 * height), 110, 1)
    groundless = dataclasses.replace(play, ball_grounded=np.zeros((FRAMES, 2)))
    assert find_worst_window(groundless).sole_gap is None


def test_an_acceleration_belongs_to_the_middle_of_its_three_frames():
    errors = np.zeros((FRAMES - 2, 2, 3))
    errors[149, 1] = [0.0, 30.0, 0.0]
    window = find_worst_window(playback({"smooth": errors}, sigmas={"smooth": 10.0}))
    assert (window.kind, window.frame, window.leg) == ("smooth", 150, 1)
    assert window.offset is None and window.size == 30.0


def test_a_perfect_fit_has_a_worst_window_too():
    window = find_worst_window(playback())
    assert window.rms == 0.0 and window.size == 0.0 and window.leg_fractions.sum() == 0.0
