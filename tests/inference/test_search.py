"""The search finds known parameters, says how it ended, and compiles once."""

import dataclasses
import functools
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from fitting.inference.optimise import descent, evolution, levenberg_marquardt, search
from fitting.inference.optimise.solution import (
    ROUNDING,
    Point,
    Report,
    Search,
    SearchSettings,
    SearchState,
    Solution,
    StepsUsedUp,
)
from fitting.problem.problem import Problem
from fitting.runtime.declarations import keys
from support import toy
from support.curves import CURVE_TRUTH, Curve, curve_problem
from support.problems import Fractions, compilations, problem_of_fractions
from support.watching import listening

TOLERANCE = 0.05  # fraction of the range within which a fit must recover the truth
WITH_THRESHOLD = ("height", "rate", "turn")


def errors(problem: Problem, values: np.ndarray, truth: dict[str, float]) -> np.ndarray:
    """Distance from the truth as a fraction of the range; NaN where there is no truth."""
    known = np.asarray([truth.get(name, np.nan) for name in problem.space.names])
    return np.abs(values - known) / np.asarray(problem.space.high - problem.space.low)


def cost_of(problem: Problem, u: np.ndarray | jax.Array) -> float:
    return float(problem.cost(jnp.asarray(u)))


@functools.cache
def solved_curve() -> Solution:
    return search.find_best_fit(curve_problem())


def test_thresholds_and_smooth_parameters_are_recovered():
    problem, solution = toy.solved()
    assert solution.converged, solution.message
    assert np.nanmax(errors(problem, solution.values, toy.TRUTH)) < TOLERANCE
    truth = np.asarray(problem.space.pack(toy.TRUTH))
    assert solution.cost <= cost_of(problem, truth)
    assert solution.cost == pytest.approx(cost_of(problem, solution.u))
    assert solution.cost_before == pytest.approx(cost_of(problem, np.asarray(problem.space.start)))


def test_the_jacobian_of_a_solution_is_the_problems_and_thresholds_have_only_their_prior():
    problem, solution = toy.solved()
    jacobian = np.asarray(eqx.filter_jit(problem.jacobian)(jnp.asarray(solution.u)))
    smooth = np.asarray(problem.space.smooth)
    for column in np.flatnonzero(smooth):
        atol = 1e-9 * np.abs(jacobian[:, column]).max()
        np.testing.assert_allclose(solution.jacobian[:, column], jacobian[:, column], atol=atol)
    assert not jacobian[: -problem.space.size, ~smooth].any()


def test_other_data_of_the_same_shape_compiles_nothing():
    toy.solved()
    problem = toy.make_problem(seed=1)
    with compilations() as compiled:
        search.find_best_fit(problem, SearchSettings(max_steps=40), starts=1)
        assert not compiled


def test_the_reports_name_the_stages_and_the_best_cost_never_rises():
    solution = toy.solved()[1]
    reports = solution.history
    stages = list(dict.fromkeys(report.stage for report in reports))
    assert (stages[0], stages[-1]) == ("start", "polish")
    assert {"descent", "evolution"} < set(stages)
    assert set(stages) <= {"start", "descent", "sweep", "evolution", "polish"}
    assert (np.diff([r.best for r in reports]) <= 1e-6).all()
    assert (np.diff([r.seconds for r in reports]) >= 0).all()
    order = [(r.start, r.step) for r in reports]
    assert order == sorted(order)
    last = {r.start: r.step for r in reports}
    assert len(last) == solution.starts and sum(last.values()) == solution.steps
    assert reports[-1].seconds <= solution.seconds


def test_an_interrupt_keeps_the_best_point():
    reports = []

    def interrupt_tenth_report(report: object) -> None:
        assert isinstance(report, Report)
        reports.append(report)
        if len(reports) == 10:
            raise KeyboardInterrupt

    problem = toy.make_problem()
    with listening(reported=interrupt_tenth_report):
        solution = search.find_best_fit(problem)
    assert not solution.converged
    assert solution.message.startswith("Interrupted after")
    assert solution.cost == min(report.best for report in reports) < solution.cost_before
    assert cost_of(problem, reports[-1].best_u) == pytest.approx(reports[-1].best)
    assert solution.cost == pytest.approx(cost_of(problem, solution.u))


@pytest.mark.parametrize("walls", [(-1.0, 2.1), (1.0, 9.0)], ids=["by the truth", "at the start"])
def test_a_region_where_residuals_are_not_finite_is_survived(walls):
    problem = curve_problem(walls=walls)
    solution = search.find_best_fit(problem)
    assert solution.converged, solution.message
    assert errors(problem, solution.values, CURVE_TRUTH).max() < TOLERANCE


