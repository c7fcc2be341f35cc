"""Simulated references: what their residuals at the truth are."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxik
from fitting.experiments import experiment_files, problems
from fitting.problem import residuals
from fitting.problem.problem import Problem
from fitting.problem.simulation import autoregression, simulate
from support.experiments import write

SEEDS = 8
EVERY_KIND = """[sigmas]
ankle = 0.02
knee = 0.03
pelvis = 0.01
foot = 0.1
body = 0.2
contact = 0.5
"""


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """A second of the uneven walk with residuals of every kind that can be simulated."""
    path = write(tmp_path_factory.mktemp("simulation"), rest=EVERY_KIND)
    return problems.make_problem(experiment_files.load_experiment(path))


def errors(problem: Problem, u: np.ndarray) -> dict[str, np.ndarray]:
    """Residuals by kind at `u`, one frame after another."""
    (scene,) = problem.data
    result = jaxik.run(problem.space.unpack(u), scene.rig, scene.terrain, scene.frames)
    by_kind = residuals.residuals_by_kind(scene, residuals.errors_by_kind(scene, result))
    return {kind: np.asarray(r) for kind, r in by_kind.items() if kind != "smooth"}


def with_noise(problem: Problem, correlation: float, fraction: float) -> Problem:
    return eqx.tree_at(
        lambda p: (p.data[0].sigmas.correlation, p.independent_fraction),
        problem,
        (jnp.asarray(correlation), jnp.asarray(fraction)),
    )


@pytest.mark.parametrize(("correlation", "fraction"), [(0.0, 1.0), (0.9, 1.0), (0.0, 0.1)])
def test_residuals_at_the_truth_are_the_noise_that_is_assumed(
    problem: Problem, correlation: float, fraction: float
) -> None:
    """Standard normal, and as correlated as the fraction of independent ones says."""
    noisy = with_noise(problem, correlation, fraction)
    u = np.asarray([0.7, -1.2])
    drawn = [errors(simulate(noisy, u, seed), u) for seed in range(SEEDS)]
    rho = (1 - fraction) / (1 + fraction)
    for kind in drawn[0]:
        series = np.stack([draw[kind] for draw in drawn], axis=1)
        series = series.reshape(len(series), -1)
        count = series.size * (1 - rho) / (1 + rho)
        assert abs(series.mean()) < 4 / np.sqrt(count), kind
        assert abs(series.var() - 1) < 6 / np.sqrt(count), kind
        lag = np.sum(series[1:] * series[:-1]) / np.sum(series**2)
        assert abs(lag - rho) < 5 / np.sqrt(count), kind
        if rho == 0:
            assert stats.kstest(series.ravel(), "norm").pvalue > 1e-4, kind


def test_seeds_give_noise_and_truths_give_motion(problem: Problem) -> None:
    u = np.zeros(2)
    first, again, other = (simulate(problem, u, seed) for seed in (3, 3, 4))
    knees = [p.data[0].reference.knee_ws for p in (first, again, other)]
    assert np.array_equal(knees[0], knees[1])
    assert not np.array_equal(knees[0], knees[2])


def test_a_masked_frame_stays_masked(problem: Problem) -> None:
    observed = jnp.ones(len(problem.data[0].reference.observed), bool).at[7].set(False)
    masked = eqx.tree_at(lambda p: p.data[0].reference.observed, problem, observed)
    assert np.array_equal(simulate(masked, np.zeros(2)).data[0].reference.observed, observed)


def test_kinds_that_are_off_get_no_noise(problem: Problem) -> None:
    off = eqx.tree_at(lambda p: p.data[0].sigmas.ankle, problem, jnp.asarray(jnp.inf))
    u = np.zeros(2)
    (scene,) = simulate(off, u).data
    result = jaxik.run(off.space.unpack(u), scene.rig, scene.terrain, scene.frames)
    assert np.max(np.abs(residuals.errors_by_kind(scene, result)["ankle"])) < 1e-12


def test_accelerations_cannot_be_simulated(problem: Problem) -> None:
    smooth = eqx.tree_at(lambda p: p.data[0].sigmas.smooth, problem, jnp.asarray(20.0))
    with pytest.raises(ValueError, match=r"sigmas.smooth is 20: .*wanted inf"):
        simulate(smooth, np.zeros(2))


def test_an_autoregression_is_stationary() -> None:
    """Its variance and its correlation after one and two steps, against their formulas."""
    series = autoregression(np.random.default_rng(0).normal(size=(100, 20_000)), 0.8)
    assert np.allclose(series.var(axis=1), 1, atol=0.06)
    for lag in (1, 2):
        covariance = np.mean(series[lag:] * series[:-lag])
        assert covariance == pytest.approx(0.8**lag, abs=0.01)
