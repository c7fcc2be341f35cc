"""The picture of a ground that was found from motion."""

from collections.abc import Mapping

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from fitting.datasets.terrain.reconstruction import SURFACE_KINDS, Prediction, Reconstruction
from fitting.datasets.terrain.surfaces import LevelBlocks

from .style import BEFORE, GROUND, STAGES, legend, styled

COLOURS: dict[str, str] = dict(zip(SURFACE_KINDS, (STAGES[1], STAGES[2], STAGES[0]), strict=True))
PIXELS = 300  # along the longer side of the plan
LEGS = "o^sDvP*X"  # marks of the legs


@styled
def plan(ground: Reconstruction, margin: float, legs: tuple[str, ...], title: str) -> Figure:
    """The chosen ground from above with the stances on it, and how well each kind predicts them.

    Args:
        ground: what was found.
        margin: around the stances, m, that is shown.
        legs: their names.
        title: of the figure.
    """
    figure = Figure(figsize=(17, 9.5), layout="constrained")
    figure.suptitle(title)
    ((left, right),) = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.15, 1.0])
    _draw_plan(left.subplots(), ground, margin, legs)
    (upper,), (lower,) = right.subplots(2, 1, squeeze=False)
    _draw_errors(upper, ground.predictions)
    _draw_shares(lower, ground.predictions)
    marks = [
        Line2D([], [], color="black", marker=mark, linestyle="", markerfacecolor="white", label=leg)
        for leg, mark in zip(legs, _marks(len(legs)), strict=True)
    ]
    entries: list[Artist] = [*marks]
    if not ground.stances.used.all():
        entries.append(
            Line2D([], [], color="black", marker="x", linestyle="", label="on toes, not used")
        )
    if isinstance(ground.surface, LevelBlocks):
        entries.append(Patch(facecolor="white", edgecolor=BEFORE, hatch="///", label="not visited"))
    entries += [
        Line2D([], [], color=COLOURS[kind], linewidth=3, label=f"predicted by {kind}")
        for kind in SURFACE_KINDS
    ]
    legend(figure, *entries, columns=7)
    return figure


def _draw_plan(axes: Axes, ground: Reconstruction, margin: float, legs: tuple[str, ...]) -> None:
    """Heights in colour, blocks with their edges, stances in the colour of what they measured."""
    low, high = ground.extent(margin)
    count = np.ceil(PIXELS * (high - low) / np.max(high - low)).astype(int)
    x, z = (np.linspace(*part) for part in zip(low, high, count, strict=True))
    points = np.stack(np.meshgrid(x, z), axis=-1)
    heights = 100 * ground.surface.heights(points.reshape(-1, 2)).reshape(points.shape[:2])
    stances = ground.stances
    measured = 100 * stances.heights
    shown = np.concatenate([heights.ravel(), measured[stances.used]])
    least, most = shown.min(), max(shown.max(), shown.min() + 1.0)
    colours = {"vmin": least, "vmax": most, "cmap": "viridis"}
    image = axes.pcolormesh(x, z, heights, shading="nearest", rasterized=True, **colours)
    axes.figure.colorbar(image, ax=axes, label="height, cm", shrink=0.8)
    axes.grid(False)
    if isinstance(ground.surface, LevelBlocks):
        _draw_blocks(axes, ground.surface, points)
    for leg, mark in zip(range(len(legs)), _marks(len(legs)), strict=True):
        here = (stances.leg == leg) & stances.used
        axes.scatter(
            *stances.points[here].T, c=measured[here], marker=mark, s=70, edgecolors="white",
            linewidths=1.4, **colours,
        )  # fmt: skip
    axes.plot(*stances.points[~stances.used].T, "x", color="white", markersize=7)
    axes.set_aspect("equal")
    axes.set_xlim(high[0], low[0])  # seen from above, x goes to the left where z goes up
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    axes.set_title(f"{ground.chosen.capitalize()} from above, and what each stance measured")


def _draw_blocks(axes: Axes, found: LevelBlocks, points: np.ndarray) -> None:
    """Edges of blocks, and hatches over those that nobody stepped on."""
    cells = found.grid.cells(points.reshape(-1, 2))
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    lines = [[(i, low[1]), (i, high[1])] for i in range(low[0], high[0] + 1)]
    lines += [[(low[0], j), (high[0], j)] for j in range(low[1], high[1] + 1)]
    edges = found.grid.places(np.array(lines, np.float64))
    axes.add_collection(LineCollection(list(edges), colors=GROUND, linewidths=1.0))
    visited = found.shared(points.reshape(-1, 2)).reshape(points.shape[:2])
    axes.contourf(
        points[0, :, 0], points[:, 0, 1], ~visited, levels=[0.5, 1.5], colors="none", hatches=["//"]
    )


def _draw_errors(axes: Axes, tested: Mapping[str, Prediction]) -> None:
    """The error at every stance, in the order of time."""
    for kind, one in tested.items():
        number = np.arange(1, len(one.errors) + 1)
        axes.plot(number, 100 * one.errors, color=COLOURS[kind], linewidth=1.0, alpha=0.5)
        axes.plot(number, 100 * one.errors, "o", color=COLOURS[kind], markersize=4)
        axes.plot(
            number[one.alone], 100 * one.errors[one.alone], "o", color=COLOURS[kind], markersize=9,
            fillstyle="none",
        )  # fmt: skip
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("stance, in the order of time")
    axes.set_ylabel("error, cm")
    axes.set_title("Predicted from the other stances (ringed: none of them on its block)")


def _draw_shares(axes: Axes, tested: Mapping[str, Prediction]) -> None:
    """How many stances are predicted within an error."""
    largest = max(np.abs(one.errors).max() for one in tested.values())
    for kind, one in tested.items():
        size = np.sort(np.abs(one.errors))
        share = np.arange(len(size) + 1) / len(size)
        across = 100 * np.concatenate([[0.0], size, [1.05 * largest]])
        axes.step(across, 100 * np.append(share, 1.0), where="post", color=COLOURS[kind])
    axes.set_xlim(0.0, 105 * largest)
    axes.set_ylim(0.0, 102.0)
    axes.set_xlabel("size of the error, cm")
    axes.set_ylabel("stances within it, %")
    told = ", ".join(f"{kind} {100 * one.rms:.1f}" for kind, one in tested.items())
    axes.set_title(f"Stances within an error (rms: {told} cm)")


def _marks(count: int) -> str:
    return (LEGS * count)[:count]
