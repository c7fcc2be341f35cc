"""The fit finds known parameters, says how it ended, and compiles once."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from fitting.inference.optimisation import levenberg_marquardt, models, population, search, sweep
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.optimisation.state import ROUNDING
from fitting.problem import free_parameters, space
from fitting.problem.problem import Problem
from jaxik.maths import parameter_tree
from support import toy

CLIPS = (1, 5)  # seeds of toy clips that determine every threshold
SHARE = 0.05  # of the range: how near the truth a fit must come


class Curve(eqx.Module):
    """A decay that jumps where a decision turns."""

    height: jax.Array = parameter_tree.parameter(
        0.8, unit="1", low=0.0, high=4.0, doc="Height of the test rule."
    )
    rate: jax.Array = parameter_tree.parameter(
        1.0, unit="1/s", low=0.1, high=10.0, scale="log", doc="Rate of the test rule."
    )
    turn: jax.Array = parameter_tree.parameter(
        0.7, unit="s", low=0.0, high=1.0, kind="threshold", doc="Turn of the test rule."
    )


TIME = jnp.linspace(0, 1, 200)
CURVE_TRUTH = {"height": 2.0, "rate": 3.0, "turn": 0.4}


def curve(ik: Curve) -> jax.Array:
    time = TIME.astype(ik.rate.dtype)
    decay = ik.height * jnp.exp(-ik.rate * time)
    return jnp.where(time <= ik.turn, decay, decay + 0.5)


def curve_residuals(ik: Curve, data: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Finite only while the height is between the walls."""
    seen, walls = data
    rows = (curve(ik) - seen) / jnp.asarray(0.02, seen.dtype)
    return jnp.where((walls[0] < ik.height) & (ik.height < walls[1]), rows, jnp.nan)


def curve_problem(
    names: tuple[str, ...] = ("height", "rate"),
    walls: tuple[float, float] = (-1.0, 9.0),
    outliers: float = 0.0,
    **options,
) -> Problem:
    base = Curve(turn=jnp.asarray(0.7 if "turn" in names else CURVE_TRUTH["turn"]))
    random = np.random.default_rng(3)
    clean = curve(Curve(**{name: jnp.asarray(value) for name, value in CURVE_TRUTH.items()}))
    gross = (random.random(TIME.size) < outliers) * random.uniform(1, 3, TIME.size)
    data = clean + random.normal(0, 0.02, TIME.size) + gross
    made = space.make_space(base, [free_parameters.free_parameter(base, name) for name in names])
    return Problem(made, (data, jnp.asarray(walls)), curve_residuals, **options)


def errors(problem: Problem, values: np.ndarray, truth: dict[str, float]) -> np.ndarray:
    """Distance from the truth in shares of the range; NaN where there is no truth."""
    known = np.asarray([truth.get(name, np.nan) for name in problem.space.names])
    return np.abs(values - known) / np.asarray(problem.space.high - problem.space.low)


