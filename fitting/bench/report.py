"""What `jaxik bench` tells: the machine, a line a figure, all of it as JSON, curves."""

import dataclasses
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from fitting.report import formatting
from fitting.report.plots import style
from fitting.runtime import files
from fitting.runtime.threads import usable_cores

from . import plots
from .measure import Figure, Report, Row, load, medians

MEMORY = Path("/proc/meminfo")
CPU = Path("/proc/cpuinfo")


def hardware() -> dict[str, Any]:
    """What the figures are measured on."""
    device = jax.devices()[0]
    return {
        "cpu": _told(CPU, "model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": usable_cores(),
        "memory_gb": _memory_gb(),
        "device": f"{device.platform}: {device.device_kind}",
        "jax": jax.__version__,
        "python": platform.python_version(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def _memory_gb() -> float | None:
    """All memory of the machine; None where the system does not tell."""
    told = _told(MEMORY, "MemTotal")
    return float(told.split()[0]) / 1e6 if told else None


def _told(path: Path, key: str) -> str:
    """What a file of the system says first under a key; nothing where there is no such file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")


def to_json(report: Report) -> str:
    """All of it: medians with their samples, s a call, and whether each figure is reached.

    What is not a number is null.
    """
    whole = {
        "machine": hardware() | {"load": [row.load for row in report.rows] + [load()]},
        "quick": report.quick,
        "interrupted": report.interrupted,
        "rows": [_row(row) for row in report.rows],
    }
    return json.dumps(_finite(whole), indent=1, allow_nan=False) + "\n"


def _row(row: Row) -> dict[str, Any]:
    plain = {
        field.name: getattr(row, field.name)
        for field in dataclasses.fields(row)
        if field.name not in ("tell", "figures", "series", "work")
    }
    figures = [
        dataclasses.asdict(one) | {"met": one.met, "closeness": one.closeness}
        for one in row.figures
    ]
    series = [
        dataclasses.asdict(one) | {"slopes": {name: one.slope(name) for name in one.seconds}}
        for one in row.series
    ]
    work = {name: dataclasses.asdict(one) for name, one in row.work.items()}
    more = {"figures": figures, "series": series, "work": work, "medians": medians(row.samples)}
    return plain | more


def _finite(value: Any) -> Any:
    """The same with None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not abs(value) < float("inf") else value


def text(report: Report) -> str:
    """The machine, a table with a line a figure, compile times, notes."""
    machine = hardware()
    loads = [row.load for row in report.rows] + [load()]
    memory = f"{machine['memory_gb']:.0f} GB, " if machine["memory_gb"] else ""
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores, {machine['threads']} threads used, {memory}"
        f"{machine['device']}; JAX {machine['jax']}, Python {machine['python']}; "
        f"load average {min(loads):.1f} to {max(loads):.1f}",
        "Medians of several runs; CPU: by the time of CPU, shared out over the threads that work; "
        "limit: what memory, arithmetic or dispatch alone would allow, and the share reached.",
    ]
    if report.quick:
        lines.append(
            "Quick: smaller sizes, fewer runs and rows than the figures to be reached ask for."
        )
    if report.interrupted:
        lines.append("Interrupted: this is what was measured until then.")
    compiled = [
        f"{row.name}: " + ", ".join(f"{name} {took:.1f} s" for name, took in row.compile_s.items())
        for row in report.rows
        if row.compile_s
    ]
    notes = [
        f"{row.name}: {note}"
        for row in report.rows
        for note in (*_notes(row.figures), *row.notes, *row.failures)
    ]
    parts = ["\n".join(lines), formatting.aligned(table(report))]
    if compiled:
        parts.append("Compile time, which is in no figure but cold ones\n" + "\n".join(compiled))
    if notes:
        parts.append("Notes\n" + "\n".join(notes))
    return "\n\n".join(parts)


def table(report: Report) -> formatting.Table:
    """A line a figure."""
    made = [["row", "what", "measured", "runs", "CPU", "to reach", "met", "limit", "share"]]
    for row in report.rows:
        for one in row.figures:
            met = {True: "yes", False: "no", None: ""}[one.met]
            runs = formatting.interval(*(_short(end) for end in one.spread)) if one.spread else ""
            busy = "" if one.busy is None else formatting.number(one.busy)
            limit = "" if one.limit is None else f"{_short(one.limit):g}, {one.bound}"
            close = "" if one.closeness is None else formatting.percent(one.closeness)
            measured = f"{formatting.number(one.value)} {one.unit}".rstrip()
            made.append([row.name, one.what, measured, runs, busy, one.reach, met, limit, close])
    return made


def _notes(figures: Sequence[Figure]) -> list[str]:
    return [f"{one.what}: {one.note}" for one in figures if one.note]


def _short(value: float) -> float:
    """Three digits."""
    return float(f"{value:.3g}")


def check_places(numbers: Path | None, plot: Path | None) -> Path | None:
    """Where the curves are drawn: at `plot`, else beside the numbers, else nowhere.

    Raises:
        ValueError: where nothing can be written, or a plot that is not to be a PNG.
    """
    drawn = numbers.with_suffix(".png") if plot is None and numbers is not None else plot
    if plot is not None and plot.suffix.lower() != ".png":
        raise ValueError(f"{plot}: wanted a name that ends in .png")
    if numbers is not None and numbers == drawn:
        raise ValueError(f"{numbers}: the numbers and the curves cannot be one file")
    for place in (numbers, drawn):
        if place is not None:
            files.check_output_file(place)
    return drawn


def write(report: Report, numbers: Path | None, drawn: Path | None) -> list[Path]:
    """Writes the numbers and the curves; the files that were written."""
    written = []
    if numbers is not None:
        files.write_text(numbers, to_json(report))
        written.append(numbers)
    series = [one for row in report.rows for one in row.series if one.sizes]
    if drawn is not None and series:
        machine = hardware()
        title = f"{machine['cpu']}, {machine['threads']} threads"
        style.save(drawn, plots.curves(series, title))
        written.append(drawn)
    return written
