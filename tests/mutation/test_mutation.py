"""The command that tests the tests: which mutants it makes, and that it tells what becomes of them.

On a package of a single module; `PYTHONPATH=tests python -m mutation` is the run on jaxik.
"""

import math
from pathlib import Path

import pytest

from mutation import trial
from mutation.explained import EXPLAINED, Explained, reason_for
from mutation.mutants import diff, modules_of, mutants_of, sample
from mutation.report import CAUGHT, SURVIVED, Result, score, summary
from mutation.run import Run
from mutation.survey import EVERYTHING, Survey, make, statement
from mutation.trial import Workplace

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
TESTS = {
    "tests/solvers/test_toy.py": """from jaxik.solvers.toy import Doubling

def test_nothing_is_twice_nothing():
    assert Doubling().doubled(0) == 0

def test_nothing_at_all():
    pass
""",
    "tests/solvers/test_other.py": """import time

from jaxik.solvers.toy import Doubling

def test_what_fails_already():
    assert Doubling().doubled(1) == 3

def test_a_slow_sum():
    time.sleep(0.2)
    assert Doubling().doubled(0) + 0 == 0
""",
    "tests/solvers/test_else.py": "def test_something_else():\n    assert True\n",
}
SETTINGS = """[tool.coverage.run]
source = ["jaxik"]
relative_files = true
[tool.pytest.ini_options]
pythonpath = ["."]
"""
CATCHER = "tests/solvers/test_toy.py::test_nothing_is_twice_nothing"
SLOW_CATCHER = "tests/solvers/test_other.py::test_a_slow_sum"


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory):
    """A checkout with a module and weak tests of it, and the folder of its survey."""
    root, folder = tmp_path_factory.mktemp("root"), tmp_path_factory.mktemp("survey")
    files = {MODULE: SOURCE, "pyproject.toml": SETTINGS, **TESTS}
    files |= {f"{folder}/__init__.py": "" for folder in ("jaxik", "jaxik/solvers")}
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    make(root, folder, EVERYTHING)
    return root, folder


@pytest.fixture
def run(surveyed, tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "PRELOADED", [])
    root, folder = surveyed
    return Run(Workplace(root, tmp_path / "copy"), Survey(root, folder), tmp_path / "1.jsonl")


@pytest.mark.slow
def test_only_what_runs_is_mutated(surveyed):
    changes = [diff(mutant, surveyed[0]) for mutant in mutants_of(surveyed[0], MODULE)]
    assert sorted(changes) == [
        ("if x is None:", "if not x is None:"),
        ("if x is None:", "if x is not None:"),
        ("return 2.0 * x", "return 1.0 * x"),
        ("return 2.0 * x", "return 2.0 / x"),
        ("return 2.0 * x", "return 3.0 * x"),
    ]


@pytest.mark.slow
def test_those_are_asked_that_execute_the_line_and_pass_quick_files_first(surveyed):
    """Files that changed since the survey are asked before them, whole."""
    root, folder = surveyed
    survey = Survey(root, folder)
    line = 1 + SOURCE.splitlines().index("        return 2.0 * x")
    asked = survey.asked(root, MODULE, line)
    assert asked == [CATCHER, SLOW_CATCHER, "tests/solvers/test_toy.py::test_nothing_at_all"]
    assert survey.first_part(asked, 0.0) == asked[:1] and survey.first_part(asked, 9.0) == asked
    assert survey.passes(CATCHER) and not survey.passes("tests/solvers/test_toy.py::test_new")
    new = root / "tests/solvers/test_new.py"
    new.write_text(TESTS["tests/solvers/test_else.py"], encoding="utf-8")
    try:
        survey = Survey(root, folder)
    finally:
        new.unlink()
    assert survey.asked(root, MODULE, line) == ["tests/solvers/test_new.py", *asked]
    assert survey.passes(CATCHER)


def test_a_change_of_a_statement_is_one_of_all_its_lines(tmp_path):
    path = tmp_path / "a.py"
    path.write_text("x = [\n    1,\n]\nif (\n    x\n):\n    y = 2\n", encoding="utf-8")
    assert [list(statement(path, line)) for line in (2, 5, 7)] == [[1, 2, 3], [4, 5, 6], [7]]


@pytest.mark.slow
def test_a_run_tells_caught_mutants_from_survivors_and_keeps_what_it_found(run):
    root, seen = run.workplace.root, []
    wanted = ("return 2.0 / x", "return 1.0 * x")
    chosen = [mutant for mutant in mutants_of(root, MODULE) if diff(mutant, root)[1] in wanted]
    run.round(chosen, math.inf, lambda results, seconds, last: seen.append(last))
    outcomes = {result.after: (result.outcome, result.by) for result in run.results_of(chosen)}
    assert outcomes == {"return 2.0 / x": (CAUGHT, CATCHER), "return 1.0 * x": (SURVIVED, "")}
    assert (root / MODULE).read_text() == SOURCE

    again = Run(run.workplace, run.survey, run.kept)
    again.round(chosen, math.inf, lambda *_: pytest.fail("tested again"))
    assert again.results_of(chosen) == seen
    assert "50.0%" in summary(seen) and f"{MODULE}:15" in summary(seen)


@pytest.mark.slow
def test_a_run_ends_where_tests_fail_without_any_change(run, monkeypatch):
    monkeypatch.setattr(run.survey, "passes", lambda test: False)
    monkeypatch.setattr(run.survey, "asked", lambda *_: ["tests/solvers/test_other.py"])
    with pytest.raises(SystemExit, match="Without any change"):
        run.round(mutants_of(run.workplace.root, MODULE), math.inf, lambda *_: None)


def test_a_sample_takes_from_each_module_by_its_number_of_mutants():
    modules = modules_of(ROOT, "jaxik/solvers")
    mutants = [mutant for path in modules for mutant in mutants_of(ROOT, path)]
    chosen = sample(mutants, 50, seed=4)
    assert chosen == sample(mutants, 50, seed=4) != sample(mutants, 50, seed=5)
    assert len(set(chosen)) == 50
    for path in modules:
        share = 50 * sum(x.path == path for x in mutants) / len(mutants)
        assert abs(sum(x.path == path for x in chosen) - share) <= 1.0


def test_the_score_has_the_interval_of_wilson_and_leaves_out_what_is_explained():
    results = [Result(MODULE, 1, "a", str(i), CAUGHT if i < 95 else SURVIVED) for i in range(100)]
    results += [Result(MODULE, 2, "a", "b", "explained")] * 7
    z, n, part = 1.959964, 100, 0.95  # the formula of Wilson (1927)
    centre = (part + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(part * (1 - part) / n + z**2 / (4 * n**2))
    assert score(results) == pytest.approx((part, centre - half, centre + half), abs=1e-6)
    assert "| all | 107 | 95 | 5 | 7 |" in summary(results)


def test_an_explanation_is_about_lines_that_exist():
    entry = Explained("a.py", "1 + y", "1 - y", "symmetric")
    assert entry.matches("a.py", "x = 1 + y  # m", "x = 1 - y  # m")
    assert not entry.matches("b.py", "x = 1 + y", "x = 1 - y")
    assert not entry.matches("a.py", "x = 1 + y", "x = 2 + y")
    assert entry._replace(after="").matches("a.py", "x = 1 + y", "x = 2 + y")
    for entry in EXPLAINED:
        text = " ".join((ROOT / entry.path).read_text(encoding="utf-8").split())
        assert entry.before in text, entry
        assert reason_for(entry.path, entry.before, entry.after) == entry.reason
