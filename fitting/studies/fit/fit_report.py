"""The report of a fit: text for the terminal, the run's summary.md with its plots, its page."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TypeAlias

import numpy as np
from matplotlib.figure import Figure

from fitting.motion import playback, worst_window
from fitting.motion.playback import ClipActivity, Playback
from fitting.report import style
from fitting.report.formatting import aligned, bullets, joined, markdown
from fitting.runtime import activity, files
from fitting.runtime.beside import calls_beside
from fitting.runtime.precision import in_float64
from fitting.studies.sample import prior_report

from . import fit_page, fit_plots, fit_tables, goodness_report, identifiability_report
from .assess import MIN_IMPROVEMENT
from .fit import Fit
from .fit_motions import Rehearsal
from .fit_page import Measured
from .identifiability_report import sections as identifiability_sections
from .run_folder import SUMMARY

KNEE_LIMITS = ("min_knee_angle", "max_knee_angle")
Plots: TypeAlias = dict[str, str]  # captions by file name


def fit_text(fitted: Fit) -> str:
    """The result of a fit, for the terminal."""
    rows, truth = fitted.summary["parameters"], fitted.known_values
    parts = [goodness_report.text(fitted), ""]
    if not rows:
        return joined([*parts, fitted.summary["message"]])
    parts += [fitted.summary["message"], cost_sentence(fitted), ""]
    system, capture = goodness_report.of_system(rows), goodness_report.of_capture(rows)
    parts.append(aligned(fit_tables.parameter_table(system, truth)))
    if capture:
        parts += ["", f"{goodness_report.HEADING}:"]
        parts.append(aligned(fit_tables.parameter_table(capture, truth)))
    if seen := goodness_report.sentences(fitted):
        parts += ["", *seen]
    if any("half_life" in row for row in rows):
        parts += ["", aligned(fit_tables.gain_table(rows))]
    if truth:
        parts += ["", fit_tables.recovered(rows, truth)]
    return joined(parts)


@in_float64
def write_fit(
    run: Path,
    fitted: Fit,
    opening: Sequence[str] = (),
    details: Sequence[str] = (),
    rehearsal: Rehearsal | None = None,
) -> None:
    """Writes the plots of a fit, a new summary.md and its page into the folder of its run.

    Args:
        run: the folder.
        fitted: the fit.
        opening: paragraphs of Markdown to insert before the parameters.
        details: paragraphs of Markdown to insert before the plots.
        rehearsal: of the fit's problem, if one has begun.
    """
    plots: Plots = {}
    worst = ["## The worst two seconds"]
    with activity.announced("Playing the clips with the system before the fit"):
        before = (rehearsal or Rehearsal(fitted.problem)).results()
    with ExitStack() as drawing, calls_beside():
        with activity.announced("Drawing the curves of the parameters"):  # which takes longest
            curves = _draw_search(run, fitted)
        plays = zip(fitted.scenes, fitted.playbacks, strict=True)
        for index, (scene, after) in enumerate(plays):
            with activity.announced(f"Drawing {_clip_names(fitted, index)[0]}"):
                first = playback.play(scene, before[index])
                plots |= _draw_clip(run, fitted, index, first, after)
                worst += _worst_window(run, fitted, index, after)
        plots |= curves
        with activity.announced("Measuring where limits are in effect"):
            clips = playback.measure(fitted.ik, fitted.scenes, fitted.results)
            limits = _limits(fitted, clips)
        parts = [
            *_result(fitted),
            *_check(fitted),
            *opening,
            *goodness_report.goodness_section(fitted),
            *(_parameters(fitted, clips) if fitted.experiment.free_count else []),
            *limits,
            *worst,
            *details,
            "## Pictures",
            gallery(plots),
        ]
        if fitted.clips:
            with activity.announced("Writing the page"):
                fit_page.write(run, fitted, Measured(before, clips))
        drawing.enter_context(activity.announced("Finishing the pictures"))
    files.write_text(run / SUMMARY, "\n\n".join(parts) + "\n")


def save_plot(run: Path, name: str, caption: str, figure: Figure) -> Plots:
    """Saves a figure; returns its file name with the caption."""
    style.save(run / name, figure)
    return {name: caption}


def gallery(plots: Plots) -> str:
    """Plots as Markdown."""
    return "\n\n".join(f"![{caption}]({name})" for name, caption in plots.items())


def cost_sentence(fitted: Fit) -> str:
    """Cost before and after, and the effort it took."""
    summary, moved = fitted.summary, fitted.experiment.noise.moves_optimum
    noise = " (both with the noise estimated here)" if moved else ""
    sentence = (
        f"Cost {summary['cost_before']:.6g} before, {summary['cost']:.6g} after{noise}: "
        f"{summary['steps']} steps in {summary['seconds']:.1f} s."
    )
    if left := summary["left"]:
        costs = ", ".join(f"{cost:.6g}" for cost in left)
        sentence += f" Profiles led on to lower points from solutions of cost {costs}."
    if (lower := summary["improvement"]) > MIN_IMPROVEMENT:
        sentence += f" A profile still meets a point that is {lower:.3g} lower."
    return sentence


def _clip_names(fitted: Fit, index: int) -> tuple[str, str]:
    """What titles call a clip, and how the file names of its plots end."""
    several = len(fitted.problem.data) > 1
    title = fitted.experiment.name + (f", clip {index + 1}" if several else "")
    return title, f"_{index + 1}.png" if several else ".png"


def _worst_window(run: Path, fitted: Fit, index: int, play: Playback) -> list[str]:
    """Draws and describes the worst two seconds of a clip."""
    legs = fitted.problem.data[index].rig.names
    window = worst_window.find_worst_window(play)
    clip, ending = _clip_names(fitted, index)
    title = f"{clip}: the worst {play.time[window.end] - play.time[window.start]:.1f} seconds"
    figure = fit_plots.worst_window(play, legs, window, title)
    plots = save_plot(run, f"worst{ending}", title, figure)
    return [bullets(identifiability_report.describe(play, window, legs)), gallery(plots)]


def _draw_clip(run: Path, fitted: Fit, index: int, first: Playback, after: Playback) -> Plots:
    """Draws one clip with the system before and after the fit."""
    legs = fitted.problem.data[index].rig.names
    clip, ending = _clip_names(fitted, index)
    leg = fitted.ik.leg
    limits = [float(np.mean(getattr(leg, name))) for name in KNEE_LIMITS if hasattr(leg, name)]
    plots: Plots = {}
    for name, subject, draw in (
        ("motion", "heights of feet and pelvis", lambda t: fit_plots.motion(after, legs, t)),
        ("side_view", "legs over the ground", lambda t: fit_plots.side_view(after, legs, t)),
        ("knees", "knee angles", lambda t: fit_plots.knees(after, legs, limits, t)),
        ("residuals", "residuals", lambda t: fit_plots.residuals(first, after, t)),
        ("locks", "contact and locks", lambda t: fit_plots.locks(after, legs, t)),
        ("noise", "are the residuals noise?", lambda t: fit_plots.noise(after, t)),
    ):
        title = f"{clip}: {subject}"
        plots |= save_plot(run, f"{name}{ending}", title, draw(title))
    return plots


def _draw_search(run: Path, fitted: Fit) -> Plots:
    """Draws the curves of the parameters and the course of the search, where there was one."""
    if not fitted.experiment.free_count:
        return {}
    title = f"{fitted.experiment.name}: cost of the fit over time"
    cost = fit_plots.cost(fitted.solution.history, fitted.solution.cost_before, title)
    plots = save_plot(run, "cost.png", title, cost)
    title = f"{fitted.experiment.name}: how the cost rises over the range of each parameter"
    units = {row["name"]: row["unit"] for row in fitted.summary["parameters"]}
    parameters = {parameter.name: parameter for parameter in fitted.problem.space.parameters}
    profiles = fitted.identifiability.profiles
    figure = fit_plots.profiles(parameters, profiles, units, fitted.known_values, title)
    return save_plot(run, "profiles.png", title, figure) | plots


def _result(fitted: Fit) -> list[str]:
    experiment, summary = fitted.experiment, fitted.summary
    rules = "".join(f", `{stage}` by `{name}`" for stage, name in experiment.rules.items())
    original = ", faithful to its original" if experiment.faithful else ""
    return [
        f"# {experiment.name}",
        f"{summary['goodness']['sentence']} {summary['message']} {cost_sentence(fitted)}",
        f"Preset `{experiment.preset}`{original}{rules}, loss `{experiment.loss}`, "
        f"seed {experiment.seed}.",
    ]


def _check(fitted: Fit) -> list[str]:
    if not fitted.check.lines:
        return []
    return ["## What these clips can tell", bullets(list(fitted.check.lines))]


def _parameters(fitted: Fit, clips: Sequence[ClipActivity]) -> list[str]:
    rows, truth = fitted.summary["parameters"], fitted.known_values
    table = fit_tables.parameter_table(goodness_report.of_system(rows), truth)
    parts = ["## Parameters", markdown(table)]
    if truth:
        parts.append(f"{fit_tables.recovered(rows, truth)}.")
    if any("half_life" in row for row in rows):
        parts.append(markdown(fit_tables.gain_table(rows)))
    parts += goodness_report.capture_section(fitted, truth)
    return [*parts, *prior_report.prior_section(rows), *identifiability_sections(fitted, clips)]


def _limits(fitted: Fit, clips: Sequence[ClipActivity]) -> list[str]:
    parts = [
        "## What the clips ask of the fitted system",
        "Fraction of all frames, for each foot:",
        markdown(fit_tables.activity_table(clips)),
        "Fraction of frames that would look different if the limit were out of the way:",
        markdown(fit_tables.limit_table(clips)),
    ]
    if nudges := playback.nudge_thresholds(fitted.problem, fitted.solution.u):
        parts.append(
            "Fraction of the feet's decisions (planted, lifted, locked, ground found) that flip "
            "when a threshold moves by 10 % of its range, and the rise in cost:"
        )
        parts.append(markdown(fit_tables.flip_table(nudges)))
    return parts
