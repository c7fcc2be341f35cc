"""The report of a fit: what it found, with its plots and its motions."""

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import jaxik
from fitting.clips import flight
from fitting.motion import playback, worst_window
from fitting.motion.accuracy import Accuracy
from fitting.motion.measures import Measures
from fitting.motion.playback import ClipActivity, Nudge, Playback
from fitting.motion.worst_window import WorstWindow
from fitting.report import document, motion_data, pages, style
from fitting.report.document import (
    Block,
    Document,
    Finding,
    Grid,
    Heading,
    Jump,
    Plot,
    Points,
    Ranges,
    Section,
    Terms,
    Text,
    View,
)
from fitting.report.formatting import Table, figures_table, listed, percent
from fitting.report.live_data import LiveClip
from fitting.report.motion_data import ViewedClip, ViewedMotion
from fitting.runtime import activity
from fitting.runtime.beside import calls_beside
from fitting.runtime.precision import in_float64
from jaxik.maths import parameter_tree

from . import fit_motions, fit_plots, fit_tables
from .assess import MIN_IMPROVEMENT
from .fit import Fit
from .fit_motions import ClipMotions, WarmUp
from .run_folder import FIT, PARAMETERS, SUMMARY

KNEE_LIMITS = ("min_knee_angle", "max_knee_angle")
RANGES = (
    "Dot: fitted value. Band: its 95 % interval, blue where the clips determine the parameter and "
    "dashed grey where they do not. Grey tick: before the fit. Green line: the true value, where "
    "it is known."
)


class Measured(NamedTuple):
    """What takes long to measure, for each clip."""

    before: Sequence[jaxik.Result]
    """Of the system as it was before the fit."""
    activities: Sequence[ClipActivity]
    nudges: Mapping[str, tuple[Nudge, Nudge]]
    """By threshold."""


def fit_text(fitted: Fit, opening: Sequence[Section] = ()) -> str:
    """The result of a fit, for the terminal; the `opening` comes before its numbers."""
    return document.text(fit_document(fitted, opening=opening))


@in_float64
def write_fit(
    run: Path,
    fitted: Fit,
    opening: Sequence[Section] = (),
    details: Sequence[Section] = (),
    warm_up: WarmUp | None = None,
) -> None:
    """Writes the plots of a fit, a new summary.md and its page into the folder of its run.

    Args:
        run: the folder.
        fitted: the fit.
        opening: sections to insert before the goodness of the fit.
        details: sections to insert before the pictures.
        warm_up: of the fit's problem, if one has begun.
    """
    plots: list[Plot] = []
    with activity.announced("Playing the clips with the system before the fit"):
        before = (warm_up or WarmUp(fitted.problem)).results()
    with ExitStack() as drawing, calls_beside():
        with activity.announced("Drawing the curves of the parameters"):  # which takes longest
            curves = _draw_search(run, fitted)
        plays = zip(fitted.scenes, fitted.playbacks, strict=True)
        for index, (scene, after) in enumerate(plays):
            with activity.announced(f"Drawing {_clip_names(fitted, index)[0]}"):
                first = playback.play(scene, before[index])
                plots += _draw_clip(run, fitted, index, first, after)
        with activity.announced("Measuring where limits are in effect"):
            measured = Measured(
                before,
                playback.measure_activity(fitted.ik, fitted.scenes, fitted.results),
                playback.nudge_thresholds(fitted.problem, fitted.solution.u),
            )
        details = [*details, Section("Pictures", [*plots, *curves], on_page=False)]
        report = fit_document(fitted, measured, opening, details)
        with activity.announced("Writing the page"):
            report.write(run, stored=True)
        drawing.enter_context(activity.announced("Finishing the pictures"))


