"""How well the data determine parameters: intervals, bounds, correlations, missed minima."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.inference import identifiability
from fitting.inference.identifiability import Identifiability
from fitting.inference.optimisation import population, search
from fitting.inference.optimisation.settings import SearchSettings
from fitting.problem.free_parameters import free_parameter
from fitting.problem.prior import SPREAD, ParameterPrior, Priors
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from support import toy
from support.curves import curve_problem
from support.problems import Fractions, problem_of_fractions

UNINFORMATIVE = 2  # seed of a clip in which the foot is always lifted before it is fast
TRUTH = np.asarray([toy.TRUTH.get(name, np.nan) for name in toy.NAMES])


def assess(problem: Problem) -> Identifiability:
    solution = search.find_best_fit(problem, SearchSettings(max_steps=24), starts=1)
    return identifiability.assess_identifiability(problem, solution)


@pytest.fixture(scope="module")
def report() -> Identifiability:
    return identifiability.assess_identifiability(*toy.solved())


def test_a_parameter_without_effect_is_undetermined(report):
    assert report.undetermined == ("foot.idle",)
    idle = report.names.index("foot.idle")
    assert report.contraction[idle] == pytest.approx(0, abs=0.01)
    assert report.sd[idle] == pytest.approx(SPREAD)
    assert report.eigenvalues[0] == pytest.approx(0, abs=1e-6)
    assert report.weakest == ("foot.idle",)


def second_alone(ik: Fractions, data: jax.Array) -> jax.Array:
    return (ik.x[1:] - data) / jnp.asarray(0.02, data.dtype)


def sum_of_both(ik: Fractions, data: jax.Array) -> jax.Array:
    return (ik.x[:1] + ik.x[1:] - 2.0 * data) / jnp.asarray(0.02, data.dtype)


def of_two_fractions(residuals: Callable) -> Problem:
    return problem_of_fractions(2, jnp.asarray(0.4), residuals)


@pytest.mark.parametrize("kind", ["smooth", "threshold"])
def test_a_parameter_without_effect_has_contraction_0_whatever_its_prior(kind):
    problem = of_two_fractions(second_alone)
    ik = problem.space.system
    space = make_space(ik, [free_parameter(ik, "x[0]", kind=kind), free_parameter(ik, "x[1]")])
    for prior in (
        ParameterPrior("uniform"),
        ParameterPrior(),
        ParameterPrior(centre=0.2, spread=0.3),
        ParameterPrior(centre=0.9, spread=3.0),
    ):
        own = space.with_prior(Priors(named={"x[0]": prior}))
        report = assess(dataclasses.replace(problem, space=own))
        assert report.contraction[0] == pytest.approx(0, abs=0.01), prior
        assert report.undetermined == ("x[0]",), prior
        assert report.contraction[1] > 0.9, prior
        # At 0.4 a fraction rises by 0.24 for each unit of `u`, whose prior has the usual spread.
        information = (0.24 / 0.02 * SPREAD) ** 2
        assert report.eigenvalues[-1] == pytest.approx(information, rel=0.01), prior


def test_parameters_with_the_same_effect_are_named_as_a_pair(report):
    ((first, second, correlation),) = assess(of_two_fractions(sum_of_both)).correlated
    assert {first, second} == {"x[0]", "x[1]"}
    assert -1 < correlation < -0.98
    assert report.correlated == assess(of_two_fractions(second_alone)).correlated == ()


def test_intervals_contain_the_truth_of_nearly_all_parameters(report):
    known = np.isfinite(TRUTH)
    covered = (report.interval[:, 0] <= TRUTH) & (TRUTH <= report.interval[:, 1])
    assert covered[known].sum() >= known.sum() - 1
    assert (report.interval[:, 0] <= report.interval[:, 1]).all()


def test_a_threshold_has_the_interval_of_its_profile_and_no_standard_deviation(report):
    problem, solution = toy.solved()
    thresholds = np.asarray(problem.space.thresholds)
    np.testing.assert_array_equal(np.isnan(report.sd), thresholds)
    for i, name in enumerate(report.names):
        profile = report.profiles[name]
        low, high = profile.interval
        assert tuple(report.interval[i]) == (low, high)
        assert low <= solution.values[i] <= high
        if thresholds[i]:
            assert 0 < high - low < 0.2 * float(problem.space.high[i] - problem.space.low[i])
            outside = (profile.values < low) | (profile.values > high)
            assert (profile.rises[outside] > profile.max_rise).all()


def test_the_laplace_sd_of_a_linear_parameter_is_the_least_squares_one(report):
    problem, solution = toy.solved()
    smooth = np.asarray(problem.space.smooth)
    jacobian = solution.jacobian[:, smooth]
    expected = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    np.testing.assert_allclose(report.sd[smooth], expected, rtol=1e-6)


def test_values_at_bounds_and_a_threshold_that_the_clip_never_reaches_are_flagged(report):
    """The search takes a few steps since it starts at the truth."""
    truth = toy.TRUTH | {"body.rise": 0.0, "foot.limit[1]": 0.1}
    problem = toy.make_problem(UNINFORMATIVE, truth=truth)
    start = np.clip(np.asarray(problem.space.pack(truth)), -5, 5)
    solution = search.find_best_fit(problem, SearchSettings(max_steps=24), starts=1, first=start)
    flagged = identifiability.assess_identifiability(problem, solution)
    assert set(report.at_bound) == {""}
    named = {name: flag for name, flag in zip(toy.NAMES, flagged.at_bound, strict=True) if flag}
    assert named == {"body.rise": "low", "foot.limit[1]": "low"}
    low, high = flagged.profiles["lock.speed_off"].interval
    assert high - low > 0.5 * 2.3
    assert low <= truth["lock.speed_off"] <= high
    assert "lock.speed_off" in flagged.undetermined


def test_only_a_fit_off_its_minimum_gets_a_lower_point_from_its_profiles(report):
    assert report.improvement < 0.5
    problem = curve_problem(("height", "rate", "turn"))
    solution = search.find_best_fit(problem, starts=1)
    values = dict(zip(solution.names, solution.values, strict=True)) | {"turn": 0.6}
    u = np.asarray(problem.space.pack(values))
    cost = float(population.evaluate(problem, u[None]).cost[0])
    moved = dataclasses.replace(
        solution, u=u, values=np.asarray(problem.space.values(jnp.asarray(u))), cost=cost
    )
    lower = identifiability.assess_identifiability(problem, moved)
    assert lower.improvement > 0.9 * (cost - solution.cost) > 100
    assert lower.best_cost == pytest.approx(cost - lower.improvement)
    again = population.evaluate(problem, lower.best_u[None]).cost[0]
    assert again == pytest.approx(lower.best_cost)


def test_a_jacobian_that_is_not_finite_is_refused():
    problem, solution = toy.solved()
    broken = dataclasses.replace(solution, jacobian=solution.jacobian * np.nan)
    with pytest.raises(ValueError, match="the Jacobian at the solution is not finite"):
        identifiability.assess_identifiability(problem, broken)
