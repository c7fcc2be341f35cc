"""The figure of an ablation: each figure of accuracy for all variants."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.experiments.ablations import COMPLETE
from fitting.report.labels import ACCURACY
from fitting.studies.ablation import Row

from .style import AFTER, CAPTURED, STAGES, legend, styled

PANELS_PER_ROW = 4
ABLATED = STAGES[1]


def variant_name(variant: str) -> str:
    """A variant as tables and axes call it."""
    return variant if variant == COMPLETE else f"without {variant}"


@styled
def overview(rows: Sequence[Row], title: str) -> Figure:
    """Each figure of all variants: on parts held out, and where everything was fitted."""
    variants = list(dict.fromkeys(row.variant for row in rows))
    lines = -(-len(ACCURACY) // PANELS_PER_ROW)
    size = (17, lines * (0.45 * len(variants) + 1.2) + 1.8)
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(lines, PANELS_PER_ROW, squeeze=False, sharey=True)
    for axes, key in zip(grid.flat, ACCURACY, strict=False):
        _bars(axes, key, rows, variants)
    for axes in list(grid.flat)[len(ACCURACY) :]:
        axes.set_axis_off()
    legend(
        figure,
        Patch(color=AFTER, label=f"{COMPLETE}: mean of the parts held out"),
        Patch(color=ABLATED, label="without this rule: mean of the parts held out"),
        Line2D([], [], marker="o", linestyle="", color="black", label="each part held out"),
        Line2D([], [], marker="D", linestyle="", color=CAPTURED, label="fitted on everything"),
    )
    return figure


def _bars(axes: Axes, key: str, rows: Sequence[Row], variants: Sequence[str]) -> None:
    """One figure of all variants."""
    column, largest = ACCURACY[key], 0.0
    for place, variant in enumerate(variants):
        own = [row for row in rows if row.variant == variant]
        held_out = [getattr(row.agreement, key) for row in own if row.part]
        everything = [getattr(row.agreement, key) for row in own if not row.part]
        mean = float(np.mean(held_out))
        values = column.factor * np.array([*held_out, *everything])
        end = float(np.nan_to_num(values).max())
        largest = max(largest, end)
        colour = AFTER if variant == COMPLETE else ABLATED
        axes.barh(place, column.factor * np.nan_to_num(mean), color=colour, height=0.7)
        parts = len(held_out)
        axes.plot(values[:parts], [place] * parts, "o", color="black", markersize=5)
        axes.plot(values[parts:], [place], "D", color=CAPTURED, markersize=6)
        axes.annotate(
            column.format(mean), (end, place), xytext=(8, 0),
            textcoords="offset points", va="center",
        )  # fmt: skip
        if variant == COMPLETE and not np.isnan(mean):
            axes.axvline(column.factor * mean, color=AFTER, linestyle="--", linewidth=1.2)
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlim(0.0, 1.3 * max(largest, 10.0 ** (1 - column.digits)))
    axes.set_ylim(len(variants) - 0.4, -0.6)
    axes.set_yticks(range(len(variants)), [variant_name(variant) for variant in variants])
    axes.tick_params(axis="y", length=0)
    axes.grid(False, axis="y")
    axes.set_title(f"{column.heading.capitalize()}, {column.unit}")
