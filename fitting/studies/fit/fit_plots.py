"""Pictures of a fit; each function draws one figure."""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain, pairwise
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter

from fitting.inference.optimise.solution import Progress
from fitting.inference.profiles.profile import Profile
from fitting.motion import goodness
from fitting.motion.goodness import autocorrelations, scale_by_median
from fitting.motion.playback import Motion, Playback
from fitting.motion.worst_window import POSITIONS, WorstWindow, sizes
from fitting.problem.scene import MEASURED, PER_LEG
from fitting.problem.space import FreeParameter, from_fractions, to_fractions
from fitting.report import style
from fitting.report.formatting import RESIDUALS
from fitting.report.style import AFTER, BEFORE, CAPTURED, LOCKED, SLIDING, STAGES, STANDING

RISE = 1e-6  # relative, of the lowest cost: more than rounding
LEG_SPACING = 0.3  # m, smallest distance between two drawn legs
MOMENTS, APART = 6, 0.7  # at most, and s between them
MINOR = 0.5  # of the largest difference, below which a moment is not shown
AHEAD, BELOW, ABOVE = 0.85, 1.4, 0.3  # leg lengths around the pelvis, of what a moment shows
SIGMA: Any = {"color": "black", "linestyle": "--", "linewidth": 1.3}

SECONDS = 1.0  # of lag, that are shown
WIDEST = 8.0  # standard deviations; what is beyond is shown there

PER_ROW = 2  # parameters, each with two panels
HIGHEST = 1e4  # rise shown over the whole range
LINEAR = 2.0  # rise up to which that axis is linear
MARGIN = 0.6  # of the interval's width, on either side of it where it is enlarged
ENLARGED = 6.0  # rise shown there

STANCE_ALPHA = 0.22
UNSEEN = "#dddddd"


@style.styled
def motion(playback: Playback, legs: Sequence[str], title: str) -> Figure:
    """Heights of ankles and pelvis over time above the ground; whole clip and a part of it."""
    figure, columns = _whole_and_part(playback, len(legs) + 1, title)
    ground = 100 * playback.ground_height()
    for panels in columns:
        for leg, (axes, name) in enumerate(zip(panels, legs, strict=False)):
            _plot_motions(
                axes, playback, lambda motion, leg=leg: 100 * playback.height(motion.ankle[:, leg])
            )
            style.earth(axes, playback.time, ground[:, leg])
            axes.set_title(
                f"{name.capitalize()} ankle, with the ground under it ({playback.label})"
            )
        _plot_motions(panels[-1], playback, lambda motion: 100 * playback.height(motion.pelvis))
        style.earth(panels[-1], playback.time, ground.mean(axis=1))
        panels[-1].set_title("Pelvis, with the mean ground under the feet")
    for axes in columns[0]:
        axes.set_ylabel("height, cm")
    style.legend(figure, *_lines(playback), style.ground_key())
    return figure


@style.styled
def side_view(playback: Playback, legs: Sequence[str], title: str) -> Figure:
    """Legs seen from the side, in the part of the clip that climbs most."""
    start, end = style.steepest_part(playback.time, playback.height(playback.captured.pelvis))
    inside = slice(start, end + 1)
    travelled = playback.travelled[inside]
    spacing = max(LEG_SPACING, (np.max(travelled) - np.min(travelled)) / 20)
    chosen = start + np.unique(np.floor((travelled - travelled[0]) / spacing), return_index=True)[1]
    tall = np.clip(16.0 * 1.35 / (np.ptp(travelled) + 1.6), 2.2, 6.5)
    title = f"{title}, seen from the right, {_seconds(playback, start, end)}"
    figure, rows = style.panels(len(legs), 1, title, tall + 0.7, 1.4, sharex=True, sharey=True)
    for leg, (axes, name) in enumerate(zip(rows, legs, strict=True)):
        for colour, motion in _motions(playback):
            joints = np.stack([motion.hip, motion.knee, motion.ankle, motion.toe], axis=-2)[:, leg]
            across, height = playback.along(joints)[chosen], playback.height(joints)[chosen]
            axes.plot(across.T, height.T, color=colour, linewidth=2.0, solid_capstyle="round")
            axes.plot(across[:, 1:3].T, height[:, 1:3].T, "o", color=colour, markersize=4)
            pelvis = playback.along(motion.pelvis)[inside], playback.height(motion.pelvis)[inside]
            axes.plot(*pelvis, color=colour, linewidth=2.6)
        along = playback.along(playback.ground_ws)[inside, leg]
        order = np.argsort(along, kind="stable")
        style.earth(axes, along[order], playback.ground_height()[inside, leg][order])
        axes.set_aspect("equal")
        axes.set_title(
            f"{name.capitalize()} leg every {100 * spacing:.0f} cm, and the path of the pelvis"
        )
        axes.set_ylabel("height, m")
    rows[-1].set_xlabel("distance travelled, m")
    ground = style.ground_key("ground under this foot's track")
    style.legend(figure, *_lines(playback), ground)
    return figure


