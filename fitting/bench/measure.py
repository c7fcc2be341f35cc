"""The clock of `jaxik bench`: rows of figures, medians of interleaved runs.

A row is measured by a function that gets it and fills it as it goes, so that Ctrl-C loses only what
was not measured yet. Programs are compiled ahead and apart; what is compared runs in turns, in
random order, so that a load on the machine hits both sides.
"""

import dataclasses
import os
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .limits import Work, least, work

# What a machine that is too small, or another process, does to a row; the others go on.
FAILURES = (MemoryError, jax.errors.JaxRuntimeError, subprocess.CalledProcessError)

CEILINGS = "machine"  # the row against which the others are held
SAMPLE = 0.2  # s that one sample lasts at least: what is quicker is called several times in it
STATUS = Path("/proc/self/status")
Tell = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Figure:
    """One number of a row, with the number that is to be reached and the one that could be."""

    what: str
    value: float  # the median
    unit: str
    at_most: float | None = None
    at_least: float | None = None
    spread: tuple[float, float] | None = None  # lowest and highest of the runs
    busy: float | None = None  # the same by the time of CPU, shared out over the threads that work
    limit: float | None = None  # what the machine would give if nothing but `bound` held it back
    bound: str = ""
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether it is reached; None where nothing is to be reached."""
        if self.at_most is not None:
            return self.value <= self.at_most
        return None if self.at_least is None else self.value >= self.at_least

    @property
    def reach(self) -> str:
        """What is to be reached, in words."""
        if self.at_most is not None:
            return f"≤ {self.at_most:g}"
        return "" if self.at_least is None else f"≥ {self.at_least:g}"

    @property
    def closeness(self) -> float | None:
        """Share of the physical limit that is reached, 0..1."""
        if self.limit is None:
            return None
        return min(self.limit, self.value) / max(self.limit, self.value)


@dataclasses.dataclass(frozen=True)
class Series:
    """Time against one size; `seconds` has one list a curve."""

    size: str
    sizes: list[int]
    seconds: dict[str, list[float]]

    def slope(self, name: str, last: int = 0) -> float:
        """Exponent of the power law of a curve: 1 where twice the size takes twice the time.

        Over the `last` points, or over all; NaN for one point alone.
        """
        sizes, seconds = np.log(self.sizes[-last:]), np.log(self.seconds[name][-last:])
        return float(np.polyfit(sizes, seconds, 1)[0]) if len(sizes) > 1 else float("nan")


@dataclasses.dataclass
class Row:
    """What is measured of one thing; `tell` hears what is being done."""

    name: str
    title: str
    repeats: int
    floats: str = ""  # what it computes with; empty where figures say it, or have none
    tell: Tell = lambda text: None
    ceilings: dict[str, float] = dataclasses.field(default_factory=dict)  # of `bench_limits.least`
    figures: list[Figure] = dataclasses.field(default_factory=list)
    compile_s: dict[str, float] = dataclasses.field(default_factory=dict)
    samples: dict[str, list[float]] = dataclasses.field(default_factory=dict)  # s a call
    busy: dict[str, list[float]] = dataclasses.field(default_factory=dict)  # s of CPU a call
    work: dict[str, Work] = dataclasses.field(default_factory=dict)  # of a call
    series: list[Series] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    failures: list[str] = dataclasses.field(default_factory=list)  # what kept it from its end
    load: float = 0.0  # of the machine as it began
    seconds: float = 0.0  # all of it

    def program(self, name: str, function: Callable, *given: Any, sparse: Any = ()) -> Callable:
        """The function, compiled for what is given and called with the like; the time it took.

        Args:
            name: under which its time and its work are kept.
            function: of arrays.
            given: what it is compiled for.
            sparse: arrays among it of which a run reads little (`bench_limits.work`).
        """
        self.tell(f"{self.name}: compiling {name}")
        began = time.perf_counter()
        traced = jax.jit(function).trace(*given)
        program = traced.lower().compile()
        self.compile_s[name] = time.perf_counter() - began
        self.work[name] = work(traced, program, sparse)
        return program

    def compiled(
        self, name: str, function: Callable, *given: Any, sparse: Any = ()
    ) -> Callable[[], Any]:
        """A call of the function that waits for its result."""
        program = self.program(name, function, *given, sparse=sparse)
        return lambda: jax.block_until_ready(program(*given))

    def race(
        self, calls: Mapping[str, Callable[[], Any]], repeats: int = 0, *, warm: bool = False
    ) -> dict[str, float]:
        """Median seconds of each call; they run in turns, in random order, after a warm-up.

        Args:
            calls: by name; each waits for its result.
            repeats: of each, where not the row's.
            warm: whether they need no warm-up, and are long enough for one call a sample.
        """
        counts = dict.fromkeys(calls, 1)
        for name, call in () if warm else calls.items():
            self.tell(f"{self.name}: warming up {name}")
            clocked(call, 1)  # may compile
            took, _ = clocked(call, 1)
            counts[name] = max(1, round(SAMPLE / max(took, 1e-9)))
        order = np.random.default_rng(0)
        drawn: dict[str, list[float]] = {name: [] for name in calls}
        busy: dict[str, list[float]] = {name: [] for name in calls}
        for turn in range(repeats or self.repeats):
            for name in order.permutation(list(calls)):
                self.tell(f"{self.name}: {name}, run {turn + 1} of {repeats or self.repeats}")
                took, cpu = clocked(calls[name], counts[name])
                drawn[name].append(took)
                busy[name].append(cpu)
        self.samples |= drawn
        self.busy |= busy
        return medians(drawn)

    def add(self, what: str, value: float, unit: str, **more: Any) -> None:
        """One more figure; `more` is any of the other fields of `Figure`."""
        self.figures.append(Figure(what, float(value), unit, **more))

    def timed(
        self, what: str, name: str, unit: str, scale: float = 1.0, *,
        rate: bool = False, threads: int = 1, floats: str = "", **more: Any,
    ) -> None:  # fmt: skip
        """One more figure, the median of what ran under this name, with its spread and its limit.

        Args:
            what: it is.
            name: of the call.
            unit: of `scale` times the seconds, or for a rate of `scale` a second.
            scale: in which the size of what was done is contained.
            rate: whether more is better.
            threads: that share the work, if the machine lets them.
            floats: where not the row's.
            more: as for `add`.
        """

        def of(seconds: float) -> float:
            return scale / seconds if rate else scale * seconds

        drawn = [of(one) for one in self.samples[name]]
        if name in self.busy:
            more["busy"] = of(max(statistics.median(self.busy[name]), 1e-9) / threads)
        if name in self.work and self.ceilings:
            seconds, bound = least(self.work[name], self.ceilings, floats or self.floats)
            more |= {"limit": of(seconds), "bound": bound}
        self.add(what, statistics.median(drawn), unit, spread=(min(drawn), max(drawn)), **more)

    def ratio(self, what: str, slow: str, fast: str, **more: Any) -> None:
        """One more figure: how many times as long one call took as another, medians of both."""
        turns = [a / b for a, b in zip(self.samples[slow], self.samples[fast], strict=True)]
        median = statistics.median(self.samples[slow]) / statistics.median(self.samples[fast])
        self.add(what, median, "times", spread=(min(turns), max(turns)), **more)


def medians(samples: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Median of each list."""
    return {name: statistics.median(drawn) for name, drawn in samples.items()}


