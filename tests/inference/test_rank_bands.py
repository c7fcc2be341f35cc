"""The band of an ECDF holds uniform ranks as often as it says, and no ranks of wrong posteriors."""

import numpy as np
import pytest
from scipy import special

from fitting.inference.calibration.rank_bands import RankTest, count_band, cumulative_counts

DRAWS = 99


def ranks_of_normal_posteriors(
    random: np.random.Generator, count: int, *, width: float = 1.0, shift: float = 0.0
) -> np.ndarray:
    """Ranks of truths among draws of a normal posterior that has another width, or is shifted.

    The data are the truth plus standard noise under a flat prior, so that the right posterior is a
    standard normal around them.
    """
    truth = random.normal(size=(count, 1))
    data = truth + random.normal(size=(count, 1))
    draws = data + shift + width * random.normal(size=(count, DRAWS))
    return (draws < truth).sum(axis=1)


@pytest.mark.parametrize("count", [10, 60, 200])
@pytest.mark.parametrize("level", [0.8, 0.95, 0.99])
def test_whole_curves_of_uniform_ranks_lie_in_the_band_as_often_as_it_says(count, level):
    random = np.random.default_rng(1)
    low, high = count_band(count, DRAWS, level)
    ranks = random.integers(0, DRAWS + 1, (4000, count))
    counts = np.stack([cumulative_counts(row, DRAWS) for row in ranks])
    inside = ((low <= counts) & (counts <= high)).all(axis=1).mean()
    error = np.sqrt(level * (1 - level) * (1 / 4000 + 1 / 20_000))
    assert inside > level - 4 * error
    assert inside < level + 4 * error + 1.5 / count, "counts are whole, so the band errs outwards"


def test_the_band_is_wider_than_the_interval_of_each_place_alone():
    low, high = count_band(200, DRAWS, 0.95)
    places = np.arange(1, DRAWS + 1) / (DRAWS + 1)
    coverage = special.bdtr(high, 200, places) - special.bdtr(
        np.maximum(low - 1, 0), 200, places
    ) * (low > 0)
    assert coverage.min() > 0.95
    assert (low <= 200 * places).all() and (200 * places <= high).all()


@pytest.mark.parametrize(
    ("width", "shift"), [(0.5, 0.0), (2.0, 0.0), (1.0, 0.5), (1.0, -0.5)],
    ids=["too narrow", "too wide", "too high", "too low"],
)  # fmt: skip
def test_ranks_of_a_wrong_posterior_leave_the_band(width, shift):
    ranks = ranks_of_normal_posteriors(np.random.default_rng(2), 200, width=width, shift=shift)
    assert not RankTest(ranks, DRAWS, 0.95).inside


def test_ranks_of_a_right_posterior_stay_in_the_band():
    random = np.random.default_rng(3)
    tests = [
        RankTest(ranks_of_normal_posteriors(random, 200), DRAWS, 0.95).inside for _ in range(40)
    ]
    assert sum(tests) >= 34  # of 40; P(fewer) is 0.1 % at 95 %


def test_ecdf_band_and_histogram_count_what_they_say():
    test = RankTest(np.array([0, 0, 1, 3]), 3, 0.95)
    np.testing.assert_array_equal(test.places, [0.25, 0.5, 0.75])
    np.testing.assert_array_equal(test.ecdf, [0.5, 0.75, 0.75])
    np.testing.assert_array_equal(test.histogram(2), [3, 1])
    assert test.band.shape == (2, 3) and test.inside
    assert not RankTest(np.zeros(40, int), 3, 0.95).inside
