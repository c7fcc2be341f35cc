"""Searches and profiles that were killed go on, and end to the last bit as they would have."""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from fitting.inference.optimise import checkpoints, descent, evolution, search
from fitting.inference.optimise.checkpoints import Checkpoints
from fitting.inference.optimise.solution import SearchSettings, Solution
from fitting.inference.profiles import profiling
from fitting.inference.profiles.profile import Curves
from fitting.problem.problem import Problem
from support.curves import curve_problem
from support.watching import listening

# Two ends are too few to agree, so that each start takes all stages.
SETTINGS = SearchSettings(
    descents=2, agreeing_starts=3, max_rounds=3, generations=2, population=20, elite=5
)
SHORT = dataclasses.replace(SETTINGS, max_rounds=1)


@functools.cache
def problem() -> Problem:
    return curve_problem(("height", "rate", "turn"))


@pytest.fixture
def path(tmp_path, monkeypatch) -> Path:
    """Where stages are written, each at once."""
    monkeypatch.setattr(checkpoints, "SECONDS_BETWEEN_WRITES", 0.0)
    return tmp_path / "search.json"


def checkpoints_in(path: Path | None, **options) -> Checkpoints:
    return Checkpoints(path and path.parent, "search.json", "a fit", **options)


def change_file(path: Path, change: Callable[[dict], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def assert_warned(lines: list[str], message: str) -> None:
    """Once, of the file, in one line."""
    (line,) = lines
    assert "search.json" in line and message in line and "\n" not in line


# Searches


def solve(path: Path | None, settings: SearchSettings = SETTINGS, seed: int = 0, **options):
    with checkpoints_in(path, **options):
        return search.find_best_fit(problem(), settings, starts=2, seed=seed)


@functools.cache
def whole(settings: SearchSettings = SETTINGS) -> Solution:
    """Found in one go."""
    return solve(None, settings)


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


def stages_in(content: dict) -> list[dict]:
    """Of the only search."""
    (stages,) = content["searches"].values()
    return stages


def keep_only(path: Path, count: int) -> None:
    """What a kill after so many stages leaves."""
    content = json.loads(path.read_text())
    del stages_in(content)[count:]
    path.write_text(json.dumps(content))


def names_in(path: Path) -> list[str]:
    return [stage["name"] for stage in stages_in(json.loads(path.read_text()))]


def test_a_search_goes_on_after_each_of_its_stages_to_the_same_end(path, monkeypatch):
    assert_same(solve(path), whole())
    names = names_in(path)
    assert names[:4] == ["descent", "descent", "evolution", "evolution"]
    assert names.count("polish") == 2
    for count in range(len(names)):
        keep_only(path, count)
        assert_same(solve(path), whole())
        assert names_in(path) == names

    fail = mock.Mock(side_effect=AssertionError("computed again"))
    for module in (descent, search, evolution):
        monkeypatch.setattr(module, "descend", fail)
    assert_same(solve(path), whole())


def test_a_search_that_runs_out_of_steps_is_recalled_as_such(path):
    few = dataclasses.replace(SETTINGS, max_steps=5)
    first = solve(path, few)
    assert "5 steps allowed for a start were used up" in first.message
    assert_same(solve(path, few), first)


def test_only_searches_inside_the_checkpoints_use_them(path):
    with pytest.raises(RuntimeError, match="a kill"), checkpoints_in(path):
        stop()
    assert_same(search.find_best_fit(problem(), SHORT, starts=2), whole(SHORT))
    assert not path.exists()


def test_time_adds_up_over_the_calls_and_another_search_does_not_use_the_stages(path):
    solve(path, SHORT)
    change_file(path, lambda content: stages_in(content)[-1]["history"][-1].update(seconds=500.0))
    assert 500.0 < solve(path, SHORT).seconds < 520.0
    assert_same(solve(path, SHORT, seed=1), solve(None, SHORT, seed=1))
    assert len(json.loads(path.read_text())["searches"]) == 2


def in_stage(**changes: object) -> Callable[[dict], object]:
    return lambda content: stages_in(content)[1].update(changes)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content.update(format=9), "its format is 9"),
        (lambda content: content.update(identity="x"), "the state of another fit"),
        (lambda content: content.pop("searches"), "it has no searches"),
        (in_stage(best=3), "best is 3; wanted a table"),
        (in_stage(point={"u": [0.0], "cost": 1.0}), "a point has not 3 numbers"),
        (in_stage(point={"u": [0.0, 1.0, float("nan")], "cost": 1.0}), "wanted a finite number"),
        (in_stage(random={}), "damaged"),
        (in_stage(random={"bit_generator": "PCG64", "state": 3}), "damaged"),
        (in_stage(history=[{"stage": "start"}]), "has no best, cost"),
    ],
)
def test_a_state_that_cannot_be_used_is_named_and_the_search_begins_anew(path, damage, message):
    lines = []
    solve(path, SHORT)
    change_file(path, damage)
    with listening(lines.append):
        assert_same(solve(path, SHORT), whole(SHORT))
    assert_warned(lines, message)
    assert len(names_in(path)) == 8