def clocked(call: Callable[[], Any], count: int = 1) -> tuple[float, float]:
    """Mean duration of some calls in a row, s, and mean time of CPU in them, s.

    That of the processes that they wait for counts, too.
    """
    began, busy = time.perf_counter(), _busy()
    for _ in range(count):
        call()
    return (time.perf_counter() - began) / count, (_busy() - busy) / count


def _busy() -> float:
    """Time of CPU, s, of all threads of this process and of the processes it waited for."""
    told = os.times()
    return time.process_time() + told.children_user + told.children_system


def reset_peak() -> None:
    """Forgets the peak of resident memory so far, where the system can."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        pass  # then the peak is that since the process began


def peak_mb() -> float:
    """Peak of memory, MB; NaN where the system does not tell.

    Of the device where it tells, since the process began; else resident, since `reset_peak`.
    """
    if told := jax.devices()[0].memory_stats():
        return told.get("peak_bytes_in_use", float("nan")) / 1e6
    if not STATUS.is_file():
        return float("nan")
    lines = STATUS.read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM"))


def load() -> float:
    """Load of the machine over the last minute, processes; NaN where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


@dataclasses.dataclass(frozen=True)
class Task:
    """A row to be measured, and how."""

    title: str
    floats: str  # of the row
    measure: Callable[[Row, Any], None]
    x64: bool = False  # whether JAX's 64-bit types are on meanwhile
    long: bool = False  # left out of a quick measurement, unless it is asked for by name


