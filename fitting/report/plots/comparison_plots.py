"""The picture of several systems on one clip."""

from collections.abc import Iterable, Mapping
from typing import Literal, TypeAlias, TypedDict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.analysis.measures import Measures
from fitting.report.labels import MEASURES
from fitting.studies.comparison import Comparison

from .style import BEFORE, CAPTURED, EARTH, GROUND, STAGES, earth, legend, styled, whole_and_part

COLOURS = (*STAGES, CAPTURED)
Dashes: TypeAlias = Literal["-", "--", ":"]
DASHES: tuple[Dashes, ...] = ("-", "--", ":")  # for more systems than colours
BAR_PANELS = 5  # in a row


class LineStyle(TypedDict):
    """How a system is drawn, as keywords of `Axes.plot`."""

    color: str
    linestyle: Dashes
    linewidth: float


@styled
def overview(comparison: Comparison) -> Figure:
    """Heights of ankles and pelvis under every system, with the ground, and bars of measures."""
    styles = _line_styles(comparison.motions)
    bar_rows = -(-len(MEASURES) // BAR_PANELS)
    heights = 3.4 * (len(comparison.legs) + 1) + 0.6, bar_rows * (0.42 * len(styles) + 1.0)
    figure = Figure(figsize=(17, sum(heights) + 1.6), layout="constrained")
    figure.suptitle(comparison.title)
    (upper,), (lower,) = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)
    _draw_heights(upper, comparison, styles)
    grid = lower.subplots(bar_rows, BAR_PANELS, squeeze=False, sharey=True)
    for axes, key in zip(grid.flat, MEASURES, strict=False):
        _bars(axes, key, comparison.measures, styles)
    lines = [Line2D([], [], label=name, **style) for name, style in styles.items()]
    legend(figure, *lines, Patch(facecolor=EARTH, edgecolor=GROUND, label="ground"), columns=6)
    return figure


def _draw_heights(
    figure: FigureBase, comparison: Comparison, styles: Mapping[str, LineStyle]
) -> None:
    """Heights over time, a panel for each leg and one for the pelvis."""
    ground, motions = comparison.ground, comparison.motions
    time = np.arange(len(ground)) / comparison.fps
    pelvis = np.mean([motion.pelvis[:, 1] for motion in motions.values()], axis=0)
    columns = whole_and_part(figure, time, pelvis, len(comparison.legs) + 1)
    for panels in columns:
        for leg, (axes, name) in enumerate(zip(panels, comparison.legs, strict=False)):
            for system, motion in motions.items():
                axes.plot(time, 100 * motion.ankle[:, leg, 1], **styles[system])
            earth(axes, time, 100 * ground[:, leg])
            axes.set_title(f"{_title(name)} ankle, with the ground under the animated one")
        for system, motion in motions.items():
            panels[-1].plot(time, 100 * motion.pelvis[:, 1], **styles[system])
        earth(panels[-1], time, 100 * ground.mean(axis=1))
        panels[-1].set_title("Pelvis, with the mean ground under the animated feet")
    for axes in columns[0]:
        axes.set_ylabel("height, cm")


def _line_styles(systems: Iterable[str]) -> dict[str, LineStyle]:
    """Line styles by system; the first one, which is the animation, is grey.

    Each line is thinner than the one drawn before it, so that both are visible where they coincide.
    """
    first, *others = systems
    styles: dict[str, LineStyle] = {first: {"color": BEFORE, "linestyle": "-", "linewidth": 3.5}}
    for index, name in enumerate(others):
        repeat, colour = divmod(index, len(COLOURS))
        dashes = DASHES[repeat % len(DASHES)]
        width = max(1.1, 2.6 - 0.4 * index)
        styles[name] = {"color": COLOURS[colour], "linestyle": dashes, "linewidth": width}
    return styles


def _title(name: str) -> str:
    """The name of a leg at the beginning of a title."""
    return name.replace("_", " ").capitalize()


def _bars(
    axes: Axes, key: str, measures: Mapping[str, Measures], styles: Mapping[str, LineStyle]
) -> None:
    """One measure of all systems, with the value at the end of each bar."""
    values = [getattr(measured, key) for measured in measures.values()]
    widths = MEASURES[key].factor * np.nan_to_num(values)
    rows = np.arange(len(values))
    axes.barh(rows, widths, color=[styles[name]["color"] for name in measures], height=0.7)
    for row, width, value in zip(rows, widths, values, strict=True):
        axes.annotate(
            MEASURES[key].format(value),
            (width, row),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
        )
    smallest = 10.0 ** (
        1 - MEASURES[key].digits
    )  # smallest axis: a value that rounds to 0 looks like 0
    axes.set_xlim(0.0, 1.35 * max(*widths, smallest))
    axes.xaxis.set_visible(False)  # the values are at the bars
    axes.spines["bottom"].set_visible(False)
    axes.set_ylim(len(values) - 0.4, -0.6)
    axes.set_yticks(rows, list(measures))
    axes.tick_params(axis="y", length=0)
    axes.grid(False)
    axes.set_title(f"{MEASURES[key].heading.capitalize()}, {MEASURES[key].unit}")