def test_a_search_of_nothing_finite_or_of_too_few_steps_says_so():
    solution = search.find_best_fit(curve_problem(walls=(9.0, 9.0)))
    assert solution.message == "Not converged: no residuals are finite at any starting point."
    assert not solution.converged and solution.cost == np.inf
    solution = search.find_best_fit(toy.make_problem(), SearchSettings(max_steps=10), starts=1)
    assert solution.message == "Not converged: the 10 steps allowed for a start were used up."
    assert not solution.converged and solution.steps == 10
    assert solution.cost < solution.cost_before


def test_thresholds_alone_can_be_fitted():
    base = Curve(height=jnp.asarray(2.0), rate=jnp.asarray(3.0))
    problem = eqx.tree_at(lambda p: p.space.system, curve_problem(("turn",)), base)
    solution = search.find_best_fit(problem)
    assert solution.converged, solution.message
    assert errors(problem, solution.values, CURVE_TRUTH).max() < TOLERANCE


def valley(ik: Fractions, data: jax.Array) -> jax.Array:
    """Rosenbrock's curved valley of `u`, in which a descent turns and has steps rejected."""
    u = jnp.log(ik.x) - jnp.log1p(-ik.x)
    return data * jnp.stack([1 - u[0], u[1] - u[0] ** 2])


def march(
    model: levenberg_marquardt.HardModel, u: jax.Array, steps: int
) -> list[levenberg_marquardt.LMState]:
    """The states before and after each of our steps."""
    states = [levenberg_marquardt.begin(model, u)]
    for _ in range(steps):
        states.append(levenberg_marquardt.step(model, states[-1]))
    return states


def optimum(residuals, u: jax.Array, steps: int) -> jax.Array:
    """Where optimistix is after as many steps by itself."""
    solver = optx.LevenbergMarquardt(rtol=0.0, atol=0.0)
    return optx.least_squares(
        lambda u, _: residuals(u), solver, u, max_steps=steps, throw=False
    ).value


def test_steps_on_the_compressed_rows_are_those_of_optimistix_on_all_rows():
    problem = problem_of_fractions(2, jnp.asarray([1.0, 10.0]), valley)
    start = jnp.asarray((-1.2, 1.0))
    states = march(levenberg_marquardt.HardModel(problem, start), start, 20)
    for steps in (2, 20):
        expected = optimum(problem.residuals, start, steps)
        np.testing.assert_allclose(states[steps].u, expected, rtol=1e-9, err_msg=f"{steps}")
    accepted = [bool(state.accepted) for state in states[1:]]
    assert accepted[:2] == [True, True] and not all(accepted)
    last = states[-1]
    assert float(last.cost) < 0.1 * float(problem.cost(start))
    np.testing.assert_allclose(last.cost, problem.cost(last.u), rtol=1e-12)
    jacobian = levenberg_marquardt.problem_jacobian(last.jacobian)
    np.testing.assert_allclose(jacobian, problem.jacobian(last.u), rtol=1e-12)
    # A weak type in the state, say, would compile the second step anew.
    assert jax.tree.structure(states[0]) == jax.tree.structure(states[1])
    assert jax.tree.map(jax.typeof, states[0]) == jax.tree.map(jax.typeof, states[1])


def test_a_jacobian_is_computed_only_where_the_cost_is_low_enough():
    problem = curve_problem()
    u, cost = problem.space.start, problem.cost(problem.space.start)
    jacobian = eqx.filter_jit(lambda max_cost: problem.residuals_and_jacobian(u, max_cost)[1])
    np.testing.assert_allclose(jacobian(cost), problem.jacobian(u), rtol=1e-12)
    assert np.abs(jacobian(cost)).max() > 1
    assert not np.asarray(jacobian(0.99 * cost)).any()


@pytest.mark.parametrize("rows", [3, 5, 127, 128, 129, 20000])
def test_the_triangular_factor_has_the_gram_matrix_of_all_rows(rows):
    tall = np.random.default_rng(rows).normal(size=(rows, 5)) * [1.0, 1e-3, 1e3, 1.0, 1.0]
    triangle = np.asarray(levenberg_marquardt.triangular_factor(jnp.asarray(tall)))
    assert triangle.shape == (5, 5)
    np.testing.assert_array_equal(triangle, np.triu(triangle))
    np.testing.assert_allclose(triangle.T @ triangle, tall.T @ tall, rtol=1e-10, atol=1e-10)
    if rows >= 5:
        np.testing.assert_allclose(np.abs(triangle), np.abs(np.linalg.qr(tall, "r")), rtol=1e-8)
    program = str(jax.make_jaxpr(levenberg_marquardt.triangular_factor)(tall))
    shapes = re.findall(r"\[([\d,]+)\] = qr\[", program)
    # Of several blocks at once, threads that compute factors would wait for each other for ever.
    assert shapes and all(shape.count(",") == 1 for shape in shapes)


