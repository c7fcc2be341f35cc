"""The picture of the residuals as noise: their autocorrelation and their tails."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fitting.analysis.goodness import groups
from fitting.analysis.goodness.noise import autocorrelations, scale_by_median
from fitting.analysis.playback import Playback
from fitting.problem.scene import MEASURED
from fitting.report.labels import RESIDUALS

from .style import AFTER, BEFORE, legend, styled

SECONDS = 1.0  # of lag, that are shown
WIDEST = 8.0  # standard deviations; what is beyond is shown there


@styled
def noise(playback: Playback, title: str) -> Figure:
    """Autocorrelation and distribution of the residuals of each measured kind."""
    kinds = [kind for kind in playback.fitted_kinds if kind in MEASURED]
    figure = Figure(figsize=(17, 2.6 * len(kinds) + 1.8), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(max(len(kinds), 1), 2, squeeze=False, width_ratios=[1.6, 1])
    for (left, right), kind in zip(grid, kinds, strict=False):
        _, residuals, active = groups.series(playback, kind)
        _draw_autocorrelation(left, residuals, active, float(np.median(playback.dt)))
        left.set_title(f"{RESIDUALS[kind].name}: correlation with later residuals")
        _draw_tails(right, residuals, active)
        right.set_title(f"{RESIDUALS[kind].name}: distribution")
    grid[-1, 0].set_xlabel("seconds later")
    grid[-1, 1].set_xlabel("residual, in standard deviations (from the median)")
    legend(
        figure,
        Line2D([], [], color=AFTER, linewidth=3, label="residuals of the fit"),
        Line2D([], [], color=BEFORE, linewidth=3, label="left: 95 % of white noise"),
        Line2D([], [], color="black", linestyle="--", label="right: normal distribution"),
    )
    return figure


def _draw_autocorrelation(axes: Axes, residuals: np.ndarray, active: np.ndarray, dt: float) -> None:
    r, pairs = autocorrelations(residuals, active)
    shown = min(len(r), max(round(SECONDS / dt), 1))
    lags = dt * np.arange(1, shown + 1)
    band = 1.96 / np.sqrt(np.maximum(pairs[:shown], 1))
    axes.fill_between(lags, -band, band, color=BEFORE, alpha=0.4, linewidth=0)
    axes.vlines(lags, 0, r[:shown], color=AFTER, linewidth=3)
    axes.set_xlim(0, lags[-1] + dt)
    low = min(-0.2, float(np.min(r[:shown], initial=0.0)) - 0.05)
    axes.set_ylim(low, 1.0)


def _draw_tails(axes: Axes, residuals: np.ndarray, active: np.ndarray) -> None:
    """A histogram over a logarithmic axis, which shows outliers."""
    edges = np.linspace(-WIDEST, WIDEST, 65)
    scale = scale_by_median(residuals, active)
    if scale > 0:
        values = np.clip(residuals[active] / scale, -WIDEST + 1e-9, WIDEST - 1e-9)
        density = np.histogram(values, edges, density=True)[0]
        axes.stairs(density, edges, fill=True, color=AFTER, alpha=0.6)
    curve = np.linspace(-WIDEST, WIDEST, 321)
    axes.plot(curve, np.exp(-(curve**2) / 2) / np.sqrt(2 * np.pi), "--", color="black")
    axes.set_yscale("log")
    axes.minorticks_off()  # drawing them takes a quarter of the time of the picture
    axes.set_ylim(1e-5, 1.0)
    axes.set_ylabel("density")
