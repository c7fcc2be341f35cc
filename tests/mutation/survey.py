"""Which tests execute which lines, and how long each takes: one run of the suite shows it."""

import ast
import hashlib
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from coverage import CoverageData

COVERAGE, TIMES, DIGESTS = "coverage", "tests.xml", "digests.json"
SOURCES = ("data", "fitting", "jaxik", "tests")
EVERYTHING = "slow or not slow"
COLLECTION = 0.5  # seconds that it takes to find the tests of a file


def make(root: Path, folder: Path, marks: str) -> None:
    """Runs the tests with these marks, and keeps in a folder what that shows."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / DIGESTS).unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-m", marks]
    command += ["--cov", "--cov-context=test", "--cov-report=", f"--junitxml={folder / TIMES}"]
    subprocess.run(command, cwd=root, env=os.environ | {"COVERAGE_FILE": str(folder / COVERAGE)})
    (folder / DIGESTS).write_text(json.dumps(_digests(root)), encoding="utf-8")


class Survey:
    """What a run of the suite has shown. A test that failed in it is not asked."""

    def __init__(self, root: Path, folder: Path) -> None:
        """Reads what `make` kept."""
        self._data = CoverageData(str(folder / COVERAGE))
        self._data.read()
        self.seconds: dict[str, float] = {}
        for case in ElementTree.parse(folder / TIMES).iter("testcase"):
            if not len(case):  # neither failed nor skipped
                file = case.get("classname", "").replace(".", "/")
                self.seconds[f"{file}.py::{case.get('name')}"] = float(case.get("time", 0))
        self._order = {test: place for place, test in enumerate(self.seconds)}
        known, now = json.loads((folder / DIGESTS).read_text(encoding="utf-8")), _digests(root)
        self.changed = [file for file, digest in now.items() if known.get(file) != digest]

    def passes(self, test: str) -> bool:
        """Whether a test is known to pass on the source as it is."""
        is_own = all(Path(file).name.startswith("test_") for file in self.changed)
        return is_own and test in self.seconds and _file(test) not in self.changed

    def asked(self, root: Path, path: str, line: int) -> list[str]:
        """Tests to ask about a change of a line, in the order in which they run.

        First, whole, the files of tests that changed since the survey; then the tests that execute
        the statement, or those of the module's folder where imports alone do, and last what else
        is in files of which a test executes the module, as fixtures and compiled programs serve
        several tests. Quick files come before slow ones.
        """
        contexts = self._data.contexts_by_lineno(path)
        tests = {number: _tests(names) & self.seconds.keys() for number, names in contexts.items()}
        lines = statement(root / path, line)
        hitting = set().union(*(tests.get(number, set()) for number in lines))
        if not hitting:
            folder = Path("tests", Path(path).with_suffix("").parts[1])
            hitting = {test for test in self.seconds if folder in Path(_file(test)).parents}
        files = {_file(test) for test in set().union(*tests.values())}
        others = {test for test in self.seconds if _file(test) in files} - hitting
        changed = [file for file in self.changed if Path(file).name.startswith("test_")]
        return [*changed, *self._sorted(hitting), *self._sorted(others)]

    def _sorted(self, tests: Iterable[str]) -> list[str]:
        seconds: dict[str, float] = defaultdict(float)  # by file
        for test in tests:
            seconds[_file(test)] += self.seconds[test]
        return sorted(tests, key=lambda x: (seconds[_file(x)], _file(x), self._order[x]))

    def first_part(self, asked: list[str], budget: float) -> list[str]:
        """The first of these, as many as are run within so many seconds, at least one."""
        total, files = 0.0, set()
        for count, test in enumerate(asked):
            total += self.seconds.get(test, 0.0) + COLLECTION * (_file(test) not in files)
            files.add(_file(test))
            if count and total > budget:
                return asked[:count]
        return asked


def statement(path: Path, line: int) -> range:
    """The lines of the innermost statement that a line is in; of a block, those of its head."""
    lines = range(line, line + 1)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or 0):
            body = getattr(node, "body", None)
            end = body[0].lineno if body else (node.end_lineno or 0) + 1
            if line < end:
                lines = range(node.lineno, end)
    return lines


def _tests(contexts: Iterable[str]) -> set[str]:
    """Names of tests, of which a context adds the phase; what only imports execute has none."""
    return {context.rpartition("|")[0] for context in contexts if context}


def _file(test: str) -> str:
    return test.partition("::")[0]


def _digests(root: Path) -> dict[str, str]:
    """Of all Python files, from the root of the checkout; those of mutation testing left out."""
    paths = [path for name in SOURCES for path in sorted((root / name).rglob("*.py"))]
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in paths
        if path.parent.name != "mutation"
    }
