"""A folder that one process fills while others keep out.

The lock is one of the operating system's on a file in the folder: it ends with its process, however
that ends, so that no lock of a dead process has to be recognised. The file says whose it is.
"""

import contextlib
import os
import platform
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from .validation import error_context

LOCK = ".jaxik.lock"
LONGEST_COMMAND = 100  # characters of it, in the file


class InUseError(ValueError):
    """Another process is at work in the folder; the message says which."""


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Makes a folder, if there is none, and keeps other processes out of it.

    What of it was made and is empty at the end is removed.

    Raises:
        InUseError: another process is at work in the folder; the message says which.
        OSError: the folder cannot be made or written to.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(folder):
            yield
    finally:
        with contextlib.suppress(OSError):  # one that is not empty, or gone
            for path in missing:
                path.rmdir()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    path = folder / LOCK
    with _open_locked(path) as file:
        try:
            with error_context(f"{path}: cannot be written"):
                _write_owner(file)
            yield
        finally:
            # While it is still locked: nobody else may have locked what is removed.
            if sys.platform != "win32":
                path.unlink(missing_ok=True)
    if sys.platform == "win32":
        with contextlib.suppress(OSError):  # another process has opened it by now
            path.unlink(missing_ok=True)


def _open_locked(path: Path) -> IO[bytes]:
    while True:
        file = open(path, "ab+", buffering=0)
        try:
            _lock(file)
        except (BlockingIOError, PermissionError):
            file.seek(0)
            owner = file.read(1000).decode(errors="replace").strip() or "another process"
            file.close()
            raise InUseError(
                f"{path.parent}: in use by {owner}; wait until it has ended, or name another folder"
            ) from None
        except OSError as error:
            warnings.warn(
                f"{path.parent}: nothing keeps another process out of it: {error.strerror}",
                RuntimeWarning,
                stacklevel=2,
            )
            return file
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                return file
        file.close()  # its owner has removed it in the meantime


def _write_owner(file: IO[bytes]) -> None:
    """Raises ValueError where the disk is full."""
    try:
        file.truncate(0)
        file.write(f"{_owner()}\n".encode())
    except OSError as error:
        raise ValueError(error.strerror) from None


def _owner() -> str:
    words = [os.path.basename(sys.argv[0]), *sys.argv[1:]]
    command = " ".join(" ".join(words).split())[:LONGEST_COMMAND]
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    return f"process {os.getpid()} on {platform.node()} (`{command}`) since {since}"


def _lock(file: IO[bytes]) -> None:
    """Locks a file without waiting; BlockingIOError or PermissionError if somebody else has it."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(1 << 20)  # beyond the text, which others may read
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