@style.styled
def moments(playback: Playback, legs: Sequence[str], title: str) -> Figure:
    """The moments in which solved and captured body differ most, each from the side."""
    known = np.asarray(playback.seen) | np.asarray(playback.held_out)
    distances = np.hstack([sizes(playback, kind, known) for kind in POSITIONS])
    of_legs = ([f"{leg} {kind}" for leg in legs] for kind in POSITIONS if kind in PER_LEG)
    names = [*chain.from_iterable(of_legs), "pelvis"]
    chosen = _worst_moments(distances.sum(axis=1), playback.time)
    title = f"{title}, seen from the right"
    figure, panels = style.panels(len(chosen), min(3, len(chosen)), title, 5.2, 1.4)
    size, pelvis = _leg_length(playback.captured), playback.height(playback.captured.pelvis)
    for axes, frame in zip(panels, chosen, strict=True):
        across, worst = playback.travelled[frame], int(np.argmax(distances[frame]))
        axes.set_xlim(across - AHEAD * size, across + AHEAD * size)
        axes.set_ylim(pelvis[frame] - BELOW * size, pelvis[frame] + ABOVE * size)
        axes.set_aspect("equal")
        off = 100 * distances[frame, worst]
        axes.set_title(f"{playback.time[frame]:.2f} s: {names[worst]} {off:.1f} cm off")
    along, ground = playback.along(playback.ground_ws), playback.ground_height()
    for leg in range(len(legs)):
        order = np.argsort(along[:, leg], kind="stable")
        for axes in panels:
            style.earth(axes, along[order, leg], ground[order, leg])
    for colour, motion in _motions(playback):
        width = 3.0 if colour == BEFORE else 6.0
        joints = np.stack([motion.hip, motion.knee, motion.ankle, motion.toe], axis=-2)
        for points, line in ((joints, "-"), (np.asarray(motion.pelvis)[:, None, None], "o")):
            across, height = playback.along(points), playback.height(points)
            for axes, frame in zip(panels, chosen, strict=True):
                axes.plot(
                    across[frame].T,
                    height[frame].T,
                    line,
                    color=colour,
                    linewidth=width,
                    markersize=2.5 * width,
                    solid_capstyle="round",
                    alpha=0.75,
                )
    style.legend(figure, *_lines(playback), style.ground_key("ground under a foot's track"))
    return figure


def _worst_moments(off: Float[np.ndarray, " frames"], time: np.ndarray) -> list[int]:
    """Frames in which it is furthest off, in their order, each some time from the others."""
    chosen: list[int] = []
    for frame in np.argsort(-off, kind="stable"):
        if len(chosen) == MOMENTS or off[frame] < MINOR * np.max(off):
            break
        if all(abs(time[frame] - time[other]) >= APART for other in chosen):
            chosen.append(int(frame))
    return sorted(chosen)


def _leg_length(motion: Motion) -> float:
    """m, of thigh and shin; the median of all legs and frames."""
    thigh, shin = motion.knee - motion.hip, motion.ankle - motion.knee
    return float(np.median(np.linalg.norm(thigh, axis=-1) + np.linalg.norm(shin, axis=-1)))


