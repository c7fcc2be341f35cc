"""The report of a sampling: its text, its sections of the run's report, and its plots."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import jaxik
from fitting.clips.clip_frames import raised
from fitting.experiment.problems import ClipData
from fitting.ground import ground_path
from fitting.inference.sample.blocks import SECONDS, BlockLogLikelihood, LeaveOneOut
from fitting.inference.sample.diagnostics import ParameterSummary
from fitting.inference.sample.modes import MIN_EXCHANGES, Mode
from fitting.inference.sample.posterior import Posterior
from fitting.inference.sample.prior_sensitivity import MAX_K, Reweighted
from fitting.motion import playback
from fitting.motion.measures import place, with_soles_of
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.space import Space, prior_probability
from fitting.report import document, motion_data, pages
from fitting.report.document import (
    Block,
    Document,
    Finding,
    Grid,
    Heading,
    Plot,
    Points,
    Section,
    Text,
    View,
    brief,
)
from fitting.report.formatting import RESIDUALS, Table, interval, number, percent
from fitting.report.motion_data import Appearance, ViewedClip, ViewedMotion
from fitting.report.style import AFTER, BEFORE, CAPTURED, PRIOR, legend, line_key, styled
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies.fit import fit_motions, fit_tables
from fitting.studies.fit.fit_tables import Truth
from fitting.studies.fit.run_folder import LOWER_POINT

from .replay import SURPRISING, Band, Disagreement, PredictiveCheck, Replay, Statistic
from .sample import SampledFit

TEXT = "posterior.md"
MAX_CLIPS = 4  # that are drawn
SHOWN_DRAWS = 5  # whose motion a view shows
DRAW = Appearance(AFTER, 1.0, 0.3)

WORST = 5  # blocks in the table
SENSITIVE = (
    "Sensitive to their prior, for an end of the interval moves by more than a quarter of its width"
)
UNKNOWN = "The draws cannot tell how sensitive these are; sample with another `[prior]` to see"
CORRELATED = 0.3  # between neighbouring blocks, from which the standard error is too small

SAMPLES = 20_000  # at most, in the corner
WALKERS = 40  # at most, in the picture of the chain
POINTS = 1500  # at most, of each walker
BINS = 30  # of a histogram
SMOOTHING = 0.8  # bins, of the density of a pair
HELD = (0.86, 0.39)  # by contours: two and one standard deviations of a normal in two dimensions
MARGIN = 0.05  # fraction of a panel's width


def posterior_text(sampled: SampledFit, run: Path | None = None) -> str:
    """The result of a sampling, for the terminal; `run` is the folder where it is written."""
    return brief(sections(sampled, run))


def write_posterior(run: Path, sampled: SampledFit) -> str:
    """Writes the report of a run anew, with its posterior; returns the name of its Markdown file.

    Where the fit has left no report, there is one of the posterior only.

    Raises:
        ValueError: the report of the fit is damaged.
    """
    with activity.announced("Drawing the posterior"):
        report = document.load(run) or _alone(sampled)
        of_both = replace(report, sections=[*report.sections, *sections(sampled, run)])
        of_both.write(run)
    return report.file


def _alone(sampled: SampledFit) -> Document:
    """The report of a posterior, still without its sections, where there is none of a fit."""
    converged = sampled.posterior.converged
    return Document(
        file=TEXT,
        kind="The posterior around a fit",
        title=sampled.experiment.name,
        verdict="Converged" if converged else "Not converged",
        good=converged,
        findings=[Finding(sampled.posterior.message)],
        sections=[],
        setup=pages.rows(sampled.experiment),
    )


def sections(sampled: SampledFit, run: Path | None) -> list[Section]:
    """What a sampling says; `run` is the folder where it is written, if there is one."""
    experiment, posterior, truth = sampled.experiment, sampled.posterior, sampled.known_values
    rows = {row["name"]: row for row in sampled.parameters}
    units = {name: row["unit"] for name, row in rows.items()}
    labels = [f"{name}, {units[name]}" if units[name] != "1" else name for name in posterior.names]
    values = {name: row["value"] for name, row in rows.items()}
    replay, left_out = sampled.replay, sampled.left_out
    corner_title = f"{experiment.name}: posterior of the parameters"
    walkers = f"{experiment.name}: walkers"
    blocks: list[Block] = [
        *(Text(f"**{line}**", brief=True) for line in _contradictions(sampled, run)),
        Points(_health(posterior), brief=True),
        Grid(posterior_table(posterior, truth, units), "Posterior of the parameters"),
    ]
    if posterior.sigmas:
        blocks += [
            Text("Sigmas of the noise, which were sampled along:"),
            Grid(fit_tables.sigma_table(posterior.sigmas), "Sampled sigmas"),
        ]
    if truth:
        determined = [name for name, row in rows.items() if row["determined"]]
        blocks.append(
            Text(
                "The 95 % intervals contain the true values of "
                f"{covered(posterior, truth, posterior.names)} parameters; among those that the "
                f"fit calls determined, of {covered(posterior, truth, determined)}.",
                brief=True,
            )
        )
    blocks += mode_blocks(posterior, sampled.space, units)
    blocks += posterior_prior_blocks(sampled, units)
    plots = [
        Plot(
            "corner.png",
            corner_title,
            lambda: corner(posterior, labels, values, truth, corner_title, space=sampled.space),
        ),
        Plot("chain.png", walkers, lambda: chain(posterior, labels, truth, walkers)),
    ]
    if replay is not None:
        title = f"{experiment.name}: the capture inside what the posterior would make"
        blocks += predictive_blocks(replay)
        plots.append(Plot("predictive.png", title, lambda: bands(replay.bands, title)))
        if left_out is not None:
            blocks += left_out_blocks(left_out, replay.blocks)
    return [
        Section("Posterior", blocks),
        Section("Pictures of the posterior", plots, on_page=False),
    ]


def _health(posterior: Posterior) -> list[str]:
    """How the sampling went, a sentence each."""
    steps, walkers = posterior.u.shape[0] * posterior.thin_by, posterior.u.shape[1]
    stuck = ", ".join(map(str, posterior.stuck)) or "none"
    return [
        posterior.message,
        f"{walkers} walkers, {steps} steps, the first {posterior.burn_in * posterior.thin_by} left "
        f"out as burn-in; {posterior.seconds:.0f} s in the last call.",
        f"Mean acceptance {percent(float(posterior.acceptance.mean()))}; slowest "
        f"autocorrelation time {posterior.autocorrelation_time.max():.0f} steps.",
        f"Stuck walkers: {stuck}.",
        *mode_sentences(posterior),
    ]


@in_float64
def draws_view(
    posterior: Posterior, problem: Problem[jaxik.FootIK], clips: Sequence[ClipData]
) -> View:
    """The motion that some draws of a posterior give, beside the captured one.

    Args:
        posterior: converged or not.
        problem: that was sampled.
        clips: of the problem.
    """
    draws = posterior.draws_u.reshape(-1, len(posterior.names))
    chosen = draws[np.linspace(0, len(draws) - 1, SHOWN_DRAWS).astype(int)]
    played = []
    for u in chosen:
        system, scenes = system_and_scenes(problem, u)
        played.append(playback.run_all(system, scenes))
    viewed = [
        _viewed_draws(clip, [results[number] for results in played])
        for number, clip in enumerate(clips)
    ]
    depth = 100 * viewed[0].reference.measures.visible
    names = [clip.reference.source for clip in clips]
    return View(viewed, names, f"{depth:.2g} cm", stands="captured", watched="watched draw")


def _viewed_draws(clip: ClipData, results: Sequence[jaxik.Result]) -> ViewedClip:
    """A clip as captured and as some draws give it."""
    animated = raised(clip.base, clip.root.rise)
    solved = {
        f"draw {draw}": fit_motions.fitted_clip(clip, result)
        for draw, result in enumerate(results, 1)
    }
    captured = with_soles_of(clip.reference, clip.base)
    placed = {
        name: place(motion, animated, clip.base, clip.terrain)
        for name, motion in {"flat animation": animated, "captured": captured, **solved}.items()
    }
    looks = {"flat animation": motion_data.ANIMATED, "captured": motion_data.CAPTURED}
    return ViewedClip(
        {
            name: ViewedMotion(name, motion, looks.get(name, DRAW), name != "flat animation")
            for name, motion in placed.items()
        },
        clip.reference.stance_labels(),
        clip.base,
        ground_path.around_path(clip.reference, clip.terrain),
        watched="draw 1",
    )


def posterior_table(posterior: Posterior, truth: Truth, units: Mapping[str, str]) -> Table:
    """Parameters of a posterior: moments, intervals, how well they are sampled.

    Args:
        posterior: after sampling.
        truth: known values by name; where there are any, the last column says whether the 95 %
            interval contains them.
        units: of the parameters, by name; empty to leave the column out.
    """
    heading = ["parameter", *(["unit"] if units else []), "mean", "sd", "median", "68 % interval"]
    heading += ["95 % interval", "ESS", "R-hat", "autocorrelation"]
    table = [heading + (["truth", "covered"] if truth else [])]
    for row, steps in zip(posterior.summary, posterior.autocorrelation_time, strict=True):
        cells = [row["name"], *([units[row["name"]]] if units else [])]
        cells += [number(row[key]) for key in ("mean", "sd", "median")]
        cells += [interval(row["low68"], row["high68"]), interval(row["low95"], row["high95"])]
        cells += [f"{row['ess']:.0f}", f"{row['r_hat']:.3f}", f"{steps:.0f} steps"]
        if truth:
            true = truth.get(row["name"])
            cells.append("unknown" if true is None else number(true))
            cells.append("" if true is None else "yes" if covers(row, true) else "no")
        table.append(cells)
    return table


def covered(posterior: Posterior, truth: Mapping[str, float], names: Sequence[str]) -> str:
    """How many of these parameters have their true value within their 95 % interval."""
    known = [row for row in posterior.summary if row["name"] in names and row["name"] in truth]
    inside = sum(covers(row, truth[row["name"]]) for row in known)
    return f"{inside} of {len(known)}"


def covers(row: ParameterSummary, true: float) -> bool:
    """Whether the 95 % interval of a posterior's row contains this value."""
    return row["low95"] <= true <= row["high95"]


