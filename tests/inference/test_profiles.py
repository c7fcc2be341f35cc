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
from fitting.problem.free_parameters import free_parameter, to_fractions
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from fitting.runtime import threads
from jaxik.maths import parameter_tree
from support import toy

COUPLED = ("body.gain", "body.drop", "body.rise", "foot.share", "foot.limit[0]", "foot.half_life")
NOISE = 0.05


class Bumps(eqx.Module):
    """Two thresholds of which only the sum matters, one without effect, a square, a clamp."""

    first: jax.Array = parameter_tree.parameter(
        0.5, unit="s", low=0.0, high=1.0, kind="threshold", doc="First of the test rule."
    )
    second: jax.Array = parameter_tree.parameter(
        0.5, unit="s", low=0.0, high=1.0, kind="threshold", doc="Second of the test rule."
    )
    lonely: jax.Array = parameter_tree.parameter(
        0.5, unit="s", low=0.0, high=1.0, kind="threshold", doc="Lonely of the test rule."
    )
    square: jax.Array = parameter_tree.parameter(
        0.6, unit="1", low=-1.0, high=1.0, doc="Square of the test rule."
    )
    limit: jax.Array = parameter_tree.parameter(
        0.5, unit="1", low=0.0, high=2.0, doc="Limit of the test rule."
    )


BUMPS_TRUTH = {"first": 0.4, "second": 0.7, "lonely": 0.5, "square": 0.6, "limit": 1.2}
TIME = jnp.linspace(0, 2, 400)


def bumps(ik: Bumps) -> jax.Array:
    jump = jnp.where(TIME < ik.first + ik.second, 0.0, 0.3)
    clamped = jnp.minimum(TIME / 2, ik.limit)  # up to 1
    return jnp.stack([jump, ik.square**2 * TIME, clamped])


def bumps_residuals(ik: Bumps, data: jax.Array) -> jax.Array:
    return ((bumps(ik) - data) / NOISE).ravel()


@functools.cache
def bumps_assessed(**truth: float) -> tuple[Problem, Solution, Identifiability]:
    values = BUMPS_TRUTH | truth
    clean = bumps(Bumps(**{name: jnp.asarray(value) for name, value in values.items()}))
    data = clean + NOISE * np.random.default_rng(1).normal(size=clean.shape)
    base = Bumps()
    space = make_space(base, [free_parameter(base, name) for name in BUMPS_TRUTH])
    problem = Problem(space, jnp.asarray(data), bumps_residuals)
    solution = search.find_best_fit(problem, starts=1, first=np.asarray(space.pack(values)))
    return problem, solution, identifiability.assess_identifiability(problem, solution)


@functools.cache
def coupled() -> tuple[Problem, Solution, Identifiability]:
    """Smooth parameters only, so that SciPy finds the exact profile."""
    problem = toy.make_problem(5, names=COUPLED)
    solution = search.find_best_fit(problem)
    return problem, solution, identifiability.assess_identifiability(problem, solution)


@functools.cache
def residuals_of(problem_id: int):
    problem = coupled()[0]
    return eqx.filter_jit(problem.residuals), eqx.filter_jit(problem.jacobian)


def exact_cost(problem: Problem, u: np.ndarray, held: int, place: float) -> float:
    """Lowest cost with one u held, by SciPy from the solution."""
    others = np.arange(len(u)) != held
    residuals, jacobian = residuals_of(id(problem))

    def full(rest: np.ndarray) -> jax.Array:
        return jnp.asarray(u).at[jnp.flatnonzero(jnp.asarray(others))].set(rest).at[held].set(place)

    found = scipy.optimize.least_squares(
        lambda rest: np.asarray(residuals(full(rest))),
        u[others],
        jac=lambda rest: np.asarray(jacobian(full(rest)))[:, others],  # type: ignore
        xtol=1e-12,
        ftol=1e-12,
    )
    return float(found.cost)


@pytest.mark.parametrize("cores", [1, 3])
def test_profiles_are_the_same_on_any_number_of_cores(monkeypatch, cores):
    monkeypatch.setattr(threads, "usable_cores", lambda: cores)
    problem, solution, assessed = coupled()
    again = identifiability.assess_identifiability(problem, solution)
    for name, profile in assessed.profiles.items():
        np.testing.assert_array_equal(again.profiles[name].values, profile.values)
        np.testing.assert_array_equal(again.profiles[name].rises, profile.rises)


def test_a_profile_is_the_exact_one_where_the_cost_is_low():
    problem, solution, report = coupled()
    for i, name in enumerate(COUPLED):
        curve = report.profiles[name]
        near = np.flatnonzero(curve.rises < 3 * curve.max_rise)
        assert len(near) >= 4
        for k in near:
            place = float(problem.space.pack(dict(zip(COUPLED, curve.path[k], strict=True)))[i])
            exact = exact_cost(problem, solution.u, i, place) - solution.cost
            assert curve.rises[k] == pytest.approx(exact, abs=0.05), (name, curve.values[k])


