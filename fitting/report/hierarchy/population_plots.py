"""The picture of a population: what varies, in each clip and in the population, and errors."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.report.plots.style import AFTER, BEFORE, CAPTURED, PRIOR, STAGES, legend, styled
from fitting.studies.hierarchy.estimates import Estimate, ParameterEstimates
from fitting.studies.hierarchy.population import Population

from .population_tables import CM, ERRORS, clip_label

APART = 0.16  # of a row, from its middle to an estimate
COLOURS = dict(zip(ERRORS, (BEFORE, CAPTURED, AFTER, STAGES[1], STAGES[4]), strict=True))
PANELS_PER_ROW = 3


@styled
def overview(population: Population, title: str) -> Figure:
    """A panel for each parameter that varies, and one with the errors of all clips."""
    varying = [row for row in population.parameters if row["spread"] is not None]
    labels = [clip_label(population, c) for c in range(len(population.clips))]
    columns = min(PANELS_PER_ROW, len(varying) + 1)
    rows = -(-(len(varying) + 1) // columns)
    height = rows * (0.45 * len(labels) + 1.6) + 1.6
    figure = Figure(figsize=(5.6 * columns, height), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes, row in zip(grid.flat, varying, strict=False):
        _estimates(axes, row)
    _errors(grid.flat[len(varying)], population)
    for axes in list(grid.flat)[len(varying) + 1 :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_yticks(range(len(labels)), labels)
    grid[0, 0].set_ylim(len(labels) - 0.4, -0.6)
    legend(
        figure,
        Line2D([], [], marker="o", color=BEFORE, label="fitted alone, 95 %"),
        Line2D([], [], marker="o", color=AFTER, label="in the population, 95 %"),
        Line2D([], [], color=PRIOR, label="centre of the population"),
        Patch(color=PRIOR, alpha=0.15, label="95 % of clips or subjects"),
        Line2D([], [], color=CAPTURED, linestyle="--", label="pooled"),
        *(
            Line2D([], [], marker="D", linestyle="", color=COLOURS[key], label=f"error, {words}")
            for key, words in ERRORS.items()
        ),
        columns=5,
    )
    return figure


def _estimates(axes: Axes, row: ParameterEstimates) -> None:
    """One parameter: each clip alone and in the population."""
    assert row["range"] is not None  # of a parameter that varies
    axes.axvspan(*row["range"], color=PRIOR, alpha=0.15, linewidth=0)
    axes.axvline(row["centre"]["value"], color=PRIOR)
    axes.axvline(row["pooled"]["value"], color=CAPTURED, linestyle="--")
    for c, (alone, within) in enumerate(zip(row["alone"], row["clips"], strict=True)):
        _bar(axes, c - APART, alone, BEFORE)
        _bar(axes, c + APART, within, AFTER)
    axes.set_title(row["name"])
    axes.set_xlabel("" if row["unit"] == "1" else row["unit"])


def _bar(axes: Axes, place: float, estimate: Estimate, colour: str) -> None:
    axes.plot([estimate["value"]], [place], "o", color=colour, markersize=6)
    if estimate["interval"] is not None:
        axes.plot(estimate["interval"], [place, place], color=colour)


def _errors(axes: Axes, population: Population) -> None:
    """Errors of all clips."""
    for c, row in enumerate(population.errors):
        for place, key in zip(np.linspace(-0.24, 0.24, len(ERRORS)), ERRORS, strict=True):
            axes.plot([CM * getattr(row, key)], [c + place], "D", color=COLOURS[key], markersize=6)
    axes.set_xlim(left=0.0)
    axes.set_title("Error")
    axes.set_xlabel("cm, rms")