@styled
def bands(channels: Sequence[Band], title: str) -> Figure:
    """One channel for each kind of residual, a column for each clip."""
    clips = sorted({band.clip for band in channels})[:MAX_CLIPS]
    kinds = list(dict.fromkeys(band.kind for band in channels))
    figure = Figure(
        figsize=(max(17, 8.5 * len(clips)), 2.6 * len(kinds) + 1.8), layout="constrained"
    )
    figure.suptitle(title)
    grid = figure.subplots(max(len(kinds), 1), max(len(clips), 1), squeeze=False, sharex="col")
    for band in channels:
        if band.clip in clips:
            axes = grid[kinds.index(band.kind), clips.index(band.clip)]
            _draw(axes, band, clip=len(clips) > 1)
    for axes in grid[-1]:
        axes.set_xlabel("time, s")
    legend(
        figure,
        line_key("captured", CAPTURED, linewidth=2),
        line_key("95 % of the replicates", AFTER, linewidth=8, alpha=0.3),
        line_key("median motion of the posterior", AFTER, linewidth=2),
    )
    return figure


def _draw(axes: Axes, band: Band, *, clip: bool) -> None:
    name, unit, factor = RESIDUALS[band.kind]
    axes.fill_between(
        band.time, factor * band.low, factor * band.high, color=AFTER, alpha=0.3, linewidth=0
    )
    axes.axhline(0.0, color=AFTER, linewidth=1.5)
    axes.plot(band.time, factor * band.captured, color=CAPTURED, linewidth=0.9)
    axes.set_ylabel(unit)
    axes.set_xlim(band.time[0], band.time[-1])
    where = f"clip {band.clip + 1}, " if clip else ""
    axes.set_title(
        f"{where}{name.lower()}, {band.channel}: {percent(band.outside)} outside the band"
    )


