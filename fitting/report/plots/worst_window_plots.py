"""The picture of the two seconds in which the fit is worst."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.analysis.playback import Motion, Playback
from fitting.analysis.worst_window import WorstWindow

from .style import AFTER, CAPTURED, EARTH, GROUND, STANDING, earth, legend, styled

STANCE_ALPHA = 0.22
UNSEEN = "#dddddd"


@styled
def worst_window(
    playback: Playback, legs: Sequence[str], window: WorstWindow, title: str
) -> Figure:
    """Heights of feet and pelvis, and knee angles, captured and fitted, in the worst window."""
    inside = slice(window.start, window.end + 1)
    time = playback.time[inside]
    rows = 2 * len(legs) + 1
    figure = Figure(figsize=(17, 3.1 * rows + 1.6), layout="constrained")
    figure.suptitle(title)
    panels = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
    ground = 100 * playback.ground_height()[inside]

    def draw(axes: Axes, series: Callable[[Motion], np.ndarray]) -> None:
        for colour, motion in ((CAPTURED, playback.captured), (AFTER, playback.after)):
            axes.plot(time, series(motion)[inside], color=colour, linewidth=2.2)

    for leg, name in enumerate(legs):
        foot, knee = panels[leg], panels[len(legs) + 1 + leg]
        draw(foot, lambda motion, leg=leg: 100 * playback.height(motion.ankle[:, leg]))
        earth(foot, time, ground[:, leg])
        foot.set_title(f"{name.capitalize()} ankle, with the ground under it ({playback.label})")
        draw(knee, lambda motion, leg=leg: np.degrees(motion.knee_angle[:, leg]))
        knee.set_title(f"{name.capitalize()} knee (180° is straight)")
        knee.set_ylabel("knee angle, degrees")
        for axes in (foot, knee):
            stance = np.asarray(playback.stance)[inside, leg] > 0.5
            _shade(axes, time, stance, color=STANDING, alpha=STANCE_ALPHA)
    pelvis = panels[len(legs)]
    draw(pelvis, lambda motion: 100 * playback.height(motion.pelvis))
    pelvis.set_title("Pelvis")
    for axes in panels[: len(legs) + 1]:
        axes.set_ylabel("height, cm")
    for axes in panels:
        _shade(axes, time, ~np.asarray(playback.seen)[inside], color=UNSEEN)
        axes.axvline(playback.time[window.frame], color="black", linestyle=":", linewidth=1.6)
    panels[-1].set_xlabel("time, s")
    panels[-1].set_xlim(time[0], time[-1])
    entries = [
        Line2D([], [], color=CAPTURED, linewidth=3, label=playback.label),
        Line2D([], [], color=AFTER, linewidth=3, label="after fitted foot IK"),
        Patch(facecolor=EARTH, edgecolor=GROUND, label="ground"),
        Patch(color=STANDING, alpha=STANCE_ALPHA, label="captured stance"),
        Line2D([], [], color="black", linestyle=":", label="largest error"),
    ]
    if not np.all(np.asarray(playback.seen)[inside]):
        entries.append(Patch(color=UNSEEN, label="left out of the fit"))
    legend(figure, *entries, columns=6)
    return figure


def _shade(
    axes: Axes, time: np.ndarray, mask: np.ndarray, *, color: str, alpha: float = 1.0
) -> None:
    """Colours the whole height of the axes where the mask is true."""
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    edges = np.flatnonzero(np.diff(mask.astype(int), prepend=0, append=0))
    for start, end in edges.reshape(-1, 2):
        axes.axvspan(
            float(time[start]) - half, float(time[end - 1]) + half,
            color=color, alpha=alpha, linewidth=0, zorder=0,
        )  # fmt: skip
