"""Offsets of a capture that its motion shows, and none where it does not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fitting.studies.fit import capture_check

FPS = 30.0
STANCES = 12
FRAMES = STANCES * 20


def standing(height: float, scatter: float, tilt: float = 0.0) -> tuple[np.ndarray, ...]:
    """Gaps, places and labels of feet that stand in turn along z, 0.6 m on at each stance."""
    noise = np.random.default_rng(3).normal(0.0, scatter, STANCES)
    stance, gap = np.zeros((FRAMES, 2), bool), np.full((FRAMES, 2), 0.15)
    places = np.zeros((FRAMES, 2, 2))
    for step in range(STANCES):
        frames, leg, along = slice(20 * step, 20 * step + 15), step % 2, 0.6 * step
        stance[frames, leg] = True
        gap[frames, leg] = height + noise[step] + np.tan(tilt) * (along - 0.3 * (STANCES - 1))
        places[frames, leg] = [0.1 * (1 - 2 * leg), along]
    return gap, places, stance


@pytest.mark.parametrize(
    ("made", "height", "tilt"),
    [
        ((0.029, 0.004), 0.029, 0.0),
        ((-0.029, 0.004), -0.029, 0.0),
        ((0.010, 0.002), 0.0, 0.0),  # too small to be seen
        ((0.029, 0.030), 0.0, 0.0),  # it scatters as much
        ((0.000, 0.004), 0.0, 0.0),
        ((0.029, 0.003, 0.02), 0.029, 0.02),
        ((0.000, 0.030, 0.02), 0.0, 0.0),
    ],
)
def test_an_offset_of_the_ground_is_seen_where_it_is_clear(made, height, tilt):
    found = capture_check.measure_ground(*standing(*made))
    assert found.stances == STANCES
    assert found.height == pytest.approx(height, abs=0.004)
    assert found.tilt_z == pytest.approx(tilt, abs=0.002) and abs(found.tilt_x) < 0.005
    gap, places, stance = standing(*made)
    gap[20:] = np.nan  # there is no ground but under the first stance
    assert capture_check.measure_ground(gap, places, stance).height == 0.0


def playback(late: float, noise: float = 0.0, offset: float = 0.0) -> Any:
    """Ankles that go to and fro, and their capture."""
    time = np.arange(90) / FPS

    def ankle(time: np.ndarray) -> np.ndarray:
        swing = 0.3 * np.sin(2 * np.pi * time[:, None] + np.array([0.0, np.pi]))
        return np.stack([0 * swing, 0.1 * np.abs(swing), swing], axis=-1)

    captured = ankle(time - late) + np.random.default_rng(2).normal(0, noise, (90, 2, 3)) + offset
    return SimpleNamespace(
        dt=np.full(90, 1 / FPS),
        after=SimpleNamespace(ankle=ankle(time)),
        captured=SimpleNamespace(ankle=captured),
        seen=np.ones(90, bool),
        held_out=np.zeros(90, bool),
        present=np.ones(2),
    )


@pytest.mark.parametrize(
    ("made", "wanted"),
    [
        ((0.05,), 0.05),
        ((-0.05, 0.005, 0.03), -0.05),
        ((0.0, 0.01), 0.0),
        ((0.0, 0.0, 0.05), 0.0),  # an offset is not a lag
        ((0.008,), 0.0),  # a quarter of a frame
        ((0.02, 0.2), 0.0),  # hidden in noise
    ],
)
def test_a_capture_is_late_where_the_ankles_say_so(made, wanted):
    assert capture_check.measure_lag(playback(*made)) == pytest.approx(wanted, abs=0.004)
