"""Profiles against exact ones, verdicts, valleys and ridges."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from fitting.inference import identifiability
from fitting.inference.identifiability import Identifiability
from fitting.inference.optimisation import search
from fitting.inference.optimisation.solution import Solution
from fitting.inference.profiles import heights
from fitting.problem.free_parameters import to_fractions
from fitting.problem.problem import Problem
from fitting.runtime import threads
from support import toy
from support.problems import parameter, problem_of

NOISE = 0.05
TIME = jnp.linspace(0, 2, 400)
Assessed = tuple[Problem, Solution, Identifiability]


def residuals(ik, data: jax.Array) -> jax.Array:
    return ((ik.motion() - data) / NOISE).ravel()


def assessed(kind: type, truth: dict[str, float], seed: int) -> Assessed:
    """The profiles of a system with noisy data of the truth, from a search that begins there."""
    clean = kind(**{name: jnp.asarray(value) for name, value in truth.items()}).motion()
    data = clean + NOISE * np.random.default_rng(seed).normal(size=clean.shape)
    problem = problem_of(kind(), tuple(truth), jnp.asarray(data), residuals)
    first = np.asarray(problem.space.pack(truth))
    solution = search.find_best_fit(problem, starts=1, first=first)
    return problem, solution, identifiability.assess_identifiability(problem, solution)


# Exact profiles


COUPLED = ("body.gain", "body.drop", "body.rise", "foot.share", "foot.limit[0]", "foot.half_life")


@functools.cache
def coupled() -> Assessed:
    """Smooth parameters only, so that SciPy finds the exact profile."""
    problem = toy.make_problem(names=COUPLED)
    solution = search.find_best_fit(problem)
    return problem, solution, identifiability.assess_identifiability(problem, solution)


@functools.cache
def residuals_and_jacobian():
    problem = coupled()[0]
    return eqx.filter_jit(problem.residuals), eqx.filter_jit(problem.jacobian)


def exact_rise(held: int, place: float) -> float:
    """Of the lowest cost with one u held, by SciPy from the solution."""
    _, solution, _ = coupled()
    others = np.arange(len(solution.u)) != held
    residuals, jacobian = residuals_and_jacobian()

    def full(rest: np.ndarray) -> np.ndarray:
        u = np.full(len(others), place)
        u[others] = rest
        return u

    found = scipy.optimize.least_squares(
        lambda rest: np.asarray(residuals(full(rest))),
        solution.u[others],
        jac=lambda rest: np.asarray(jacobian(full(rest)))[:, others],  # type: ignore
        xtol=1e-12,
        ftol=1e-12,
    )
    return float(found.cost) - solution.cost


def test_a_profile_is_the_exact_one_where_the_cost_is_low():
    problem, _, report = coupled()
    for i, name in enumerate(COUPLED):
        curve = report.profiles[name]
        near = np.flatnonzero(curve.rises < 3 * curve.max_rise)
        assert len(near) >= 4
        for k in near:
            place = float(problem.space.pack(dict(zip(COUPLED, curve.path[k], strict=True)))[i])
            exact = exact_rise(i, place)
            assert curve.rises[k] == pytest.approx(exact, abs=0.05), (name, curve.values[k])


def test_the_ends_of_an_interval_are_where_the_exact_cost_has_risen_by_half_of_chi_square():
    problem, _, report = coupled()
    for i, name in enumerate(COUPLED):
        profile = report.profiles[name]
        assert profile.max_rise == pytest.approx(heights.RISE_OF_SMOOTH, rel=0.1)
        for end in profile.interval:
            exact = exact_rise(i, float(problem.space.pack({name: end})[i]))
            assert exact == pytest.approx(profile.max_rise, rel=0.05), (name, end)


# Verdicts


class Bumps(eqx.Module):
    """Two thresholds of which only the sum matters, one without effect, a square, a clamp."""

    first: jax.Array = parameter(0.5, "s", 0.0, 1.0, kind="threshold")
    second: jax.Array = parameter(0.5, "s", 0.0, 1.0, kind="threshold")
    lonely: jax.Array = parameter(0.5, "s", 0.0, 1.0, kind="threshold")
    square: jax.Array = parameter(0.6, "1", -1.0, 1.0)
    limit: jax.Array = parameter(0.5, "1", 0.0, 2.0)

    def motion(self) -> jax.Array:
        jump = jnp.where(TIME < self.first + self.second, 0.0, 0.3)
        clamped = jnp.minimum(TIME / 2, self.limit)  # up to 1
        return jnp.stack([jump, self.square**2 * TIME, clamped])


@functools.cache
def bumps(limit: float = 1.2) -> Assessed:
    truth = {"first": 0.4, "second": 0.7, "lonely": 0.5, "square": 0.6, "limit": limit}
    return assessed(Bumps, truth, 1)


@pytest.mark.parametrize("cores", [1, 3])
def test_profiles_are_the_same_on_any_number_of_cores(monkeypatch, cores):
    monkeypatch.setattr(threads, "usable_cores", lambda: cores)
    problem, solution, before = bumps()
    again = identifiability.assess_identifiability(problem, solution)
    for name, profile in before.profiles.items():
        np.testing.assert_array_equal(again.profiles[name].values, profile.values)
        np.testing.assert_array_equal(again.profiles[name].rises, profile.rises)


def test_every_parameter_has_a_profile_over_its_whole_range():
    problem, _, report = bumps()
    for free in problem.space.parameters:
        curve = report.profiles[free.name]
        places = to_fractions(free, curve.values)
        assert places[0] < 0.01 and places[-1] > 0.99
        assert 0 < np.diff(places).min() and np.diff(places).max() < 0.06
        assert curve.rises.min() == 0


def test_a_clamp_that_is_never_reached_is_one_sided():
    report = bumps()[2]
    limit = report.profiles["limit"]
    assert limit.verdict == "at least"
    assert limit.interval[0] == pytest.approx(1.0, abs=0.1)
    assert limit.interval[1] > 1.6  # the prior's doing
    assert "limit" in report.undetermined


def test_a_clamp_that_is_always_reached_is_two_sided():
    report = bumps(limit=0.6)[2]
    assert report.profiles["limit"].verdict == "two-sided"
    assert "limit" in report.determined
    assert report.interval[-1] == pytest.approx([0.6, 0.6], abs=0.03)


def test_a_parameter_without_effect_is_flat_and_has_the_interval_of_its_prior():
    report = bumps()[2]
    lonely = report.profiles["lonely"]
    assert lonely.verdict == "flat"
    assert report.contraction[2] == pytest.approx(0, abs=0.1)
    assert lonely.data_rises == pytest.approx(0, abs=0.2)


def test_two_valleys_are_listed_with_their_intervals_and_heights():
    report = bumps()[2]
    square = report.profiles["square"]
    assert square.verdict == "several valleys"
    left, right = square.valleys
    assert left.value == pytest.approx(-0.6, abs=0.03)
    assert right.value == pytest.approx(0.6, abs=0.03)
    assert right.rise == 0 < left.rise < heights.RISE_OF_SMOOTH
    for valley in square.valleys:
        assert valley.interval[0] < valley.value < valley.interval[1] < valley.interval[0] + 0.1
    assert "square" in report.undetermined


def test_an_exact_ridge_of_two_thresholds_leaves_both_undetermined():
    problem, _, report = bumps()
    for name in ("first", "second"):
        curve = report.profiles[name]
        assert name in report.undetermined
        low = curve.data_rises < heights.RISE_OF_THRESHOLD
        along = curve.path[low]
        assert np.ptp(curve.values[low]) > 0.7
        assert along[:, 0] + along[:, 1] == pytest.approx(1.1, abs=0.05)
    (ridge,) = report.ridges
    assert ridge.names == ("first", "second")
    assert ridge.coefficients == pytest.approx((1, 1), rel=0.1)
    assert ridge.describe({p.name: p for p in problem.space.parameters}) == "`first` + `second`"


# Cliffs


class LettingGo(eqx.Module):
    """What a foot remembers fades; at a threshold, at a whole frame, it lets go."""

    half_life: jax.Array = parameter(0.4, "s", 0.1, 1.0)
    release: jax.Array = parameter(0.3, "m", 0.0, 0.9, kind="threshold")

    def motion(self) -> jax.Array:
        remaining = 0.5 ** (TIME / self.half_life)
        return jnp.stack([0.3 * remaining, jnp.where(remaining > self.release, 1.0, 0.0)])


@pytest.mark.parametrize("seed", range(4))
def test_intervals_go_on_beyond_cliffs_along_which_parameters_move_together(seed):
    truth = {"half_life": 0.4, "release": 0.2 + 0.1 * seed}
    problem, _, report = assessed(LettingGo, truth, seed)
    fading, holding = np.asarray(problem.data)
    half_lives, releases = np.linspace(0.35, 0.45, 201), np.linspace(0, 0.9, 1801)
    remaining = 0.5 ** (np.asarray(TIME) / half_lives[:, None])
    of_fading = np.sum((0.3 * remaining - fading) ** 2, axis=1)
    # Of `held` frames, by their number: those are the first ones.
    of_holding = np.concatenate([[0.0], np.cumsum((1 - holding) ** 2 - holding**2)])
    held = np.array(
        [len(TIME) - np.searchsorted(row[::-1], releases, "right") for row in remaining]
    )
    exact = 0.5 * (of_fading[:, None] + of_holding[held]) / NOISE**2
    low = exact - exact.min() < heights.RISE_OF_SMOOTH
    alone = half_lives[low[:, np.argmin(exact.min(axis=0))]]
    ends = half_lives[low.any(axis=1)][[0, -1]]
    assert np.ptp(ends) > 1.5 * np.ptp(alone)  # along the cliff, the release has to follow
    assert report.profiles["half_life"].interval == pytest.approx(ends, abs=0.15 * np.ptp(ends))