def _contradictions(sampled: SampledFit, run: Path | None) -> Iterator[str]:
    """What contradicts the fit, a sentence each, with how to go on; none if nothing does."""
    if sampled.has_lower_point:
        go_on = "fit again with `[start]` at `Posterior.best_values`"
        if run is not None:
            go_on = f"go on from there with `jaxik fit {run / LOWER_POINT} -o {run}-lower`"
        yield (
            "The chain contradicts its fit: it met a point whose log-probability is "
            f"{sampled.posterior.improvement:.3g} higher. The fit is not the best one; {go_on}."
        )
    yield from map(_describe, sampled.disagreements)


def _describe(disagreement: Disagreement) -> str:
    name, reason = disagreement["name"], disagreement["reason"]
    sampled, fitted = (interval(*disagreement[key]) for key in ("interval", "interval_of_fit"))
    text = f"The chain contradicts its fit: the 95 % interval of {name}, {sampled}, "
    if reason == "leaves out the fit":
        return f"{text}leaves out the fitted value {number(disagreement['value'])}."
    return f"{text}is clearly {reason} than the fit's, {fitted}."


def mode_sentences(posterior: Posterior) -> list[str]:
    """How many modes there are, what they weigh, and which walkers were left out and why."""
    sentences = []
    if posterior.modes:
        weights = ", ".join(_weight(mode) for mode in posterior.modes)
        sentences.append(f"The posterior has {len(posterior.modes)} modes: {weights}.")
    if posterior.isolated:
        walkers = ", ".join(map(str, posterior.isolated))
        sentences.append(
            f"Left out are walkers {walkers}, which never came near the others' log-probability; "
            f"by its height and width, about {percent(posterior.isolated_mass, 2)} of the "
            "posterior lies there."
        )
    return sentences


