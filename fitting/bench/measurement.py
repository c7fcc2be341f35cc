"""What one benchmark measures: compiled programs, samples of their run time, and figures of them.

A benchmark fills its `Measurement` as it goes, so that Ctrl-C loses only what was not measured yet.
Programs are compiled ahead of time, and compiling is timed separately. Calls that are compared run
in turns, in random order, so that other load on the machine affects all of them.
"""

import functools
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import PyTree

from fitting.runtime import activity, cache_folder, machine, xla
from fitting.runtime.threads import on_all_cores, usable_cores

from .roofline import Work, lower_bound, work_of_program
from .workloads import Sizes

SAMPLE = 0.2  # s, shortest sample: a faster call is repeated within it
Call: TypeAlias = Callable[[], object]  # returns once its result is there

# Factors of a unit. A figure in one of seconds is the time of an item, in another their rate.
SECONDS = {"s": 1.0, "ms": 1e3, "µs": 1e6, "ns": 1e9}
RATES = {"M": 1e-6, "GB/s": 1e-9, "GFLOP/s": 1e-9}

# What a machine that is too small, or another process, does to a benchmark; the others go on.
FAILURES = (MemoryError, jax.errors.JaxRuntimeError, subprocess.CalledProcessError)


@dataclass(frozen=True)
class Figure:
    """One number of a benchmark, with its target and its physical limit."""

    what: str
    value: float
    """The median."""
    unit: str
    at_most: float | None = None
    """Target."""
    at_least: float | None = None
    """Target."""
    spread: tuple[float, float] | None = None
    """Lowest and highest of the runs."""
    busy: float | None = None
    """The figure by CPU time, divided by the threads that work."""
    limit: float | None = None
    """The figure if nothing but `bound` took time."""
    bound: str = ""
    """Memory, arithmetic or dispatch."""
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the target is reached; None without a target."""
        if self.at_most is not None:
            return self.value <= self.at_most
        return None if self.at_least is None else self.value >= self.at_least

    @property
    def target(self) -> str:
        """The target as text."""
        if self.at_most is not None:
            return f"≤ {self.at_most:g}"
        return "" if self.at_least is None else f"≥ {self.at_least:g}"

    @property
    def closeness(self) -> float | None:
        """Fraction of the physical limit that is reached, 0..1."""
        if self.limit is None:
            return None
        return min(self.limit, self.value) / max(self.limit, self.value)


@dataclass(frozen=True)
class Series:
    """Run time against one size; `seconds` has a list for each curve."""

    size: str
    """Its name."""
    sizes: list[int] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=dict)

    def add(self, size: int, seconds: Mapping[str, float]) -> None:
        """Adds a point to each curve."""
        self.sizes.append(size)
        for name, value in seconds.items():
            self.seconds.setdefault(name, []).append(value)

    def slope(self, name: str, last: int = 0) -> float:
        """Exponent of the power law of a curve: 1 where twice the size takes twice the time.

        Of the `last` points, 0 for all; NaN for a single point.
        """
        sizes, seconds = np.log(self.sizes[-last:]), np.log(self.seconds[name][-last:])
        return float(np.polyfit(sizes, seconds, 1)[0]) if len(sizes) > 1 else float("nan")


@dataclass
class Measurement:
    """What one benchmark measures. Samples, CPU times and work are those of one call, by name."""

    name: str
    title: str
    repeats: int
    floats: str = ""
    """Float32 or float64; empty where figures say it, or there are none."""
    ceilings: dict[str, float] = field(default_factory=dict)
    """See `roofline.lower_bound`."""
    figures: list[Figure] = field(default_factory=list)
    compile_s: dict[str, float] = field(default_factory=dict)
    samples: dict[str, list[float]] = field(default_factory=dict)
    """Seconds."""
    busy: dict[str, list[float]] = field(default_factory=dict)
    """s of CPU time."""
    work: dict[str, Work] = field(default_factory=dict)
    series: list[Series] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    """Errors that ended the benchmark."""
    load: float = 0.0
    """Load average at the start."""
    seconds: float = 0.0
    """Duration of the whole benchmark."""

    def progress(self, text: str) -> None:
        """Reports what is being done."""
        activity.report(text, text)

    def compile(
        self, name: str, function: Callable, *arguments: PyTree, sparse: PyTree = ()
    ) -> Callable:
        """The function compiled for these arguments; stores its compile time and its work by name.

        A run reads little of the arrays that are `sparse`; see `work_of_program`.
        """
        self.progress(f"{self.name}: compiling {name}")
        start = time.perf_counter()
        traced = jax.jit(function).trace(*arguments)
        program = traced.lower().compile()
        self.compile_s[name] = time.perf_counter() - start
        self.work[name] = work_of_program(traced, program, sparse)
        return program

    def compile_call(
        self, name: str, function: Callable, *arguments: PyTree, sparse: PyTree = ()
    ) -> Call:
        """A call of the compiled function with these arguments that waits for the result."""
        program = self.compile(name, function, *arguments, sparse=sparse)
        return lambda: jax.block_until_ready(program(*arguments))

    def compile_parts(
        self,
        name: str,
        function: Callable,
        shared: PyTree,
        items: PyTree,
        size: int,
        *,
        axis: int = 0,
        sparse: PyTree = (),
    ) -> Callable[[], list[PyTree]]:
        """A call that computes items part by part on all cores, by one program for all parts.

        Args:
            name: of the call.
            function: of `shared` and a part of `items`.
            shared: what every part needs.
            items: arrays, counted along `axis`.
            size: of a part; the last one overlaps the one before.
            axis: of the items.
            sparse: see `compile`.
        """
        count = jax.tree.leaves(items)[0].shape[axis]
        structure = jax.tree.structure((shared, items))

        def leaves_from(first: int) -> list[jax.Array]:
            ends = first, first + size
            part = jax.tree.map(lambda x: jax.lax.slice_in_dim(x, *ends, axis=axis), items)
            return jax.tree.leaves((shared, part))

        def of_leaves(leaves: list) -> PyTree:
            return function(*jax.tree.unflatten(structure, leaves))

        # Flattened beforehand: while Python flattens arguments, no other thread can start.
        parts = [leaves_from(min(first, count - size)) for first in range(0, count, size)]
        program = self.compile(name, of_leaves, parts[0], sparse=sparse)
        self.work[name] = self.work[name] * len(parts)
        return functools.partial(on_all_cores, [functools.partial(program, p) for p in parts])

    def time_in_turns(
        self, calls: Mapping[str, Call], repeats: int = 0, *, warm_up: bool = True
    ) -> dict[str, float]:
        """Median seconds of each call; they run in turns, in random order.

        Without `repeats`, as often as the measurement says. The warm-up calls each twice, which
        also finds how many calls make a sample; without it, a sample is one call.
        """
        counts = dict.fromkeys(calls, 1)
        for name, call in calls.items() if warm_up else ():
            self.progress(f"{self.name}: warming up {name}")
            time_calls(call)  # may compile
            seconds, _ = time_calls(call)
            counts[name] = max(1, round(SAMPLE / max(seconds, 1e-9)))
        order = np.random.default_rng(0)
        samples: dict[str, list[float]] = {name: [] for name in calls}
        busy: dict[str, list[float]] = {name: [] for name in calls}
        for turn in range(repeats or self.repeats):
            for name in order.permutation(list(calls)):
                self.progress(f"{self.name}: {name}, run {turn + 1} of {repeats or self.repeats}")
                seconds, cpu_seconds = time_calls(calls[name], counts[name])
                samples[name].append(seconds)
                busy[name].append(cpu_seconds)
        self.samples |= samples
        self.busy |= busy
        return medians(samples)

    def add_sample(self, name: str, seconds: float, cpu_seconds: float | None = None) -> None:
        """Adds a sample of a call that was not timed in turns."""
        self.samples.setdefault(name, []).append(seconds)
        if cpu_seconds is not None:
            self.busy.setdefault(name, []).append(cpu_seconds)

    def add(self, what: str, value: float, unit: str, **rest: Any) -> None:
        """Adds a figure; `rest` are further fields of it."""
        self.figures.append(Figure(what, value, unit, **rest))

    def add_timing(
        self,
        name: str,
        what: str,
        unit: str = "s",
        *,
        items: float = 1.0,
        threads: int = 1,
        floats: str = "",
        **rest: Any,
    ) -> None:
        """Adds the median of the samples of this name, with its spread, CPU time and limit.

        Args:
            name: of the samples.
            what: the figure says.
            unit: one of `SECONDS` or `RATES`.
            items: that a call computes.
            threads: that share the work.
            floats: float32 or float64, where not those of the whole benchmark.
            rest: target and note of the figure.
        """

        def figure(seconds: float) -> float:
            if unit in SECONDS:
                return SECONDS[unit] * seconds / items
            return RATES[unit] * items / seconds

        values = [figure(seconds) for seconds in self.samples[name]]
        if name in self.busy:
            cpu_seconds = max(statistics.median(self.busy[name]), 1e-9)
            rest["busy"] = figure(cpu_seconds / threads)
        if name in self.work and self.ceilings:
            work = self.work[name]
            seconds, rest["bound"] = lower_bound(work, self.ceilings, floats or self.floats)
            rest["limit"] = figure(seconds)
        spread = min(values), max(values)
        self.add(what, statistics.median(values), unit, spread=spread, **rest)

    def add_ratio(self, slow: str, fast: str, what: str, **rest: Any) -> None:
        """Adds how many times as long one call takes as another, as the ratio of the medians.

        `rest` has target and note of the figure.
        """
        ratios = [a / b for a, b in zip(self.samples[slow], self.samples[fast], strict=True)]
        median = statistics.median(self.samples[slow]) / statistics.median(self.samples[fast])
        self.add(what, median, "times", spread=(min(ratios), max(ratios)), **rest)


def medians(samples: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Median of each list."""
    return {name: statistics.median(values) for name, values in samples.items()}


