"""How the C library hands memory out: what was freed is kept for the next arrays."""

import ctypes
import os

# Names of mallopt's parameters, from malloc.h of the GNU C library.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
ARRAY = 32 << 20  # bytes; a larger array gets pages of its own, which go back when it is freed
KEPT = 128 << 20  # bytes at the end of the heap that stay with the process
OF_USER = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "GLIBC_TUNABLES")


def keep_freed_memory() -> bool:
    """Lets new arrays reuse the memory of those that were freed; whether that could be set.

    By default the GNU C library returns the memory of large arrays to the system, and each call of
    a program writes its results to new pages. The system clears a page when it is first written
    to, which took 40 % of the time of feet and up to a quarter of that of legs (AMD EPYC, in a
    virtual machine). A process keeps at most `KEPT` bytes more for it. Another C library, and what
    the user set in an environment variable, is left alone.
    """
    if any(name in os.environ for name in OF_USER):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not the GNU C library; on Windows there is none
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, ARRAY) and mallopt(M_TRIM_THRESHOLD, KEPT))
