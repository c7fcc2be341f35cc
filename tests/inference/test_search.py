"""The search finds known parameters, says how it ended, and compiles once."""

import dataclasses
import functools
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from fitting.inference import settings
from fitting.inference.optimisation import (
    descent,
    evolution,
    levenberg_marquardt,
    models,
    population,
    search,
    sweep,
)
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.optimisation.state import ROUNDING, Point, Search, SearchState, StepsUsedUp
from fitting.problem.problem import Problem
from support import toy
from support.curves import CURVE_TRUTH, Curve, curve_problem

CLIPS = (1, 5)  # seeds of toy clips that determine every threshold
TOLERANCE = 0.05  # fraction of the range within which a fit must recover the truth


def errors(problem: Problem, values: np.ndarray, truth: dict[str, float]) -> np.ndarray:
    """Distance from the truth as a fraction of the range; NaN where there is no truth."""
    known = np.asarray([truth.get(name, np.nan) for name in problem.space.names])
    return np.abs(values - known) / np.asarray(problem.space.high - problem.space.low)


def cost_of(problem: Problem, u: np.ndarray) -> float:
    return float(problem.cost(jnp.asarray(u)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", CLIPS)
def test_thresholds_and_smooth_parameters_are_recovered(seed):
    problem, solution = toy.solved(seed)
    assert solution.converged, solution.message
    assert np.nanmax(errors(problem, solution.values, toy.TRUTH)) < TOLERANCE
    truth = np.asarray(problem.space.pack(toy.TRUTH))
    assert solution.cost <= cost_of(problem, truth)
    assert solution.cost == pytest.approx(cost_of(problem, solution.u))
    assert solution.cost_before == pytest.approx(cost_of(problem, np.asarray(problem.space.start)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", CLIPS)
def test_the_jacobian_agrees_with_finite_differences(seed):
    problem, solution = toy.solved(seed)
    step = 1e-6
    moves = step * np.eye(problem.space.size)
    residuals = eqx.filter_jit(lambda problem, u: jax.vmap(problem.residuals)(u))
    ahead, behind = (
        np.asarray(residuals(problem, jnp.asarray(solution.u + sign * moves))) for sign in (1, -1)
    )
    differences = (ahead - behind).T / (2 * step)
    for i, smooth in enumerate(problem.space.smooth):
        if smooth:
            size = np.abs(differences[:, i]).max()
            np.testing.assert_allclose(
                solution.jacobian[:, i], differences[:, i], atol=1e-5 * size, rtol=1e-4
            )


def test_another_start_finds_the_same_optimum_of_the_same_cost():
    problem = curve_problem()
    moved = eqx.tree_at(
        lambda p: p.space, problem, problem.space.with_start({"height": 0.4, "rate": 5.0})
    )
    first, second = search.find_best_fit(problem), search.find_best_fit(moved)
    assert first.history[0].cost != pytest.approx(second.history[0].cost, rel=0.01)
    assert first.cost == pytest.approx(second.cost, rel=1e-8)
    np.testing.assert_allclose(first.values, second.values, rtol=1e-4)


@pytest.mark.slow
def test_the_column_of_a_threshold_holds_only_its_prior():
    problem, solution = toy.solved(CLIPS[0])
    jacobian = eqx.filter_jit(lambda u: problem.jacobian(u))(jnp.asarray(solution.u))
    of_data = np.asarray(jacobian)[: -problem.space.size]
    assert not of_data[:, np.asarray(problem.space.thresholds)].any()


def test_other_data_of_the_same_shape_compiles_nothing():
    toy.solved(CLIPS[0])
    problem = toy.make_problem(CLIPS[1])
    compiled = []

    def listen(event: str, duration_secs: float, **_) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        search.find_best_fit(problem, SearchSettings(max_steps=40))
        assert not compiled
        jax.jit(lambda x: x + 1)(1.0)  # the listener does hear a compilation
        assert compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_the_reports_name_the_stages_and_the_best_cost_never_rises():
    solution = toy.solved(CLIPS[0])[1]
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
    best_costs, best_points = [], []

    def interrupt_tenth_report(report: search.Progress) -> None:
        assert isinstance(report, search.Report)
        best_costs.append(report.best)
        best_points.append(report.best_u)
        if len(best_costs) == 10:
            raise KeyboardInterrupt

    problem = toy.make_problem(CLIPS[0])
    solution = search.find_best_fit(problem, progress=interrupt_tenth_report)
    assert not solution.converged
    assert solution.message.startswith("Interrupted after")
    assert solution.cost == min(best_costs) < solution.cost_before
    assert cost_of(problem, best_points[-1]) == pytest.approx(best_costs[-1])
    assert solution.cost == pytest.approx(cost_of(problem, solution.u))


def test_a_search_that_runs_out_of_steps_has_not_converged():
    problem = toy.make_problem(CLIPS[0])
    solution = search.find_best_fit(problem, SearchSettings(max_steps=10), starts=1)
    assert solution.steps == 10
    assert not solution.converged
    assert solution.message == "Not converged: the 10 steps allowed for a start were used up."
    assert solution.cost < solution.cost_before


@pytest.mark.slow
@pytest.mark.parametrize("walls", [(-1.0, 2.1), (1.0, 9.0)], ids=["by the truth", "at the start"])
def test_a_region_where_residuals_are_not_finite_is_survived(walls):
    problem = curve_problem(walls=walls)
    solution = search.find_best_fit(problem)
    assert solution.converged, solution.message
    assert errors(problem, solution.values, CURVE_TRUTH).max() < TOLERANCE


def test_residuals_that_are_nowhere_finite_are_reported_in_a_sentence():
    solution = search.find_best_fit(curve_problem(walls=(9.0, 9.0)))
    assert not solution.converged
    assert solution.message == "Not converged: no residuals are finite at any starting point."
    assert solution.cost == np.inf


def test_thresholds_alone_can_be_fitted():
    base = Curve(height=jnp.asarray(2.0), rate=jnp.asarray(3.0))
    problem = eqx.tree_at(lambda p: p.space.system, curve_problem(("turn",)), base)
    solution = search.find_best_fit(problem)
    assert solution.converged, solution.message
    assert errors(problem, solution.values, CURVE_TRUTH).max() < TOLERANCE


@functools.cache
def error_with_outliers(loss: str) -> float:
    problem = curve_problem(outliers=0.05, loss=loss)
    return errors(problem, search.find_best_fit(problem).values, CURVE_TRUTH).max()


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_loss_limits_the_pull_of_outliers(loss):
    assert error_with_outliers(loss) < 0.01
    assert error_with_outliers(loss) < error_with_outliers("squares") / 3


class Valley(eqx.Module):
    """Rosenbrock's curved valley, in which a descent turns and has steps rejected."""

    def residuals(self, u: jax.Array) -> jax.Array:
        return jnp.stack([1 - u[0], 10 * (u[1] - u[0] ** 2)])

    def residuals_and_jacobian(self, u, max_cost):
        del max_cost
        return self.residuals(u), jax.jacfwd(self.residuals)(u)


VALLEY_START = (-1.2, 1.0)


@pytest.mark.parametrize("steps", [1, 2, 7, 20])
def test_steps_are_those_of_optimistix_in_a_valley(steps):
    states = march(Valley(), jnp.asarray(VALLEY_START), steps)
    expected = optimum(Valley().residuals, jnp.asarray(VALLEY_START), steps)
    np.testing.assert_allclose(states[-1].u, expected, rtol=1e-9)
    rejected = [not state.accepted for state in states]
    assert rejected[0] is False and any(rejected) == (steps > 2)


def test_steps_on_the_compressed_rows_are_those_of_optimistix_on_all_rows():
    problem = curve_problem()
    u = problem.space.start
    state = march(models.HardModel(problem, u), u, 20)[-1]
    np.testing.assert_allclose(state.u, optimum(problem.residuals, u, 20), rtol=1e-9)
    assert float(state.cost) < 1e-2 * float(problem.cost(u))
    np.testing.assert_allclose(state.cost, problem.cost(state.u), rtol=1e-12)
    jacobian = models.problem_jacobian(state.jacobian)
    np.testing.assert_allclose(jacobian, problem.jacobian(state.u), rtol=1e-12)


def march(model: models.Model, u: jax.Array, steps: int) -> list[levenberg_marquardt.LMState]:
    """The states after each of our steps."""
    states = [levenberg_marquardt.begin(model, u)]
    for _ in range(steps):
        states.append(levenberg_marquardt.step(model, states[-1]))
    return states[1:]


def optimum(residuals, u: jax.Array, steps: int) -> jax.Array:
    """Where optimistix is after as many steps by itself."""
    solver = optx.LevenbergMarquardt(rtol=0.0, atol=0.0)
    return optx.least_squares(
        lambda u, _: residuals(u), solver, u, max_steps=steps, throw=False
    ).value


class Reticent(optx.AbstractSearch):
    """Optimistix's search, which keeps its state in a form of its own."""

    def init(self, y, f_info_struct):
        return {"kept": optx.ClassicalTrustRegion().init(y, f_info_struct)}

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        before = (first_step, y, y_eval, f_info, f_eval_info, state["kept"])
        *outputs, after = optx.ClassicalTrustRegion().step(*before)
        return *outputs, {"kept": after}


def test_a_search_may_keep_its_state_in_any_form(monkeypatch):
    expected = march(Valley(), jnp.asarray(VALLEY_START), 3)[-1]
    monkeypatch.setattr(levenberg_marquardt, "SEARCH", Reticent())
    for name in ("begin", "step"):  # untraced, or the programs from above would run
        function = getattr(levenberg_marquardt, name).__wrapped__
        monkeypatch.setattr(levenberg_marquardt, name, function)
    state = march(Valley(), jnp.asarray(VALLEY_START), 3)[-1]
    assert set(state.search) == {"kept"}
    np.testing.assert_allclose(state.u, expected.u, rtol=1e-12)


def test_all_steps_of_a_descent_are_one_program():
    """A weak type in the state, say, would compile the second step anew."""
    problem = curve_problem()
    model = models.HardModel(problem, problem.space.start)
    before = levenberg_marquardt.begin(model, problem.space.start)
    after = levenberg_marquardt.step(model, before)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert jax.tree.map(jax.typeof, before) == jax.tree.map(jax.typeof, after)


def test_a_jacobian_is_computed_only_where_the_cost_is_low_enough():
    problem = curve_problem()
    u, cost = problem.space.start, problem.cost(problem.space.start)
    jacobian = eqx.filter_jit(lambda max_cost: problem.residuals_and_jacobian(u, max_cost)[1])
    np.testing.assert_allclose(jacobian(cost), problem.jacobian(u), rtol=1e-12)
    assert np.abs(jacobian(cost)).max() > 1
    assert not np.asarray(jacobian(0.99 * cost)).any()


@pytest.mark.parametrize("rows", [3, 5, 127, 128, 129, 1000, 20000])
def test_the_triangular_factor_has_the_gram_matrix_of_all_rows(rows):
    tall = np.random.default_rng(rows).normal(size=(rows, 5)) * [1.0, 1e-3, 1e3, 1.0, 1.0]
    triangle = np.asarray(models.triangular_factor(jnp.asarray(tall)))
    assert triangle.shape == (5, 5)
    np.testing.assert_array_equal(triangle, np.triu(triangle))
    np.testing.assert_allclose(triangle.T @ triangle, tall.T @ tall, rtol=1e-10, atol=1e-10)
    if rows >= 5:
        np.testing.assert_allclose(np.abs(triangle), np.abs(np.linalg.qr(tall, "r")), rtol=1e-8)


FACTORS_IN_THREADS = """
import os, threading
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])  # so many threads has XLA's pool
import jax, jax.numpy as jnp
from fitting.inference.optimisation.models import triangular_factor
program = jax.jit(lambda tall: triangular_factor(tall) + triangular_factor(2 * tall))
tall = jnp.arange(80_000.0).reshape(-1, 10) % 7
def repeat():
    for _ in range(50):
        program(tall).block_until_ready()
threads = [threading.Thread(target=repeat) for _ in range(4)]
for thread in threads:
    thread.start()
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen here")
def test_triangular_factors_in_several_threads_do_not_wait_for_each_other():
    """As jaxlib's decompositions of several matrices at once do."""
    subprocess.run([sys.executable, "-c", FACTORS_IN_THREADS], check=True, timeout=100)


def test_the_same_seed_gives_the_same_solution():
    first, second = (search.find_best_fit(curve_problem(), seed=4) for _ in range(2))
    np.testing.assert_array_equal(first.u, second.u)
    assert [r.cost for r in first.history] == [r.cost for r in second.history]


def test_descents_that_agree_need_neither_evolution_nor_another_start():
    solution = search.find_best_fit(curve_problem())
    assert (solution.starts, solution.agreeing) == (2, 2)
    assert {report.start for report in solution.history} == {0}
    assert "evolution" not in {report.stage for report in solution.history}


def test_the_descents_that_do_not_agree_count_too(monkeypatch):
    """Of three, one stops where it begins: two of three agree."""
    settings = SearchSettings(descents=3, draws=3, sweeps=0)
    problem = curve_problem(("height", "rate", "turn"))
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


def test_starts_are_made_until_two_of_them_agree():
    solution = search.find_best_fit(curve_problem(), SearchSettings(descents=1))
    assert (solution.starts, solution.agreeing) == (2, 2)
    assert solution.message.startswith("Converged: 2 of 2 starts agree, and no further step")
    assert {report.start for report in solution.history} == {0, 1}
    assert solution.cost <= min(r.cost for r in solution.history) * (1 + ROUNDING)


def test_one_start_alone_has_not_converged():
    solution = search.find_best_fit(curve_problem(), SearchSettings(descents=1), starts=1)
    assert not solution.converged
    assert solution.message == "Not converged: stopped in a valley, where the only start led."
    assert (solution.starts, solution.agreeing) == (1, 1)


def test_starts_that_disagree_have_not_converged():
    """Each stops after three steps from a draw of its own, so that no two costs are equal."""
    settings = SearchSettings(
        agreement=0.0, draws=2, descents=1, sweeps=0, max_steps=3, max_rounds=1
    )
    solution = search.find_best_fit(toy.make_problem(CLIPS[0]), settings, starts=4)
    assert (solution.starts, solution.agreeing) == (4, 1)
    assert not solution.converged


@pytest.mark.parametrize(
    ("ends", "count", "enough"),
    [
        ([10.0], 1, False),
        ([10.0, 12.9], 2, True),
        ([10.0, 13.1], 1, False),
        ([14.0, 10.0, 11.0], 2, True),
        ([14.0, 10.0, 20.0, 11.0], 2, True),
        ([14.0, 10.0, 20.0, 30.0, 11.0], 2, False),
        ([14.0, 10.0, 20.0, 10.5, 30.0, 11.0], 3, True),
        ([14.0, 14.1, 10.0], 1, False),
    ],
)
def test_at_least_two_starts_and_half_of_them_must_agree(ends, count, enough):
    settings = SearchSettings()
    assert search.count_agreeing(ends, settings) == count
    assert search.agree(ends, settings) is enough


def test_a_search_can_start_at_a_point_that_is_passed_in():
    problem, first = curve_problem(), np.asarray([2.0, 2.0])
    solution = search.find_best_fit(problem, first=first)
    assert solution.converged
    assert solution.cost == pytest.approx(search.find_best_fit(problem).cost)
    assert solution.history[0].cost == pytest.approx(cost_of(problem, first), rel=1e-5)


def test_a_refined_solution_keeps_its_agreement_and_adds_its_effort():
    problem = curve_problem()
    rough = search.find_best_fit(problem, SearchSettings(min_step_gain=0.5, max_small_steps=1))
    refined = search.refine(problem, rough, rough.u)
    assert refined.cost < rough.cost
    assert refined.cost == pytest.approx(search.find_best_fit(problem).cost)
    assert (refined.starts, refined.agreeing) == (rough.starts, rough.agreeing)
    assert refined.converged == rough.agreed
    assert refined.history[: len(rough.history)] == rough.history
    assert refined.steps == rough.steps + sum(r.stage == "polish" for r in refined.history) - sum(
        r.stage == "polish" for r in rough.history
    )


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_costs_of_candidates_agree_with_those_of_one_point(dtype):
    """They are computed with 32-bit floats, to a part in a hundred thousand."""
    problem = curve_problem(("turn", "height", "rate"))
    candidates = problem.space.prior.draw(np.random.default_rng(1), 100).astype(dtype)
    costs = [cost_of(problem, u) for u in candidates]
    expected = np.where(np.isfinite(costs), costs, np.inf)
    rough = population.evaluate(problem, candidates).cost
    assert np.isfinite(expected).sum() > 50
    np.testing.assert_allclose(rough, expected, rtol=population.ROUNDING)


def test_a_search_keeps_the_type_of_its_numbers():
    problem = curve_problem(("turn", "height", "rate"))
    problem = jax.tree.map(lambda x: x.astype("float32"), problem)
    solution = search.find_best_fit(problem)
    assert solution.u.dtype == solution.jacobian.dtype == np.float32
    assert errors(problem, solution.values, CURVE_TRUTH).max() < TOLERANCE


def test_no_starting_point_is_refused():
    with pytest.raises(ValueError, match="starts is 0, wanted at least 1"):
        search.find_best_fit(curve_problem(), starts=0)


# Stages on their own


def threshold_search(**settings) -> tuple[Search, SearchState]:
    """A search of a curve with a threshold, and its state at a wrong point."""
    problem = curve_problem(("turn", "height", "rate"))
    u = np.asarray(problem.space.start)
    return Search(problem, SearchSettings(**settings)), SearchState.at(u, cost_of(problem, u))


def evolve(search: Search, state: SearchState) -> SearchState:
    ends = [descent.descend(search, state, "descent").point]
    return evolution.evolve(search, dataclasses.replace(state, point=ends[0]), ends)


STAGES = {
    "descent": lambda search, state: descent.descend(search, state, "descent"),
    "polish": descent.polish,
    "evolution": evolve,
    "sweep": lambda search, state: sweep.sweep_and_descend(search, state, 1),
}


@pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)
def test_a_stage_lowers_the_cost_and_does_the_same_when_called_again(stage):
    search, state = threshold_search()
    first, second = stage(search, state), stage(search, state)
    assert first.best.cost < state.point.cost
    assert first.best.cost == pytest.approx(cost_of(search.problem, first.best.u))
    assert first.point.cost == second.point.cost
    np.testing.assert_array_equal(first.point.u, second.point.u)
    assert [line.cost for line in first.history] == [line.cost for line in second.history]
    assert state.history == ()


def test_only_thresholds_keep_their_values_in_a_descent():
    search, state = threshold_search()
    before = np.asarray(search.problem.space.values(jnp.asarray(state.point.u)))
    after = descent.descend(search, state, "descent").point.u
    changed = np.asarray(search.problem.space.values(jnp.asarray(after))) != before
    np.testing.assert_array_equal(changed, search.problem.space.smooth)


def test_evolution_crosses_the_cliff_of_a_threshold():
    """A descent leaves the threshold where it is; its truth is 0.4."""
    search, state = threshold_search()
    turn = search.problem.space.names.index("turn")
    assert float(search.problem.space.values(evolve(search, state).point.u)[turn]) == pytest.approx(
        CURVE_TRUTH["turn"], abs=0.01
    )


def test_variations_keep_the_values_that_they_do_not_move():
    problem = toy.make_problem()
    random = np.random.default_rng(0)
    values = problem.space.values(problem.space.prior.draw(random, 20))
    moved = random.random(values.shape) < 0.3
    redrawn = (random.random(values.shape) < 0.1) & ~moved
    u = evolution.vary(problem.space, values, 0.3 * moved, redrawn, random)
    kept = np.isclose(problem.space.values(u), values, rtol=1e-9)
    above = [p.above is not None for p in problem.space.parameters]  # may be pushed up
    np.testing.assert_array_equal(
        kept[:, ~np.array(above)], ~(moved | redrawn)[:, ~np.array(above)]
    )


def test_a_sweep_without_sufficient_gain_leaves_the_point_where_it_is():
    search, state = threshold_search(min_sweep_gain=1.0)
    after = sweep.sweep(search, state)
    assert after.point is state.point
    assert after.sweeps == search.settings.sweep_tries


def test_a_stage_stops_when_the_steps_of_a_start_are_used_up():
    search, state = threshold_search(max_steps=3)
    with pytest.raises(StepsUsedUp) as caught:
        descent.descend(search, state, "descent")
    assert caught.value.state.steps == 3
    assert caught.value.state.best.cost < state.point.cost


def test_each_sweep_looks_in_the_widest_gap_that_the_sweeps_before_have_left():
    offsets: list[float] = []
    for number in range(40):
        offset = sweep.offset(number)
        assert 0 <= offset < 1
        if offsets:
            ends = np.sort([*offsets, min(offsets) + 1])  # once around
            gap = np.searchsorted(ends, offset + (offset < ends[0])) - 1
            assert np.diff(ends)[gap] > np.diff(ends).max() - 1e-9
        offsets.append(offset)


# Settings


def test_every_setting_has_a_meaning_and_a_default_within_its_range():
    described = settings.describe(SearchSettings)
    assert list(described) == [field.name for field in dataclasses.fields(SearchSettings)]
    for name, setting in described.items():
        assert setting.meaning.endswith("."), name
        assert setting.allows(getattr(SearchSettings(), name)), name


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"max_steps": 0}, "max_steps is 0, wanted a whole number from 1 to 100000: Levenberg"),
        ({"agreement": -1.0}, "agreement is -1.0, wanted a number from 0"),
        ({"population": 16}, "gauss_newton_children is 16, wanted less than the population"),
    ],
)
def test_a_setting_out_of_its_range_is_refused_with_the_range(values, message):
    with pytest.raises(ValueError, match=message):
        SearchSettings(**values)


def test_a_setting_allows_only_its_kind_of_number():
    described = settings.describe(SearchSettings)
    assert not described["elite"].allows(2.5)
    assert not described["agreement"].allows(True)
    assert not described["agreement"].allows("wide")
    assert described["agreement"].allows(1)


def test_other_settings_change_the_search():
    problem = curve_problem()
    short = search.find_best_fit(problem, SearchSettings(min_step_gain=0.5, sweeps=0))
    assert short.steps < search.find_best_fit(problem).steps
