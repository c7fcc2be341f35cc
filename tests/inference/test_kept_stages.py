"""A search that was killed goes on, and finds to the last bit what it would have found."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fitting.inference.optimisation import descent, evolution, kept_stages, search
from fitting.inference.optimisation.kept_stages import KeptStages
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.optimisation.solution import Solution
from support.curves import curve_problem

# Two ends are too few to agree, so that each start takes all stages.
SETTINGS = SearchSettings(
    descents=2, agreeing_starts=3, max_rounds=3, generations=2, population=20, elite=5
)


@pytest.fixture
def problem(monkeypatch):
    monkeypatch.setattr(kept_stages, "SECONDS_BETWEEN_WRITES", 0.0)
    return curve_problem(("height", "rate", "turn"))


def solve(problem, path: Path | None, settings: SearchSettings = SETTINGS, **options) -> Solution:
    kept = None if path is None else KeptStages(path, "a fit", **options)
    return search.find_best_fit(problem, settings, starts=2, kept=kept)


def assert_same(solution: Solution, other: Solution) -> None:
    """All numbers but the duration are the same to the last bit."""
    for field in dataclasses.fields(Solution):
        mine, theirs = getattr(solution, field.name), getattr(other, field.name)
        if field.name == "history":
            mine, theirs = (
                [dataclasses.replace(line, seconds=0.0) for line in lines]
                for lines in (mine, theirs)
            )
        if field.name != "seconds":
            np.testing.assert_array_equal(mine, theirs, err_msg=field.name)


def stages(path: Path) -> list[dict]:
    (searches,) = json.loads(path.read_text())["searches"].values()
    return searches


def keep_only(path: Path, count: int) -> None:
    """What a kill after so many stages leaves."""
    content = json.loads(path.read_text())
    (searches,) = content["searches"].values()
    del searches[count:]
    path.write_text(json.dumps(content))


def test_a_search_goes_on_after_each_of_its_stages_to_the_same_end(problem, tmp_path, monkeypatch):
    path = tmp_path / "search.json"
    whole = solve(problem, None)
    assert_same(solve(problem, path), whole)
    names = [stage["name"] for stage in stages(path)]
    assert names[:4] == ["descent", "descent", "evolution", "evolution"]
    assert names.count("polish") == 2
    for count in range(len(names)):
        keep_only(path, count)
        assert_same(solve(problem, path), whole)
        assert [stage["name"] for stage in stages(path)] == names

    def fail(*_: object) -> None:
        raise AssertionError("computed again")

    for module in (descent, search, evolution):
        monkeypatch.setattr(module, "descend", fail)
    assert_same(solve(problem, path), whole)


def test_a_search_that_runs_out_of_steps_is_recalled_as_such(problem, tmp_path):
    path = tmp_path / "search.json"
    short = dataclasses.replace(SETTINGS, max_steps=5)
    whole = solve(problem, path, short)
    assert "5 steps allowed for a start were used up" in whole.message
    assert_same(solve(problem, path, short), whole)


def test_an_interrupted_search_goes_on(problem, tmp_path):
    path, reports = tmp_path / "search.json", []

    def interrupt(report: search.Progress) -> None:
        reports.append(report)
        if len(reports) == 30:
            raise KeyboardInterrupt

    kept = KeptStages(path, "a fit")
    first = search.find_best_fit(problem, SETTINGS, starts=2, kept=kept, progress=interrupt)
    assert first.interrupted and len(stages(path)) >= 2
    assert_same(solve(problem, path), solve(problem, None))


def test_time_adds_up_over_the_calls(problem, tmp_path):
    path = tmp_path / "search.json"
    solve(problem, path)
    content = json.loads(path.read_text())
    (searches,) = content["searches"].values()
    searches[-1]["history"][-1]["seconds"] = 500.0
    path.write_text(json.dumps(content))
    assert 500.0 < solve(problem, path).seconds < 520.0


def damaged(change: Callable[[dict], object]) -> Callable[[Path], object]:
    def damage(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return damage


def in_stage(**changes: object) -> Callable[[Path], object]:
    return damaged(lambda content: next(iter(content["searches"].values()))[1].update(changes))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_text(path.read_text()[:200]), "not the state of a search"),
        (lambda path: path.write_bytes(b"\xff\x00"), "not the state of a search"),
        (damaged(lambda content: content.update(format=9)), "its format is 9"),
        (damaged(lambda content: content.update(identity="x")), "the state of another fit"),
        (damaged(lambda content: content.pop("searches")), "it has no searches"),
        (in_stage(best=3), "best is 3; wanted a table"),
        (in_stage(point={"u": [0.0], "cost": 1.0}), "a point has not 3 numbers"),
        (in_stage(point={"u": [0.0, 1.0, float("nan")], "cost": 1.0}), "wanted a finite number"),
        (in_stage(random={}), "damaged"),
        (in_stage(random={"bit_generator": "PCG64", "state": 3}), "damaged"),
        (in_stage(history=[{"stage": "start"}]), "has no best, cost"),
    ],
)
def test_a_state_that_cannot_be_used_is_named_and_the_search_begins_anew(
    problem, tmp_path, damage, message
):
    path, lines = tmp_path / "search.json", []
    short = dataclasses.replace(SETTINGS, max_rounds=1)
    whole = solve(problem, path, short)
    damage(path)
    assert_same(solve(problem, path, short, warn=lines.append), whole)
    (line,) = lines
    assert "search.json" in line and message in line and "\n" not in line
    assert len(stages(path)) == 8


def test_another_search_does_not_use_the_stages(problem, tmp_path):
    path = tmp_path / "search.json"
    solve(problem, path)
    other = search.find_best_fit(
        problem, SETTINGS, starts=2, seed=1, kept=KeptStages(path, "a fit")
    )
    assert_same(other, search.find_best_fit(problem, SETTINGS, starts=2, seed=1))
    assert len(json.loads(path.read_text())["searches"]) == 2
