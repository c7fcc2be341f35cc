"""Files that are written as a whole or not at all."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any


def check_output_file(path: Path) -> None:
    """ValueError where no file can be written, before anything is computed for it."""
    if path.is_dir():
        raise ValueError(f"{path}: cannot be written: it is a folder")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: cannot be written: there is no folder {path.parent}")


def write(path: Path, fill: Callable[[Path], Any]) -> None:
    """`fill` writes a temporary file beside `path`, which then takes its place.

    Raises:
        ValueError: where the folder is not there or may not be written.
    """
    check_output_file(path)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}", suffix=path.suffix)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written: {error.strerror}") from None
    os.close(handle)
    temporary = Path(name)
    try:
        fill(temporary)
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)  # a temporary file is its owner's alone
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file."""
    write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
