"""What becomes of memory that a worker has freed.

Dask starts its workers with `MALLOC_TRIM_THRESHOLD_`, so that they return freed memory to the
system at once. With glibc that also ends the growth of the size from which each block is a mapping
of its own: every array of 128 kB or more is then mapped, filled with zeros by the kernel, and
unmapped again. Of a short fit that was a third of the CPU time.
"""

import ctypes
import sys

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # parameters of glibc's `mallopt`
# Bytes, to which glibc would raise its thresholds by itself in a process without the variable.
LARGEST_BLOCK = 32 * 1024**2
KEPT = 2 * LARGEST_BLOCK


def keep_freed_memory() -> bool:
    """Has this process keep what it frees for what it needs next, as one without Dask does.

    Returns whether it could be arranged: only glibc has the setting.
    """
    if sys.platform != "linux":
        return False
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):  # another C library, which does not read the variable
        return False
    settings = ((MMAP_THRESHOLD, LARGEST_BLOCK), (TRIM_THRESHOLD, KEPT))
    return all(library.mallopt(parameter, value) == 1 for parameter, value in settings)