def test_the_descents_that_do_not_agree_count_too(monkeypatch):
    """Of three, one stops where it begins: two of three agree."""
    settings = SearchSettings(descents=3, draws=3, sweeps=0)
    problem = curve_problem(WITH_THRESHOLD)
    begin = np.asarray(problem.space.start)
    far = begin + np.asarray([0.0, -3.0, 0.0])
    points = [Point(u, cost_of(problem, u)) for u in (begin, far, begin)]
    monkeypatch.setattr(search, "starting_points", lambda of, state, first: (points, state))
    real = search.descend

    def descend(of, state, stage):
        return state if state.point is points[1] else real(of, state, stage)

    monkeypatch.setattr(search, "descend", descend)
    solution = search.find_best_fit(problem, settings)
    assert (solution.starts, solution.agreeing) == (3, 2)
    assert solution.message.startswith("Converged: 2 of 3 starts agree")


def test_starts_are_made_until_two_of_them_agree_and_one_alone_has_not_converged():
    """Descents that agree need neither evolution nor another start."""
    solution = solved_curve()
    assert (solution.starts, solution.agreeing) == (2, 2)
    assert {report.start for report in solution.history} == {0}
    assert "evolution" not in {report.stage for report in solution.history}
    one_descent = SearchSettings(descents=1)
    solution = search.find_best_fit(curve_problem(), one_descent)
    assert (solution.starts, solution.agreeing) == (2, 2)
    assert solution.message.startswith("Converged: 2 of 2 starts agree, and no further step")
    assert {report.start for report in solution.history} == {0, 1}
    assert solution.cost <= min(r.cost for r in solution.history) * (1 + ROUNDING)
    alone = search.find_best_fit(curve_problem(), one_descent, starts=1)
    assert not alone.converged
    assert alone.message == "Not converged: stopped at a local minimum, where the only start led."
    assert (alone.starts, alone.agreeing) == (1, 1)
    with pytest.raises(ValueError, match="starts is 0, wanted at least 1"):
        search.find_best_fit(curve_problem(), starts=0)


def test_at_least_two_starts_and_half_of_them_must_agree():
    settings = SearchSettings()
    for ends, count, enough in (
        ([10.0], 1, False),
        ([10.0, 12.9], 2, True),
        ([10.0, 13.1], 1, False),
        ([14.0, 10.0, 11.0], 2, True),
        ([14.0, 10.0, 20.0, 11.0], 2, True),
        ([14.0, 10.0, 20.0, 30.0, 11.0], 2, False),
        ([14.0, 10.0, 20.0, 10.5, 30.0, 11.0], 3, True),
        ([14.0, 14.1, 10.0], 1, False),
    ):
        assert search.count_agreeing(ends, settings) == count, ends
        assert search.agree(ends, settings) is enough, ends


def test_a_search_can_start_at_a_point_that_is_passed_in():
    problem, first = curve_problem(), np.asarray([2.0, 2.0])
    solution = search.find_best_fit(problem, first=first)
    assert solution.converged
    assert solution.cost == pytest.approx(solved_curve().cost, rel=1e-8)
    np.testing.assert_allclose(solution.values, solved_curve().values, rtol=1e-4)
    for found, begin in ((solution, first), (solved_curve(), problem.space.start)):
        assert found.history[0].cost == pytest.approx(cost_of(problem, begin), rel=1e-5)


def test_a_refined_solution_keeps_its_agreement_and_adds_its_effort():
    problem = curve_problem()
    rough = search.find_best_fit(problem, SearchSettings(min_step_gain=0.5, max_small_steps=1))
    refined = search.refine(problem, rough, rough.u)
    assert refined.cost < rough.cost
    assert refined.cost == pytest.approx(solved_curve().cost)
    assert (refined.starts, refined.agreeing) == (rough.starts, rough.agreeing)
    assert refined.converged == rough.agreed
    assert refined.history[: len(rough.history)] == rough.history
    polish = [sum(r.stage == "polish" for r in each.history) for each in (rough, refined)]
    assert refined.steps == rough.steps + polish[1] - polish[0]


def test_costs_of_candidates_agree_with_those_of_one_point():
    """They are computed with 32-bit floats, to a part in a hundred thousand."""
    problem = curve_problem(WITH_THRESHOLD)
    for dtype in ("float32", "float64"):
        candidates = problem.space.prior.draw(np.random.default_rng(1), 100).astype(dtype)
        costs = jax.jit(jax.vmap(problem.cost))(jnp.asarray(candidates, float))
        expected = np.where(np.isfinite(costs), costs, np.inf)
        rough = evolution.evaluate(problem, candidates).cost
        assert np.isfinite(expected).sum() > 50
        np.testing.assert_allclose(rough, expected, rtol=evolution.ROUNDING)


