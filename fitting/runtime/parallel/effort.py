"""What a piece of work takes: time, time of the processor, memory."""

import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict

# Of Linux, in kB. What `getrusage` says there begins with the peak of the process that started this
# one, so that a small process of a large one would look large.
STATUS, HIGHEST = Path("/proc/self/status"), "VmHWM"


class Effort(TypedDict):
    """What a piece of work took, and where it was done."""

    seconds: float
    """Without those for which it waited."""
    waited: float
    """s, for other processes that compiled what it needs."""
    cpu_seconds: float
    """Of all threads of the process."""
    peak_mb: float | None
    """Resident memory of the process at its highest so far; None where that is not known."""
    host: str
    process: int


class Stopwatch:
    """Measures work from the moment it is made."""

    def __init__(self) -> None:
        self._began = time.monotonic(), time.process_time()
        self._waited = 0.0

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Does not count what is done within."""
        began = time.monotonic()
        try:
            yield
        finally:
            self._waited += time.monotonic() - began

    def read(self) -> Effort:
        """What has been taken so far."""
        began, cpu_began = self._began
        return {
            "seconds": time.monotonic() - began - self._waited,
            "waited": self._waited,
            "cpu_seconds": time.process_time() - cpu_began,
            "peak_mb": peak_mb(),
            "host": platform.node(),
            "process": os.getpid(),
        }


def peak_mb() -> float | None:
    """Resident memory of this process at its highest; None where the system does not say."""
    if STATUS.exists():
        lines = STATUS.read_text(encoding="utf-8").splitlines()
        values = dict(line.split(":", 1) for line in lines if ":" in line)
        if HIGHEST in values:
            return float(values[HIGHEST].split()[0]) * 1024 / 1e6
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
