"""The suite on one page: a row for each situation, a column for each system, seen from the side."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.analysis.placement import VISIBLE
from fitting.datasets import ground_path
from fitting.report.suite.suite_tables import MEASURES, MISS
from fitting.studies.suite.suite import Outcome, Scene, Suite

from .style import BEFORE, EARTH, GROUND, STAGES, earth, legend, styled

RED = "#CC0000"
OFF = f"sole off its ground by {100 * VISIBLE:.0f} cm"
SOLES = STAGES[0], STAGES[1]
NARROWEST = 1.5  # m along the path
PANEL = 2.6, 1.45  # inches
ENTRY = 2.3, 0.32  # inches, an entry of the legend
ENTRIES = 6
MARGIN = 0.3  # m, around what is shown
JUMP = 1.0  # m in a frame, from which a line is interrupted
HEAD = 0.5, 1.45  # place of a column's heading, in heights of a panel
SAMPLES = 600  # of the ground


@styled
def page(suite: Suite) -> Figure:
    """Ground, soles, ankles and pelvis of every system in every situation."""
    rows, columns = len(suite.scenes), len(suite.systems)
    width = PANEL[0] * columns + 1.0
    across = max(1, min(ENTRIES, int(width / ENTRY[0])))  # entries of the legend side by side
    height = PANEL[1] * rows + 1.0 + ENTRY[1] * -(-ENTRIES // across)
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex="row", sharey="row")
    for scene, row in zip(suite.scenes, panels, strict=True):
        row[0].set_ylim(_heights(scene))
        for system, axes in zip(suite.systems, row, strict=True):
            _panel(axes, scene, scene.outcomes.get(system))
        row[0].set_ylabel(f"{scene.situation.name}\nheight, m", fontsize=10)
    for system, axes in zip(suite.systems, panels[0], strict=True):
        axes.annotate(system, HEAD, xycoords="axes fraction", ha="center", fontsize=15)
    panels[-1, 0].set_xlabel("along the path, m", fontsize=9)
    legend(
        figure,
        Patch(facecolor=EARTH, edgecolor=GROUND, label="ground below the path"),
        Line2D([], [], color=SOLES[0], label="left sole"),
        Line2D([], [], color=SOLES[1], label="right sole"),
        Line2D([], [], color=BEFORE, label="ankles"),
        Line2D([], [], color="black", label="pelvis"),
        Line2D([], [], color=RED, marker=".", linestyle="", label=OFF),
        columns=across,
    )  # fmt: skip
    return figure


def _panel(axes: Axes, scene: Scene, outcome: Outcome | None) -> None:
    axes.tick_params(labelsize=8)
    if outcome is None:
        _title(axes, ["no motion"])
        return
    clip, soles = outcome.clip, outcome.soles
    pelvis, balls = clip.positions_ws[:, clip.rig.pelvis], clip.joints_ws(3)
    _line(axes, pelvis, color="black", linewidth=1.2)
    for leg, ankle in enumerate(np.moveaxis(clip.joints_ws(2), 1, 0)):
        _line(axes, ankle, color=BEFORE, linewidth=0.6)
        sole = balls[:, leg].copy()
        sole[:, 1] = soles.height[:, leg, 1] + soles.ground[:, leg, 1]
        _line(axes, sole, color=SOLES[leg % len(SOLES)], linewidth=1.0)
        gap = soles.gap[:, leg]
        off = (gap < -VISIBLE) | (soles.stance[:, leg] & (gap > VISIBLE))
        axes.plot(sole[off, 2], sole[off, 1], ".", color=RED, markersize=3)
    middle = (balls[..., 2].min() + balls[..., 2].max()) / 2
    reach = max(NARROWEST / 2, np.ptp(balls[..., 2]) / 2 + MARGIN)
    points = np.zeros((SAMPLES, 3))
    points[:, 2] = middle + np.linspace(-reach, reach, SAMPLES)
    axes.set_xlim(points[0, 2], points[-1, 2])
    ground = ground_path.heights_under(scene.animation.terrain, points, ground_path.SKY)
    earth(axes, points[:, 2], ground)
    missed = [key for key, cell in outcome.cells.items() if not cell.is_within]
    _title(
        axes,
        [
            f"{MEASURES[key].heading} {MEASURES[key].format(outcome.cells[key].value)}{MISS}"
            for key in missed
        ],
    )


def _line(axes: Axes, points: np.ndarray, **look: Any) -> None:
    """A path from the side, interrupted where it jumps."""
    jumps = np.linalg.norm(np.diff(points, axis=0), axis=1) > JUMP
    broken = np.insert(points, np.flatnonzero(jumps) + 1, np.nan, axis=0)
    axes.plot(broken[:, 2], broken[:, 1], **look)


def _heights(scene: Scene) -> tuple[float, float]:
    """The range of heights of a row, m."""
    clips = [outcome.clip for outcome in scene.outcomes.values()] or [scene.animation.placed_clip]
    highest = max(float(clip.positions_ws[:, clip.rig.pelvis, 1].max()) for clip in clips)
    lowest = min(float(clip.joints_ws(3)[..., 1].min()) for clip in clips)
    return lowest - MARGIN, highest + MARGIN / 2


def _title(axes: Axes, missed: list[str]) -> None:
    """Says what misses its bound, in red, with a red frame."""
    middle = (len(missed) + 1) // 2
    lines = [part for part in (missed[:middle], missed[middle:]) if part]
    axes.set_title("\n".join(", ".join(line) for line in lines), fontsize=7, color=RED)
    for spine in axes.spines.values() if missed else ():
        spine.set(visible=True, color=RED)
