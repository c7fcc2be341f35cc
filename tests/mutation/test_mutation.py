"""The command that tests the tests: which mutants it makes, and that it tells what becomes of them.

On a package of a single module; `PYTHONPATH=tests python -m mutation` is the run on jaxik.
"""

import json
import math
from pathlib import Path

import pytest

from mutation import trial
from mutation.explained import EXPLAINED, Explained, reason_for
from mutation.mutants import diff, modules_of, mutants_of, sample
from mutation.ranking import NEAR, RINGS, Group, first_part, ranked, wing_of
from mutation.report import CAUGHT, SURVIVED, Result, score, summary
from mutation.run import Run
from mutation.workplace import Workplace

ROOT = Path(__file__).resolve().parents[2]
MODULE = "jaxik/solvers/toy.py"
SOURCE = '''"""Doubles 1 + 1."""

from abc import abstractmethod
from typing import TypeAlias

Number: TypeAlias = "float | int"


class Doubling:
    @abstractmethod
    def doubled(self, x: int | None) -> float | None:
        """Twice x, not 3 times."""
        if x is None:
            raise ValueError(f"{1 + 1} is wanted")
        return 2.0 * x
'''
TESTS = """from jaxik.solvers.toy import Doubling

def test_nothing_is_twice_nothing():
    assert Doubling().doubled(0) == 0
"""


@pytest.fixture
def root(tmp_path):
    """A checkout with a module and a weak test of it."""
    for name, text in ((MODULE, SOURCE), ("tests/solvers/test_toy.py", TESTS)):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    for folder in ("jaxik", "jaxik/solvers"):
        (tmp_path / folder / "__init__.py").touch()
    return tmp_path


def test_only_what_runs_is_mutated(root):
    changes = [diff(mutant, root) for mutant in mutants_of(root, MODULE)]
    assert sorted(changes) == [
        ("if x is None:", "if not x is None:"),
        ("if x is None:", "if x is not None:"),
        ("return 2.0 * x", "return 1.0 * x"),
        ("return 2.0 * x", "return 2.0 / x"),
        ("return 2.0 * x", "return 3.0 * x"),
    ]


def test_a_run_tells_caught_mutants_from_survivors_and_keeps_what_it_found(
    root, tmp_path_factory, monkeypatch
):
    monkeypatch.setattr(trial, "PRELOADED", [])
    chosen = [
        x
        for x in mutants_of(root, MODULE)
        if diff(x, root)[1] in ("return 2.0 / x", "return 1.0 * x")
    ]
    kept, seen = tmp_path_factory.mktemp("kept"), []
    run = Run(Workplace(root, tmp_path_factory.mktemp("copy")), kept, "1")
    run.round(chosen, math.inf, lambda results, seconds, last: seen.append(last))
    outcomes = {result.after: (result.outcome, result.by) for result in run.results_of(chosen)}
    by = "tests/solvers/test_toy.py::test_nothing_is_twice_nothing"
    assert outcomes == {"return 2.0 / x": (CAUGHT, by), "return 1.0 * x": (SURVIVED, "")}
    assert (root / MODULE).read_text() == SOURCE

    again = Run(run.workplace, kept, "1")
    again.round(chosen, math.inf, lambda *_: pytest.fail("tested again"))
    assert again.results_of(chosen) == seen
    assert "50.0%" in summary(seen) and f"{MODULE}:15" in summary(seen)


def test_a_run_ends_where_tests_fail_without_any_change(root, tmp_path_factory, monkeypatch):
    monkeypatch.setattr(trial, "PRELOADED", [])
    (root / "tests/solvers/test_toy.py").write_text("import nothing_that_exists")
    run = Run(Workplace(root, tmp_path_factory.mktemp("copy")), root / "build", "1")
    with pytest.raises(SystemExit, match="Without any change"):
        run.round(mutants_of(root, MODULE), math.inf, lambda *_: None)


def test_a_sample_takes_from_each_module_by_its_number_of_mutants():
    modules = modules_of(ROOT, "jaxik/solvers")
    mutants = [mutant for path in modules for mutant in mutants_of(ROOT, path)]
    chosen = sample(mutants, 50, seed=4)
    assert chosen == sample(mutants, 50, seed=4) != sample(mutants, 50, seed=5)
    assert len(set(chosen)) == 50
    for path in modules:
        share = 50 * sum(x.path == path for x in mutants) / len(mutants)
        assert abs(sum(x.path == path for x in chosen) - share) <= 1.0


def test_tests_run_by_likely_catches_per_second_within_their_budget():
    quick, near, catcher = (
        Group(f"tests/solvers/test_{x}.py", False) for x in ("aim", "pole", "x")
    )
    seconds = {quick: 1.0, near: 4.0, catcher: 4.0}
    groups = ranked("jaxik/solvers/pole.py", [quick, near, catcher], seconds, {catcher: 90})
    assert groups == [catcher, near, quick]
    assert first_part(groups, seconds, budget=10.0) == ([catcher, near], [quick])


def test_tests_of_a_module_run_before_those_of_its_folder():
    names = ("stages/test_declarations", "stages/test_limits", "stages/test_stride_probe")
    groups = [Group(f"tests/{name}.py", False) for name in names]
    assert ranked("jaxik/stages/probe/stride.py", groups, {}, {}) == groups[::-1]


def test_every_wing_has_tests():
    wings = {wing_of(path) for path in modules_of(ROOT, "jaxik")}
    assert wings <= RINGS.keys()
    places = [place for wing in wings for place in RINGS[wing]]
    places += [name for names in NEAR.values() for name in names]
    assert not [place for place in places if not (ROOT / "tests" / place).exists()]


def test_the_score_has_the_interval_of_wilson_and_leaves_out_what_is_explained():
    results = [Result(MODULE, 1, "a", str(i), CAUGHT if i < 95 else SURVIVED) for i in range(100)]
    results += [Result(MODULE, 2, "a", "b", "explained")] * 7
    z, n, part = 1.959964, 100, 0.95  # the formula of Wilson (1927)
    centre = (part + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(part * (1 - part) / n + z**2 / (4 * n**2))
    assert score(results) == pytest.approx((part, centre - half, centre + half), abs=1e-6)
    assert "| all | 107 | 95 | 5 | 7 |" in summary(results)


def test_an_explanation_is_about_lines_that_exist():
    entry = Explained("a.py", "x = 1 + y...", "x = 1 - y...", "symmetric")
    assert entry.matches("a.py", "x = 1 + y  # m", "x = 1 - y  # m")
    assert not entry.matches("b.py", "x = 1 + y", "x = 1 - y")
    for entry in EXPLAINED:
        before = entry.before.removesuffix("...")
        text = " ".join((ROOT / entry.path).read_text(encoding="utf-8").split())
        assert before in text, entry
        assert reason_for(entry.path, entry.before, entry.after)
    assert json.dumps(EXPLAINED)
