"""Pictures of a posterior: the corner plot and the chain."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from fitting.inference.sample.posterior import Posterior
from fitting.problem.space import Space, prior_probability
from fitting.report.style import AFTER, BEFORE, CAPTURED, PRIOR, line_key, styled

SAMPLES = 20_000  # at most, in the corner
WALKERS = 40  # at most, in the picture of the chain
POINTS = 1500  # at most, of each walker
BINS = 30  # of a histogram
SMOOTHING = 0.8  # bins, of the density of a pair
HELD = (0.86, 0.39)  # by contours: two and one standard deviations of a normal in two dimensions
MARGIN = 0.05  # fraction of a panel's width


@styled
def corner(
    posterior: Posterior,
    labels: Sequence[str],
    fitted: Mapping[str, float],
    truth: Mapping[str, float] | None,
    title: str,
    space: Space | None = None,
) -> Figure:
    """Every parameter and every pair of them: samples, best fit, and truth if known.

    With a space, its prior stands over the posterior of each parameter.
    """
    size = len(posterior.names)
    samples = posterior.draws.reshape(-1, size)
    samples = samples[:: max(1, len(samples) // SAMPLES)]
    marks = [[values.get(name) for name in posterior.names] for values in (fitted, truth or {})]
    ranges = [_range(samples[:, i], [values[i] for values in marks]) for i in range(size)]
    inches = 1.2 + max(size, 3) * (2.2 if size <= 6 else 1.75)
    font_size = 15 if size <= 6 else 11
    figure = Figure(figsize=(inches, inches), dpi=100, layout="constrained")
    panels = figure.subplots(size, size, sharex="col", squeeze=False)
    for (row, column), axes in np.ndenumerate(panels):
        axes.grid(False)
        axes.tick_params(labelsize=font_size - 2, labelrotation=45, labelleft=column == 0)
        if column > row:
            axes.set_axis_off()
        elif column < row:
            pair = [column, row]
            _draw_pair(axes, samples[:, pair], [ranges[i] for i in pair])
            axes.locator_params(nbins=3)
        else:
            _draw_histogram(axes, samples[:, row], ranges[row])
    for i, label in enumerate(labels):
        label = label.replace(".", ".\n", 1)
        panels[-1, i].set_xlabel(label, fontsize=font_size)
        if i:
            panels[i, 0].set_ylabel(label, fontsize=font_size)
    figure.align_labels()
    for values, colour, dashes in zip(marks, (BEFORE, CAPTURED), ("--", "-"), strict=True):
        _draw_values(panels, values, color=colour, linestyle=dashes, linewidth=1.8)
    if space is not None:
        edges = np.stack([np.linspace(*ends, BINS + 1) for ends in ranges], axis=1)
        expected = len(samples) * np.diff(prior_probability(space, edges), axis=0)
        for i, axes in enumerate(panels.diagonal()):
            axes.stairs(expected[:, i], edges[:, i], color=PRIOR, linewidth=1.8)
            axes.set_ylim(0, max(axes.get_ylim()[1], 1.1 * expected[:, i].max()))
    entries = [
        line_key("posterior: contours hold 39 % and 86 %", AFTER, linewidth=4),
        line_key("ends of the 95 % interval", AFTER, linestyle="--"),
        line_key("best fit", BEFORE, linestyle="--", linewidth=1.8),
    ]
    if space is not None:
        entries.append(line_key("prior", PRIOR, linewidth=1.8))
    if truth:
        entries.append(line_key("truth", CAPTURED, linewidth=1.8))
    legend_size = np.clip(1.1 * inches, 12, 24)
    figure.suptitle(title, fontsize=1.3 * legend_size, x=0.98, ha="right")
    figure.legend(
        handles=entries, loc="upper right", bbox_to_anchor=(0.98, 0.94), fontsize=legend_size
    )
    return figure


def _draw_histogram(axes: Axes, values: np.ndarray, ends: tuple[float, float]) -> None:
    """The samples of a parameter, and the ends of their 95 % interval."""
    counts, *_ = axes.hist(values, bins=BINS, range=ends, histtype="step", color=AFTER)
    for end in np.quantile(values, (0.025, 0.975)):
        axes.axvline(end, color=AFTER, linestyle="--")
    axes.set_xlim(ends)
    axes.set_ylim(0, 1.1 * np.max(counts))
    axes.set_yticks([])
    axes.locator_params("x", nbins=3)


def _draw_pair(axes: Axes, pairs: np.ndarray, ends: Sequence[tuple[float, float]]) -> None:
    """Contours around the densest samples of two parameters, (samples, 2)."""
    counts, _ = np.histogramdd(pairs, BINS, ends)
    density = gaussian_filter(counts, SMOOTHING)
    order = np.argsort(density, axis=None)[::-1]
    held = np.cumsum(counts.ravel()[order]) / np.sum(counts)
    heights = np.unique(density.ravel()[order[np.searchsorted(held, HELD)]])
    x, y = (low + (high - low) / BINS * (np.arange(-1, BINS + 1) + 0.5) for low, high in ends)
    padded = np.pad(density, 1, "edge").T  # to the border of the panel
    colours = [(AFTER, 1 / 3), (AFTER, 1.0)][-len(heights) :]
    axes.contourf(x, y, padded, [*heights, 2 * density.max()], colors=colours)
    axes.contour(x, y, padded, heights, colors=AFTER)
    axes.set(xlim=ends[0], ylim=ends[1])


def _draw_values(panels: np.ndarray, values: Sequence[float | None], **style: Any) -> None:
    """Lines at known values."""
    for i, value in enumerate(values):
        if value is not None:
            for axes in panels[i:, i]:
                axes.axvline(value, **style)
            for axes in panels[i, :i]:
                axes.axhline(value, **style)


@styled
def chain(
    posterior: Posterior, labels: Sequence[str], truth: Mapping[str, float] | None, title: str
) -> Figure:
    """Log-probability and parameters of the walkers over the sampler's steps."""
    panels: list[tuple[str, np.ndarray, float | None]]
    panels = [("log-probability", posterior.log_probability, None)]
    for i, name in enumerate(posterior.names):
        panels.append((labels[i], posterior.values[..., i], (truth or {}).get(name)))
    columns = 2 if len(panels) > 4 else 1
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(17, 2.2 * rows + 1.8), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    every = max(1, len(posterior.u) // POINTS)
    steps = posterior.thin_by * (1 + np.arange(len(posterior.u)))
    drawn = np.unique(np.linspace(0, posterior.u.shape[1] - 1, WALKERS).astype(int))
    for axes, (label, series, true) in zip(grid.T.flat, panels, strict=False):
        colour = {"color": AFTER, "linewidth": 0.5, "alpha": 0.35}
        axes.plot(steps[::every], series[::every][:, drawn], **colour)
        for stuck in posterior.stuck:
            axes.plot(steps[::every], series[::every, stuck], color="black", linewidth=1.2)
        axes.axvspan(0, posterior.burn_in * posterior.thin_by, color="#dddddd")
        if true is not None:
            axes.axhline(true, color=CAPTURED, linewidth=2.0)
        axes.set_title(label)
        axes.set_xlim(0, steps[-1])
        axes.tick_params(labelbottom=True)
    low, high = np.quantile(posterior.log_probability[posterior.burn_in :], [0.001, 1.0])
    grid[0, 0].set_ylim(low - 0.3 * (high - low) - 1.0, high + 0.1 * (high - low) + 1.0)
    for axes in list(grid.T.flat)[len(panels) :]:
        axes.set_axis_off()
    for lowest in {*range(rows - 1, len(panels), rows), len(panels) - 1}:
        grid.T.flat[lowest].set_xlabel("step of the sampler")
    entries = [
        line_key(f"walkers ({len(drawn)} of {posterior.u.shape[1]} shown)", AFTER),
        line_key("burn-in, discarded", "#dddddd", linewidth=8),
    ]
    if truth:
        entries.append(line_key("truth", CAPTURED, linewidth=2.0))
    if posterior.stuck:
        entries.append(line_key("stuck walkers"))
    figure.legend(handles=entries, loc="outside lower center", ncols=4)
    return figure


def _range(samples: np.ndarray, marks: Sequence[float | None]) -> tuple[float, float]:
    """Ends of a panel: nearly all samples, the marks and a margin; never of zero width."""
    low, high = np.quantile(samples, [0.001, 0.999])
    low, high = (
        min([low, *(m for m in marks if m is not None)]),
        max([high, *(m for m in marks if m is not None)]),
    )
    width = max(high - low, 1e-6 * max(abs(high), 1.0))
    return float(low - MARGIN * width), float(high + MARGIN * width)
