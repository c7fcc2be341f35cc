"""JSON files that say in which format they are, and whose content is checked when they are read.

A file without a version is one of a release before there were versions. What it has is checked in
the same way; what it must have, its kind says.
"""

import dataclasses
import json
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any, Generic, TypeVar

from fitting.runtime import files
from fitting.runtime.validation import in_one_line, read_json

from .declared_types import checked

FORMAT = "format"  # key of the version
Stored = TypeVar("Stored")


@dataclasses.dataclass(frozen=True)
class JsonFile(Generic[Stored]):
    """A kind of JSON file: what it holds, and what to tell a user whose file holds something else.

    The declared content is a `TypedDict` or a dataclass.
    """

    content: type[Stored]
    description: str
    """In words, after "not": "the numbers of a fit"."""
    advice: str
    """What to do about a damaged one."""
    version: int = 1
    """Of the format that is written; all from 1 on are read."""
    essential: Set[str] | None = None
    """The only keys that a file without a version must have; None is all."""
    indent: int | None = 2
    """Spaces; None is one line, which is written ten times as fast."""

    def write(self, path: Path, content: Mapping[str, Any]) -> None:
        """Writes a file, its version first."""
        write_json(path, content, self.version, self.indent)

    def read(self, path: Path) -> Stored:
        """What a file holds, its version left out.

        Raises:
            ValueError: it cannot be read, holds something else, or has a version that is not known;
                the message names it, and says what was wanted and what to do.
        """
        try:
            content = read_json(path)
        except (OSError, ValueError) as error:
            problem = error.strerror if isinstance(error, OSError) else in_one_line(error)
            raise self._refusal(path, f"not JSON ({problem})") from None
        version = content.pop(FORMAT, 0) if isinstance(content, dict) else 0
        check_version(path, version, self.version)
        try:
            return checked(content, self.content, None if version else self.essential)
        except ValueError as error:
            raise self._refusal(path, str(error)) from None

    def _refusal(self, path: Path, problem: str) -> ValueError:
        return ValueError(f"{path}: not {self.description}: {problem}; {self.advice}")


def write_json(
    path: Path, content: Mapping[str, Any], version: int = 1, indent: int | None = 2
) -> None:
    """Writes numbers as JSON, with the version of their format first."""
    text = json.dumps({FORMAT: version, **content}, indent=indent, default=float)
    files.write_text(path, text + "\n")


def check_version(path: Path, version: object, newest: int) -> None:
    """Checks that the version of a file's format, 0 where it has none, is a known one.

    Raises:
        ValueError: it is not.
    """
    known = isinstance(version, int) and not isinstance(version, bool) and 0 <= version <= newest
    if not known:
        raise ValueError(
            f"{path}: its format is {version!r}; this release reads formats up to {newest}; a "
            "newer jaxik may read it"
        )