def mode_blocks(posterior: Posterior, space: Space, units: Mapping[str, str]) -> list[Block]:
    """Modes and their medians; nothing where there is one mode only."""
    modes = posterior.modes
    if not modes:
        return []
    blocks: list[Block] = [
        Heading("Modes"),
        Text(
            "Parts of the posterior that lie apart. Walkers come and go between them by jumps, so "
            "that each weighs as many draws as it deserves; exchanges count how often one came or "
            "left."
        ),
        Grid(mode_table(modes), "Modes", brief=False),
        Text("Medians in each mode:"),
        Grid(median_table(modes, space, units), "Medians in each mode", brief=False),
    ]
    if not all(mode.is_weighed for mode in modes):
        blocks.append(
            Text(
                f"Where there were fewer than {MIN_EXCHANGES} exchanges, the weight is out of "
                "reach: there are as many draws as walkers happened to start there, and intervals "
                "over all modes are no better. Sample longer, or narrow a prior to the mode "
                "that is meant."
            )
        )
    return blocks


def mode_table(modes: tuple[Mode, ...]) -> Table:
    """Weight, exchanges and height of each mode."""
    table = [["mode", "weight", "exchanges", "walkers at the end", "highest log-probability"]]
    for index, mode in enumerate(modes, 1):
        counts = map(str, (mode.exchanges, mode.walkers))
        table.append([str(index), _weight(mode), *counts, number(mode.log_probability)])
    return table


def median_table(modes: tuple[Mode, ...], space: Space, units: Mapping[str, str]) -> Table:
    """Median of each parameter in each mode."""
    values = np.asarray(space.values(np.stack([mode.median for mode in modes])))
    heading = [f"mode {index}" for index in range(1, len(modes) + 1)]
    rows = zip(space.names, values.T, strict=True)
    return [
        ["parameter", "unit", *heading],
        *([name, units[name], *map(number, row)] for name, row in rows),
    ]


def _weight(mode: Mode) -> str:
    if math.isnan(mode.error):
        return f"out of reach ({percent(mode.weight)} of the draws)"
    return f"{percent(mode.weight)} ± {percent(mode.error)}"


def left_out_sentence(left_out: LeaveOneOut) -> str:
    """The figure, and how far it can be trusted."""
    count = len(left_out.pareto_k)
    text = (
        f"Log predictive density of {count} blocks of {SECONDS:g} s, each left out in turn: "
        f"{left_out.elpd:.1f} ± {left_out.error:.1f}; effective number of parameters "
        f"{left_out.parameters:.1f}."
    )
    if left_out.unreliable:
        text += (
            f" Unreliable for {left_out.unreliable} of them, whose Pareto k is above "
            f"{left_out.max_k:.2g}: the fit hangs on them."
        )
    if left_out.neighbours > CORRELATED:
        text += (
            f" Neighbouring blocks correlate by {left_out.neighbours:.2f}, so that the standard "
            "error is too small."
        )
    return text


def left_out_blocks(left_out: LeaveOneOut, blocks: BlockLogLikelihood) -> list[Block]:
    """How well each block is predicted from the others."""
    correlation = "unknown" if math.isnan(left_out.neighbours) else f"{left_out.neighbours:.2f}"
    return [
        Heading("Blocks of frames left out"),
        Text(left_out_sentence(left_out), brief=True),
        Text(
            "By Pareto-smoothed importance sampling, without another fit. Blocks last "
            f"{SECONDS:g} s, two steps of a walk, because what one frame misses its neighbours "
            f"give away; the correlation of neighbouring blocks is {correlation}. With "
            "`jaxik compare --runs`, fits of several systems to the same clips are compared by "
            "this figure. The blocks that are predicted worst:"
        ),
        Grid(worst_blocks(left_out, blocks), "Blocks that are predicted worst", brief=False),
    ]


def worst_blocks(left_out: LeaveOneOut, blocks: BlockLogLikelihood) -> Table:
    """The blocks with the lowest predictive density for each second."""
    table = [["clip", "from", "to", "log predictive density per s", "Pareto k"]]
    seconds = np.maximum(blocks.end - blocks.start, 1e-9)
    for i in np.argsort(left_out.elpd_of_block / seconds)[:WORST]:
        mark = "" if left_out.pareto_k[i] <= left_out.max_k else "!"
        cells = [str(blocks.clip[i]), f"{blocks.start[i]:.1f} s", f"{blocks.end[i]:.1f} s"]
        density = left_out.elpd_of_block[i] / seconds[i]
        table.append([*cells, f"{density:.1f}", f"{left_out.pareto_k[i]:.2f}{mark}"])
    return table


