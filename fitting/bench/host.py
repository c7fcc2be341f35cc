"""The machine on which benchmarks run: its hardware, its load, and peaks of memory."""

import math
import os
import platform
from pathlib import Path
from typing import TypedDict

import jax

from fitting.runtime import xla
from fitting.runtime.threads import usable_cores

STATUS = Path("/proc/self/status")
MEMORY = Path("/proc/meminfo")
CPU = Path("/proc/cpuinfo")


class Hardware(TypedDict):
    """The machine, as the JSON report holds it."""

    cpu: str
    cores: int | None
    vector_bits: int | None
    threads: int
    """Used."""
    memory_gb: float | None
    device: str
    jax: str
    jaxlib: str
    python: str
    xla_flags: str


def hardware() -> Hardware:
    """The hardware and software of this process."""
    device = jax.devices()[0]
    return {
        "cpu": _system_entry(CPU, "model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "vector_bits": xla.vector_bits(),
        "threads": usable_cores(),
        "memory_gb": _memory_gb(),
        "device": f"{device.platform}: {device.device_kind}",
        "jax": jax.__version__,
        "jaxlib": xla.jaxlib_version(),
        "python": platform.python_version(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def time_in_width() -> float:
    """Factor of the times that kernels aim at, which are set for vectors of 256 bits.

    Vectors of twice the width take 0.7 of the time, the square root of a half: what goes through
    caches and calls does not get faster.
    """
    return math.sqrt(256 / (xla.vector_bits() or 256))


def _memory_gb() -> float | None:
    """All memory of the machine; None where the system does not report it."""
    entry = _system_entry(MEMORY, "MemTotal")
    return float(entry.split()[0]) / 1e6 if entry else None


def _system_entry(path: Path, key: str) -> str:
    """The first entry of a key in a system file; empty where there is no such file or key."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")


def load_average() -> float:
    """Load average over the last minute; NaN where the system does not report it."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


def reset_peak_memory() -> None:
    """Restarts the record of peak resident memory, where the system allows it."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        pass  # then the peak counts from the start of the process


def peak_memory_mb() -> float:
    """Peak memory, MB; NaN where the system does not report it.

    That of the device since the process started, where the device reports it; otherwise resident
    memory since `reset_peak_memory`.
    """
    if statistics := jax.devices()[0].memory_stats():
        return statistics.get("peak_bytes_in_use", float("nan")) / 1e6
    peak = _system_entry(STATUS, "VmHWM")
    return float(peak.split()[0]) / 1e3 if peak else float("nan")
