"""What files of settings may hold: TOML with known keys and values of the right kind."""

import difflib
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple


class Kind(NamedTuple):
    """A kind of value: in words, and how it is told."""

    wanted: str
    fits: Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and not math.isnan(value)


def _is_whole(value: Any) -> bool:
    return _is_number(value) and isinstance(value, int)


TEXT = Kind("a text", lambda value: isinstance(value, str))
SWITCH = Kind("true or false", lambda value: isinstance(value, bool))
TABLE = Kind("a table", lambda value: isinstance(value, Mapping))
NUMBER = Kind("a number", _is_number)
POSITIVE = Kind("a number above 0", lambda value: _is_number(value) and value > 0)
RATE = Kind("a finite number above 0", lambda value: _is_number(value) and 0 < value < math.inf)
TIME = Kind("a number of seconds, 0 or more", lambda value: _is_number(value) and value >= 0)
SHARE = Kind("a number from 0 to below 1", lambda value: _is_number(value) and 0 <= value < 1)
COUNT = Kind("a whole number above 0", lambda value: _is_whole(value) and value > 0)
SEED = Kind(
    "a whole number from 0 to 4294967295", lambda value: _is_whole(value) and 0 <= value < 2**32
)


def one_of(words: Sequence[str]) -> Kind:
    """Any of these texts."""
    return Kind(f"one of {list(words)}", lambda value: value in words)


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The tables of a TOML file.

    Args:
        path: the file.
        what: it should be, for the error: "an experiment".

    Raises:
        ValueError: a file that is not there or no TOML.
    """
    if not path.is_file():
        raise ValueError(f"{path}: {why_missing(path)}, wanted {what} file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not TOML: {error}") from None


def why_missing(path: Path) -> str:
    """Why there is nothing to read, in words."""
    return "a folder" if path.is_dir() else "no such file"


@contextmanager
def error_context(where: Path | str) -> Iterator[None]:
    """Says in front of a ValueError from within where it is."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def check_keys(given: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    """ValueError for a key that is not known, with the nearest one that is."""
    for key in given:
        if key not in known:
            nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise ValueError(
                f"{where}: unknown key {key!r}; nearest is {nearest!r} of {list(known)}"
            )


def check_table(given: Any, kinds: Mapping[str, Kind], where: str) -> Mapping[str, Any]:
    """The table, which may hold these keys with values of these kinds; else ValueError."""
    if not TABLE.fits(given):
        raise ValueError(f"{where} is {given!r}; wanted a table, such as {{}}")
    check_keys(given, list(kinds), where)
    for key, value in given.items():
        if not kinds[key].fits(value):
            raise ValueError(f"{where}: {key} is {value!r}; wanted {kinds[key].wanted}")
    return given


def flat(tables: Mapping[str, Any], depth: int, prefix: str = "") -> dict[str, Any]:
    """Nested TOML tables as dotted names, `depth` parts each: `lock.enabled`.

    An empty table keeps its place, so that no name goes unread.
    """
    found: dict[str, Any] = {}
    for key, value in tables.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value and name.count(".") + 1 < depth:
            found |= flat(value, depth, f"{name}.")
        else:
            found[name] = value
    return found


def nested(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Values by `stage.name` as a table a stage: what `flat` made flat."""
    tables: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        stage, _, leaf = name.partition(".")
        tables.setdefault(stage, {})[leaf] = value
    return tables
