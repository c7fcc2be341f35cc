"""The picture of how time grows with size."""

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from fitting.report.plots.style import STAGES, styled

from .measure import Series

COLUMNS = 3
DECADE = 12


@styled
def curves(series: Sequence[Series], title: str) -> Figure:
    """Seconds against each size, both as logarithms, every curve with its slope.

    Args:
        series: with a point or more each.
        title: of all.
    """
    rows = math.ceil(len(series) / COLUMNS)
    columns = min(COLUMNS, len(series))
    figure = Figure(figsize=(6.2 * columns, 4.6 * rows + 0.8), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, one in zip(grid, series, strict=False):
        for colour, (name, seconds) in zip(STAGES, one.seconds.items(), strict=False):
            label = f"{name}, slope {one.slope(name):.2f}"
            axes.loglog(one.sizes, seconds, "o-", color=colour, markersize=4, label=label)
        axes.set(xlabel=one.size, ylabel="s")
        if max(one.sizes) < DECADE * min(one.sizes):  # too few powers of ten to tell sizes by
            axes.set_xticks(one.sizes, [str(size) for size in one.sizes])
            axes.set_xticks([], minor=True)
        axes.legend()
    for axes in grid[len(series) :]:
        axes.set_axis_off()
    return figure
