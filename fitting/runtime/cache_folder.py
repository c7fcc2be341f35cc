"""The folder in which programs are cached between processes: where it is, and what lies in it.

It is JAX's folder for compiled programs, with one inside it for the traced ones and one for what C
compilers have compiled. JAX (0.10.2 to 0.12.0.1) writes a compiled program in place, and never
again once it is there. A process that reads it at that moment warns and compiles for itself; one
that is killed at that moment leaves half a file, of which every later process warns, and which none
replaces. Here each is complete or missing.
"""

import functools
import os
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax

from . import files
from .validation import in_one_line

FOLDER, ENABLED = "jax_compilation_cache_dir", "jax_enable_compilation_cache"  # settings of JAX
MIN_SECONDS = "jax_persistent_cache_min_compile_time_secs"
TRACED, KERNELS = "traced", "kernels"  # inside JAX's folder
# Names of complete and of half-written files: of ours, and of JAX's.
TRACED_NAMES = re.compile(r"\.?\w+-[0-9a-f]{64}\w*(\.jaxik-\w+-\d+-\w+)?")
COMPILED_NAMES = re.compile(r".+-[0-9a-f]{64}-(cache|atime)(\.jaxik-\w+-\d+-\w+)?")
KERNEL_NAMES = re.compile(r"\w+-[0-9a-f]{64}\.so(\.jaxik-\w+-\d+-\w+)?")
WARNED: set[str] = set()  # problems that this process has warned of

SUFFIX = "-cache"  # of the files' names


class SwitchedOffError(Exception):
    """JAX's settings say that no traced programs are cached; the message names one."""


class CachedPrograms(NamedTuple):
    """The files of cached programs."""

    traced: list[Path]
    compiled: list[Path]


def use_default() -> None:
    """Has JAX cache compiled programs in the user's cache folder, unless a setting names another.

    Warns, and caches nothing, where that folder belongs to somebody else or cannot be made: JAX
    would run what it finds there. In any folder, JAX then writes its files completely or not at
    all (`write_complete_files`).
    """
    write_complete_files()
    if setting(FOLDER) is not None:
        return
    try:
        folder = default()
        _make_own(folder)
    except (OSError, RuntimeError) as error:
        warn_once("programs are not cached between calls", in_one_line(error))
        return
    jax.config.update(FOLDER, str(folder))
    if MIN_SECONDS.upper() not in os.environ:
        jax.config.update(MIN_SECONDS, 0.0)


def default() -> Path:
    """`jaxik` in this platform's folder for caches, or in `XDG_CACHE_HOME`."""
    folder = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(folder):  # the specification says to ignore others
        return Path(folder, "jaxik")
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local, "jaxik", "Cache")
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "jaxik"


def traced() -> Path:
    """The user's own folder for traced programs, made if missing.

    Raises:
        SwitchedOffError: JAX's settings say that none are cached.
        OSError: the folder cannot be made, or is not safe from others.
    """
    folder = _own_folder(TRACED)
    if jax.device_count() > 1:
        raise SwitchedOffError(f"there are {jax.device_count()} devices; programs are for one")
    return folder


def kernels() -> Path:
    """The user's own folder for compiled C code, as `traced`."""
    return _own_folder(KERNELS)


def _own_folder(name: str) -> Path:
    folder = setting(FOLDER)
    if not folder:
        raise SwitchedOffError(f"{FOLDER} names no folder")
    if not setting(ENABLED):
        raise SwitchedOffError(f"{ENABLED} is off")
    if "://" in str(folder):
        raise SwitchedOffError(f"programs are cached on this machine only, not in {folder}")
    path = Path(str(folder), name)
    _make_own(path)
    return path


def check_own(path: Path, status: os.stat_result) -> None:
    """Checks that a file or folder is this user's own, and that not everybody may write to it.

    Raises:
        PermissionError: it is not, or everybody may.
    """
    if not _is_own(status):
        raise PermissionError(f"{path} belongs to another user")
    if os.name == "posix" and status.st_mode & 0o002:
        raise PermissionError(f"everybody may write to {path}")


def cached_programs(folder: Path) -> CachedPrograms:
    """The user's own files of programs in a folder, and no others."""
    compiled = _files(folder, COMPILED_NAMES), _files(folder / KERNELS, KERNEL_NAMES)
    return CachedPrograms(list(_files(folder / TRACED, TRACED_NAMES)), [*compiled[0], *compiled[1]])


def used_folder() -> Path:
    """The folder of JAX's setting, or the default."""
    return Path(str(setting(FOLDER) or default()))


def why_not_cached() -> str:
    """Why no traced programs are cached, in a line; empty if they are."""
    try:
        traced()
    except (SwitchedOffError, OSError) as error:
        return in_one_line(error)
    return ""


def setting(name: str) -> object:
    """The value of one of JAX's settings."""
    return getattr(jax.config, name)


def warn_once(problem: str, reason: str) -> None:
    """Warns of a problem the first time that it arises in this process, for whatever reason."""
    if problem not in WARNED:
        WARNED.add(problem)
        warnings.warn(f"{problem}: {reason}", RuntimeWarning, stacklevel=2)


def _make_own(folder: Path) -> None:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_own(folder, folder.stat())


def _is_own(status: os.stat_result) -> bool:
    """Whether it belongs to this user; on Windows everything in a user's folders does."""
    return not hasattr(os, "getuid") or status.st_uid == os.getuid()


def _files(folder: Path, names: re.Pattern[str]) -> Iterator[Path]:
    if not folder.is_dir():
        return
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        if names.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
            if _is_own(entry.stat(follow_symlinks=False)):
                yield Path(entry)


@functools.cache
def write_complete_files() -> None:
    """Has JAX write complete files, also in place of damaged ones.

    It writes as before where it locks the folder, to bound its size, and to storage that is not a
    folder of this machine. JAX has no setting for this; a version without the class that is
    changed here writes as it likes.
    """
    try:
        from jax._src.lru_cache import LRUCache
    except ImportError:
        return
    in_place = LRUCache.put

    def put(self: LRUCache, key: str, value: bytes) -> None:
        """Caches a compiled program, which JAX offers only if it could not read it."""
        if self.eviction_enabled or "://" in str(self.path):
            in_place(self, key, value)
        else:
            path = Path(self.path, f"{key}{SUFFIX}")
            _sweep_once(path.parent)
            files.write(path, lambda temporary: temporary.write_bytes(value), lasting=False)

    LRUCache.put = put


@functools.cache
def _sweep_once(folder: Path) -> None:
    """Removes what killed processes have left; a folder of thousands of files takes long."""
    files.sweep(folder)
