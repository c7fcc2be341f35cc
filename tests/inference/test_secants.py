"""Slopes of thresholds: of a gradual effect its derivative, of a sudden one none."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.inference.optimisation.search import find_best_fit
from fitting.inference.profiles.conditional import Conditional, Targets
from fitting.inference.profiles.secants import slopes_of_thresholds
from fitting.problem.problem import Problem
from support.problems import parameter, problem_of

HEIGHT = jnp.linspace(0.0, 0.3, 300)  # m
NOISE = 0.02


class Fade(eqx.Module):
    """A weight that fades between two heights, and a jump."""

    low: jax.Array = parameter(0.1, "m", 0.05, 0.15, kind="threshold")  # full weight below
    high: jax.Array = parameter(0.2, "m", 0.15, 0.25, kind="threshold")  # no weight above
    jump: jax.Array = parameter(0.15, "m", 0.0, 0.3, kind="threshold")
    gain: jax.Array = parameter(1.0, "1", 0.5, 1.5)


def residuals(ik: Fade, data: jax.Array) -> jax.Array:
    weight = jnp.clip((ik.high - HEIGHT) / (ik.high - ik.low), 0.0, 1.0)
    flipped = jnp.where(HEIGHT < ik.jump, 1.0, 0.0)
    return ((jnp.stack([ik.gain * weight, flipped]) - data) / NOISE).ravel()


@pytest.fixture(scope="module")
def problem() -> Problem:
    base = Fade()
    clean = NOISE * residuals(base, jnp.zeros((2, 300))).reshape(2, -1)
    data = clean + NOISE * np.random.default_rng(0).normal(size=clean.shape)
    return problem_of(base, ("low", "high", "jump", "gain"), data, residuals)


def test_a_gradual_effect_has_its_derivative_and_a_sudden_one_none(problem):
    u = np.asarray(problem.space.start)
    slopes = slopes_of_thresholds(problem, u)
    exact = np.asarray(jax.jacfwd(problem.residuals)(problem.space.start))
    assert (slopes[:, 2:] == 0).all()
    for i in (0, 1):
        scale = np.linalg.norm(exact[:, i])
        assert np.linalg.norm(slopes[:, i] - exact[:, i]) < 0.1 * scale


def test_thresholds_that_fade_a_weight_follow_each_other(problem):
    """Along the ridge on which the middle of the fade stays, the cost rises much less."""
    solution = find_best_fit(problem, starts=1)
    conditional = Conditional.around(problem, solution)
    start = conditional.points(np.asarray(solution.u)[None])
    held = np.asarray([0])
    targets = Targets(held, start.values[:, 0] - 0.004)
    alone = conditional.points(
        conditional.move(start, np.zeros((1, 4)), targets, np.zeros((1, 4), bool))
    )
    following = conditional.lowest(targets, [start])
    assert following.cost[0] - start.cost[0] < 0.6 * (alone.cost[0] - start.cost[0])
    assert following.values[0, 1] > start.values[0, 1] + 0.001
