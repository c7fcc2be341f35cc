"""JAX's files of compiled programs, each of which is to be complete or missing.

JAX (0.10.2 to 0.12.0.1) writes such a file in place, and never again once it is there. A process
that reads it at that moment warns and compiles for itself; one that is killed at that moment
leaves half a file, of which every later process warns, and which none replaces.
"""

import functools
from pathlib import Path

from fitting.runtime import files

SUFFIX = "-cache"  # of the files' names


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
        """Keeps a compiled program, which JAX offers only if it could not read it."""
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
