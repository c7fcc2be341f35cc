"""Pictures of a posterior: the corner plot and the chain."""

from collections.abc import Mapping, Sequence
from typing import Any

import corner as corner_library
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fitting.inference.sample.posterior import Posterior
from fitting.problem.space import Space, prior_probability
from fitting.report.style import AFTER, BEFORE, CAPTURED, PRIOR, styled

SAMPLES = 20_000  # at most, in the corner
WALKERS = 40  # at most, in the picture of the chain
POINTS = 1500  # at most, of each walker
BINS = 30  # of a histogram
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
    samples = posterior.kept.reshape(-1, size)
    samples = samples[:: max(1, len(samples) // SAMPLES)]
    marks = [[values.get(name) for name in posterior.names] for values in (fitted, truth or {})]
    ranges = [_range(samples[:, i], [values[i] for values in marks]) for i in range(size)]
    inches = 1.2 + max(size, 3) * (2.2 if size <= 6 else 1.75)
    font_size = 15 if size <= 6 else 11
    figure = Figure(figsize=(inches, inches), dpi=100)
    corner_library.corner(
        samples,
        fig=figure,
        bins=BINS,
        range=ranges,
        labels=[label.replace(".", ".\n", 1) for label in labels],
        label_kwargs={"fontsize": font_size},
        labelpad=0.12 if size <= 6 else 0.25,
        quantiles=[0.025, 0.975],
        color=AFTER,
        plot_datapoints=False,
        fill_contours=True,
        smooth=0.8,
        levels=(0.39, 0.86),  # one and two standard deviations of a normal in two dimensions
        max_n_ticks=3,
    )
    for axes in figure.axes:
        axes.grid(False)
        axes.tick_params(labelsize=font_size - 2)
    for values, colour, dashes in zip(marks, (BEFORE, CAPTURED), ("--", "-"), strict=True):
        _draw_values(figure, values, color=colour, linestyle=dashes, linewidth=1.8)
    if space is not None:
        edges = np.stack([np.linspace(*ends, BINS + 1) for ends in ranges], axis=1)
        expected = len(samples) * np.diff(prior_probability(space, edges), axis=0)
        for i, axes in enumerate(figure.axes[:: size + 1]):  # the diagonal
            axes.stairs(expected[:, i], edges[:, i], color=PRIOR, linewidth=1.8)
            axes.set_ylim(0, max(axes.get_ylim()[1], 1.1 * expected[:, i].max()))
    entries = [
        Line2D([], [], color=AFTER, linewidth=4, label="posterior: contours hold 39 % and 86 %"),
        Line2D([], [], color=AFTER, linestyle="--", label="ends of the 95 % interval"),
        Line2D([], [], color=BEFORE, linestyle="--", linewidth=1.8, label="best fit"),
    ]
    if space is not None:
        entries.append(Line2D([], [], color=PRIOR, linewidth=1.8, label="prior"))
    if truth:
        entries.append(Line2D([], [], color=CAPTURED, linewidth=1.8, label="truth"))
    legend_size = np.clip(1.1 * inches, 12, 24)
    figure.suptitle(title, fontsize=1.3 * legend_size, x=0.98, ha="right")
    figure.legend(
        handles=entries, loc="upper right", bbox_to_anchor=(0.98, 0.94), fontsize=legend_size
    )
    return figure


def _draw_values(figure: Figure, values: Sequence[float | None], **style: Any) -> None:
    """Lines at known values; `corner.overplot_lines` fails with a single parameter."""
    grid = np.reshape(np.array(figure.axes), (len(values), len(values)))
    for i, value in enumerate(values):
        if value is not None:
            for axes in grid[i:, i]:
                axes.axvline(value, **style)
            for axes in grid[i, :i]:
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
    shown = np.unique(np.linspace(0, posterior.u.shape[1] - 1, WALKERS).astype(int))
    for axes, (label, series, true) in zip(grid.T.flat, panels, strict=False):
        colour = {"color": AFTER, "linewidth": 0.5, "alpha": 0.35}
        axes.plot(steps[::every], series[::every][:, shown], **colour)
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
        Line2D(
            [], [], color=AFTER, label=f"walkers ({len(shown)} of {posterior.u.shape[1]} shown)"
        ),
        Line2D([], [], color="#dddddd", linewidth=8, label="burn-in, discarded"),
    ]
    if truth:
        entries.append(Line2D([], [], color=CAPTURED, linewidth=2.0, label="truth"))
    if posterior.stuck:
        entries.append(Line2D([], [], color="black", label="stuck walkers"))
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