@in_float64
def fit_document(
    fitted: Fit,
    measured: Measured | None = None,
    opening: Sequence[Section] = (),
    details: Sequence[Section] = (),
) -> Document:
    """What a fit says; without the measurements only as much as the terminal shows."""
    summary, motions = fitted.summary, []
    if measured is not None:
        every = zip(fitted.clips, measured.before, fitted.results, strict=False)
        motions = [fit_motions.clip_motions(*results) for results in every]
    sections = [
        Section("What these clips can tell", [Points(fitted.check.lines)]),
        *opening,
        Section("Goodness of fit", fit_tables.goodness_blocks(fitted), on_page=False),
        _parameters(fitted),
        _capture(fitted),
        _distances(fitted, motions),
    ]
    if measured is not None:
        sections += [_worst(fitted), *_determined(fitted, measured.activities)]
        sections += [_activity(measured), _limits(fitted, measured.activities)]
    closing = [summary["message"], cost_sentence(fitted)]
    if not fitted.is_worse:
        closing.insert(0, fitted.verdict.sentence)
    return Document(
        file=SUMMARY,
        kind="Foot IK fitted to captured motion",
        title=fitted.experiment.name,
        verdict=_verdict(fitted),
        good=summary["converged"] and fitted.verdict.fits,
        findings=[Finding(sentence) for sentence in _findings(fitted, motions)],
        sections=[*sections, *details],
        setup=_setup(fitted),
        files={FIT: "all numbers", PARAMETERS: "the fitted system"},
        view=_view(fitted, motions) if motions else None,
        note=" ".join(closing),
    )


@in_float64
def fit_view(fitted: Fit) -> View | None:
    """The motions of a fit, also with the system before it; None for a fit without clips."""
    if not fitted.clips:
        return None
    before = WarmUp(fitted.problem).results()
    every = zip(fitted.clips, before, fitted.results, strict=False)
    return _view(fitted, [fit_motions.clip_motions(*results) for results in every])


def _view(fitted: Fit, motions: Sequence[ClipMotions]) -> View:
    windows = map(worst_window.find_worst_window, fitted.playbacks)
    labels = [scene.reference.label for scene in fitted.problem.data]
    lives = (fit_motions.live_clip(fitted, number, clip) for number, clip in enumerate(motions))
    return View(
        [viewed_clip(*each) for each in zip(motions, labels, windows, lives, strict=True)],
        [entry.reference.name for entry in fitted.experiment.clips],
        f"{100 * motions[0].fitted.measures.visible:.2g} cm",
        stands="captured",
        watched="fitted motion",
    )


def viewed_clip(
    clip: ClipMotions, label: str, window: WorstWindow, live: LiveClip | None = None
) -> ViewedClip:
    """What the page shows of one clip; `label` is what it calls the captured motion."""
    worst = window.start, window.end
    return ViewedClip(
        {
            "animated": ViewedMotion("flat animation", clip.animated, motion_data.ANIMATED, True),
            "before": ViewedMotion("before the fit", clip.before, motion_data.BEFORE),
            "captured": ViewedMotion(label, clip.captured, motion_data.CAPTURED, visible=True),
            "fitted": ViewedMotion("fitted", clip.fitted, motion_data.FITTED, True, worst),
        },
        clip.stance,
        clip.flat,
        clip.ground,
        watched="fitted",
        live=live,
    )


def _save(run: Path, name: str, caption: str, figure: Figure) -> Plot:
    style.save(run / name, figure)
    return Plot(name, caption)


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


