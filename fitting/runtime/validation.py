"""Checks on files that users write: known keys, and values of the right type and range."""

import difflib
import json
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

Content: TypeAlias = dict[str, Any]  # tables as TOML or JSON reads them, not yet checked
Table: TypeAlias = Mapping[str, Any]  # the same, to read only

QUOTED = 200  # characters of the error of another library, in a sentence of ours


class Constraint(NamedTuple):
    """What a value must be: in words for error messages, and as a test."""

    description: str
    accepts: Callable[[object], bool]


def _number_in(accepts: Callable[[float], bool]) -> Callable[[object], bool]:
    """A test for numbers that are not NaN and for which `accepts` holds."""

    def test(value: object) -> bool:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        return not math.isnan(value) and accepts(value)

    return test


def _integer_in(accepts: Callable[[float], bool]) -> Callable[[object], bool]:
    return lambda value: isinstance(value, int) and _number_in(accepts)(value)


TEXT = Constraint("a text", lambda value: isinstance(value, str))
BOOLEAN = Constraint("true or false", lambda value: isinstance(value, bool))
TABLE = Constraint("a table", lambda value: isinstance(value, Mapping))
NUMBER = Constraint("a number", _number_in(lambda value: True))
POSITIVE = Constraint("a number above 0", _number_in(lambda value: value > 0))
FINITE_POSITIVE = Constraint(
    "a finite number above 0", _number_in(lambda value: 0 < value < math.inf)
)
SECONDS = Constraint("a number of seconds, 0 or more", _number_in(lambda value: value >= 0))
FRACTION = Constraint("a number from 0 to below 1", _number_in(lambda value: 0 <= value < 1))
COUNT = Constraint("a whole number above 0", _integer_in(lambda value: value > 0))
SEED = Constraint(
    "a whole number from 0 to 4294967295", _integer_in(lambda value: 0 <= value < 2**32)
)


def one_of(words: Sequence[str]) -> Constraint:
    """Any of these texts."""
    return Constraint(f"one of {list(words)}", lambda value: value in words)


def list_of(description: str) -> Constraint:
    """A list, described in these words; its elements are checked elsewhere."""
    return Constraint(description, lambda value: isinstance(value, list))


def read_toml(path: Path, description: str) -> Content:
    """The tables of a TOML file.

    Args:
        path: the file.
        description: what kind of file it should be, for the error message: "an experiment".

    Raises:
        ValueError: the file does not exist or is not TOML.
    """
    if not path.is_file():
        raise ValueError(f"{path}: {why_missing(path)}, wanted {description} file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not TOML: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}: not TOML: nested too deeply") from None


def read_json(path: Path) -> Any:
    """What a JSON file holds.

    Raises:
        ValueError: the file is not JSON; the message does not name it.
        OSError: it cannot be read.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def why_missing(path: Path) -> str:
    """Why there is no file to read at this path, in words."""
    return "a folder" if path.is_dir() else "no such file"


@contextmanager
def error_context(where: Path | str) -> Iterator[None]:
    """Prefixes any ValueError raised inside with the place it belongs to."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def in_one_line(error: Exception, longest: int = 1000) -> str:
    """An error in one line that any terminal can show, for a message.

    Args:
        error: ours, or that of another library, which may quote whole files.
        longest: characters; a longer line loses its middle.
    """
    text = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        text = f"{error.filename}: {error.strerror}"
    line = " ".join(text.splitlines())
    line = "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in line)
    end = longest // 3
    return line if len(line) <= longest else f"{line[: longest - end - 5]} ... {line[-end:]}"


def check_keys(table: Table, known: Sequence[str], where: str) -> None:
    """Checks that all keys are known ones.

    Raises:
        ValueError: a key is unknown; the message names the nearest known one.
    """
    for key in table:
        if key not in known:
            nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise ValueError(
                f"{where}: unknown key {key!r}; nearest is {nearest!r} of {list(known)}"
            )


def check_table(value: object, constraints: Mapping[str, Constraint], where: str) -> Table:
    """Returns the value if it is a table with these keys, each value meeting its constraint.

    Args:
        value: what was read.
        constraints: what the value under each known key must be; any key may be absent.
        where: the table's place in its file, for the error message.

    Raises:
        ValueError: it is no table, or has an unknown key or a value that is not accepted.
    """
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} is {value!r}; wanted a table, such as {{}}")
    check_keys(value, list(constraints), where)
    for key, entry in value.items():
        if not constraints[key].accepts(entry):
            raise ValueError(f"{where}: {key} is {entry!r}; wanted {constraints[key].description}")
    return value


def flatten(tables: Table, depth: int, prefix: str = "") -> Content:
    """Nested TOML tables as one with dotted keys of up to `depth` parts: `lock.enabled`."""
    flat: Content = {}
    for key, value in tables.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value and name.count(".") + 1 < depth:
            flat |= flatten(value, depth, f"{name}.")
        else:
            flat[name] = value
    return flat


def nest(values: Table) -> dict[str, Content]:
    """Values by `stage.name` as one table per stage, the reverse of `flatten`."""
    tables: dict[str, Content] = {}
    for name, value in values.items():
        stage, _, leaf = name.partition(".")
        tables.setdefault(stage, {})[leaf] = value
    return tables
