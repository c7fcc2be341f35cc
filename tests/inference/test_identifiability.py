"""How well the data determine parameters: intervals, bounds, correlations, missed minima."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.inference import identifiability
from fitting.inference.optimisation import population, search
from fitting.inference.optimisation.settings import SearchSettings
from fitting.problem import free_parameters
from fitting.problem.prior import SPREAD, ParameterPrior, Priors
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from support import toy

SEED = 5  # a toy clip that determines every threshold
UNINFORMATIVE = 2  # one in which the foot is always lifted before it is fast
TRUTH = np.asarray([toy.TRUTH.get(name, np.nan) for name in toy.NAMES])


def from_the_truth(seed: int, truth: dict[str, float]) -> tuple[Problem, search.Solution]:
    """A problem and its solution, found in a few steps since it starts at the truth."""
    problem = toy.make_problem(seed, truth=truth)
    start = np.clip(np.asarray(problem.space.pack(truth)), -5, 5)
    return problem, search.find_best_fit(
        problem, SearchSettings(max_steps=24), starts=1, first=start
    )


@pytest.fixture(scope="module")
def report() -> identifiability.Identifiability:
    return identifiability.assess_identifiability(*toy.solved(SEED))


def test_a_parameter_without_effect_is_undetermined(report):
    assert report.undetermined == ("foot.idle",)
    idle = report.names.index("foot.idle")
    assert report.contraction[idle] == pytest.approx(0, abs=0.01)
    assert report.sd[idle] == pytest.approx(SPREAD)
    assert report.eigenvalues[0] == pytest.approx(0, abs=1e-6)
    assert report.weakest == ("foot.idle",)


@pytest.mark.parametrize(
    "prior",
    [
        ParameterPrior("uniform"),
        ParameterPrior(),
        ParameterPrior(centre=0.2, spread=0.3),
        ParameterPrior(centre=0.9, spread=3.0),
    ],
)
@pytest.mark.parametrize("kind", ["smooth", "threshold"])
def test_a_parameter_without_effect_has_contraction_0_whatever_its_prior(prior, kind):
    ik = toy.Toy()
    parameters = [
        free_parameters.free_parameter(ik, "foot.idle", kind=kind),
        free_parameters.free_parameter(ik, "foot.share"),
    ]
    space = make_space(ik, parameters).with_prior(Priors(named={"foot.idle": prior}))
    problem = Problem(space, toy.make_data(ik, frames=60), toy.residuals)
    solution = search.find_best_fit(problem, SearchSettings(max_steps=24), starts=1)
    report = identifiability.assess_identifiability(problem, solution)
    assert report.contraction[0] == pytest.approx(0, abs=0.01)
    assert report.undetermined == ("foot.idle",)
    assert report.contraction[1] > 0.9


def test_intervals_contain_the_truth_of_nearly_all_parameters(report):
    known = np.isfinite(TRUTH)
    covered = (report.interval[:, 0] <= TRUTH) & (TRUTH <= report.interval[:, 1])
    assert covered[known].sum() >= known.sum() - 1
    assert (report.interval[:, 0] <= report.interval[:, 1]).all()


def test_a_threshold_has_the_interval_of_its_profile_and_no_standard_deviation(report):
    problem, solution = toy.solved(SEED)
    thresholds = np.asarray(problem.space.thresholds)
    np.testing.assert_array_equal(np.isnan(report.sd), thresholds)
    for i, name in enumerate(report.names):
        profile = report.profiles[name]
        assert tuple(report.interval[i]) == profile.interval
        assert profile.interval[0] <= solution.values[i] <= profile.interval[1]
        if thresholds[i]:
            width = profile.interval[1] - profile.interval[0]
            assert 0 < width < 0.2 * float(problem.space.high[i] - problem.space.low[i])
            low, high = profile.interval
            outside = (profile.values < low) | (profile.values > high)
            assert (profile.rises[outside] > profile.max_rise).all()


def test_the_laplace_sd_of_a_linear_parameter_is_the_least_squares_one(report):
    problem, solution = toy.solved(SEED)
    smooth = np.asarray(problem.space.smooth)
    jacobian = solution.jacobian[:, smooth]
    expected = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    np.testing.assert_allclose(report.sd[smooth], expected, rtol=1e-6)


def test_a_threshold_that_the_clip_never_reaches_has_a_wide_interval():
    i = toy.NAMES.index("lock.speed_off")
    report = identifiability.assess_identifiability(*from_the_truth(UNINFORMATIVE, toy.TRUTH))
    low, high = report.profiles["lock.speed_off"].interval
    assert high - low > 0.5 * 2.3
    assert low <= TRUTH[i] <= high
    assert "lock.speed_off" in report.undetermined


def test_a_fit_at_its_minimum_is_not_improved_by_its_profiles(report):
    assert report.improvement < 0.5


def test_a_fit_off_its_minimum_gets_the_lower_point():
    problem, solution = toy.solved(SEED)
    values = dict(zip(toy.NAMES, solution.values, strict=True)) | {"lock.height_on": 0.06}
    u = np.asarray(problem.space.pack(values))
    cost = float(population.evaluate(problem, u[None]).cost[0])
    moved = dataclasses.replace(
        solution, u=u, values=np.asarray(problem.space.values(jnp.asarray(u))), cost=cost
    )
    report = identifiability.assess_identifiability(problem, moved)
    assert report.improvement > 0.9 * (cost - solution.cost)
    assert report.best_cost == pytest.approx(cost - report.improvement)
    assert population.evaluate(problem, report.best_u[None]).cost[0] == pytest.approx(
        report.best_cost
    )


def test_a_value_at_its_bound_is_flagged():
    assert set(identifiability.assess_identifiability(*toy.solved(SEED)).at_bound) == {""}
    truth = toy.TRUTH | {"body.rise": 0.0, "foot.limit[1]": 0.1}
    flags = identifiability.assess_identifiability(*from_the_truth(SEED, truth)).at_bound
    named = {name: flag for name, flag in zip(toy.NAMES, flags, strict=True) if flag}
    assert named == {"body.rise": "low", "foot.limit[1]": "low"}


def test_parameters_with_the_same_effect_are_named_as_a_pair(report):
    assert report.correlated == ()
    problem, solution = toy.solved(SEED)
    idle, drop = (toy.NAMES.index(name) for name in ("foot.idle", "body.drop"))
    jacobian = solution.jacobian.copy()
    data = slice(0, -problem.space.size)
    jacobian[data, idle] = jacobian[data, drop]
    twin = identifiability.assess_identifiability(
        problem, dataclasses.replace(solution, jacobian=jacobian)
    )
    ((first, second, correlation),) = twin.correlated
    assert {first, second} == {"foot.idle", "body.drop"}
    assert correlation == pytest.approx(-1, abs=1e-3)


def test_a_jacobian_that_is_not_finite_is_refused():
    problem, solution = toy.solved(SEED)
    broken = dataclasses.replace(solution, jacobian=solution.jacobian * np.nan)
    with pytest.raises(ValueError, match="the Jacobian at the solution is not finite"):
        identifiability.assess_identifiability(problem, broken)
