"""Files that are written completely or not at all, also where the power fails or the disk is full.

A file is written under a temporary name beside it, which says which process writes it. Of a link,
it is the file that it leads to which is written, and the link stays. What killed
processes have left under such names is removed when the next file is written in the same folder.
Names by 0.1.0 do not say which process it was: those go when the same file is written again, if
they are old.

HDF5 files with a checksum behind their last byte, which HDF5 itself ignores.

HDF5 ends the process with a segmentation fault where some bytes of a file are damaged, or where
the disk is full while it writes. So a file is made in memory, and is checked before HDF5 opens it.
A program that changes the file drops the seal, and then it is not checked.
"""

import contextlib
import os
import platform
import re
import stat
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

from .validation import in_one_line

LONGEST_STEM = 150  # bytes of it in a temporary name: names have 255 at most
HOST = re.sub(r"\W", "_", platform.node(), flags=re.ASCII)[:40]
TEMPORARY = re.compile(rf"\..*\.jaxik-{re.escape(HOST)}-(\d+)-\w+(\.\w+)?")

OWNERS_ONLY = stat.S_IFREG | 0o600  # mode of files that are being written
NO_LONGER_WRITTEN = 3600.0  # s since the last change, after which a file of 0.1.0 is a dead one's


SEAL = b"jaxik crc32 "
DIGITS = 8


def check_output_file(path: Path) -> None:
    """Checks, before anything is computed, that a file can be written here.

    Raises:
        ValueError: the path is a folder or a device, or its folder does not exist.
    """
    if path.exists() and not path.is_file():
        kind = "a folder" if path.is_dir() else "not a regular file"
        raise ValueError(f"{path}: cannot be written: it is {kind}")
    if not (folder := _without_link(path).parent).is_dir():
        raise ValueError(f"{path}: cannot be written: there is no folder {folder}")


def _without_link(path: Path) -> Path:
    """The path, or where it leads to if it is a link."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def relative_path(path: Path, folder: Path) -> str:
    """A path from a folder, with slashes; whole where there is none, as on another drive."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return path.resolve().as_posix()


def write(path: Path, fill: Callable[[Path], object], *, lasting: bool = True) -> None:
    """Calls `fill` with a temporary file in the same folder, then moves that file to `path`.

    Args:
        path: of the file.
        fill: writes the content to a path.
        lasting: whether the file must outlive a power failure, and what killed processes have left
            in the folder is removed first; without, small files are written five times as fast.

    Raises:
        ValueError: the folder does not exist or may not be written to, or the disk is full.
    """
    check_output_file(path)
    target = _without_link(path)
    try:
        if lasting:
            sweep(target.parent)
            _sweep_first_release(target)
        stem = path.stem.encode()[:LONGEST_STEM].decode(errors="ignore")
        prefix = f".{stem}.jaxik-{HOST}-{os.getpid()}-"
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=prefix, suffix=path.suffix)
        os.close(handle)
        temporary = Path(name)
        try:
            fill(temporary)
            mask = os.umask(0)
            os.umask(mask)
            temporary.chmod(0o666 & ~mask)  # mkstemp makes files that only their owner can read
            if lasting:
                _synchronise(temporary)  # the content before the name
            os.replace(temporary, target)
            if lasting and os.name == "posix":
                _synchronise(target.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        reason = in_one_line(error) if error.errno is None else os.strerror(error.errno)
        raise ValueError(f"{path}: cannot be written: {reason}") from None


def write_text(path: Path, text: str) -> None:
    """Writes a text file in UTF-8."""
    write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def sweep(folder: Path) -> None:
    """Removes the temporary files that dead processes of this machine have left in a folder."""
    for entry in os.scandir(folder):
        name = TEMPORARY.fullmatch(entry.name)
        if name is not None and not _is_alive(int(name[1])):
            with contextlib.suppress(OSError):  # another process has removed it, or may do so
                os.unlink(entry.path)


def _sweep_first_release(path: Path) -> None:
    """Removes what processes of 0.1.0 have left of a file: `.NAME`, 8 characters and its suffix.

    Files of other names, those that others may read and those that changed recently stay.
    """
    left = re.compile(rf"\.{re.escape(path.stem)}[a-z0-9_]{{8}}{re.escape(path.suffix)}")
    for entry in os.scandir(path.parent):
        if left.fullmatch(entry.name):
            with contextlib.suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                is_own = status.st_mode == OWNERS_ONLY
                if is_own and time.time() - status.st_mtime > NO_LONGER_WRITTEN:
                    os.unlink(entry.path)


def _is_alive(process: int) -> bool:
    """Whether a process runs on this machine; where the system does not say, it may."""
    if sys.platform == "win32":  # there os.kill ends the process, whatever the signal
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OverflowError, OSError):  # somebody else's
        return True
    return True


def _synchronise(path: Path) -> None:
    """Waits until a file or folder is on the disk."""
    flags = os.O_RDONLY if path.is_dir() or os.name == "posix" else os.O_RDWR
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_sealed(path: Path, image: bytes | memoryview) -> None:
    """Writes a file and its seal.

    Raises:
        ValueError: it cannot be written.
    """
    seal = SEAL + f"{zlib.crc32(image):0{DIGITS}x}".encode()

    def fill(temporary: Path) -> None:
        with open(temporary, "wb") as stream:
            stream.write(image)
            stream.write(seal)

    write(path, fill)


def check_seal(path: Path) -> None:
    """Checks that a file's bytes are those that were written, if it has a seal.

    Raises:
        ValueError: they are not.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    length = len(SEAL) + DIGITS
    image, seal = memoryview(content)[:-length], content[-length:]
    if seal.startswith(SEAL) and seal[len(SEAL) :] != f"{zlib.crc32(image):0{DIGITS}x}".encode():
        raise ValueError("its bytes are not those that were written")