def _draw_clip(run: Path, fitted: Fit, index: int, first: Playback, after: Playback) -> list[Plot]:
    """Draws one clip with the system before and after the fit."""
    legs = fitted.problem.data[index].rig.names
    clip, ending = _clip_names(fitted, index)
    leg = fitted.ik.leg
    limits = [float(np.mean(getattr(leg, name))) for name in KNEE_LIMITS if hasattr(leg, name)]
    plots: list[Plot] = []
    for name, subject, draw in (
        ("motion", "heights of feet and pelvis", lambda t: fit_plots.motion(after, legs, t)),
        ("side_view", "legs over the ground", lambda t: fit_plots.side_view(after, legs, t)),
        ("moments", "where it differs most", lambda t: fit_plots.moments(after, legs, t)),
        ("knees", "knee angles", lambda t: fit_plots.knees(after, legs, limits, t)),
        ("residuals", "residuals", lambda t: fit_plots.residuals(first, after, t)),
        ("locks", "contact and locks", lambda t: fit_plots.locks(after, legs, t)),
        ("noise", "are the residuals noise?", lambda t: fit_plots.noise(after, t)),
    ):
        title = f"{clip}: {subject}"
        plots.append(_save(run, f"{name}{ending}", title, draw(title)))
    window = worst_window.find_worst_window(after)
    title = f"{clip}: the worst {after.time[window.end] - after.time[window.start]:.1f} seconds"
    figure = fit_plots.worst_window(after, legs, window, title)
    return [*plots, _save(run, f"worst{ending}", title, figure)]


def _draw_search(run: Path, fitted: Fit) -> list[Plot]:
    """Draws the curves of the parameters and the course of the search, where there was one."""
    if not fitted.experiment.free_count:
        return []
    title = f"{fitted.experiment.name}: cost of the fit over time"
    cost = fit_plots.cost(fitted.solution.history, fitted.solution.cost_before, title)
    plot = _save(run, "cost.png", title, cost)
    title = f"{fitted.experiment.name}: how the cost rises over the range of each parameter"
    units = {row["name"]: row["unit"] for row in fitted.summary["parameters"]}
    parameters = {parameter.name: parameter for parameter in fitted.problem.space.parameters}
    profiles = fitted.identifiability.profiles
    figure = fit_plots.profiles(parameters, profiles, units, fitted.known_values, title)
    return [_save(run, "profiles.png", title, figure), plot]


def _ranges(fitted: Fit, of: str, label: str) -> Ranges:
    """The parameters of the system, or of the capture."""
    space, truth = fitted.problem.space, fitted.known_values
    free = {parameter.name: parameter for parameter in space.parameters}
    docs = parameter_tree.docs(space.system)
    parameters = [row for row in fitted.summary["parameters"] if row.get("of", "system") == of]
    rows = [fit_tables.parameter_row(row, free[row["name"]], docs, truth) for row in parameters]
    return Ranges(rows, label, RANGES, fit_tables.parameter_table(parameters, truth))


def _parameters(fitted: Fit) -> Section:
    rows, truth = fitted.summary["parameters"], fitted.known_values
    known = f"{fit_tables.recovered(rows, truth)}." if rows and truth else ""
    return Section(
        "Parameters",
        [
            _ranges(fitted, "system", "Free parameters"),
            Text(known, brief=True),
        ],
    )


def _capture(fitted: Fit) -> Section:
    ranges = _ranges(fitted, "capture", "Of the captures")
    words = "What is not known of the captures, fitted along; no part of the system:"
    return Section(
        "The capture",
        [
            Text(words if ranges.rows else "", brief=True),
            ranges,
            Points(fit_tables.sentences(fitted), brief=True),
        ],
    )


def _distances(fitted: Fit, motions: Sequence[ClipMotions]) -> Section:
    blocks: list[Block] = [
        Grid(fit_tables.distance_table(fitted.distances), "Distances from the captured motion")
    ]
    if motions:
        accuracies = fit_motions.summarised(motions)
        table = figures_table("difference from the captured motion", accuracies)
        blocks.append(Grid(table, "Accuracy before and after the fit"))
        for entry, clip in zip(fitted.experiment.clips, motions, strict=True):
            name = f": {entry.reference.name}" if len(motions) > 1 else ""
            table = figures_table("feet on the ground", _measures(clip))
            blocks += [Heading(f"Feet on the ground{name}"), Grid(table, "How feet are placed")]
        blocks.append(
            Text(
                "Distances and angles are root mean squares. After the dot: where a measure is "
                "worst; frames count from 0."
            )
        )
    return Section("Before and after", blocks)