@style.styled
def knees(playback: Playback, legs: Sequence[str], limits: Sequence[float], title: str) -> Figure:
    """Knee angles over time with the fitted limits; whole clip and a part of it."""
    figure, columns = _whole_and_part(playback, len(legs), title)
    lines = _lines(playback)
    for panels in columns:
        for leg, (axes, name) in enumerate(zip(panels, legs, strict=True)):
            _plot_motions(
                axes, playback, lambda motion, leg=leg: np.degrees(motion.knee_angle[:, leg])
            )
            axes.set_title(f"{name.capitalize()} knee (180° is straight)")
            low, high = axes.get_ylim()
            for limit in limits:
                axes.axhline(np.degrees(limit), **SIGMA)
            axes.set_ylim(low, max(high, 183.0))
    for axes in columns[0]:
        axes.set_ylabel("knee angle, degrees")
    if limits:
        lines.append(style.line_key("limits", **SIGMA))
    style.legend(figure, *lines)
    return figure


@style.styled
def residuals(first: Playback, fitted: Playback, title: str) -> Figure:
    """Errors of each kind over time, and their distribution against the assumed sigma."""
    kinds = fitted.fitted_kinds
    figure, panels = style.panels(2 * len(kinds), 2, title, 3.0, 1.8, width_ratios=[2.4, 1])
    for axes, side, kind in zip(panels[::2], panels[1::2], kinds, strict=True):
        name, unit, factor = RESIDUALS[kind]
        for playback, colour in ((first, BEFORE), (fitted, AFTER)):
            size = factor * _size(playback, kind)
            axes.plot(_times(playback, size), size, color=colour, linewidth=1.2)
        axes.axhline(factor * float(fitted.sigmas[kind]), **SIGMA)
        of_legs = "" if kind in ("pelvis", "body") else " (the larger of the legs)"
        axes.set_title(f"{name}: size of the error{of_legs}")
        axes.set_ylabel(unit)
        axes.set_xlim(fitted.time[0], fitted.time[-1])
        axes.set_ylim(bottom=0)
        _distribution(side, np.asarray(first.residuals[kind]), np.asarray(fitted.residuals[kind]))
        side.set_title(f"{name}: distribution of the residuals")
    panels[-2].set_xlabel("time, s")
    panels[-1].set_xlabel("residual, in sigmas")
    style.legend(
        figure,
        style.line_key("preset parameters", BEFORE, linewidth=3),
        style.line_key("fitted parameters", AFTER, linewidth=3),
        style.line_key("assumed sigma; right: normal distribution", **SIGMA),
    )
    return figure


@style.styled
def locks(playback: Playback, legs: Sequence[str], title: str) -> Figure:
    """When each foot stands and locks, as lanes; the whole clip and a part of it."""
    labelled, locking = bool(np.any(playback.stance)), bool(np.any(playback.locked))
    lanes: list[tuple[str, str, np.ndarray]] = []
    for leg, name in enumerate(legs):
        lanes.append((f"{name} contact weight", STANDING, np.asarray(playback.contact)[:, leg]))
        if locking:
            lanes.append((f"{name} foot locked", LOCKED, np.asarray(playback.locked)[:, leg]))
        if labelled:
            lanes.append(
                (f"{name} stance, {playback.label}", CAPTURED, np.asarray(playback.stance)[:, leg])
            )
    if np.any(playback.slide):
        lanes.append(("sliding", SLIDING, np.asarray(playback.slide)))
    parts = style.sections(playback.time, playback.height(playback.captured.pelvis))
    title = title if locking else f"{title} (no foot ever locks)"
    figure, rows = style.panels(len(parts), 1, title, 0.55 * len(lanes) + 1.3, 1.3)
    for axes, (start, end) in zip(rows, parts, strict=True):
        _draw_lanes(axes, playback.time, lanes)
        axes.set_xlim(playback.time[start], playback.time[end])
        whole = (start, end) == parts[0]
        axes.set_title("Whole clip" if whole else f"Enlarged: {_seconds(playback, start, end)}")
        axes.set_xlabel("time, s")
    released = style.line_key("released", marker="v", linestyle="")
    entries = [
        (True, style.area_key("contact weight, 0 to 1", STANDING)),
        (locking, style.area_key("foot locked", LOCKED)),
        (locking, released),
        (labelled, style.area_key(f"stance, {playback.label}", CAPTURED)),
        (bool(np.any(playback.slide)), style.area_key("sliding", SLIDING)),
    ]
    style.legend(figure, *(entry for visible, entry in entries if visible))
    return figure


