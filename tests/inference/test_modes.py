"""Posteriors with several modes: found, weighted, or said to be out of reach."""

import math

import emcee
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from fitting.inference.sample import diagnostics, modes, posterior, sampler
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.sample.posterior import Posterior, WalkerStart
from fitting.problem.problem import Problem
from support.problems import problem_of_fractions

CENTRES = np.array([-6.0, 6.0])  # of the modes, along the first parameter
WIDTHS = np.array([1.0, 0.3])
SPREAD = 1.6  # of the prior


def mixture(ik, log_weights):
    """Residuals whose half squares are minus the log-density of two normals, up to a constant."""
    u = jnp.log(ik.x) - jnp.log1p(-ik.x)
    place = jnp.zeros((2, u.size)).at[:, 0].set(CENTRES)
    squares = jnp.sum(((u - place) / WIDTHS[:, None]) ** 2, axis=1)
    log_density = jnp.logaddexp(*(log_weights - 0.5 * squares))
    return jnp.sqrt(2 * (jnp.max(log_weights) + 1 - log_density))[None]


def two_modes(size: int, weights: tuple[float, float]) -> Problem:
    """A problem whose posterior has modes with exactly these weights."""
    # A normal of this width times the prior has this integral.
    volumes = WIDTHS * stats.norm.pdf(0, 0, np.hypot(SPREAD, WIDTHS))
    drawn_to_prior = -0.5 * CENTRES**2 / (SPREAD**2 + WIDTHS**2)
    log_weights = np.log(weights) - size * np.log(volumes) - drawn_to_prior
    return problem_of_fractions(size, jnp.asarray(log_weights), mixture)


def start_of(size: int, first: int) -> WalkerStart:
    """Three quarters of the walkers in one mode, a quarter in the other."""
    u = np.zeros((2, size))
    precision = 1 / WIDTHS**2 + 1 / SPREAD**2
    u[:, 0] = CENTRES / WIDTHS**2 / precision
    return WalkerStart(u[first], np.full(size, 0.2), u[[1 - first]])


def sample(problem: Problem, start: WalkerStart, **settings) -> Posterior:
    return posterior.sample_posterior(problem, start, SamplerSettings(**settings))


@pytest.mark.slow
def test_modes_get_their_exact_weights_from_unbalanced_starts():
    settings = {"walkers": 24, "max_steps": 2000, "stop_at": 1e9}
    sampled = sample(two_modes(6, (0.2, 0.8)), start_of(6, 0), **settings)
    heavy, light = sampled.modes
    assert heavy.exchanges > 200 and light.exchanges > 200
    assert heavy.error < 0.025
    assert abs(heavy.weight - 0.8) < 4 * heavy.error
    assert light.weight == pytest.approx(1 - heavy.weight)
    there = sampled.draws_u[..., 0] > 0
    assert abs(there.mean() - 0.8) < 5 * heavy.error
    assert sampled.isolated == []
    assert heavy.median[0] > 0


@pytest.fixture
def no_jumps(monkeypatch) -> None:
    """Differential evolution alone."""
    monkeypatch.setattr(sampler, "moves", lambda chain: [(emcee.moves.DEMove(), 1.0)])


@pytest.mark.usefixtures("no_jumps")
def test_without_jumps_weights_are_out_of_reach_and_nothing_is_left_out():
    sampled = sample(two_modes(6, (0.8, 0.2)), start_of(6, 1), max_steps=600)
    assert not sampled.converged
    assert "the weights of modes are out of reach" in sampled.message
    assert sum(mode.walkers for mode in sampled.modes) == 24
    assert not any(mode.is_weighed for mode in sampled.modes)
    assert all(math.isnan(mode.error) for mode in sampled.modes)
    assert sampled.isolated == [] and sampled.draws.shape[1] == 24


def test_walkers_in_a_negligible_mode_come_home():
    sampled = sample(two_modes(6, (1 - 1e-9, 1e-9)), start_of(6, 0), stop_at=20.0)
    assert sampled.converged, sampled.message
    assert sampled.u[50, :, 0].max() > 5.0 and sampled.u[-500:, :, 0].max() < 0
    assert sampled.isolated == [] and sampled.modes == ()


