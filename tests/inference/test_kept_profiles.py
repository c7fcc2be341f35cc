"""Profiles that were killed go on, and end to the last bit as they would have."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fitting.inference.optimisation import kept_stages, search
from fitting.inference.optimisation.kept_stages import KeptStages
from fitting.inference.profiles import profiling
from fitting.inference.profiles.curves import Curves
from support.curves import curve_problem


@pytest.fixture(scope="module")
def solved():
    problem = curve_problem(("height", "rate", "turn"))
    solution = search.find_best_fit(problem, starts=1)
    return problem, solution, profiling.find_curves(problem, solution)


@pytest.fixture(autouse=True)
def written_at_once(monkeypatch):
    monkeypatch.setattr(kept_stages, "SECONDS_BETWEEN_WRITES", 0.0)


class Stop(Exception):
    """In place of a kill."""


def stop(*_: object) -> None:
    raise Stop


def assert_same(curves: Curves, others: Curves) -> None:
    for mine, theirs in zip(curves.curves, others.curves, strict=True):
        for name in ("u", "values", "cost"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)


def kill_at(number: int, monkeypatch: pytest.MonkeyPatch, path: Path, solved) -> None:
    """Finds profiles until this stage begins."""
    problem, solution, _ = solved
    with monkeypatch.context() as patch, pytest.raises(Stop):
        patch.setattr(profiling, "STAGES", [*profiling.STAGES[:number], stop])
        profiling.find_curves(problem, solution, KeptStages(path, "a fit"))


def test_profiles_go_on_after_each_of_their_stages_to_the_same_end(solved, tmp_path, monkeypatch):
    path, called = tmp_path / "search.json", []
    problem, solution, whole = solved
    for number in range(1, 9):
        kill_at(number, monkeypatch, path, solved)
        assert KeptStages(path, "a fit").profile_count == number
    stages = [lambda state: called.append(state.stages), *profiling.STAGES[1:]]
    monkeypatch.setattr(profiling, "STAGES", stages)
    assert_same(profiling.find_curves(problem, solution, KeptStages(path, "a fit")), whole)
    monkeypatch.setattr(profiling, "STAGES", [stop] * len(stages))
    assert_same(profiling.find_curves(problem, solution, KeptStages(path, "a fit")), whole)
    assert called == []


def test_the_profiles_of_another_solution_are_not_used(solved, tmp_path, monkeypatch):
    path = tmp_path / "search.json"
    kill_at(1, monkeypatch, path, solved)
    problem, solution, _ = solved
    kept = KeptStages(path, "a fit")
    kept.recall_profiles(problem, solution.u + 1e-9, stop)
    kept.recall_profiles(curve_problem(("height", "rate", "turn"), loss="huber"), solution.u, stop)
    with pytest.raises(Stop):
        kept.recall_profiles(problem, solution.u, stop)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda stored: stored.update(stages=-1), "wanted a number from 0"),
        (lambda stored: stored["curves"].pop(), "there are 2 profiles of 3 parameters"),
        (lambda stored: stored["curves"][0]["cost"].pop(), "cannot reshape"),
        (lambda stored: stored["curves"][1]["u"][0].pop(), "damaged"),
        (
            lambda stored: stored["curves"][1].update(
                cost=[float("nan")], u=[[0.0] * 3], values=[[0.0] * 3]
            ),
            "a point without a cost",
        ),
        (lambda stored: stored["curves"][1].update(cost=[], u=[], values=[]), "or no point"),
        (lambda stored: stored.update(random={}), "damaged"),
        (lambda stored: stored.update(cliffs=[[1]]), "wanted a list of 2"),
    ],
)
def test_profiles_that_cannot_be_used_are_named_and_begin_anew(
    solved, tmp_path, monkeypatch, change: Callable[[dict], object], message
):
    path, lines = tmp_path / "search.json", []
    kill_at(1, monkeypatch, path, solved)
    content = json.loads(path.read_text())
    change(next(iter(content["profiles"].values())))
    path.write_text(json.dumps(content))
    monkeypatch.setattr(profiling, "STAGES", [])
    problem, solution, _ = solved
    profiling.find_curves(problem, solution, KeptStages(path, "a fit", lines.append))
    (line,) = lines
    assert "search.json" in line and message in line and "\n" not in line