@style.styled
def cost(history: Sequence[Progress], cost_before: float, title: str) -> Figure:
    """Cost of the fit over time, by stage, and the best so far.

    Where the best rises, the noise was estimated anew; costs on both sides do not compare.
    """
    figure = Figure(figsize=(13, 6.5), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots()
    for i, stage in enumerate(dict.fromkeys(step.stage for step in history)):
        steps = [step for step in history if step.stage == stage and np.isfinite(step.cost)]
        axes.plot(
            [step.seconds for step in steps],
            [step.cost for step in steps],
            "o",
            markersize=7,
            color=STAGES[i % len(STAGES)],
            label=f"stage: {stage}",
        )
    best = [(step.seconds, step.best) for step in history if np.isfinite(step.best)]
    costs = [cost for _, cost in best]
    rises = [i for i in range(1, len(best)) if costs[i] > costs[i - 1] * (1 + RISE)]
    for begin, end in pairwise([0, *rises, len(best)] if best else []):
        label = None if begin else "best so far"
        axes.step(*zip(*best[begin:end], strict=True), where="post", color="black", label=label)
    for i in rises:
        label = "noise estimated anew: another cost" if i == rises[0] else None
        axes.axvline(best[i][0], color="black", linestyle=":", label=label)
    axes.axhline(cost_before, color=BEFORE, linestyle="--", label="preset, before the fit")
    axes.set_yscale("log")
    for ticks in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        ticks(LogFormatter(labelOnlyBase=False, minor_thresholds=(2, 0.5)))
    axes.set_xlabel("time since the fit began, compilation included, s")
    axes.set_ylabel("cost: half the sum of squared residuals")
    style.legend(figure, *axes.get_legend_handles_labels()[0])
    return figure


def _lines(playback: Playback) -> list[Line2D]:
    """Legend entries of the three motions."""
    motions = (
        (BEFORE, "flat animation, before foot IK"),
        (AFTER, "after fitted foot IK"),
        (CAPTURED, playback.label),
    )
    return [style.line_key(label, colour, linewidth=3) for colour, label in motions]


def _whole_and_part(playback: Playback, rows: int, title: str) -> tuple[Figure, list[list[Axes]]]:
    figure = Figure(figsize=(17, 3.4 * rows + 1.6), layout="constrained")
    figure.suptitle(title)
    return figure, style.whole_and_part(
        figure, playback.time, playback.height(playback.captured.pelvis), rows
    )


def _motions(playback: Playback) -> list[tuple[str, Motion]]:
    """The three motions with their colours, in drawing order."""
    return [(BEFORE, playback.before), (CAPTURED, playback.captured), (AFTER, playback.after)]


def _plot_motions(axes: Axes, playback: Playback, series: Callable[[Motion], np.ndarray]) -> None:
    """Plots one series of the animation, the captured and the solved motion over time."""
    for colour, motion in _motions(playback):
        axes.plot(
            playback.time, series(motion), color=colour, linewidth=1.2 if colour == BEFORE else 1.7
        )


def _size(playback: Playback, kind: str) -> np.ndarray:
    """Length of the error of a kind in every frame, the larger of the legs; NaN if not seen."""
    error = np.abs(np.asarray(playback.errors[kind]))
    if kind != "contact":
        error = np.linalg.norm(error, axis=-1)
    if error.ndim > 1:
        error = error.max(axis=1)
    seen = playback.seen if len(error) == len(playback.seen) else playback.seen[1:-1]
    return np.where(seen, error, np.nan)


def _times(playback: Playback, series: np.ndarray) -> np.ndarray:
    return playback.time if len(series) == len(playback.time) else playback.time[1:-1]


def _distribution(axes: Axes, first: np.ndarray, fitted: np.ndarray) -> None:
    """Histograms of residuals in sigmas with the normal curve; values beyond 5 are shown at 5."""
    edges = np.linspace(-5.0, 5.0, 41)
    for residuals, colour, fill in ((first, BEFORE, True), (fitted, AFTER, False)):
        values = np.clip(residuals[residuals != 0], -5.0, 5.0)  # 0 in frames that were not seen
        if values.size:
            density = np.histogram(values, edges, density=True)[0]
            axes.stairs(density, edges, fill=fill, color=colour, alpha=0.45 if fill else 1.0)
    _draw_normal(axes, 5.0)
    axes.set_xlim(-5.6, 5.6)
    axes.set_xticks([-5, -2.5, 0, 2.5, 5], ["≤−5", "−2.5", "0", "2.5", "≥5"])
    axes.set_ylabel("density")


def _draw_normal(axes: Axes, end: float) -> None:
    """The density of the normal distribution from -end to end."""
    x = np.linspace(-end, end, 321)
    axes.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), "--", color="black")


