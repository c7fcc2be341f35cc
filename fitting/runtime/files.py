"""Files that are written completely or not at all."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path


def check_output_file(path: Path) -> None:
    """Checks, before anything is computed, that a file can be written here.

    Raises:
        ValueError: the path is a folder, or its folder does not exist.
    """
    if path.is_dir():
        raise ValueError(f"{path}: cannot be written: it is a folder")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: cannot be written: there is no folder {path.parent}")


def write(path: Path, fill: Callable[[Path], object]) -> None:
    """Calls `fill` with a temporary file in the same folder, then moves that file to `path`.

    Raises:
        ValueError: the folder does not exist or may not be written to.
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
        temporary.chmod(0o666 & ~mask)  # mkstemp makes files that only their owner can read
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file in UTF-8."""
    write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
