"""Blocks of frames left out: against the exact answer, and what is said of unreliable figures."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fitting.inference.sampling import blocks
from fitting.inference.sampling.blocks import BlockLogLikelihood

pytestmark = pytest.mark.skipif(not blocks.is_available(), reason="needs ArviZ")
OBSERVED = np.random.default_rng(1).normal(0.4, 1.0, 40)
SPREAD = 3.0  # of the prior of the mean


def posterior_of_mean(observed: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation, for noise of one and a normal prior about 0."""
    variance = 1 / (len(observed) + 1 / SPREAD**2)
    return variance * observed.sum(), math.sqrt(variance)


def log_likelihood(observed: np.ndarray, draws: int = 2000) -> BlockLogLikelihood:
    """Of values as blocks, for exact draws of the posterior of their mean."""
    mean, sd = posterior_of_mean(observed)
    means = np.random.default_rng(0).normal(mean, sd, draws)
    count = len(observed)
    return BlockLogLikelihood(
        values=stats.norm.logpdf(observed[None], means[:, None]),
        clip=np.repeat([1, 2], [count - 10, 10]),
        start=np.arange(count, dtype=float),
        end=np.arange(count) + 1.0,
        data="0123456789abcdef",
        efficiency=1.0,
    )


def test_blocks_left_out_get_their_exact_density():
    found = blocks.leave_one_out(log_likelihood(OBSERVED))
    assert found is not None
    exact = []
    for i in range(len(OBSERVED)):
        mean, sd = posterior_of_mean(np.delete(OBSERVED, i))
        exact.append(stats.norm.logpdf(OBSERVED[i], mean, math.hypot(sd, 1.0)))
    np.testing.assert_allclose(found.elpd_of_block, exact, atol=0.03)
    assert found.elpd == pytest.approx(np.sum(exact), abs=0.05)
    assert found.error == pytest.approx(math.sqrt(len(exact)) * np.std(exact), rel=0.05)
    assert found.parameters == pytest.approx(1.0, abs=0.3)
    assert found.unreliable == 0
    assert abs(found.neighbours) < 0.5


def test_a_block_on_which_the_fit_hangs_is_unreliable():
    observed = OBSERVED.copy()
    observed[7] = 60.0
    found = blocks.leave_one_out(log_likelihood(observed))
    assert found is not None
    assert found.pareto_k[7] > found.max_k and found.unreliable >= 1


def test_neighbours_in_different_clips_are_no_neighbours():
    values = np.array([1.0, 1.1, 0.9, 1.0, 5.0, 5.1, 4.9, 5.0])
    assert blocks._neighbours(values, np.repeat([1, 2], 4)) > 0.9  # of all, about one mean
    assert math.isnan(blocks._neighbours(values, np.arange(8)))


def test_a_handful_of_draws_or_one_block_says_nothing():
    few = log_likelihood(OBSERVED, blocks.MIN_DRAWS - 1)
    assert blocks.leave_one_out(few) is None
    whole = log_likelihood(OBSERVED)
    one = replace(whole, values=whole.values[:, :1], clip=whole.clip[:1])
    assert blocks.leave_one_out(one) is None


def test_without_arviz_nothing_is_said(monkeypatch):
    monkeypatch.setattr(blocks, "is_available", lambda: False)
    assert blocks.leave_one_out(log_likelihood(OBSERVED)) is None


def test_a_tree_gives_back_what_was_put_in():
    given = log_likelihood(OBSERVED)
    read = blocks.from_tree(blocks.to_tree(given))
    np.testing.assert_array_equal(read.values, given.values)
    for name in ("clip", "start", "end"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
    assert (read.data, read.efficiency) == (given.data, given.efficiency)