def _worst(fitted: Fit) -> Section:
    blocks: list[Block] = []
    plays = zip(fitted.playbacks, fitted.problem.data, strict=True)
    for index, (play, scene) in enumerate(plays):
        window = worst_window.find_worst_window(play)
        lines = fit_tables.describe_window(play, window, scene.rig.names)
        if len(fitted.playbacks) > 1:
            blocks.append(Heading(fitted.experiment.clips[index].reference.name))
        blocks += [Points(lines), Jump("Show them in the view", index)]
    return Section("The worst two seconds", blocks)


def _determined(fitted: Fit, activities: Sequence[ClipActivity]) -> list[Section]:
    if not fitted.experiment.free_count:
        return []
    blocks = fit_tables.determined_blocks(fitted, len(activities))
    return [
        fit_tables.prior_section(fitted.summary["parameters"]),
        Section("What these clips determine", blocks, on_page=False),
    ]


def _activity(measured: Measured) -> Section:
    limits, idle = fit_tables.limit_table(measured.activities)
    flips = fit_tables.flip_table(measured.nudges)
    blocks: list[Block] = [
        Text("Fraction of all frames, for each foot:"),
        Grid(fit_tables.activity_table(measured.activities), "What the clips ask of the system"),
    ]
    if len(limits) > 1:
        words = "Fraction of frames that would look different if the limit were out of the way:"
        blocks += [Text(words), Grid(limits, "How often limits act")]
    if idle:
        blocks.append(Text(f"Limits that never act in these clips: {', '.join(idle)}."))
    if measured.nudges:
        words = (
            "Fraction of the feet's decisions (planted, lifted, locked, ground found) that flip "
            "when a threshold moves by 10 % of its range, and the rise in cost:"
        )
        blocks += [Text(words), Grid(flips, "Decisions that hang on thresholds")]
    return Section("What the clips ask of the fitted system", blocks)


def _limits(fitted: Fit, activities: Sequence[ClipActivity]) -> Section:
    missing = fit_tables.missing_motion(fitted, activities)
    blocks: list[Block] = []
    if missing:
        blocks.append(Text("What a clip would have to show to determine the rest:"))
        blocks.append(Terms(missing))
    elif fitted.summary["parameters"]:
        blocks.append(Text("These clips determine every free parameter."))
    return Section("Limits of the data", [*blocks, Points(_remarks(fitted))])


def _measures(clip: ClipMotions) -> dict[str, Measures]:
    motions = {"flat animation": clip.animated, "before": clip.before}
    motions |= {"fitted": clip.fitted, "captured": clip.captured}
    return {name: motion.measures for name, motion in motions.items()}


def _setup(fitted: Fit) -> Table:
    """The options of the experiment."""
    experiment = fitted.experiment
    sigmas = fitted.playbacks[0].sigmas
    rows = [["System", pages.system(experiment)], ["Free parameters", f"{len(experiment.free)}"]]
    if experiment.capture:
        rows.append(["Of the captures", f"{experiment.free_count - len(experiment.free)}"])
    for number, (clip, entry) in enumerate(zip(fitted.clips, experiment.clips, strict=False), 1):
        motion, name = clip.reference, f"Clip {number}" if len(fitted.clips) > 1 else "Clip"
        text = f"{entry.reference.name}: {motion.frame_count} frames at {motion.fps:g} Hz"
        rows.append([name, f"{text}, {motion.seconds:.1f} s, on {entry.terrain.name}"])
    kinds = [f"{kind} {float(sigmas[kind]):.3g}" for kind in fitted.playbacks[0].fitted_kinds]
    return [*rows, ["Noise, m and rad", ", ".join(kinds)], pages.loss_and_seed(experiment)]