def _draw_lanes(axes: Axes, time: np.ndarray, lanes: Sequence[tuple[str, str, np.ndarray]]) -> None:
    """Series of 0..1 above one another, with a mark where a locked foot is released."""
    for row, (_, colour, series) in enumerate(reversed(lanes)):
        axes.fill_between(time, row, row + 0.75 * series, step="post", color=colour, linewidth=0)
        axes.axhline(row, color="#bbbbbb", linewidth=0.7)
        if colour == LOCKED:
            ends = time[1:][np.diff(series) < -0.5]
            axes.plot(ends, np.full(len(ends), row + 0.4), "v", color="black", markersize=5)
    axes.set_ylim(-0.05, len(lanes))
    axes.set_yticks(np.arange(len(lanes)) + 0.4, [name for name, _, _ in reversed(lanes)])
    axes.tick_params(axis="y", length=0)
    axes.grid(False, axis="y")


def _seconds(playback: Playback, start: int, end: int) -> str:
    return f"{playback.time[start]:.1f} s to {playback.time[end]:.1f} s"


@style.styled
def noise(playback: Playback, title: str) -> Figure:
    """Autocorrelation and distribution of the residuals of each measured kind."""
    kinds = [kind for kind in playback.fitted_kinds if kind in MEASURED]
    count = 2 * max(len(kinds), 1)
    figure, panels = style.panels(count, 2, title, 2.6, 1.8, width_ratios=[1.6, 1])
    for left, right, kind in zip(panels[::2], panels[1::2], kinds, strict=False):
        _, residuals, active = goodness.series(playback, kind)
        _draw_autocorrelation(left, residuals, active, float(np.median(playback.dt)))
        left.set_title(f"{RESIDUALS[kind].name}: correlation with later residuals")
        _draw_tails(right, residuals, active)
        right.set_title(f"{RESIDUALS[kind].name}: distribution")
    panels[-2].set_xlabel("seconds later")
    panels[-1].set_xlabel("residual, in standard deviations (from the median)")
    style.legend(
        figure,
        style.line_key("residuals of the fit", AFTER, linewidth=3),
        style.line_key("left: 95 % of white noise", BEFORE, linewidth=3),
        style.line_key("right: normal distribution", linestyle="--"),
    )
    return figure


def _draw_autocorrelation(axes: Axes, residuals: np.ndarray, active: np.ndarray, dt: float) -> None:
    r, pairs = autocorrelations(residuals, active)
    count = min(len(r), max(round(SECONDS / dt), 1))
    lags = dt * np.arange(1, count + 1)
    band = 1.96 / np.sqrt(np.maximum(pairs[:count], 1))
    axes.fill_between(lags, -band, band, color=BEFORE, alpha=0.4, linewidth=0)
    axes.vlines(lags, 0, r[:count], color=AFTER, linewidth=3)
    axes.set_xlim(0, lags[-1] + dt)
    low = min(-0.2, float(np.min(r[:count], initial=0.0)) - 0.05)
    axes.set_ylim(low, 1.0)


def _draw_tails(axes: Axes, residuals: np.ndarray, active: np.ndarray) -> None:
    """A histogram over a logarithmic axis, which shows outliers."""
    edges = np.linspace(-WIDEST, WIDEST, 65)
    scale = scale_by_median(residuals, active)
    if scale > 0:
        values = np.clip(residuals[active] / scale, -WIDEST + 1e-9, WIDEST - 1e-9)
        density = np.histogram(values, edges, density=True)[0]
        axes.stairs(density, edges, fill=True, color=AFTER, alpha=0.6)
    _draw_normal(axes, WIDEST)
    axes.set_yscale("log")
    axes.minorticks_off()  # drawing them takes a quarter of the time of the picture
    axes.set_ylim(1e-5, 1.0)
    axes.set_ylabel("density")


