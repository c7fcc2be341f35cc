"""The figure of the profiles: how the cost rises over the range of each parameter."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.inference.profiles.profile import Profile
from fitting.problem.free_parameters import FreeParameter, from_fractions, to_fractions

from .style import AFTER, BEFORE, CAPTURED, legend, styled

PER_ROW = 2  # parameters, each with two panels
HIGHEST = 1e4  # rise shown over the whole range
LINEAR = 2.0  # rise up to which that axis is linear
MARGIN = 0.6  # of the interval's width, on either side of it where it is enlarged
ENLARGED = 6.0  # rise shown there


@styled
def profiles(
    parameters: Mapping[str, FreeParameter],
    curves: Mapping[str, Profile],
    units: Mapping[str, str],
    truth: Mapping[str, float] | None,
    title: str,
) -> Figure:
    """Each parameter's profile: on the left over its whole range, on the right its interval.

    Args:
        parameters: by name.
        curves: their profiles, by name.
        units: of the parameters, by name.
        truth: known values by name.
        title: of the figure.
    """
    lines = -(-len(curves) // PER_ROW)
    figure = Figure(figsize=(17, 2.35 * lines + 1.6), layout="constrained")
    figure.suptitle(title)
    ratios = [1.25, 1.0] * PER_ROW
    grid = figure.subplots(lines, 2 * PER_ROW, squeeze=False, width_ratios=ratios)
    panels = grid.reshape(-1, 2)
    for (whole, part), (name, curve) in zip(panels, curves.items(), strict=False):
        true = (truth or {}).get(name)
        for axes in (whole, part):
            _draw(axes, parameters[name], curve, true)
        _whole_range(whole, parameters[name])
        _interval(part, parameters[name], curve)
        whole.set_title(f"{name}: {curve.verdict}")
        part.set_xlabel("" if units[name] == "1" else units[name], labelpad=1)
    for axes in panels[len(curves) :].ravel():
        axes.set_visible(False)
    entries = [
        Line2D([], [], color=AFTER, linewidth=3, label="rise of the lowest cost"),
        Line2D([], [], color=BEFORE, linestyle="--", label="the prior's part of it"),
        Patch(color=AFTER, alpha=0.18, label="95 % interval"),
        Line2D([], [], color="black", linestyle=":", label="rise at its ends"),
    ]
    if truth:
        entries.append(Line2D([], [], color=CAPTURED, linewidth=2.2, label="truth"))
    legend(figure, *entries, columns=5)
    return figure


def _draw(axes: Axes, parameter: FreeParameter, curve: Profile, true: float | None) -> None:
    """The curve over fractions of the range, with what belongs to it."""
    places = to_fractions(parameter, curve.values)
    axes.plot(places, curve.rises, ".-", color=AFTER, markersize=4)
    axes.plot(places, curve.prior_rises, "--", color=BEFORE)
    for valley in curve.valleys:
        axes.axvspan(
            *to_fractions(parameter, np.asarray(valley.interval)),
            color=AFTER, alpha=0.18, linewidth=0,
        )  # fmt: skip
    axes.axhline(curve.max_rise, color="black", linestyle=":", linewidth=1.2)
    if true is not None:
        axes.axvline(float(to_fractions(parameter, np.asarray(true))), color=CAPTURED)


def _whole_range(axes: Axes, parameter: FreeParameter) -> None:
    axes.set_xlim(0, 1)
    axes.set_yscale("symlog", linthresh=LINEAR, linscale=0.7)
    axes.set_ylim(0, HIGHEST)
    axes.set_yticks([0, 1, 10, 100, 1000, 10000], ["0", "1", "10", "100", "1000", "$10^4$"])
    axes.tick_params(axis="y", labelsize=10)
    _label_values(axes, parameter, [0, 0.25, 0.5, 0.75, 1])


def _interval(axes: Axes, parameter: FreeParameter, curve: Profile) -> None:
    low, high = to_fractions(parameter, np.asarray(curve.interval))
    margin = MARGIN * (high - low)
    start, end = max(0.0, low - margin), min(1.0, high + margin)
    axes.set_xlim(start, end)
    axes.set_ylim(0, ENLARGED)
    _label_values(axes, parameter, [low, high])


def _label_values(axes: Axes, parameter: FreeParameter, places: list[float]) -> None:
    """Ticks at fractions of the range, labelled with the parameter's values."""
    values = from_fractions(parameter, np.asarray(places))
    axes.set_xticks(places, [f"{value:.4g}" for value in values], fontsize=10)
