"""What all figures share: colours, fonts, ground, time axes, and saving to a file."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from fitting.runtime import beside, files

# The palette of Okabe and Ito, which colour-blind readers can distinguish.
BEFORE, AFTER, CAPTURED = "#8c8c8c", "#0072B2", "#D55E00"
STANDING, LOCKED, SLIDING = "#56B4E9", "#009E73", "#CC79A7"
PRIOR = "#009E73"
STAGES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9")
GROUND, EARTH = "#5f5236", "#ece5d6"
WIDTH = 17.0  # inches, of most figures
SPAN = 5.0  # s, length of the section that is also shown enlarged
LONG = 8.0  # s; shorter clips are not enlarged
STYLE: Any = {
    "font.size": 13,
    "axes.titlesize": 14,
    "axes.labelsize": 13,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "figure.titlesize": 18,
    "legend.frameon": False,
    "legend.fontsize": 13,
    "lines.linewidth": 1.6,
    "savefig.dpi": 100,
    "figure.constrained_layout.w_pad": 0.15,  # inches around everything
    "figure.constrained_layout.h_pad": 0.1,
}
styled = matplotlib.rc_context(STYLE)


def panels(
    count: int, columns: int, title: str, height: float, margin: float, **options: Any
) -> tuple[Figure, list[Axes]]:
    """A figure with a title and panels, row by row.

    Args:
        count: of the panels.
        columns: of them in a row.
        title: of the figure.
        height: of a row, inches.
        margin: inches for title and legend.
        options: of `Figure.subplots`; and `width`, inches.
    """
    rows, width = -(-count // columns), options.pop("width", WIDTH)
    figure = Figure(figsize=(width, height * rows + margin), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(rows, columns, squeeze=False, **options).ravel().tolist()
    for unused in axes[count:]:
        unused.set_axis_off()
    return figure, axes[:count]


def steepest_part(time: np.ndarray, pelvis: np.ndarray) -> tuple[int, int]:
    """First and last frame of the section in which the pelvis rises and falls most.

    Args:
        time: of each frame, s.
        pelvis: its height, m.
    """
    if time[-1] <= LONG:
        return 0, len(time) - 1
    frames = int(np.searchsorted(time, SPAN))
    steps = np.abs(np.diff(pelvis))
    sums = np.concatenate([[0.0], np.cumsum(steps)])
    start = int(np.argmax(sums[frames:] - sums[:-frames]))
    return start, start + frames


def sections(time: np.ndarray, pelvis: np.ndarray) -> list[tuple[int, int]]:
    """First and last frames of the sections shown: the whole clip and, of a long one, a part."""
    whole = 0, len(time) - 1
    return list(dict.fromkeys([whole, steepest_part(time, pelvis)]))


def whole_and_part(
    figure: FigureBase, time: np.ndarray, pelvis: np.ndarray, rows: int
) -> list[list[Axes]]:
    """Axes in a column for the whole clip and, for a long clip, in another for a part of it.

    Args:
        figure: to draw into.
        time: of each frame, s.
        pelvis: its height, m, which decides the part.
        rows: number of axes in a column.
    """
    parts = sections(time, pelvis)
    ratios = [1.6, 1.0][: len(parts)]
    grid = figure.subplots(rows, len(parts), squeeze=False, sharey="row", width_ratios=ratios)
    for column, (start, end) in zip(grid.T, parts, strict=True):
        for axes in column:
            axes.set_xlim(time[start], time[end])
        enlarged = "" if (start, end) == parts[0] else ", enlarged"
        column[-1].set_xlabel(f"time, s{enlarged}")
    return [list(column) for column in grid.T]


def earth(axes: Axes, across: np.ndarray, height: np.ndarray) -> None:
    """Ground as a filled area with an edge, down to the current lower limit of the axes."""
    axes.plot(across, height, color=GROUND, linewidth=1.4)
    low, high = axes.get_ylim()
    axes.fill_between(across, height, low, where=np.isfinite(height), color=EARTH, linewidth=0)
    axes.set_ylim(low, high)


def shade(axes: Axes, time: np.ndarray, mask: np.ndarray, color: str, alpha: float = 1.0) -> None:
    """Colours the whole height of the axes over the frames of a mask; the time of each is in s."""
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    edges = np.flatnonzero(np.diff(mask.astype(int), prepend=0, append=0))
    for start, end in edges.reshape(-1, 2):
        ends = float(time[start]) - half, float(time[end - 1]) + half
        axes.axvspan(*ends, color=color, alpha=alpha, linewidth=0, zorder=0)


def name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Names the rows of the axes, which are at 0, 1, ... from the top."""
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0)


def write_beside(axes: Axes, text: str, end: float, row: float, points: float) -> None:
    """Writes a text some points to the right of the end of a bar."""
    axes.annotate(text, (end, row), xytext=(points, 0), textcoords="offset points", va="center")


def legend(figure: Figure, *entries: Artist, columns: int = 4) -> None:
    """Adds a legend below the figure."""
    figure.legend(handles=entries, loc="outside lower center", ncols=min(columns, len(entries)))


def line_key(label: str, color: str = "black", **properties: Any) -> Line2D:
    """An entry of a legend for a line or, without a `linestyle`, for a `marker`."""
    return Line2D([], [], color=color, label=label, **properties)


def area_key(label: str, color: str, **properties: Any) -> Patch:
    """An entry of a legend for an area."""
    return Patch(label=label, **{"facecolor": color, "edgecolor": color, **properties})


def ground_key(label: str = "ground") -> Patch:
    """An entry of a legend for what `earth` draws."""
    return area_key(label, EARTH, edgecolor=GROUND)


def prepare_saving() -> None:
    """Starts the processes in which `save` writes figures, if it is about to be called."""
    beside.prepare(_import_drawing)


def _import_drawing() -> None:
    """Imports all that writing a figure takes."""
    Figure().savefig(io.BytesIO())


def save(path: Path, figure: Figure) -> None:
    """Writes a figure, which is not changed any more; never leaves half a file.

    Within `calls_beside`, another process does.
    """
    beside.call(_write, path, figure)


def _write(path: Path, figure: Figure) -> None:
    def fill(temporary: Path) -> None:
        try:
            figure.savefig(temporary, facecolor="white")
        except ValueError:  # a name of the user's, such as "$x^$", is not mathematics
            for text in figure.findobj(Text):
                text.set_parse_math(False)  # pyright: ignore[reportAttributeAccessIssue]
            figure.savefig(temporary, facecolor="white")

    files.write(path, fill)