def test_a_search_keeps_the_type_of_its_numbers():
    problem = curve_problem(WITH_THRESHOLD)
    problem = jax.tree.map(lambda x: x.astype("float32"), problem)
    solution = search.find_best_fit(problem)
    assert solution.u.dtype == solution.jacobian.dtype == np.float32
    assert errors(problem, solution.values, CURVE_TRUTH).max() < TOLERANCE


# Stages on their own


def threshold_search(**settings) -> tuple[Search, SearchState]:
    """A search of a curve with a threshold, and its state at a wrong point."""
    problem = curve_problem(WITH_THRESHOLD)
    u = np.asarray(problem.space.start)
    return Search(problem, SearchSettings(**settings)), SearchState.at(u, cost_of(problem, u))


def evolve(search: Search, state: SearchState) -> SearchState:
    ends = [descent.descend(search, state, "descent").point]
    return evolution.evolve(search, dataclasses.replace(state, point=ends[0]), ends)


STAGES = {
    "descent": lambda search, state: descent.descend(search, state, "descent"),
    "polish": descent.polish,
    "evolution": evolve,
    "sweep": lambda search, state: evolution.sweep_and_descend(search, state, 1),
}


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_lowers_the_cost_and_does_the_same_when_called_again(name):
    search, state = threshold_search()
    space = search.problem.space
    first, second = (STAGES[name](search, state) for _ in range(2))
    assert first.best.cost < state.point.cost
    assert first.best.cost == pytest.approx(cost_of(search.problem, first.best.u))
    assert first.point.cost == second.point.cost
    np.testing.assert_array_equal(first.point.u, second.point.u)
    assert [line.cost for line in first.history] == [line.cost for line in second.history]
    assert state.history == ()
    before, after = (np.asarray(space.values(jnp.asarray(s.point.u))) for s in (state, first))
    if name in ("descent", "polish"):  # thresholds alone stay
        np.testing.assert_array_equal(after != before, space.smooth)
    if name == "evolution":  # it crosses the cliff
        turn = after[space.names.index("turn")]
        assert turn == pytest.approx(CURVE_TRUTH["turn"], abs=0.01)


def test_variations_keep_the_values_that_they_do_not_move():
    space = toy.make_problem().space
    random = np.random.default_rng(0)
    values = space.values(space.prior.draw(random, 20))
    moved = random.random(values.shape) < 0.3
    redrawn = (random.random(values.shape) < 0.1) & ~moved
    u = evolution.vary(space, values, 0.3 * moved, redrawn, random)
    kept = np.isclose(space.values(u), values, rtol=1e-9)
    alone = np.array([p.above is None for p in space.parameters])  # others may be pushed up
    np.testing.assert_array_equal(kept[:, alone], ~(moved | redrawn)[:, alone])


def test_a_stage_stops_without_sufficient_gain_or_when_the_steps_of_a_start_are_used_up():
    search, state = threshold_search(min_sweep_gain=1.0, max_steps=3)
    after = evolution.sweep(search, state)
    assert after.point is state.point
    assert after.sweeps == search.settings.sweep_tries
    with pytest.raises(StepsUsedUp) as caught:
        descent.descend(search, state, "descent")
    assert caught.value.state.steps == 3
    assert caught.value.state.best.cost < state.point.cost


def test_each_sweep_looks_in_the_widest_gap_that_the_sweeps_before_have_left():
    offsets: list[float] = []
    for number in range(40):
        offset = evolution.offset(number)
        assert 0 <= offset < 1
        if offsets:
            ends = np.sort([*offsets, min(offsets) + 1])  # once around
            gap = np.searchsorted(ends, offset + (offset < ends[0])) - 1
            assert np.diff(ends)[gap] > np.diff(ends).max() - 1e-9
        offsets.append(offset)


def test_a_setting_has_a_meaning_and_allows_its_default_and_only_its_kind_of_number():
    declared = keys(SearchSettings)
    assert list(declared) == [field.name for field in dataclasses.fields(SearchSettings)]
    for name, setting in declared.items():
        assert setting.meaning.endswith("."), name
    for name, value, allowed in (
        ("elite", 2.5, False), ("agreement", True, False), ("agreement", "wide", False),
        ("agreement", 1, True),
    ):  # fmt: skip
        assert declared[name].constraint.accepts(value) == allowed, value
    with pytest.raises(ValueError, match="max_steps is 0, wanted a whole number from 1 to 100000:"):
        SearchSettings(max_steps=0)
    with pytest.raises(ValueError, match="gauss_newton_children is 16, wanted less than the pop"):
        SearchSettings(population=16)
