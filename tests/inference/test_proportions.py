"""Bounds of probabilities, against SciPy's tests and by simulation."""

import numpy as np
import pytest
from scipy import stats

from fitting.inference.calibration.proportions import clopper_pearson, proportion


@pytest.mark.parametrize(("hits", "total"), [(0, 7), (7, 7), (59, 60), (3, 10)])
@pytest.mark.parametrize("level", [0.8, 0.95])
def test_bounds_are_those_of_scipy_s_exact_test(hits, total, level):
    expected = stats.binomtest(hits, total).proportion_ci(level, method="exact")
    assert clopper_pearson(hits, total, level) == pytest.approx(tuple(expected))


def test_nothing_is_known_without_cases():
    nothing = proportion(np.ones((3, 2), bool), np.zeros((3, 2), bool), level=0.95)
    assert (nothing.hits, nothing.total, nothing.low, nothing.high) == (0, 0, 0.0, 1.0)
    assert np.isnan(nothing.fraction) and nothing.inside


def test_only_what_counts_is_counted():
    hits, counted = np.array([[True, False], [True, True]]), np.array([[True, True], [False, True]])
    some = proportion(hits, counted, level=0.95)
    assert (some.hits, some.total) == (2, 3)


def test_a_share_is_inside_if_its_bounds_meet_what_is_wanted():
    hits = (np.arange(100) < 76)[:, None]
    assert not proportion(hits, level=0.95, wanted=(0.95, 0.95)).inside
    assert proportion(hits, level=0.95, wanted=(0.7, 0.7)).inside
    assert not proportion(hits, level=0.95, wanted=(0.0, 0.5)).inside
    assert proportion(hits, level=0.95, wanted=(0.8, 1.0)).inside


@pytest.mark.parametrize("copies", [1, 8], ids=["independent", "all the same"])
def test_bounds_hold_however_the_quantities_of_a_replicate_depend_on_each_other(copies):
    """Bounds for 8 times 50 independent cases would hold in half of the repetitions only."""
    random = np.random.default_rng(4)
    held = []
    for _ in range(600):
        own = random.random((50, 8 // copies)) < 0.8
        found = proportion(np.repeat(own, copies, axis=1), level=0.95, wanted=(0.8, 0.8))
        held.append(found.inside)
    assert np.mean(held) > 0.93


def test_one_replicate_says_as_much_as_one_case():
    one = proportion(np.ones((1, 5), bool), level=0.95)
    assert (one.low, one.high) == clopper_pearson(1, 1, 0.95)