def _remarks(fitted: Fit) -> list[str]:
    """What limits the data of each clip."""
    remarks = []
    every = zip(fitted.clips, fitted.experiment.clips, fitted.problem.data, strict=False)
    for clip, entry, scene in every:
        name = entry.reference.name
        observed = np.asarray(scene.reference.observed)
        if missing := int(np.sum(~observed)):
            remarks.append(f"{name}: {missing} of {len(observed)} frames are left out as not seen.")
        if clip.reference.stance is None:
            remarks.append(f"{name}: it has no contact labels; stances are found by its motion.")
        remarks.append(f"{name}: root {clip.root.reason}.")
        remarks += [f"{name}: {remark}" for remark in clip.reference.remarks]
        if in_the_air := flight.describe(clip.base):
            remarks.append(f"{name}: {in_the_air}.")
    return remarks


def _findings(fitted: Fit, motions: Sequence[ClipMotions]) -> list[str]:
    """How close the motion is, what is determined, and how the feet stand: a sentence each.

    What the fit has made worse comes first. Without the motions, the rest is what is determined.
    """
    worse = [fitted.verdict.sentence] if fitted.is_worse else []
    if not motions:
        return [*worse, _open_parameters(fitted)]
    closeness = _closeness(fitted, fit_motions.summarised(motions))
    return [*worse, closeness, _open_parameters(fitted), _feet(motions)]


def _verdict(fitted: Fit) -> str:
    """The verdict in two or three words."""
    if fitted.is_worse:
        return "Worse"
    if not fitted.summary["converged"]:
        return "Not converged"
    if fitted.has_noise:
        return "Fits" if fitted.verdict.fits else "Does not fit"
    return "The same motion" if fitted.verdict.fits else "Not the same motion"


def _closeness(fitted: Fit, accuracies: Mapping[str, Accuracy]) -> str:
    before, after = (_centimetres(accuracies[name].ankle) for name in ("before", "fitted"))
    whose = "the captured ones" if fitted.has_noise else "those of the source"
    figures = f"its ankles are {after} from {whose} (root mean square), {before} before the fit"
    if not fitted.summary["converged"]:
        return f"The search did not settle on one solution; in the best that it met, {figures}."
    motion = "captured motion" if fitted.has_noise else "source's motion"
    if fitted.verdict.fits:
        degree = "as closely as its noise allows" if fitted.has_noise else "within the tolerances"
        return f"The fitted system reproduces the {motion} {degree}: {figures}."
    return f"The fitted system does not reproduce the whole {motion}: {figures}."


def _open_parameters(fitted: Fit) -> str:
    rows = fitted.summary["parameters"]
    if not rows:
        return "No parameter was fitted: this is the system as it comes."
    names = [row["name"] for row in rows if not row["determined"]]
    count = len(rows) - len(names)
    if not names:
        every = "the parameter" if len(rows) == 1 else f"all {len(rows)} parameters"
        return f"The clips determine {every}."
    left = f"{listed(names)} {'stays' if len(names) == 1 else 'stay'} open"
    return f"The clips determine {count} of {len(rows)} parameters; {left}."


def _feet(motions: Sequence[ClipMotions]) -> str:
    before, after, captured = (
        [getattr(clip, name).measures for clip in motions]
        for name in ("before", "fitted", "captured")
    )
    shares = [
        max(
            (measures.penetration_stance for measures in each),
            key=lambda share: -1.0 if math.isnan(share) else share,
        )
        for each in (before, after, captured)
    ]
    if math.isnan(shares[1]):
        return "No standing foot has ground under it, so nothing can be said of feet in the ground."
    visible = f"{100 * motions[0].fitted.measures.visible:.2g} cm"
    where = " of the worst clip" if len(motions) > 1 else ""
    text = (
        f"Standing feet are {visible} or more in the ground in {percent(shares[1])} of their "
        f"frames{where}, {percent(shares[0])} before the fit"
    )
    if not math.isnan(shares[2]):
        text += f" and {percent(shares[2])} as captured"
    return f"{text}."


def _centimetres(length: float) -> str:
    return "an unknown distance" if math.isnan(length) else f"{100 * length:.1f} cm"
