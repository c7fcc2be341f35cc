"""What becomes of the points that profiles meet below a solution."""

import dataclasses

import jax
import numpy as np
import pytest

from fitting.experiments import problems
from fitting.experiments.experiment_files import load_experiment
from fitting.studies import assess
from fitting.studies.fit import search
from support import small_studies
from support.experiments import write
from support.small_studies import HALF_SECOND


@pytest.fixture
def solved(tmp_path, monkeypatch):
    """An experiment with residuals that compile at once, its problem and its solution."""
    small_studies.quick_fits(monkeypatch)
    experiment = load_experiment(write(tmp_path, clips=HALF_SECOND))
    with jax.enable_x64(True):
        problem = problems.make_problem(experiment)
        return experiment, problem, search(problem, experiment)


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_point_that_is_lower_with_32_bits_only_changes_nothing(solved, monkeypatch, interrupted):
    experiment, problem, solution = solved
    known = assess.assess_identifiability(problem, solution)
    tempting = dataclasses.replace(known, improvement=5.0, best_u=solution.u + 1.0)
    behind = dataclasses.replace(
        solution, u=solution.u + 1.0, cost=solution.cost + 9000.0, interrupted=interrupted
    )
    monkeypatch.setattr(assess, "assess_identifiability", lambda *_: tempting)
    monkeypatch.setattr(assess, "refine", lambda *_: behind)
    monkeypatch.setattr(assess, "search", lambda *_: behind)
    fitted = assess.assess_solution(experiment, problem, solution)
    assert fitted.solution.cost == solution.cost and fitted.left == ()
    np.testing.assert_array_equal(fitted.solution.u, solution.u)
    assert fitted.solution.interrupted == interrupted
