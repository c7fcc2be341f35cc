"""The picture of how run time grows with size."""

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from fitting.report.plots.style import STAGES, styled

from .measurement import Series

COLUMNS = 3
FEW_DECADES = 12  # ratio of the sizes below which every size gets its own tick


@styled
def curves(series: Sequence[Series], title: str) -> Figure:
    """Seconds against each size on logarithmic axes, every curve with its slope.

    Args:
        series: with at least one point each.
        title: of the figure.
    """
    rows = math.ceil(len(series) / COLUMNS)
    columns = min(COLUMNS, len(series))
    figure = Figure(figsize=(6.2 * columns, 4.6 * rows + 0.8), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, one_size in zip(grid, series, strict=False):
        sizes = one_size.sizes
        for colour, (name, seconds) in zip(STAGES, one_size.seconds.items(), strict=False):
            label = f"{name}, slope {one_size.slope(name):.2f}" if len(sizes) > 1 else name
            axes.loglog(sizes, seconds, "o-", color=colour, markersize=4, label=label)
        axes.set(xlabel=one_size.size, ylabel="time, s")
        if max(sizes) < FEW_DECADES * min(sizes):  # too few powers of ten for readable ticks
            axes.set_xticks(sizes, [str(size) for size in sizes])
            axes.set_xticks([], minor=True)
        axes.legend()
    for axes in grid[len(series) :]:
        axes.set_axis_off()
    return figure
