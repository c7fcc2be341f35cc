"""Results on disk, from which a call goes on after an interrupt or a kill.

Each is a JSON file, written whole or not at all. What it follows from is its key: a digest in its
name, or entries of the file, which are compared with those that are wanted.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from .json_files import JsonFile
from .validation import Table

Result = TypeVar("Result", bound=Mapping[str, Any])
NO_KEY: Table = {}


@dataclasses.dataclass(frozen=True)
class Store(Generic[Result]):
    """The results of one kind in a folder."""

    kind: JsonFile[Result]
    folder: Path | None
    """It is made with the first result. None stores nothing."""
    other: str = ""
    """What a file with another key is, in words: `{changed}` names the entries that differ, and any
    other name in braces is that of an entry."""
    check: Callable[[Result], object] = lambda result: None
    """Raises ValueError for a result that contradicts itself or the request."""

    def remember(self, name: str, compute: Callable[[], Result], key: Table = NO_KEY) -> Result:
        """The stored result, or a new one, which is stored.

        Args:
            name: of its file.
            compute: makes it.
            key: entries that it must have.

        Raises:
            ValueError: as `read` and `write`.
        """
        result = self.read(name, key)
        if result is None:
            result = compute()
            self.write(name, result)
        return result

    def read(self, name: str, key: Table = NO_KEY) -> Result | None:
        """The stored result; None if there is none.

        Raises:
            ValueError: it is damaged, of a version that is not known, or has another key; the
                message names the file, and says what to do.
        """
        if self.folder is None or not (path := self.folder / name).exists():
            return None
        result = self.kind.read(path, self.check)
        if changed := [entry for entry in key if result.get(entry) != key[entry]]:
            other = self.other.format_map({**result, "changed": ", ".join(changed)})
            raise ValueError(f"{path}: {other}; {self.kind.advice}")
        return result

    def write(self, name: str, result: Mapping[str, Any]) -> None:
        """Stores a result in place of that which is there.

        Raises:
            ValueError: it cannot be written.
        """
        if self.folder is not None:
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            self.kind.write(path, result)

    def remove(self, name: str) -> None:
        """Deletes a result, if it is there."""
        if self.folder is not None:
            (self.folder / name).unlink(missing_ok=True)
