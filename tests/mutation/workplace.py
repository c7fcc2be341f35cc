"""A throwaway copy of the checkout in which mutants are tested; the checkout stays as it is."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from .mutants import Mutant

COPIED = ("data", "fitting", "jaxik", "tests", "pyproject.toml", "README.md", "CHANGELOG.md")
SHARED = "shared"  # reference material beside the checkout


class Workplace:
    """The copy, in a folder that is deleted afterwards."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.root = root
        self.checkout = folder / "checkout"
        self._written = 0
        ignored = shutil.ignore_patterns("__pycache__", ".*")
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, self.checkout / name, ignore=ignored)
            elif (root / name).exists():
                shutil.copy2(root / name, self.checkout / name)
        if (root.parent / SHARED).exists():
            (folder / SHARED).symlink_to((root.parent / SHARED).resolve())

    @contextlib.contextmanager
    def mutated(self, mutant: Mutant) -> Iterator[None]:
        """With a mutant in place of its module."""
        path = self.checkout / mutant.path
        path.write_text(mutant.source(self.root), encoding="utf-8")
        # Python recognises a changed module by its size and the second in which it was written.
        self._written += 1
        os.utime(path, (self._written, self._written))
        try:
            yield
        finally:
            shutil.copy2(self.root / mutant.path, path)
