"""The picture of a terrain that was reconstructed from motion."""

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
def plan(terrain: Reconstruction, margin: float, legs: tuple[str, ...], title: str) -> Figure:
    """The chosen surface from above with its stances, and how well each kind predicts them.

    Args:
        terrain: what was reconstructed.
        margin: shown around the stances, m.
        legs: their names.
        title: of the figure.
    """
    figure = Figure(figsize=(17, 9.5), layout="constrained")
    figure.suptitle(title)
    ((left, right),) = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.15, 1.0])
    _draw_plan(left.subplots(), terrain, margin, legs)
    (upper,), (lower,) = right.subplots(2, 1, squeeze=False)
    _draw_errors(upper, terrain.predictions)
    _draw_fractions(lower, terrain.predictions)
    marks = [
        Line2D([], [], color="black", marker=mark, linestyle="", markerfacecolor="white", label=leg)
        for leg, mark in zip(legs, _marks(len(legs)), strict=True)
    ]
    entries: list[Artist] = [*marks]
    if not terrain.stances.used.all():
        entries.append(Line2D([], [], color="black", marker="x", linestyle="", label="not used"))
    if isinstance(terrain.surface, LevelBlocks):
        entries.append(Patch(facecolor="white", edgecolor=BEFORE, hatch="///", label="not visited"))
    entries += [
        Line2D([], [], color=COLOURS[kind], linewidth=3, label=f"predicted by {kind}")
        for kind in SURFACE_KINDS
    ]
    legend(figure, *entries, columns=7)
    return figure


def _draw_plan(axes: Axes, terrain: Reconstruction, margin: float, legs: tuple[str, ...]) -> None:
    """Heights as colours, edges of blocks, and stances coloured by their measured height."""
    low, high = terrain.extent(margin)
    count = np.ceil(PIXELS * (high - low) / np.max(high - low)).astype(int)
    x, z = (np.linspace(*part) for part in zip(low, high, count, strict=True))
    points = np.stack(np.meshgrid(x, z), axis=-1)
    heights = 100 * terrain.surface.heights(points.reshape(-1, 2)).reshape(points.shape[:2])
    stances = terrain.stances
    measured = 100 * stances.heights
    shown = np.concatenate([heights.ravel(), measured[stances.used]])
    lowest, highest = shown.min(), max(shown.max(), shown.min() + 1.0)
    colours = {"vmin": lowest, "vmax": highest, "cmap": "viridis"}
    image = axes.pcolormesh(x, z, heights, shading="nearest", rasterized=True, **colours)
    axes.figure.colorbar(image, ax=axes, label="height, cm", shrink=0.8)
    axes.grid(False)
    if isinstance(terrain.surface, LevelBlocks):
        _draw_blocks(axes, terrain.surface, points)
    for leg, mark in zip(range(len(legs)), _marks(len(legs)), strict=True):
        of_leg = (stances.leg == leg) & stances.used
        axes.scatter(
            *stances.points[of_leg].T, c=measured[of_leg], marker=mark, s=70, edgecolors="white",
            linewidths=1.4, **colours,
        )  # fmt: skip
    axes.plot(*stances.points[~stances.used].T, "x", color="white", markersize=7)
    axes.set_aspect("equal")
    axes.set_xlim(high[0], low[0])  # seen from above with z up, x points left
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    axes.set_title(
        f"{terrain.chosen.capitalize()} from above, with the\nheight measured at each stance"
    )


def _draw_blocks(axes: Axes, blocks: LevelBlocks, points: np.ndarray) -> None:
    """Edges of blocks, and hatching over those that nobody stepped on."""
    cells = blocks.grid.cells(points.reshape(-1, 2))
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    lines = [[(i, low[1]), (i, high[1])] for i in range(low[0], high[0] + 1)]
    lines += [[(low[0], j), (high[0], j)] for j in range(low[1], high[1] + 1)]
    edges = blocks.grid.points(np.array(lines, np.float64))
    axes.add_collection(LineCollection(list(edges), colors=GROUND, linewidths=1.0))
    visited = blocks.supported(points.reshape(-1, 2)).reshape(points.shape[:2])
    axes.contourf(
        points[0, :, 0], points[:, 0, 1], ~visited, levels=[0.5, 1.5], colors="none", hatches=["//"]
    )


def _draw_errors(axes: Axes, predictions: Mapping[str, Prediction]) -> None:
    """The error of every stance, in order of time."""
    for kind, prediction in predictions.items():
        number, errors = np.arange(1, len(prediction.errors) + 1), 100 * prediction.errors
        colour, alone = COLOURS[kind], prediction.alone
        axes.plot(number, errors, color=colour, linewidth=1.0, alpha=0.5)
        axes.plot(number, errors, "o", color=colour, markersize=4)
        ring = {"color": colour, "markersize": 9, "fillstyle": "none"}
        axes.plot(number[alone], errors[alone], "o", **ring)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("stance, in order of time")
    axes.set_ylabel("error, cm")
    axes.set_title("Predicted from the other stances (ringed: no other stance on its block)")


def _draw_fractions(axes: Axes, predictions: Mapping[str, Prediction]) -> None:
    """Fraction of the stances that are predicted within an error."""
    largest = max(np.abs(prediction.errors).max() for prediction in predictions.values())
    for kind, prediction in predictions.items():
        size = np.sort(np.abs(prediction.errors))
        fraction = np.arange(len(size) + 1) / len(size)
        across = 100 * np.concatenate([[0.0], size, [1.05 * largest]])
        axes.step(across, 100 * np.append(fraction, 1.0), where="post", color=COLOURS[kind])
    axes.set_xlim(0.0, 105 * largest)
    axes.set_ylim(0.0, 102.0)
    axes.set_xlabel("size of the error, cm")
    axes.set_ylabel("stances within this error, %")
    rms = ", ".join(
        f"{kind} {100 * prediction.rms:.1f}" for kind, prediction in predictions.items()
    )
    axes.set_title(f"Stances within an error (rms: {rms} cm)")


def _marks(count: int) -> str:
    return (LEGS * count)[:count]