@style.styled
def profiles(
    parameters: Mapping[str, FreeParameter],
    curves: Mapping[str, Profile],
    units: Mapping[str, str],
    truth: Mapping[str, float] | None,
    title: str,
) -> Figure:
    """Each parameter's profile: on the left over its whole range, on the right its interval."""
    ratios = [1.25, 1.0] * PER_ROW
    count, columns = 2 * len(curves), 2 * PER_ROW
    figure, panels = style.panels(count, columns, title, 2.35, 1.6, width_ratios=ratios)
    for whole, part, (name, curve) in zip(panels[::2], panels[1::2], curves.items(), strict=True):
        true = (truth or {}).get(name)
        for axes in (whole, part):
            _draw(axes, parameters[name], curve, true)
        _whole_range(whole, parameters[name])
        _interval(part, parameters[name], curve)
        whole.set_title(f"{name}: {curve.verdict}")
        part.set_xlabel("" if units[name] == "1" else units[name], labelpad=1)
    entries = [
        style.line_key("rise of the lowest cost", AFTER, linewidth=3),
        style.line_key("the prior's part of it", BEFORE, linestyle="--"),
        style.area_key("95 % interval", AFTER, alpha=0.18),
        style.line_key("rise at its ends", linestyle=":"),
    ]
    if truth:
        entries.append(style.line_key("truth", CAPTURED, linewidth=2.2))
    style.legend(figure, *entries, columns=5)
    return figure


def _draw(axes: Axes, parameter: FreeParameter, curve: Profile, true: float | None) -> None:
    """The curve over fractions of the range, with what belongs to it."""
    places = to_fractions(parameter, curve.values)
    axes.plot(places, curve.rises, ".-", color=AFTER, markersize=4)
    axes.plot(places, curve.prior_rises, "--", color=BEFORE)
    for minimum in curve.minima:
        axes.axvspan(
            *to_fractions(parameter, np.asarray(minimum.interval)),
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


@style.styled
def worst_window(
    playback: Playback, legs: Sequence[str], window: WorstWindow, title: str
) -> Figure:
    """Heights of feet and pelvis, and knee angles, captured and fitted, in the worst window."""
    inside = slice(window.start, window.end + 1)
    time = playback.time[inside]
    figure, panels = style.panels(2 * len(legs) + 1, 1, title, 3.1, 1.6, sharex=True)
    ground = 100 * playback.ground_height()[inside]

    def draw(axes: Axes, series: Callable[[Motion], np.ndarray]) -> None:
        for colour, motion in ((CAPTURED, playback.captured), (AFTER, playback.after)):
            axes.plot(time, series(motion)[inside], color=colour, linewidth=2.2)

    for leg, name in enumerate(legs):
        foot, knee = panels[leg], panels[len(legs) + 1 + leg]
        draw(foot, lambda motion, leg=leg: 100 * playback.height(motion.ankle[:, leg]))
        style.earth(foot, time, ground[:, leg])
        foot.set_title(f"{name.capitalize()} ankle, with the ground under it ({playback.label})")
        draw(knee, lambda motion, leg=leg: np.degrees(motion.knee_angle[:, leg]))
        knee.set_title(f"{name.capitalize()} knee (180° is straight)")
        knee.set_ylabel("knee angle, degrees")
        for axes in (foot, knee):
            stance = np.asarray(playback.stance)[inside, leg] > 0.5
            style.shade(axes, time, stance, STANDING, STANCE_ALPHA)
    pelvis = panels[len(legs)]
    draw(pelvis, lambda motion: 100 * playback.height(motion.pelvis))
    pelvis.set_title("Pelvis")
    for axes in panels[: len(legs) + 1]:
        axes.set_ylabel("height, cm")
    for axes in panels:
        style.shade(axes, time, ~np.asarray(playback.seen)[inside], UNSEEN)
        axes.axvline(playback.time[window.frame], color="black", linestyle=":", linewidth=1.6)
    panels[-1].set_xlabel("time, s")
    panels[-1].set_xlim(time[0], time[-1])
    entries = [
        style.line_key(playback.label, CAPTURED, linewidth=3),
        style.line_key("after fitted foot IK", AFTER, linewidth=3),
        style.ground_key(),
        style.area_key("captured stance", STANDING, alpha=STANCE_ALPHA),
        style.line_key("largest error", linestyle=":"),
    ]
    if not np.all(np.asarray(playback.seen)[inside]):
        entries.append(style.area_key("left out of the fit", UNSEEN))
    style.legend(figure, *entries, columns=6)
    return figure
