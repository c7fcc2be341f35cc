"""The picture of several systems on one clip."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.analysis.measures import Measures
from fitting.analysis.playback import Motion
from fitting.report.labels import MEASURES

from .style import BEFORE, CAPTURED, EARTH, GROUND, STAGES, earth, legend, styled, whole_and_part

COLOURS = (*STAGES, CAPTURED)
DASHES = ("-", "--", ":")  # for more systems than colours
BARS = 5  # panels of measures in a row


@styled
def overview(
    time: Float64[np.ndarray, " frames"],
    legs: Sequence[str],
    ground: Float64[np.ndarray, "frames legs"],
    motions: Mapping[str, Motion],
    measures: Mapping[str, Measures],
    title: str,
) -> Figure:
    """Heights of ankles and pelvis over the ground under every system, and bars of the measures.

    Args:
        time: of each frame, s.
        legs: their names.
        ground: height under the animated ankles, m; NaN without.
        motions: by system, the animation first.
        measures: of the same systems.
        title: of the figure.
    """
    looks = _looks(motions)
    bars = -(-len(MEASURES) // BARS)
    heights = 3.4 * (len(legs) + 1) + 0.6, bars * (0.42 * len(motions) + 1.0)
    figure = Figure(figsize=(17, sum(heights) + 1.6), layout="constrained")
    figure.suptitle(title)
    (upper,), (lower,) = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)
    pelvis = np.mean([motion.pelvis[:, 1] for motion in motions.values()], axis=0)
    columns = whole_and_part(upper, time, pelvis, len(legs) + 1)
    for shown in columns:
        for leg, (axes, name) in enumerate(zip(shown, legs, strict=False)):
            for system, motion in motions.items():
                axes.plot(time, 100 * motion.ankle[:, leg, 1], **looks[system])
            earth(axes, time, 100 * ground[:, leg])
            axes.set_title(f"{_words(name)} ankle, over the ground under the animated one")
        for system, motion in motions.items():
            shown[-1].plot(time, 100 * motion.pelvis[:, 1], **looks[system])
        earth(shown[-1], time, 100 * ground.mean(axis=1))
        shown[-1].set_title("Pelvis, over the mean of the ground under the animated feet")
    for axes in columns[0]:
        axes.set_ylabel("height, cm")
    grid = lower.subplots(bars, BARS, squeeze=False, sharey=True)
    for axes, key in zip(grid.flat, MEASURES, strict=False):
        _bars(axes, key, measures, looks)
    lines = [Line2D([], [], label=name, **look) for name, look in looks.items()]
    legend(figure, *lines, Patch(facecolor=EARTH, edgecolor=GROUND, label="ground"), columns=6)
    return figure


def _looks(systems: Iterable[str]) -> dict[str, dict[str, Any]]:
    """How each system is drawn: the animation, which is the first, in grey.

    Each line is thinner than the one before, below it, so that both show where they meet.
    """
    first, *others = systems
    looks = {first: {"color": BEFORE, "linestyle": "-", "linewidth": 3.5}}
    for index, name in enumerate(others):
        lap, colour = divmod(index, len(COLOURS))
        dashes = DASHES[lap % len(DASHES)]
        wide = max(1.1, 2.6 - 0.4 * index)
        looks[name] = {"color": COLOURS[colour], "linestyle": dashes, "linewidth": wide}
    return looks


def _words(name: str) -> str:
    """A leg's name as the beginning of a title."""
    return name.replace("_", " ").capitalize()


def _bars(
    axes: Axes, key: str, measures: Mapping[str, Measures], looks: Mapping[str, dict[str, Any]]
) -> None:
    """One measure of all systems, with its value at the end of each bar."""
    values = [getattr(one, key) for one in measures.values()]
    widths = MEASURES[key].factor * np.nan_to_num(values)
    rows = np.arange(len(values))
    axes.barh(rows, widths, color=[looks[name]["color"] for name in measures], height=0.7)
    for row, width, value in zip(rows, widths, values, strict=True):
        axes.annotate(
            MEASURES[key].format(value),
            (width, row),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
        )
    smallest = 10.0 ** (1 - MEASURES[key].digits)  # of a scale: what rounds to 0 looks like 0
    axes.set_xlim(0.0, 1.35 * max(*widths, smallest))
    axes.xaxis.set_visible(False)  # the values stand at the bars
    axes.spines["bottom"].set_visible(False)
    axes.set_ylim(len(values) - 0.4, -0.6)
    axes.set_yticks(rows, list(measures))
    axes.tick_params(axis="y", length=0)
    axes.grid(False)
    axes.set_title(f"{MEASURES[key].heading.capitalize()}, {MEASURES[key].unit}")