def test_the_ends_of_an_interval_are_where_the_exact_cost_has_risen_by_half_of_chi_square():
    problem, solution, report = coupled()
    for i, name in enumerate(COUPLED):
        assert report.profiles[name].max_rise == pytest.approx(heights.RISE_OF_SMOOTH, rel=0.1)
        for end in report.profiles[name].interval:
            place = float(problem.space.pack({name: end})[i])
            exact = exact_cost(problem, solution.u, i, place) - solution.cost
            assert exact == pytest.approx(report.profiles[name].max_rise, rel=0.05), (name, end)


def test_every_parameter_has_a_profile_over_its_whole_range():
    problem, _, report = bumps_assessed()
    for parameter in problem.space.parameters:
        curve = report.profiles[parameter.name]
        places = to_fractions(parameter, curve.values)
        assert places[0] < 0.01 and places[-1] > 0.99
        assert np.diff(places).max() < 0.06
        assert (np.diff(places) > 0).all()
        assert curve.rises.min() == 0


def test_a_clamp_that_is_never_reached_is_one_sided():
    report = bumps_assessed()[2]
    limit = report.profiles["limit"]
    assert limit.verdict == "at least"
    assert limit.interval[0] == pytest.approx(1.0, abs=0.1)
    assert limit.interval[1] > 1.6  # the prior's doing
    assert "limit" in report.undetermined


def test_a_clamp_that_is_always_reached_is_two_sided():
    report = bumps_assessed(limit=0.6)[2]
    assert report.profiles["limit"].verdict == "two-sided"
    assert "limit" in report.determined
    assert report.interval[-1] == pytest.approx([0.6, 0.6], abs=0.03)


def test_a_parameter_without_effect_is_flat_and_has_the_interval_of_its_prior():
    report = bumps_assessed()[2]
    lonely = report.profiles["lonely"]
    assert lonely.verdict == "flat"
    assert report.contraction[2] == pytest.approx(0, abs=0.1)
    assert lonely.data_rises == pytest.approx(0, abs=0.2)


def test_two_valleys_are_listed_with_their_intervals_and_heights():
    report = bumps_assessed()[2]
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
    problem, _, report = bumps_assessed()
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

    half_life: jax.Array = parameter_tree.parameter(
        0.4, unit="s", low=0.1, high=1.0, doc="Half-life of the test rule."
    )
    release: jax.Array = parameter_tree.parameter(
        0.3, unit="m", low=0.0, high=0.9, kind="threshold", doc="Release of the test rule."
    )


def letting_go(ik: LettingGo) -> jax.Array:
    remaining = 0.5 ** (TIME / ik.half_life)
    return jnp.stack([0.3 * remaining, jnp.where(remaining > ik.release, 1.0, 0.0)])


def letting_go_residuals(ik: LettingGo, data: jax.Array) -> jax.Array:
    return ((letting_go(ik) - data) / NOISE).ravel()


@pytest.mark.parametrize("seed", range(4))
def test_intervals_go_on_beyond_cliffs_along_which_parameters_move_together(seed):
    truth = {"half_life": 0.4, "release": 0.2 + 0.1 * seed}
    clean = letting_go(LettingGo(**{name: jnp.asarray(value) for name, value in truth.items()}))
    data = clean + NOISE * np.random.default_rng(seed).normal(size=clean.shape)
    base = LettingGo()
    space = make_space(base, [free_parameter(base, name) for name in truth])
    problem = Problem(space, data, letting_go_residuals)
    solution = search.find_best_fit(problem, starts=1, first=np.asarray(space.pack(truth)))
    report = identifiability.assess_identifiability(problem, solution)
    half_lives = np.linspace(0.35, 0.45, 201)
    releases = np.linspace(0, 0.9, 1801)

    @jax.jit
    def costs(half_life: jax.Array) -> jax.Array:
        def cost(release: jax.Array) -> jax.Array:
            residuals = letting_go_residuals(LettingGo(half_life, release), data)
            return 0.5 * jnp.sum(residuals**2)

        return jax.lax.map(cost, jnp.asarray(releases), batch_size=100)

    exact = np.asarray([costs(jnp.asarray(half_life)) for half_life in half_lives])
    low = exact - exact.min() < heights.RISE_OF_SMOOTH
    alone = half_lives[low[:, np.argmin(exact.min(axis=0))]]
    ends = half_lives[low.any(axis=1)][[0, -1]]
    assert np.ptp(ends) > 1.5 * np.ptp(alone)  # along the cliff, the release has to follow
    assert report.profiles["half_life"].interval == pytest.approx(ends, abs=0.15 * np.ptp(ends))
