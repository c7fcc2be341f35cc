"""Runs benchmarks one after another."""

import dataclasses
import subprocess
import time
from collections.abc import Callable, Mapping

import jax

from fitting.runtime import cache_folder

from . import host
from .measurement import Measurement
from .sizes import Sizes

# What a machine that is too small, or another process, does to a benchmark; the others go on.
FAILURES = (MemoryError, jax.errors.JaxRuntimeError, subprocess.CalledProcessError)


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Something to be measured, and how."""

    title: str
    floats: str
    """Float32, float64, or empty where the figures differ or have none."""
    measure: Callable[[Measurement, Sizes], None]
    x64: bool = False
    """Whether JAX's 64-bit types are enabled meanwhile."""
    long: bool = False
    """Left out of a quick run, unless it is named."""


@dataclasses.dataclass
class Report:
    """All that was measured."""

    quick: bool
    measurements: list[Measurement] = dataclasses.field(default_factory=list)
    interrupted: bool = False


def run_benchmarks(
    benchmarks: Mapping[str, Benchmark],
    sizes: Sizes,
    quick: bool,
    announce: Callable[[str], None],
    progress: Callable[[str], None] = lambda text: None,
) -> Report:
    """Measures benchmarks one after another; an interrupt ends it and keeps what was measured.

    Args:
        benchmarks: by name.
        sizes: of the workloads.
        quick: whether these are the small sizes, for the report.
        announce: called with a line at the start and at the end of each benchmark.
        progress: called with what is being done within a benchmark.
    """
    report, ceilings = Report(quick), {}
    cached = cache_folder.setting(cache_folder.ENABLED)
    # With a cache, the second run of a benchmark would not compile.
    jax.config.update(cache_folder.ENABLED, False)
    try:
        for number, (name, benchmark) in enumerate(benchmarks.items()):
            announce(f"[{number + 1}/{len(benchmarks)}] {name}: {benchmark.title}")
            measurement = Measurement(
                name, benchmark.title, sizes.repeats, benchmark.floats, progress, ceilings,
                load=host.load_average(),
            )  # fmt: skip
            report.measurements.append(measurement)
            report.interrupted = _interrupted(measurement, benchmark, sizes)
            results = [f"{fig.what} {fig.value:.4g} {fig.unit}" for fig in measurement.figures]
            summary = "; ".join(results + measurement.failures) or "nothing"
            announce(f"      {summary}  ({measurement.seconds:.1f} s)")
            if report.interrupted:
                break
    finally:
        jax.config.update(cache_folder.ENABLED, cached)
    return report


def _interrupted(measurement: Measurement, benchmark: Benchmark, sizes: Sizes) -> bool:
    """Runs one benchmark; whether Ctrl-C ended it."""
    start = time.perf_counter()
    try:
        with jax.enable_x64(benchmark.x64):
            benchmark.measure(measurement, sizes)
    except KeyboardInterrupt:
        return True
    except FAILURES as error:
        measurement.failures.append(f"failed: {_one_line(error)}")
    finally:
        measurement.seconds = time.perf_counter() - start
    return False


def _one_line(error: Exception) -> str:
    """An error in one line; of a child process, with the last line that it printed."""
    printed = error.stderr or "" if isinstance(error, subprocess.CalledProcessError) else ""
    lines = [line for line in f"{error}\n{printed}".splitlines() if line.strip()]
    first_and_last = lines[:1] + lines[1:][-1:]
    return f"{type(error).__name__}: {' … '.join(first_and_last)}".rstrip(": ")
