"""Checks on files that users write: known keys, and values of the right type and range."""

import dataclasses
import difflib
import json
import math
import os
import stat
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

Content: TypeAlias = dict[str, Any]  # tables as TOML or JSON reads them, not yet checked
Table: TypeAlias = Mapping[str, Any]  # the same, to read only

LONGEST_TEXT = 1000
LARGEST = 3.4e38  # that 32 bits hold
# JSON has no infinity: some validators read inf as a number above all others, Taplo as null.
INFINITE = ({"type": "number", "exclusiveMinimum": sys.float_info.max}, {"type": "null"})
QUOTED = 200  # characters of the error of another library, in a sentence of ours


@dataclasses.dataclass(frozen=True)
class Constraint:
    """What a value must be: in words for error messages, as a test, and as JSON Schema."""

    description: str
    accepts: Callable[[Any], bool]
    schema: Table = dataclasses.field(default_factory=dict, compare=False)
    """As much of it as JSON Schema can say: what that allows may still be refused."""

    def meaning(self, doc: str, unit: str = "") -> "Constraint":
        """The constraint of a key with this meaning: a sentence, and the unit of its value."""
        description = f"{doc} Unit: {unit}." if unit else doc
        return dataclasses.replace(self, schema={**self.schema, "description": description})


def is_within(value: object, low: int | float, high: int | float, *, whole: bool = False) -> bool:
    """Whether it is a number in this range, and with `whole` one without a fraction."""
    kinds = int if whole else (int, float)
    return isinstance(value, kinds) and not isinstance(value, bool) and low <= value <= high


def number(
    low: int | float, high: int | float, unit: str = "", *, or_inf: bool = False
) -> Constraint:
    """A number in a range, or with `or_inf` infinity as well."""
    words = f"a number{' of ' if unit else ''}{unit} from {low:g} to {high:g}"
    schema = {"type": "number", "minimum": low, "maximum": high}
    return Constraint(
        f"{words}, or inf" if or_inf else words,
        lambda value: is_within(value, low, high) or (or_inf and value == math.inf),
        {"anyOf": [schema, *INFINITE]} if or_inf else schema,
    )


def count(low: int, high: int) -> Constraint:
    """A whole number in a range."""
    return Constraint(
        f"a whole number from {low} to {high}",
        lambda value: is_within(value, low, high, whole=True),
        {"type": "integer", "minimum": low, "maximum": high},
    )


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isprintable() and len(value) <= LONGEST_TEXT


TEXT = Constraint(
    f"a text of at most {LONGEST_TEXT} printable characters",
    _is_text,
    {"type": "string", "maxLength": LONGEST_TEXT, "pattern": "^[^\\u0000-\\u001f\\u007f]*$"},
)
BOOLEAN = Constraint("true or false", lambda value: isinstance(value, bool), {"type": "boolean"})
TABLE = Constraint("a table", lambda value: isinstance(value, Mapping), {"type": "object"})
NUMBER = Constraint(
    "a finite number",
    lambda value: is_within(value, -LARGEST, LARGEST),
    {"type": "number", "minimum": -LARGEST, "maximum": LARGEST},
)
SECONDS = number(0, 1e6, "seconds")
RATE = number(1, 1000, "Hz")
CORRELATION = number(0, 0.999)
SEED = count(0, 2**32 - 1)


def one_of(words: Sequence[str]) -> Constraint:
    """Any of these texts."""
    return Constraint(f"one of {list(words)}", lambda value: value in words, {"enum": list(words)})


def list_of(description: str) -> Constraint:
    """A list, described in these words; its elements are checked elsewhere."""
    return Constraint(description, lambda value: isinstance(value, list), {"type": "array"})


def list_of_texts(description: str) -> Constraint:
    """A list of texts, described in these words."""
    return Constraint(
        description,
        lambda value: isinstance(value, list) and all(map(_is_text, value)),
        {"type": "array", "items": TEXT.schema},
    )


def read_toml(path: Path, description: str) -> Content:
    """The tables of a TOML file.

    Args:
        path: the file.
        description: what kind of file it should be, for the error message: "an experiment".

    Raises:
        ValueError: the file does not exist or is not TOML.
    """
    if reason := why_unreadable(path):
        raise ValueError(f"{path}: {reason}, wanted {description} file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise ValueError(f"{path}: not TOML: nested too deeply") from None
    except ValueError as error:  # of TOML, UTF-8, or a number of thousands of digits
        raise ValueError(f"{path}: not TOML: {in_one_line(error, QUOTED)}") from None


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


def why_unreadable(path: Path) -> str:
    """Why there is no file to read at this path, in words; empty if there is one."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "no such file"
    except ValueError:
        return "a name with a null byte"
    except OSError as error:
        return str(error.strerror).lower()
    if stat.S_ISDIR(mode):
        return "a folder"
    if not stat.S_ISREG(mode):
        return "no regular file"
    return "" if os.access(path, os.R_OK) else "may not be read"


def check_file(path: Path) -> None:
    """ValueError unless there is a file to read at this path."""
    if reason := why_unreadable(path):
        raise ValueError(f"{path}: {reason}")


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
    text = str(error) or type(error).__name__
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


def with_floats(table: Table, keys: Iterable[str]) -> Content:
    """The table with whole numbers under these keys as floats, as code expects them."""
    return {
        key: float(value) if key in keys and type(value) is int else value
        for key, value in table.items()
    }


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
