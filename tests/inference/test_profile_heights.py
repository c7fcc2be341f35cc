"""Heights of intervals: chi-square's, or higher beside a plateau that noise undercuts."""

import itertools

import numpy as np
import pytest
import scipy.stats

from fitting.inference.profiles.heights import RISE_OF_SMOOTH, level_of, max_rise
from fitting.problem.free_parameters import FreeParameter, free_parameter, from_fractions
from support import toy

U = np.concatenate([np.linspace(-6, 6, 241), np.linspace(-0.02, 0.02, 21)])
U = np.unique(U)


@pytest.fixture
def parameter() -> FreeParameter:
    return free_parameter(toy.Toy(), "body.gain")


def values_of(parameter: FreeParameter, u: np.ndarray) -> np.ndarray:
    return from_fractions(parameter, 1 / (1 + np.exp(-u)))


def test_heights_and_levels_of_a_parabola_are_those_of_chi_square(parameter):
    for sd, step in itertools.product((0.05, 0.3, 1.6), (0.3, 1.0)):
        u = 0.4 + sd * np.arange(-5, 5.1, step)  # few points suffice
        height = max_rise(parameter, values_of(parameter, u), 0.5 * ((u - 0.4) / sd) ** 2)
        assert RISE_OF_SMOOTH <= height < 1.1 * RISE_OF_SMOOTH, (sd, step)
    u = np.linspace(-3, 3, 31)
    for rise in (0.1, 0.5, 1.92, 4.0):
        level = level_of(parameter, values_of(parameter, u), 0.5 * (u / 0.5) ** 2, rise)
        assert level == pytest.approx(scipy.stats.chi2(1).cdf(2 * rise), abs=0.02)


def test_a_narrow_valley_does_not_exclude_a_wide_plateau(parameter):
    plateau = 3.0 + 0.5 * (U / 1.6) ** 2  # a prior
    narrow = 0.5 * (U / 0.005) ** 2
    rises = np.minimum(plateau, narrow)
    share_of_plateau = np.exp(-3) * 1.6 / (np.exp(-3) * 1.6 + 0.005)
    assert share_of_plateau > 0.9
    height = max_rise(parameter, values_of(parameter, U), rises)
    inside = scipy.stats.norm(scale=1.6).cdf(np.sqrt(2 * (height - 3)) * 1.6)
    assert share_of_plateau * (2 * inside - 1) + 1 - share_of_plateau == pytest.approx(
        0.95, abs=0.01
    )


def test_a_plateau_out_of_reach_changes_nothing(parameter):
    rises = np.minimum(12.0 + 0.5 * (U / 1.6) ** 2, 0.5 * (U / 0.005) ** 2)
    height = max_rise(parameter, values_of(parameter, U), rises)
    assert height == pytest.approx(RISE_OF_SMOOTH, rel=0.1)


def test_a_single_point_has_the_usual_height(parameter):
    assert max_rise(parameter, values_of(parameter, np.zeros(1)), np.zeros(1)) == RISE_OF_SMOOTH