@dataclasses.dataclass
class Report:
    """All that was measured."""

    quick: bool
    rows: list[Row] = dataclasses.field(default_factory=list)
    interrupted: bool = False


def measure(
    tasks: Mapping[str, Task], sizes: Any, quick: bool, say: Tell, tell: Tell = lambda text: None
) -> Report:
    """Measures rows one after another; an interrupt ends it and keeps what is measured.

    Args:
        tasks: by name.
        sizes: handed to each; `sizes.repeats` says how many runs are made of each thing.
        quick: whether the sizes are small ones, for the report.
        say: hears of each row that it begins, and what came of it.
        tell: hears what is being done within it.
    """
    report, ceilings = Report(quick), {}
    kept = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)  # or a second go would not compile
    try:
        for number, (name, task) in enumerate(tasks.items()):
            say(f"[{number + 1}/{len(tasks)}] {name}: {task.title}")
            row = Row(name, task.title, sizes.repeats, task.floats, tell, ceilings, load=load())
            report.rows.append(row)
            report.interrupted = _interrupted(row, task, sizes)
            told = [f"{one.what} {one.value:.4g} {one.unit}" for one in row.figures]
            say(f"      {'; '.join(told + row.failures) or 'nothing'}  ({row.seconds:.1f} s)")
            if report.interrupted:
                break
    finally:
        jax.config.update("jax_enable_compilation_cache", kept)
    return report


def _interrupted(row: Row, task: Task, sizes: Any) -> bool:
    """Measures one row; whether Ctrl-C ended it."""
    began = time.perf_counter()
    try:
        with jax.enable_x64(task.x64):
            task.measure(row, sizes)
    except KeyboardInterrupt:
        return True
    except FAILURES as error:
        row.failures.append(f"failed: {_sentence(error)}")
    finally:
        row.seconds = time.perf_counter() - began
    return False


def _sentence(error: Exception) -> str:
    """An error in one line; of another process, the last of what it said."""
    said = error.stderr or "" if isinstance(error, subprocess.CalledProcessError) else ""
    lines = [line for line in f"{error}\n{said}".splitlines() if line.strip()]
    whole = lines[:1] + lines[1:][-1:]
    return f"{type(error).__name__}: {' … '.join(whole)}".rstrip(": ")


def choose(tasks: Mapping[str, Task], only: str | None, quick: bool = False) -> dict[str, Task]:
    """The rows of these names, in the order of the table; for None all, or all that are quick.

    The row of the ceilings is always among them.

    Raises:
        ValueError: for a name that there is not.
    """
    if only is None:
        return {name: task for name, task in tasks.items() if not (quick and task.long)}
    asked = [name.strip() for name in only.split(",") if name.strip()]
    if unknown := [name for name in asked if name not in tasks]:
        raise ValueError(f"--only: no rows named {unknown}; there are {list(tasks)}")
    if not asked:
        raise ValueError(f"--only: wanted names of rows; there are {list(tasks)}")
    return {name: task for name, task in tasks.items() if name in asked or name == CEILINGS}
