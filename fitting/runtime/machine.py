"""What the system reports about this machine and this process."""

import os
import platform
import sys
from pathlib import Path

PROC = Path("/proc")  # on Linux
WIDTHS = {"avx512f": 512, "avx2": 256, "avx": 256, "sse2": 128, "asimd": 128}  # bits


def entry(file: str, *keys: str) -> str:
    """The first entry with one of these keys in a file of `/proc`; empty where there is none."""
    path = PROC / file
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    rows = (line.partition(":") for line in lines)
    return next((value.strip() for key, _, value in rows if key.strip() in keys), "")


def processor() -> str:
    """The name of the processor."""
    return entry("cpuinfo", "model name") or platform.processor() or platform.machine()


def vector_bits() -> int | None:
    """Width of this core's vectors; None where the system does not report its features."""
    features = entry("cpuinfo", "flags", "Features").split()
    return next((bits for feature, bits in WIDTHS.items() if feature in features), None)


def memory_gb(key: str = "MemTotal") -> float | None:
    """All memory, or that of another key of `/proc/meminfo`; None where it is not reported."""
    kilobytes = entry("meminfo", key).split()
    return float(kilobytes[0]) / 1e6 if kilobytes else None


def load_average() -> float:
    """Load average over the last minute; NaN where the system does not report it."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


def mappings() -> int:
    """How many mappings of memory this process has; 0 where the system does not report it."""
    path = PROC / "self/maps"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def peak_mb() -> float | None:
    """Resident memory of this process at its highest; None where the system does not report it."""
    # What Linux reports to `getrusage` begins with the peak of the process that started this one.
    if kilobytes := entry("self/status", "VmHWM").split():
        return float(kilobytes[0]) * 1024 / 1e6
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def reset_peak() -> None:
    """Restarts the record of `peak_mb`, where the system allows it."""
    try:
        (PROC / "self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        pass  # then the peak counts from the start of the process