def time_calls(call: Call, count: int = 1) -> tuple[float, float]:
    """Mean duration of consecutive calls, s, and mean CPU time, s.

    The CPU time includes that of child processes that the calls wait for.
    """
    start, cpu_start = time.perf_counter(), _cpu_seconds()
    for _ in range(count):
        call()
    return (time.perf_counter() - start) / count, (_cpu_seconds() - cpu_start) / count


def call_in_process(
    function: Callable[..., Any], *arguments: str | int, environment: Mapping[str, str]
) -> Any:
    """What a function of a module returns in a new process, through JSON.

    Raises:
        subprocess.CalledProcessError: it has failed.
    """
    code = (
        f"import json, sys; from {function.__module__} import {function.__name__} as call; "
        "print('\\n' + json.dumps(call(*json.loads(sys.argv[1]))))"
    )
    finished = subprocess.run(
        [sys.executable, "-c", code, json.dumps(arguments)],
        env=environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    return json.loads(finished.stdout.splitlines()[-1])


def _cpu_seconds() -> float:
    """CPU time, s, of all threads of this process and of the child processes it waited for."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def hardware() -> dict[str, Any]:
    """The hardware and software of this process, as the JSON report holds them."""
    device = jax.devices()[0]
    return {
        "cpu": machine.processor(),
        "cores": os.cpu_count(),
        "vector_bits": machine.vector_bits(),
        "threads": usable_cores(),
        "memory_gb": machine.memory_gb(),
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
    return math.sqrt(256 / (machine.vector_bits() or 256))


def peak_memory_mb() -> float:
    """Peak memory, MB; NaN where the system does not report it.

    That of the device since the process started, where the device reports it; otherwise resident
    memory since `machine.reset_peak`.
    """
    if statistics := jax.devices()[0].memory_stats():
        return statistics.get("peak_bytes_in_use", float("nan")) / 1e6
    return machine.peak_mb() or float("nan")


@dataclass(frozen=True)
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


@dataclass
class Report:
    """All that was measured."""

    quick: bool
    measurements: list[Measurement] = field(default_factory=list)
    interrupted: bool = False


def run_benchmarks(
    benchmarks: Mapping[str, Benchmark],
    sizes: Sizes,
    quick: bool,
    announce: Callable[[str], None],
) -> Report:
    """Measures benchmarks one after another; an interrupt ends it; what was measured stays.

    `announce` gets a line at the start and at the end of each.
    """
    report, ceilings = Report(quick), {}
    cached = cache_folder.setting(cache_folder.ENABLED)
    # With a cache, the second run of a benchmark would not compile.
    jax.config.update(cache_folder.ENABLED, False)
    try:
        for number, (name, benchmark) in enumerate(benchmarks.items()):
            announce(f"[{number + 1}/{len(benchmarks)}] {name}: {benchmark.title}")
            measurement = Measurement(
                name, benchmark.title, sizes.repeats, benchmark.floats, ceilings,
                load=machine.load_average(),
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
