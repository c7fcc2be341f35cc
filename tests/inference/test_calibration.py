"""Bounds of shares, against SciPy's tests, and bands of ranks: by simulation."""

import numpy as np
import pytest
from scipy import stats

from fitting.inference.proportions import (
    RankTest,
    clopper_pearson,
    count_band,
    cumulative_counts,
    proportion,
)

# Shares


def test_bounds_are_those_of_scipys_exact_test():
    for hits, total in ((0, 7), (7, 7), (59, 60), (3, 10)):
        for level in (0.8, 0.95):
            expected = stats.binomtest(hits, total).proportion_ci(level, method="exact")
            bounds = clopper_pearson(hits, total, level)
            assert bounds == pytest.approx(tuple(expected)), (hits, total, level)


def test_only_what_counts_is_counted_and_one_replicate_says_as_much_as_one_case():
    hits, counted = np.array([[True, False], [True, True]]), np.array([[True, True], [False, True]])
    some = proportion(hits, counted, level=0.95)
    assert (some.hits, some.total) == (2, 3)
    nothing = proportion(hits, np.zeros((2, 2), bool), level=0.95)
    assert (nothing.hits, nothing.total, nothing.low, nothing.high) == (0, 0, 0.0, 1.0)
    assert np.isnan(nothing.fraction) and nothing.inside
    replicate = proportion(np.ones((1, 5), bool), level=0.95)
    assert (replicate.low, replicate.high) == clopper_pearson(1, 1, 0.95)


def test_a_share_is_inside_if_its_bounds_meet_what_is_wanted():
    hits = (np.arange(100) < 76)[:, None]
    wanted = {(0.95, 0.95): False, (0.7, 0.7): True, (0.0, 0.5): False, (0.8, 1.0): True}
    for share, inside in wanted.items():
        assert proportion(hits, level=0.95, wanted=share).inside == inside, share


@pytest.mark.parametrize("copies", [1, 8], ids=["independent", "all the same"])
def test_bounds_hold_however_the_quantities_of_a_replicate_depend_on_each_other(copies):
    """Bounds for 8 times 50 independent cases would hold in half of the repetitions only."""
    random = np.random.default_rng(4)
    held = []
    for _ in range(600):
        own = random.random((50, 8 // copies)) < 0.8
        hits = np.repeat(own, copies, axis=1)
        held.append(proportion(hits, level=0.95, wanted=(0.8, 0.8)).inside)
    assert np.mean(held) > 0.93


# Ranks of truths among draws

DRAWS = 99


def ranks_of_normal_posteriors(
    random: np.random.Generator, *, width: float = 1.0, shift: float = 0.0
) -> np.ndarray:
    """Of 200 truths in normal posteriors that have another width, or are shifted.

    The data are the truth plus standard noise under a flat prior, so that the right posterior is a
    standard normal around them.
    """
    truth = random.normal(size=(200, 1))
    data = truth + random.normal(size=(200, 1))
    draws = data + shift + width * random.normal(size=(200, DRAWS))
    return (draws < truth).sum(axis=1)


def test_whole_curves_of_uniform_ranks_lie_in_the_band_as_often_as_it_says():
    for count in (10, 60, 200):
        ranks = np.random.default_rng(1).integers(0, DRAWS + 1, (4000, count))
        counts = np.stack([cumulative_counts(row, DRAWS) for row in ranks])
        for level in (0.8, 0.95, 0.99):
            low, high = count_band(count, DRAWS, level)
            inside = ((low <= counts) & (counts <= high)).all(axis=1).mean()
            error = np.sqrt(level * (1 - level) * (1 / 4000 + 1 / 20_000))
            assert inside > level - 4 * error, (count, level)
            # Counts are whole, so the band errs outwards.
            assert inside < level + 4 * error + 1.5 / count, (count, level)


def test_ranks_of_a_right_posterior_stay_in_the_band_and_those_of_wrong_ones_leave_it():
    random = np.random.default_rng(3)
    tests = [RankTest(ranks_of_normal_posteriors(random), DRAWS, 0.95).inside for _ in range(40)]
    assert sum(tests) >= 34  # of 40; P(fewer) is 0.1 % at 95 %
    for width, shift in ((0.5, 0.0), (2.0, 0.0), (1.0, 0.5), (1.0, -0.5)):
        ranks = ranks_of_normal_posteriors(random, width=width, shift=shift)
        assert not RankTest(ranks, DRAWS, 0.95).inside, (width, shift)


def test_ecdf_band_and_histogram_count_what_they_say():
    test = RankTest(np.array([0, 0, 1, 3]), 3, 0.95)
    np.testing.assert_array_equal(test.places, [0.25, 0.5, 0.75])
    np.testing.assert_array_equal(test.ecdf, [0.5, 0.75, 0.75])
    np.testing.assert_array_equal(test.histogram(2), [3, 1])
    assert test.band.shape == (2, 3) and test.inside
    assert not RankTest(np.zeros(40, int), 3, 0.95).inside