def predictive_sentence(checks: Sequence[PredictiveCheck]) -> str:
    """Whether the capture is like the replicates, and where not."""
    several = len({check.clip for check in checks}) > 1
    unlike = [
        f"{RESIDUALS[check.kind].name.lower()}{f' of clip {check.clip + 1}' if several else ''} "
        f"({', '.join(check.surprises)})"
        for check in checks
        if check.surprises
    ]
    if not unlike:
        return "The captured motion is like the posterior's replicates of it."
    return f"The captured motion is unlike the posterior's replicates: {'; '.join(unlike)}."


def predictive_blocks(replay: Replay) -> list[Block]:
    """Whether the capture is like what the posterior makes."""
    count = len(replay.checks[0].rms.replicated) if replay.checks else 0
    return [
        Heading("The capture beside replicates"),
        Text(predictive_sentence(replay.checks), brief=True),
        Text(
            f"{count} draws of the posterior move the clip again, each with noise of its own from "
            "the model in force. Residuals are those from the draw's own motion, in sigmas: of the "
            "capture the median over the draws, of the replicates 95 %. p is how often a "
            "replicate's figure is the larger one; an exclamation mark stands where it is below "
            f"{SURPRISING:g} or above {1 - SURPRISING:g}. About 5 % of the frames should be "
            "outside the band of the replicates that the picture shows."
        ),
        Grid(check_table(replay.checks, replay.bands), "Capture and replicates", brief=False),
    ]


def check_table(checks: Sequence[PredictiveCheck], bands: Sequence[Band]) -> Table:
    """One row for each kind of residual and clip."""
    table = [["clip", "residuals", "rms", "replicates", "p", "autocorrelation", "replicates", "p"]]
    table[0] += ["largest", "replicates", "p", "outside the band"]
    for check, band in zip(checks, bands, strict=True):
        cells = [str(check.clip + 1), RESIDUALS[check.kind].name]
        for statistic in (check.rms, check.autocorrelation, check.largest):
            cells += _cells(statistic)
        table.append([*cells, percent(band.outside)])
    return table


def _cells(statistic: Statistic) -> list[str]:
    low, high = statistic.replicated_interval
    mark = "!" if statistic.is_surprising else ""
    return [f"{statistic.median:.3g}", f"{low:.3g} to {high:.3g}", f"{statistic.p:.3f}{mark}"]


def posterior_prior_blocks(sampled: SampledFit, units: Mapping[str, str]) -> list[Block]:
    """Prior beside posterior, and how much the one decides the other."""
    sensitivity = sampled.prior_sensitivity.items()
    moved = [name for name, rows in sensitivity if any(row["sensitive"] for row in rows)]
    unknown = [
        name
        for name, rows in sensitivity
        if name not in moved and any(row["sensitive"] is None for row in rows)
    ]
    table = prior_and_posterior_table(sampled, units)
    sentences = [
        f"{words}: {', '.join(f'`{name}`' for name in names)}."
        for words, names in ((SENSITIVE, moved), (UNKNOWN, unknown))
        if names
    ]
    return [
        Heading("Prior and posterior"),
        Text(
            "The last columns are the median and the 95 % interval if the parameter's own prior "
            "had half or twice the spread in `u`, by weighting the draws. `k` is the Pareto shape "
            f"of the weights; above {MAX_K:g} they are unreliable, and no figure is given."
        ),
        Grid(table, "Prior and posterior", brief=False),
        *map(Text, sentences or ["No parameter is sensitive to its prior."]),
    ]


def prior_and_posterior_table(sampled: SampledFit, units: Mapping[str, str]) -> Table:
    """Free parameters: intervals of the prior, of the posterior, and under other priors."""
    table = [["parameter", "unit", "prior", "95 % of the prior", "95 % of the posterior"]]
    table[0] += ["with half the spread", "with twice the spread"]
    for row in sampled.posterior.summary:
        name = row["name"]
        prior = sampled.priors[name]
        cells = [name, units[name], prior["shape"], interval(*prior["interval"])]
        cells.append(interval(row["low95"], row["high95"]))
        table.append([*cells, *map(_reweighted, sampled.prior_sensitivity[name])])
    return table


def _reweighted(row: Reweighted) -> str:
    if row["median"] is None or row["interval"] is None:
        return f"unreliable (k {row['pareto_k']:.2f})"
    return f"{number(row['median'])}, {interval(*row['interval'])} (k {row['pareto_k']:.2f})"


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
