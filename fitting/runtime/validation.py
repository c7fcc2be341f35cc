"""Files that users write: reading them, their keys, and errors in one line."""

import difflib
import json
import os
import stat
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

Content: TypeAlias = dict[str, Any]  # tables as TOML or JSON reads them, not yet checked
Table: TypeAlias = Mapping[str, Any]  # the same, to read only

QUOTED = 200  # characters of the error of another library, in a sentence of ours


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
