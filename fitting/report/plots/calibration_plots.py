"""Pictures of a calibration: ranks with their bands, and fitted against true values."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy import special

from fitting.inference.calibration.rank_bands import RankTest
from fitting.studies.calibration.replicates import ReplicateFit

from .style import AFTER, BEFORE, CAPTURED, legend, styled

PAIRS_PER_ROW, PANELS_PER_ROW = 2, 4
BINS = {100: 20, 0: 10}  # of a histogram, from so many replicates on
BAND = "#dddddd"


@styled
def ranks(tests: Mapping[str, RankTest], title: str) -> Figure:
    """Of each quantity: the histogram of its ranks, and its ECDF less that of uniform ranks."""
    rows = -(-len(tests) // PAIRS_PER_ROW)
    figure = Figure(figsize=(17, 2.6 * rows + 1.8), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(rows, 2 * PAIRS_PER_ROW, squeeze=False).reshape(-1, 2)
    for (histogram, difference), (name, test) in zip(grid, tests.items(), strict=False):
        _histogram(histogram, test)
        _difference(difference, test)
        histogram.set_title(name)
        if not test.inside:
            difference.set_title("outside its band", color=CAPTURED)
    for axes in grid[len(tests) :].ravel():
        axes.set_axis_off()
    for histogram, difference in grid[: len(tests)][-PAIRS_PER_ROW:]:
        histogram.set_xlabel("rank")
        difference.set_xlabel("rank, as a fraction")
    (test, *_) = tests.values()
    legend(
        figure,
        Patch(color=AFTER, label="left: replicates by the rank of their truth"),
        Line2D([], [], color=AFTER, label="right: ECDF of the ranks less the uniform one"),
        Patch(color=BAND, label=f"95 % of each bar; {100 * test.level:.2f} % of whole curves"),
    )
    return figure


@styled
def recovery(fits: Sequence[ReplicateFit], title: str) -> Figure:
    """Of each parameter: fitted against true values, with intervals that miss the truth marked."""
    rows = fits[0]["parameters"]
    lines = -(-len(rows) // PANELS_PER_ROW)
    figure = Figure(figsize=(17, 4.0 * lines + 1.4), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(lines, PANELS_PER_ROW, squeeze=False)
    for i, axes in enumerate(grid.flat):
        if i >= len(rows):
            axes.set_axis_off()
            continue
        _recovered(axes, fits, i)
    legend(
        figure,
        Line2D([], [], marker="o", color=AFTER, label="fitted, 95 % interval"),
        Line2D([], [], marker="o", color=CAPTURED, label="the interval misses the truth"),
        Line2D([], [], marker="o", linestyle="", mfc="none", color=BEFORE, label="undetermined"),
        Line2D([], [], color="black", linewidth=0.8, label="fitted = true"),
    )
    return figure


def _histogram(axes: Axes, test: RankTest) -> None:
    bins = next(count for least, count in BINS.items() if len(test.ranks) >= least)
    edges = np.linspace(0, test.draws + 1, bins + 1)
    counts = np.arange(len(test.ranks) + 1)
    below = special.bdtr(counts, len(test.ranks), 1 / bins)
    low, high = np.searchsorted(below, [0.025, 0.975])
    axes.axhspan(low, high, color=BAND)
    axes.stairs(test.histogram(bins), edges, color=AFTER, fill=True, alpha=0.7)
    axes.axhline(len(test.ranks) / bins, color="black", linewidth=0.8)
    axes.set_xlim(0, test.draws + 1)
    axes.grid(False)


def _difference(axes: Axes, test: RankTest) -> None:
    low, high = test.band - test.places
    axes.fill_between(test.places, low, high, step="post", color=BAND, linewidth=0)
    axes.step(test.places, test.ecdf - test.places, where="post", color=AFTER)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_xlim(0, 1)


def _recovered(axes: Axes, fits: Sequence[ReplicateFit], i: int) -> None:
    """One parameter in all replicates."""
    first = fits[0]["parameters"][i]
    for fitted in fits:
        row, truth = fitted["parameters"][i], fitted["truth"][i]
        low, high = row["interval"]
        colour = AFTER if low <= truth <= high else CAPTURED
        axes.plot([truth, truth], [low, high], color=colour, linewidth=0.9, alpha=0.6)
        face = colour if row["determined"] else "none"
        axes.plot(truth, row["value"], "o", color=colour, markersize=4, markerfacecolor=face)
    ends = [first["low"], first["high"]]
    axes.plot(ends, ends, color="black", linewidth=0.8)
    unit = "" if first["unit"] == "1" else f", {first['unit']}"
    axes.set_title(f"{first['name']}{unit}")
    axes.locator_params(nbins=5)
