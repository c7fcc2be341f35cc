"""The picture of many fits: what they found of each parameter, and how long they took."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from fitting.report.plots.style import AFTER, BEFORE, CAPTURED, styled
from fitting.studies.many.progress import ManyFits
from fitting.studies.many.rows import FittedValue, Row

COLUMNS = 4
SHOWN = 15  # parameters
SHORTEST = 1e-3  # s, of a fit as the histogram shows it
SINGLE = 150  # fits, up to which each has its interval


@styled
def overview(fits: ManyFits, title: str) -> Figure:
    """Of each parameter the values of all fits; and the seconds that they took.

    Args:
        fits: with at least one that is finished.
        title: of the figure.
    """
    series = list(_by_parameter(fits.finished).items())[:SHOWN]
    rows = -(-(len(series) + 1) // COLUMNS)
    figure = Figure(figsize=(17, 3.6 * rows + 1.0), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axes, ((experiment, name), values) in zip(grid, series, strict=False):
        _values(axes, values)
        axes.set_title(f"{name}\n{experiment}", fontsize=12)
    _seconds(grid[len(series)], fits.finished)
    for axes in grid[len(series) + 1 :]:
        axes.set_axis_off()
    return figure


def _by_parameter(rows: Sequence[Row]) -> dict[tuple[str, str], list[FittedValue]]:
    """What fits say of each parameter of each experiment."""
    series: dict[tuple[str, str], list[FittedValue]] = {}
    for row in rows:
        for name, fitted in row["outcome"]["parameters"].items() if "outcome" in row else ():
            series.setdefault((row["experiment"], name), []).append(fitted)
    return series


def _values(axes: Axes, values: Sequence[FittedValue]) -> None:
    """Each fit's value with its 95 % interval, or a histogram of very many."""
    unit = values[0]["unit"]
    if len(values) > SINGLE:
        known = [fitted["value"] for fitted in values if fitted["determined"]]
        axes.hist([fitted["value"] for fitted in values], 40, color=BEFORE, label="all")
        axes.hist(known, 40, color=AFTER, label="determined")
        axes.set(xlabel=unit, ylabel="fits")
        return
    for number, fitted in enumerate(values, 1):
        colour = AFTER if fitted["determined"] else BEFORE
        axes.plot([number, number], fitted["interval"], color=colour, linewidth=1.2)
        axes.plot(number, fitted["value"], ".", color=colour)
    axes.set(xlabel="fit", ylabel=unit, xlim=(0.5, len(values) + 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _seconds(axes: Axes, rows: Sequence[Row]) -> None:
    """How long fits took, and how much of that was their search."""
    pairs = [
        (row["effort"]["seconds"], row["outcome"]["search_seconds"])
        for row in rows
        if "effort" in row and "outcome" in row
    ]
    whole, search = np.array(pairs).T
    # Logarithmic, for first fits compile and take a hundred times as long as those that follow.
    ends = min(whole.min(), search.min()), max(whole.max(), search.max())
    bins = np.geomspace(max(ends[0], SHORTEST) / 1.1, max(ends[1], SHORTEST) * 1.1, 30).tolist()
    axes.hist(whole, bins, color=AFTER, alpha=0.8, label="fit")
    axes.hist(search, bins, color=CAPTURED, alpha=0.6, label="its search")
    axes.set(xlabel="time, s", ylabel="fits", xscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title("time of a fit", fontsize=12)
    axes.margins(y=0.35)  # room for the legend
    axes.legend(loc="upper right")
