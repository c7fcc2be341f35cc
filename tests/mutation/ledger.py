"""Which tests are known to pass on the source as it is, and how long they take."""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from .ranking import Group

SOURCES = ("data", "fitting", "jaxik")


class Ledger:
    """Tests that have passed, kept in a file; what a change of any source may affect is forgotten.

    A test that has passed with some mutant in place passes without it: it fails for its mutants
    and not for itself.
    """

    def __init__(self, path: Path, root: Path) -> None:
        self.path, self.root = path, root
        known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        self._common = self._digest_of_sources()
        self._files: dict[str, dict] = {
            file: entry for file, entry in known.items() if entry["digest"] == self._digest(file)
        }

    def add(self, passed: dict[str, tuple[float, bool]], whole: Iterable[Group] = ()) -> None:
        """Notes tests that passed.

        Args:
            passed: by name, CPU seconds and whether a test is marked as slow.
            whole: groups of which these are all tests.
        """
        for test, (seconds, slow) in passed.items():
            file = test.partition("::")[0]
            self._entry(file)["tests"][test] = seconds, slow
        for file, slow in whole:
            self._entry(file)["whole"][str(slow)] = True
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(self._files), encoding="utf-8")

    def __contains__(self, test: str) -> bool:
        return test in self._files.get(test.partition("::")[0], {"tests": ()})["tests"]

    def seconds(self) -> dict[Group, float]:
        """CPU seconds of each group of tests all of which are known."""
        return {
            Group(file, slow): sum(time for time, is_slow in tests if is_slow == slow)
            for file, entry in self._files.items()
            for tests in [entry["tests"].values()]
            for slow in (False, True)
            if str(slow) in entry["whole"]
        }

    def _entry(self, file: str) -> dict:
        return self._files.setdefault(
            file, {"digest": self._digest(file), "tests": {}, "whole": {}}
        )

    def _digest(self, file: str) -> str:
        path = self.root / file
        own = path.read_bytes() if path.exists() else b""
        return hashlib.sha256(self._common + own).hexdigest()

    def _digest_of_sources(self) -> bytes:
        """Changes with everything but the files of tests themselves."""
        paths = [path for name in SOURCES for path in (self.root / name).rglob("*.py")]
        helpers = (self.root / "tests").rglob("*.py")
        paths += [path for path in helpers if not path.name.startswith("test_")]
        digest = hashlib.sha256()
        for path in sorted(path for path in paths if path.parent.name != "mutation"):
            digest.update(path.relative_to(self.root).as_posix().encode() + path.read_bytes())
        return digest.digest()
