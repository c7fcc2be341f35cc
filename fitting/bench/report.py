"""The report of `jaxik bench`: a table with a line for each figure, JSON, and curves."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxtyping import PyTree
from matplotlib.figure import Figure as PlotFigure

from fitting.report import formatting, style
from fitting.report.style import STAGES, panels, styled
from fitting.runtime import files, machine, xla

from .measurement import (
    Measurement,
    Report,
    Series,
    hardware,
    medians,
    time_in_width,
)

COLUMNS = 3
FEW_DECADES = 12  # ratio of the sizes below which every size gets its own tick


def to_json(report: Report) -> str:
    """Everything as JSON: figures, and for each call all samples, s, with their medians.

    Numbers that are not finite are null.
    """
    content = {
        "machine": {**hardware(), "load": _loads(report)},
        "quick": report.quick,
        "interrupted": report.interrupted,
        "rows": [_numbers(measurement) for measurement in report.measurements],
    }
    return json.dumps(_finite(content), indent=1, allow_nan=False) + "\n"


def _loads(report: Report) -> list[float]:
    """Load averages at the start of each benchmark, and now."""
    return [measurement.load for measurement in report.measurements] + [machine.load_average()]


def _numbers(measurement: Measurement) -> dict[str, Any]:
    numbers = dataclasses.asdict(measurement)
    for figure, entry in zip(measurement.figures, numbers["figures"], strict=True):
        entry |= {"met": figure.met, "closeness": figure.closeness}
    for curves, entry in zip(measurement.series, numbers["series"], strict=True):
        entry["slopes"] = {name: curves.slope(name) for name in curves.seconds}
    return numbers | {"medians": medians(measurement.samples)}


def _finite(value: PyTree) -> PyTree:
    """The same with None for numbers that are not finite, which JSON has no form for."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not abs(value) < float("inf") else value


def text(report: Report) -> str:
    """The machine, a table with a line for each figure, compile times and notes."""
    facts = hardware()
    loads = _loads(report)
    memory = f"{facts['memory_gb']:.0f} GB, " if facts["memory_gb"] else ""
    vectors = f"vectors of {facts['vector_bits']} bits, " if facts["vector_bits"] else ""
    lines = [
        f"{facts['cpu']}, {facts['cores']} cores, {facts['threads']} threads used, "
        f"{vectors}{memory}"
        f"{facts['device']}; JAX {facts['jax']}, Python {facts['python']}; "
        f"load average {min(loads):.1f} to {max(loads):.1f}",
        f"XLA flags: {xla.describe_flags()}",
        "Medians of several runs. CPU: by CPU time, divided by the number of threads that work. "
        "Limit: what memory, arithmetic or dispatch alone would allow, and the fraction reached. "
        "Targets of legs, feet and crowds are those of vectors of 256 bits, times "
        f"{time_in_width():.2g} for this core.",
    ]
    if report.quick:
        lines.append(
            "Quick: smaller sizes, fewer runs and fewer rows than the targets are meant for."
        )
    if report.interrupted:
        lines.append("Interrupted: this is what was measured before.")
    compiled = [
        f"{measurement.name}: "
        + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in measurement.compile_s.items())
        for measurement in report.measurements
        if measurement.compile_s
    ]
    notes = [
        f"{measurement.name}: {note}"
        for measurement in report.measurements
        for note in (
            *(f"{figure.what}: {figure.note}" for figure in measurement.figures if figure.note),
            *measurement.notes,
            *measurement.failures,
        )
    ]
    parts = ["\n".join(lines), formatting.aligned(table(report))]
    if compiled:
        parts.append("Compile time, which counts in cold figures only\n" + "\n".join(compiled))
    if notes:
        parts.append("Notes\n" + "\n".join(notes))
    return formatting.joined(parts, apart=True)


def table(report: Report) -> formatting.Table:
    """A row for each figure."""
    rows = [["row", "what", "measured", "runs", "CPU", "target", "met", "limit", "reached"]]
    for measurement in report.measurements:
        for figure in measurement.figures:
            met = {True: "yes", False: "no", None: ""}[figure.met]
            runs = formatting.interval(*map(_short, figure.spread)) if figure.spread else ""
            busy = "" if figure.busy is None else formatting.number(figure.busy)
            limit = "" if figure.limit is None else f"{_short(figure.limit):g}, {figure.bound}"
            closeness = "" if figure.closeness is None else formatting.percent(figure.closeness)
            value = f"{formatting.number(figure.value)} {figure.unit}".rstrip()
            cells = [figure.what, value, runs, busy, figure.target, met, limit, closeness]
            rows.append([measurement.name, *cells])
    return rows


def _short(value: float) -> float:
    """A number with three significant digits."""
    return float(f"{value:.3g}")


def check_output_files(numbers: Path | None, plot: Path | None) -> Path | None:
    """The file for the curves: `plot`, or else one beside the numbers, or None.

    Raises:
        ValueError: if a file cannot be written, or the plot is not a PNG.
    """
    curves = numbers.with_suffix(".png") if plot is None and numbers is not None else plot
    if plot is not None and plot.suffix.lower() != ".png":
        raise ValueError(f"{plot}: wanted a name that ends in .png")
    if numbers is not None and numbers == curves:
        raise ValueError(f"{numbers}: the numbers and the curves cannot be one file")
    for path in (numbers, curves):
        if path is not None:
            files.check_output_file(path)
    return curves


def write(report: Report, numbers: Path | None, curves: Path | None) -> list[Path]:
    """Writes the numbers and the curves; returns the files that were written."""
    written = []
    if numbers is not None:
        files.write_text(numbers, to_json(report))
        written.append(numbers)
    series = [each for measured in report.measurements for each in measured.series if each.sizes]
    if curves is not None and series:
        facts = hardware()
        title = f"{facts['cpu']}, {facts['threads']} threads"
        style.save(curves, draw_curves(series, title))
        written.append(curves)
    return written


@styled
def draw_curves(series: Sequence[Series], title: str) -> PlotFigure:
    """Seconds against each size on logarithmic axes, every curve with its slope."""
    columns = min(COLUMNS, len(series))
    figure, grid = panels(len(series), columns, title, 4.6, 0.8, width=6.2 * columns)
    for axes, one_size in zip(grid, series, strict=True):
        sizes = one_size.sizes
        for colour, (name, seconds) in zip(STAGES, one_size.seconds.items(), strict=False):
            label = f"{name}, slope {one_size.slope(name):.2f}" if len(sizes) > 1 else name
            axes.loglog(sizes, seconds, "o-", color=colour, markersize=4, label=label)
        axes.set(xlabel=one_size.size, ylabel="time, s")
        if max(sizes) < FEW_DECADES * min(sizes):  # too few powers of ten for readable ticks
            axes.set_xticks(sizes, [str(size) for size in sizes])
            axes.set_xticks([], minor=True)
        axes.legend()
    return figure
