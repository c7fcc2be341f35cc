"""What one benchmark measures: compiled programs, samples of their run time, and figures of them.

A benchmark fills its `Measurement` as it goes, so that Ctrl-C loses only what was not measured yet.
Programs are compiled ahead of time, and compiling is timed separately. Calls that are compared run
in turns, in random order, so that other load on the machine affects all of them.
"""

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import jax
import numpy as np
from jaxtyping import PyTree

from .roofline import Work, lower_bound, work_of_program

SAMPLE = 0.2  # s, shortest sample: a faster call is repeated within it
Call: TypeAlias = Callable[[], object]  # returns once its result is there


@dataclass(frozen=True, kw_only=True)
class FigureSpec:
    """How a figure follows from the seconds that a call takes, and the value it should reach."""

    what: str
    unit: str = "times"
    scale: float = 1.0
    """Figure = scale * seconds, or scale / seconds for a rate."""
    rate: bool = False
    threads: int = 1
    """That share the work."""
    floats: str = ""
    """Float32 or float64, where not that of the whole benchmark."""
    at_most: float | None = None
    at_least: float | None = None
    note: str = ""

    def value(self, seconds: float) -> float:
        """The figure for a run time, s."""
        return self.scale / seconds if self.rate else self.scale * seconds


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
    sizes: list[int]
    seconds: dict[str, list[float]]

    def slope(self, name: str, last: int = 0) -> float:
        """Exponent of the power law of a curve: 1 where twice the size takes twice the time.

        Args:
            name: of the curve.
            last: how many of the last points to use; 0 for all. NaN for a single point.
        """
        sizes, seconds = np.log(self.sizes[-last:]), np.log(self.seconds[name][-last:])
        return float(np.polyfit(sizes, seconds, 1)[0]) if len(sizes) > 1 else float("nan")


def _ignore(text: str) -> None:
    pass


@dataclass
class Measurement:
    """What one benchmark measures. Samples, CPU times and work are those of one call, by name."""

    name: str
    title: str
    repeats: int
    floats: str = ""
    """Float32 or float64; empty where figures say it, or there are none."""
    progress: Callable[[str], None] = _ignore
    """Called with what is being done."""
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

    def compile(
        self, name: str, function: Callable, *arguments: PyTree, sparse: PyTree = ()
    ) -> Callable:
        """The function compiled for these arguments; keeps its compile time and its work.

        Args:
            name: under which they are kept.
            function: of arrays.
            arguments: what it is compiled for.
            sparse: arrays among them of which a run reads little; see `work_of_program`.
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

    def time_in_turns(
        self, calls: Mapping[str, Call], repeats: int = 0, *, warm_up: bool = True
    ) -> dict[str, float]:
        """Median seconds of each call; they run in turns, in random order.

        Args:
            calls: by name.
            repeats: samples of each call; 0 for the number of the measurement.
            warm_up: whether to call each twice beforehand, which also finds how many calls make a
                sample. Without it, a sample is one call.
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

    def add(self, figure: Figure) -> None:
        """Adds a figure."""
        self.figures.append(figure)

    def add_timing(self, name: str, spec: FigureSpec) -> None:
        """Adds the median of the samples of this name, with its spread, CPU time and limit."""
        values = [spec.value(seconds) for seconds in self.samples[name]]
        busy, limit, bound = None, None, ""
        if name in self.busy:
            cpu_seconds = max(statistics.median(self.busy[name]), 1e-9)
            busy = spec.value(cpu_seconds / spec.threads)
        if name in self.work and self.ceilings:
            seconds, bound = lower_bound(self.work[name], self.ceilings, spec.floats or self.floats)
            limit = spec.value(seconds)
        self._add(spec, statistics.median(values), values, (busy, limit, bound))

    def add_ratio(self, slow: str, fast: str, spec: FigureSpec) -> None:
        """Adds how many times as long one call takes as another, as the ratio of the medians."""
        ratios = [a / b for a, b in zip(self.samples[slow], self.samples[fast], strict=True)]
        median = statistics.median(self.samples[slow]) / statistics.median(self.samples[fast])
        self._add(spec, median, ratios)

    def _add(
        self,
        spec: FigureSpec,
        value: float,
        values: Sequence[float],
        limits: tuple[float | None, float | None, str] = (None, None, ""),
    ) -> None:
        busy, limit, bound = limits
        self.add(
            Figure(
                spec.what, float(value), spec.unit, spec.at_most, spec.at_least,
                (min(values), max(values)), busy, limit, bound, spec.note,
            )
        )  # fmt: skip


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


def _cpu_seconds() -> float:
    """CPU time, s, of all threads of this process and of the child processes it waited for."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system