@pytest.mark.usefixtures("no_jumps")
def test_a_walker_that_cannot_come_home_is_named_with_what_is_left_out(monkeypatch):
    balls = posterior._balls

    def one_apart(start, walkers):
        centres, widths = balls(WalkerStart(start.u, start.sd), walkers)
        centres[3] = start.elsewhere[0]
        return centres, widths

    monkeypatch.setattr(posterior, "_balls", one_apart)
    sampled = sample(two_modes(6, (1 - 1e-7, 1e-7)), start_of(6, 0), stop_at=20.0)
    assert sampled.isolated == [3] and 3 in sampled.stuck
    assert "left out: 1 of 24 walkers" in sampled.message
    assert sampled.converged, sampled.message
    assert sampled.isolated_mass < 1e-6
    assert sampled.draws.shape[1] == 23 and sampled.draws_u[..., 0].max() < 0


def test_low_walkers_with_much_room_are_not_left_out():
    random = np.random.default_rng(0)
    u = random.normal(size=(1000, 20, 3))
    log_probability = -0.5 * np.sum(u**2, axis=-1)
    u[:, 7] *= 1e4
    log_probability[:, 7] -= 15.0
    assert diagnostics.isolated_walkers(log_probability)[7]
    assert not diagnostics.check(u, log_probability).isolated.any()
    u[:, 7] /= 1e4
    check = diagnostics.check(u, log_probability)
    assert check.isolated.nonzero()[0].tolist() == [7]
    assert check.isolated_mass == pytest.approx(np.exp(-15.0), rel=0.2)


def test_lessons_are_powers_of_two_times_the_first():
    lengths = [sampler.lesson(stored, 1) for stored in (0, 99, 100, 199, 200, 399, 400, 6400)]
    assert lengths == [0, 0, 100, 100, 200, 200, 400, 6400]
    assert sampler.lesson(33, 3) == 0 and sampler.lesson(34, 3) == 34


@pytest.mark.parametrize("size", [1, 2, 6, 17])
def test_a_posterior_of_one_piece_has_one_mode_and_two_of_different_width_are_both_found(size):
    random = np.random.default_rng(size)
    draws = (150, 4 * max(size, 2), size)
    normal = random.normal(size=draws)
    for shape, u in {
        "normal": normal,
        "heavy tails": random.standard_t(3, size=draws),
        "ridge": 10 * random.normal(size=(*draws[:2], 1)) + random.normal(size=draws),
        "plateau": random.uniform(size=draws) ** 3,
    }.items():
        assert len(modes.find_modes(u)) == 1, shape
        assert modes.survey(u, np.zeros(draws[:2])) == (), shape
    few = draws[1] // 8
    many = draws[1] - few
    normal[:, :few] = 0.2 * normal[:, :few] + 15.0 * np.eye(size)[0]
    labels = modes.find_modes(normal).labels(normal)
    assert np.sort(np.bincount(labels.ravel())).tolist() == sorted([150 * few, 150 * many])
    small, large = modes.survey(normal, np.zeros(draws[:2]))[::-1]
    assert (small.exchanges, small.walkers, large.walkers) == (0, few, many)


def test_walkers_that_have_not_met_yet_or_never_move_are_not_modes():
    random = np.random.default_rng(0)
    u = 0.1 * random.normal(size=(100, 24, 6)) + 10.0 * random.normal(size=(24, 6))
    assert len(modes.find_modes(u)) == 1
    assert len(modes.find_modes(np.ones((50, 8, 2)))) == 1


def test_the_density_of_jumps_is_that_of_their_draws():
    found = modes.Modes(
        np.array([[0.0, 0.0], [9.0, 1.0]]),
        np.array([[[1.0, 0.0], [0.8, 0.5]], [[0.2, 0.0], [0.0, 2.0]]]),
        np.array([0.7, 0.3]),
    )
    u = found.draw(np.random.RandomState(0), 20_000)
    # Any density q has E[p / q] = 1 for a density p that it covers.
    log_constant = math.lgamma(3.5) - math.lgamma(2.5) - math.log(5 * math.pi)
    ratio = np.exp(stats.norm.logpdf(u).sum(axis=1) - found.log_density(u) - log_constant)
    assert ratio.mean() == pytest.approx(1.0, abs=4 * ratio.std() / len(u) ** 0.5)
    assert (found.labels(u[None])[0] == 1).mean() == pytest.approx(0.3, abs=0.02)
