"""JSON files that say in which format they are, and whose content is checked when they are read.

A file without a version is one of a release before there were versions. What it has is checked in
the same way; what it must have, its kind says.

The `TypedDict` or dataclass that declares what is written also says what is accepted when it is
read again. `Annotated[float, constraint]` narrows a type by a `Constraint`;
`Annotated[Content, SomeClass]` is a table with the fields of a dataclass, and no others; a field
may have metadata that say by which name earlier releases wrote it.
"""

import dataclasses
import functools
import json
import math
import types
from collections.abc import Callable, Mapping, Set
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Generic,
    Literal,
    NotRequired,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from . import files
from .declarations import BOOLEAN, Constraint
from .validation import Table, in_one_line, read_json

FORMAT = "format"  # key of the version
Stored = TypeVar("Stored")

FORMERLY = "formerly"  # in the metadata of a field: its name in earlier releases
LARGEST = 1e300  # of whole numbers that are read as floats
Finite: TypeAlias = Annotated[float, Constraint("a finite number", lambda x: abs(x) < math.inf)]
PLAIN = {
    str: Constraint("a text", lambda value: isinstance(value, str)),
    bool: BOOLEAN,
    int: Constraint("a whole number", lambda value: type(value) is int),
    float: Constraint(
        "a number",
        lambda value: type(value) is float or type(value) is int and abs(value) < LARGEST,
        convert=float,
    ),
    types.NoneType: Constraint("null", lambda value: value is None),
}


@dataclasses.dataclass(frozen=True)
class JsonFile(Generic[Stored]):
    """A kind of JSON file: what it holds, and what a user reads whose file holds something else.

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

    def read(self, path: Path, check: Callable[[Stored], object] = lambda content: None) -> Stored:
        """What a file holds, its version left out.

        Args:
            path: of the file.
            check: raises ValueError where what it holds contradicts itself.

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
            stored = checked(content, self.content, None if version else self.essential)
            check(stored)
        except ValueError as error:
            raise self._refusal(path, str(error)) from None
        return stored

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


def length(count: int) -> Constraint:
    """A list of this many elements."""
    return Constraint(f"a list of {count}", lambda elements: len(elements) == count)


def checked(value: Any, declared: Any, essential: Set[str] | None = None) -> Any:
    """The value, if it is what is declared; whole numbers become floats where those are declared.

    Tables may have further keys, except those of dataclasses.

    Args:
        value: as JSON reads it.
        declared: a type: text, number, list, dict, Literal, union, `TypedDict` or dataclass.
        essential: the only keys that a table in it must have; None is all that are declared.

    Raises:
        ValueError: it is something else; the message says where, what came and what was wanted.
    """
    return _Check(essential).check(value, declared, "")


@dataclasses.dataclass(frozen=True)
class _Check:
    essential: Set[str] | None

    def check(self, value: Any, declared: Any, where: str) -> Any:
        if declared is Any:
            return value
        if (plain := PLAIN.get(declared)) is not None:
            return plain.convert(_wanted(plain.accepts(value), value, plain.description, where))
        origin, arguments = get_origin(declared), get_args(declared)
        if origin is Annotated:
            return self._constrained(value, arguments[0], arguments[1:], where)
        if origin is NotRequired:
            return self.check(value, arguments[0], where)
        if origin in (Union, types.UnionType):
            return self._any_of(value, arguments, where)
        if is_typeddict(declared) or dataclasses.is_dataclass(declared):
            return self._table(value, declared, where)
        if origin is Literal:
            return _wanted(value in arguments, value, f"one of {list(arguments)}", where)
        return self._collection(value, origin or declared, arguments, where)

    def _constrained(self, value: Any, declared: Any, constraints: tuple, where: str) -> Any:
        value = self.check(value, declared, where)
        for constraint in constraints:
            if isinstance(constraint, type):
                value = self.check(value, constraint, where)
                continue
            _wanted(constraint.accepts(value), value, constraint.description, where)
        return value

    def _any_of(self, value: Any, alternatives: tuple, where: str) -> Any:
        problems = []
        for alternative in alternatives:
            try:
                return self.check(value, alternative, where)
            except ValueError as error:
                problems.append(str(error))
        raise ValueError(problems[0])

    def _table(self, value: Any, declared: Any, where: str) -> Any:
        _wanted(isinstance(value, Mapping), value, "a table", where)
        hints = _hints(declared)
        if is_typeddict(declared):
            required = declared.__required_keys__
        else:
            fields = dataclasses.fields(declared)
            required = {field.name for field in fields}
            names = {field.metadata.get(FORMERLY, field.name): field.name for field in fields}
            value = {names.get(key, key): entry for key, entry in value.items()}
            if unknown := sorted(set(value) - required):
                raise ValueError(f"{where or 'it'} has an unknown {', '.join(unknown)}")
        if self.essential is not None:
            required = required & self.essential
        if missing := sorted(required - set(value)):
            raise ValueError(f"{where or 'it'} has no {', '.join(missing)}")
        return {
            key: self.check(entry, hints[key], _inside(where, key)) if key in hints else entry
            for key, entry in value.items()
        }

    def _collection(self, value: Any, kind: Any, arguments: tuple, where: str) -> Any:
        if issubclass(kind, Mapping):
            table: Table = _wanted(isinstance(value, Mapping), value, "a table", where)
            declared = arguments[1] if arguments else Any
            return {
                key: self.check(entry, declared, _inside(where, key))
                for key, entry in table.items()
            }
        _wanted(isinstance(value, list), value, "a list", where)
        declared = arguments[0] if arguments else Any
        return [self.check(entry, declared, f"{where}[{i}]") for i, entry in enumerate(value)]


@functools.cache  # a fit's file has a thousand tables
def _hints(declared: Any) -> dict[str, Any]:
    return get_type_hints(declared, include_extras=True)


def _inside(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def _wanted(accepted: bool, value: Any, description: str, where: str) -> Any:
    """The value, or a ValueError that says where it stands and what was wanted there."""
    if not accepted:
        text = repr(value)
        text = text if len(text) <= 40 else f"{text[:37]}..."
        raise ValueError(f"{where or 'it'} is {text}; wanted {description}")
    return value


# Results on disk, from which a call goes on after an interrupt or a kill.

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
