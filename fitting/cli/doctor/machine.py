"""The machine: processor, vector width, memory."""

import os
import platform
from collections.abc import Iterator
from pathlib import Path

from fitting.runtime import xla

from .findings import Finding

CPU, MEMORY = Path("/proc/cpuinfo"), Path("/proc/meminfo")  # on Linux
NEEDED_GB = 1.0  # the self-test, which fits one parameter to 12 s of motion, takes 0.6


def examine() -> Iterator[Finding]:
    """Processor and memory."""
    name = _entry(CPU, "model name") or platform.processor() or platform.machine()
    width = xla.vector_bits()
    vectors = f", vectors of {width} bits" if width else ""
    yield Finding("processor", f"{name}, {os.cpu_count()} cores{vectors}")
    total, free = (_gigabytes(key) for key in ("MemTotal", "MemAvailable"))
    if total is None or free is None:
        return
    problem = f"only {free:.1f} GB of memory are free" if free < NEEDED_GB else ""
    remedy = "close other programs; a fit takes about a gigabyte"
    yield Finding("memory", f"{total:.1f} GB, {free:.1f} GB of them free", problem, remedy)


def _gigabytes(key: str) -> float | None:
    entry = _entry(MEMORY, key)
    return float(entry.split()[0]) / 1e6 if entry else None


def _entry(path: Path, key: str) -> str:
    """The first entry of a key in a system file; empty where there is no such file or key."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")