def test_a_file_that_is_no_state_is_named(path):
    for content in (b'{"format": 1, "ident', b"\xff\x00"):
        path.write_bytes(content)
        lines = []
        with listening(lines.append):
            checkpoints_in(path)
        assert_warned(lines, "not the state of a search")


# Profiles


@functools.cache
def solution() -> Solution:
    return search.find_best_fit(problem(), starts=1)


def find_curves(path: Path | None = None, **options) -> Curves:
    with checkpoints_in(path, **options):
        return profiling.find_curves(problem(), solution())


def assert_same_curves(curves: Curves, others: Curves) -> None:
    for mine, theirs in zip(curves.curves, others.curves, strict=True):
        for name in ("u", "values", "cost"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)


def stop(*_: object) -> None:
    raise RuntimeError("in place of a kill")


def kill_at(number: int, monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    """Finds profiles until this stage begins."""
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="a kill"):
        patch.setattr(profiling, "STAGES", [*profiling.STAGES[:number], stop])
        find_curves(path)


def test_profiles_go_on_after_each_of_their_stages_to_the_same_end(path, monkeypatch):
    found, called = find_curves(), []
    for number in range(1, 9):
        kill_at(number, monkeypatch, path)
        assert checkpoints_in(path).profile_count == number
    stages = [lambda state: called.append(state.stages), *profiling.STAGES[1:]]
    monkeypatch.setattr(profiling, "STAGES", stages)
    assert_same_curves(find_curves(path), found)
    monkeypatch.setattr(profiling, "STAGES", [stop] * len(stages))
    assert_same_curves(find_curves(path), found)
    assert called == []


def test_the_profiles_of_another_solution_are_not_used(path, monkeypatch):
    kill_at(1, monkeypatch, path)
    u, stored = solution().u, checkpoints_in(path)
    stored.recall_profiles(problem(), u + 1e-9, stop)
    stored.recall_profiles(curve_problem(problem().space.names, loss="huber"), u, stop)
    with pytest.raises(RuntimeError, match="a kill"):
        stored.recall_profiles(problem(), u, stop)


NOT_FINITE = {"cost": [float("nan")], "u": [[0.0] * 3], "values": [[0.0] * 3]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda stored: stored.update(stages=-1), "wanted a whole number from 0 to 100"),
        (lambda stored: stored["curves"].pop(), "there are 2 profiles of 3 parameters"),
        (lambda stored: stored["curves"][0]["cost"].pop(), "cannot reshape"),
        (lambda stored: stored["curves"][1]["u"][0].pop(), "damaged"),
        (lambda stored: stored["curves"][1].update(NOT_FINITE), "a point without a cost"),
        (lambda stored: stored["curves"][1].update(cost=[], u=[], values=[]), "or no point"),
        (lambda stored: stored.update(random={}), "damaged"),
        (lambda stored: stored.update(cliffs=[[1]]), "wanted a list of 2"),
    ],
)
def test_profiles_that_cannot_be_used_are_named_and_begin_anew(path, monkeypatch, change, message):
    lines = []
    kill_at(1, monkeypatch, path)
    change_file(path, lambda content: change(next(iter(content["profiles"].values()))))
    monkeypatch.setattr(profiling, "STAGES", [])
    with listening(lines.append):
        find_curves(path)
    assert_warned(lines, message)
