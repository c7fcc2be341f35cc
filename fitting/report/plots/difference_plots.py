"""The picture of what remains of another system's correction."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.analysis.difference import NEGLIGIBLE, Difference
from fitting.report.labels import DIFFERENCES

from .style import AFTER, BEFORE, EARTH, legend, styled


@styled
def difference(clip: Difference, source: str, target: str, title: str) -> Figure:
    """Size of the source's correction, and of what remains of it under the target, over time."""
    names = [
        name
        for name in DIFFERENCES
        if max(clip.correction[name].max(), clip.remaining[name].max()) > NEGLIGIBLE
    ]
    figure = Figure(figsize=(17, 2.9 * max(len(names), 1) + 1.8), layout="constrained")
    figure.suptitle(title)
    rows = figure.subplots(max(len(names), 1), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(rows, names, strict=False):
        kind = DIFFERENCES[name]
        of_legs = clip.remaining[name].shape[1] > 1
        for series, colour in ((clip.correction, BEFORE), (clip.remaining, AFTER)):
            axes.plot(clip.time, kind.factor * series[name].max(axis=1), color=colour)
        axes.set_title(kind.name.capitalize() + (" (the larger of the legs)" if of_legs else ""))
        axes.set_ylabel(kind.unit)
        axes.set_ylim(bottom=0)
        _shade(axes, clip)
    rows[-1].set_xlabel("time, s")
    rows[-1].set_xlim(clip.time[0], clip.time[-1])
    entries: list[Line2D | Patch] = [
        Line2D([], [], color=BEFORE, linewidth=3, label=f"{source} - animation: its correction"),
        Line2D([], [], color=AFTER, linewidth=3, label=f"{source} - {target}: what remains"),
    ]
    if clip.standing.any():
        entries.append(Patch(color=EARTH, label="the character stands"))
    legend(figure, *entries)
    return figure


def _shade(axes: Axes, clip: Difference) -> None:
    """Marks the time in which the character stands."""
    edges = np.flatnonzero(np.diff(clip.standing.astype(int), prepend=0, append=0))
    for start, end in edges.reshape(-1, 2):
        axes.axvspan(float(clip.time[start]), float(clip.time[end - 1]), color=EARTH, zorder=0)