def cost_of(problem: Problem, u: np.ndarray) -> float:
    return float(population.evaluate(problem, u[None]).cost[0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", CLIPS)
def test_thresholds_and_smooth_parameters_are_recovered(seed):
    problem, solution = toy.solved(seed)
    assert solution.converged, solution.message
    assert np.nanmax(errors(problem, solution.values, toy.TRUTH)) < SHARE
    truth = np.asarray(problem.space.pack(toy.TRUTH))
    assert solution.cost <= cost_of(problem, truth)
    assert solution.cost == pytest.approx(cost_of(problem, solution.u))
    assert solution.cost_before == pytest.approx(cost_of(problem, np.asarray(problem.space.u0)))


@pytest.mark.parametrize("seed", CLIPS)
def test_the_jacobian_agrees_with_finite_differences(seed):
    problem, solution = toy.solved(seed)
    step = 1e-6
    moves = step * np.eye(problem.space.size)
    rows = eqx.filter_jit(lambda problem, u: jax.vmap(problem.residuals)(u))
    sides = [np.asarray(rows(problem, jnp.asarray(solution.u + sign * moves))) for sign in (1, -1)]
    differences = (sides[0] - sides[1]).T / (2 * step)
    for i, smooth in enumerate(problem.space.smooth):
        if smooth:
            size = np.abs(differences[:, i]).max()
            np.testing.assert_allclose(
                solution.jacobian[:, i], differences[:, i], atol=1e-5 * size, rtol=1e-4
            )


def test_a_hard_decision_has_no_slope_by_its_threshold():
    problem, solution = toy.solved(CLIPS[0])
    slopes = eqx.filter_jit(lambda u: problem.jacobian(u))(jnp.asarray(solution.u))
    assert not np.asarray(slopes)[: -problem.space.size, np.asarray(problem.space.thresholds)].any()


def test_other_data_of_the_same_shape_compile_nothing():
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
    assert {"blocks", "ensemble"} < set(stages)
    assert set(stages) <= {"start", "blocks", "sweep", "ensemble", "polish"}
    assert (np.diff([r.best for r in reports]) <= 1e-6).all()
    assert (np.diff([r.seconds for r in reports]) >= 0).all()
    assert (np.diff([r.step for r in reports]) >= 0).all()
    assert reports[-1].step == solution.steps
    assert reports[-1].seconds <= solution.seconds


def test_an_interrupt_keeps_the_best_point():
    seen = []

    def stop_later(report: search.Progress) -> None:
        seen.append(report.best)
        if len(seen) == 10:
            raise KeyboardInterrupt

    problem = toy.make_problem(CLIPS[0])
    solution = search.find_best_fit(problem, progress=stop_later)
    assert not solution.converged
    assert solution.message.startswith("Interrupted after")
    assert solution.cost == min(seen) < solution.cost_before
    assert solution.cost == pytest.approx(cost_of(problem, solution.u))


def test_too_few_steps_are_said_not_to_have_converged():
    problem = toy.make_problem(CLIPS[0])
    solution = search.find_best_fit(problem, SearchSettings(max_steps=10))
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
    assert errors(problem, solution.values, CURVE_TRUTH).max() < SHARE


def test_residuals_that_are_nowhere_finite_are_told_in_a_sentence():
    solution = search.find_best_fit(curve_problem(walls=(9.0, 9.0)))
    assert not solution.converged
    assert solution.message == "Not converged: no residuals are finite at any starting point."
    assert solution.cost == np.inf


def test_a_fit_may_be_of_thresholds_alone():
    base = Curve(height=jnp.asarray(2.0), rate=jnp.asarray(3.0))
    problem = eqx.tree_at(lambda p: p.space.system, curve_problem(("turn",)), base)
    solution = search.find_best_fit(problem)
    assert solution.converged, solution.message
    assert errors(problem, solution.values, CURVE_TRUTH).max() < SHARE


@functools.cache
def error_with_outliers(loss: str) -> float:
    problem = curve_problem(outliers=0.05, loss=loss)
    return errors(problem, search.find_best_fit(problem).values, CURVE_TRUTH).max()


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_loss_keeps_outliers_from_pulling(loss):
    assert error_with_outliers(loss) < 0.01
    assert error_with_outliers(loss) < error_with_outliers("squares") / 3


@pytest.mark.slow
def test_the_steps_are_those_of_optimistix_on_the_rows_themselves():
    problem = curve_problem()
    u, args = problem.space.u0, (problem, problem.space.u0)
    at = levenberg_marquardt.begin(jacobian.hard, u, args)
    solver = optx.LevenbergMarquardt(rtol=0.0, atol=0.0)
    plain, rows = u, lambda u, _: (problem.residuals(u), None)
    shape = jax.eval_shape(rows, u, None)[0]
    common = {"options": {"jac": "fwd"}, "tags": frozenset()}
    state = solver.init(rows, u, None, f_struct=shape, aux_struct=None, **common)
    for _ in range(20):
        at = levenberg_marquardt.step(jacobian.hard, at, args)
        plain, state, _ = solver.step(rows, plain, None, state=state, **common)
        np.testing.assert_allclose(at.u, plain, rtol=1e-9)
    assert float(at.cost) < 1e-2 * float(problem.cost(u))
    np.testing.assert_allclose(at.cost, problem.cost(at.u), rtol=1e-12)
    np.testing.assert_allclose(at.slopes[:-2], problem.jacobian(at.u), rtol=1e-12)


def test_slopes_are_made_only_where_the_cost_is_low_enough():
    problem = curve_problem()
    u, cost = problem.space.u0, problem.cost(problem.space.u0)
    made = eqx.filter_jit(lambda below: problem.residuals_and_jacobian(u, below)[1])
    np.testing.assert_allclose(made(cost), problem.jacobian(u), rtol=1e-12)
    assert np.abs(made(cost)).max() > 1
    assert not np.asarray(made(0.99 * cost)).any()


@pytest.mark.parametrize("rows", [3, 5, 127, 128, 129, 1000, 20000])
def test_the_triangle_of_tall_rows_has_their_squares(rows):
    tall = np.random.default_rng(rows).normal(size=(rows, 5)) * [1.0, 1e-3, 1e3, 1.0, 1.0]
    small = np.asarray(models.triangular_factor(jnp.asarray(tall)))
    assert small.shape == (5, 5)
    np.testing.assert_array_equal(small, np.triu(small))
    np.testing.assert_allclose(small.T @ small, tall.T @ tall, rtol=1e-10, atol=1e-10)
    if rows >= 5:
        np.testing.assert_allclose(np.abs(small), np.abs(np.linalg.qr(tall, "r")), rtol=1e-8)


def test_the_same_seed_gives_the_same_solution():
    first, second = (search.find_best_fit(curve_problem(), seed=4) for _ in range(2))
    np.testing.assert_array_equal(first.u, second.u)
    assert [r.cost for r in first.history] == [r.cost for r in second.history]


def test_several_starts_are_tried_and_the_best_is_kept():
    problem = curve_problem()
    solution = search.find_best_fit(problem, starts=3)
    assert [r.start for r in solution.history if r.stage == "start"] == [0, 1, 2]
    assert solution.cost <= min(r.cost for r in solution.history) * (1 + ROUNDING)
    given = np.asarray([[2.0, 2.0], [0.0, 0.0]])
    assert search.find_best_fit(problem, starts=given).cost == pytest.approx(solution.cost)


def test_a_fit_keeps_the_type_of_its_numbers():
    problem = curve_problem(("turn", "height", "rate"))
    problem = jax.tree.map(lambda x: x.astype("float32"), problem)
    solution = search.find_best_fit(problem)
    assert solution.u.dtype == solution.jacobian.dtype == np.float32
    assert errors(problem, solution.values, CURVE_TRUTH).max() < SHARE


@pytest.mark.parametrize("options", [{"starts": 0}, {"max_steps": 0}])
def test_no_start_and_no_step_are_refused(options):
    with pytest.raises(ValueError, match="wanted at least 1 of each"):
        search.find_best_fit(curve_problem(), **options)


def test_each_sweep_looks_in_the_widest_gap_that_the_sweeps_before_have_left():
    seen: list[float] = []
    for place in itertools.islice(population.offsets(), 40):
        assert 0 <= place < 1
        if seen:
            ends = np.sort([*seen, min(seen) + 1])  # once around
            fallen_into = np.searchsorted(ends, place + (place < ends[0])) - 1
            assert np.diff(ends)[fallen_into] > np.diff(ends).max() - 1e-9
        seen.append(place)
