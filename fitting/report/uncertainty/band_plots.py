"""The picture of the capture inside the band of the posterior's replicates."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fitting.report.formatting import percent
from fitting.report.labels import RESIDUALS
from fitting.report.plots.style import AFTER, CAPTURED, legend, styled
from fitting.studies.posterior.predictive import Band

MAX_CLIPS = 4  # that are drawn


@styled
def bands(shown: Sequence[Band], title: str) -> Figure:
    """One channel for each kind of residual, a column for each clip."""
    clips = sorted({band.clip for band in shown})[:MAX_CLIPS]
    kinds = list(dict.fromkeys(band.kind for band in shown))
    figure = Figure(
        figsize=(max(17, 8.5 * len(clips)), 2.6 * len(kinds) + 1.8), layout="constrained"
    )
    figure.suptitle(title)
    grid = figure.subplots(max(len(kinds), 1), max(len(clips), 1), squeeze=False, sharex="col")
    for band in shown:
        if band.clip in clips:
            axes = grid[kinds.index(band.kind), clips.index(band.clip)]
            _draw(axes, band, clip=len(clips) > 1)
    for axes in grid[-1]:
        axes.set_xlabel("time, s")
    legend(
        figure,
        Line2D([], [], color=CAPTURED, linewidth=2, label="captured"),
        Line2D([], [], color=AFTER, linewidth=8, alpha=0.3, label="95 % of the replicates"),
        Line2D([], [], color=AFTER, linewidth=2, label="median motion of the posterior"),
    )
    return figure


def _draw(axes: Axes, band: Band, *, clip: bool) -> None:
    name, unit, factor = RESIDUALS[band.kind]
    axes.fill_between(
        band.time, factor * band.low, factor * band.high, color=AFTER, alpha=0.3, linewidth=0
    )
    axes.axhline(0.0, color=AFTER, linewidth=1.5)
    axes.plot(band.time, factor * band.captured, color=CAPTURED, linewidth=0.9)
    axes.set_ylabel(unit)
    axes.set_xlim(band.time[0], band.time[-1])
    where = f"clip {band.clip + 1}, " if clip else ""
    axes.set_title(
        f"{where}{name.lower()}, {band.channel}: {percent(band.outside)} outside the band"
    )
