"""The page of a fit: `report.html` in its run's folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxik
from fitting.clips import flight
from fitting.motion import worst_window
from fitting.motion.measures import Placement
from fitting.motion.playback import ClipActivity
from fitting.motion.worst_window import WorstWindow
from fitting.report import motion_data, pages
from fitting.report.formatting import Table
from fitting.report.motion_data import ShownClip, ShownMotion
from fitting.runtime.precision import in_float64
from jaxik.maths import parameter_tree

from . import (
    fit_figures,
    fit_motions,
    fit_tables,
    goodness_report,
    identifiability_report,
    sentences,
)
from .fit import Fit, FittedParameter
from .fit_motions import ClipMotions
from .identifiability_report import missing_table


class Measured(NamedTuple):
    """What the summary of a fit has measured already, for each clip."""

    before: Sequence[jaxik.Result]
    """Of the system as it was before the fit."""
    activities: Sequence[ClipActivity]


@in_float64
def write(run: Path, fitted: Fit, measured: Measured) -> None:
    """Writes the page of a fit with its clips into the folder of its run."""
    motions = [
        fit_motions.clip_motions(*results)
        for results in zip(fitted.clips_as_fitted, measured.before, fitted.results, strict=True)
    ]
    windows = [worst_window.find_worst_window(play) for play in fitted.playbacks]
    content = _content(fitted, motions, measured.activities)
    content["worst"] = [
        identifiability_report.describe(play, window, scene.rig.names)
        for play, window, scene in zip(fitted.playbacks, windows, fitted.problem.data, strict=True)
    ]
    labels = [scene.reference.label for scene in fitted.problem.data]
    clips = [shown(*each) for each in zip(motions, labels, windows, strict=True)]
    pages.write(run / pages.PAGE, "fit.html", motion_data.pack(clips), **content)


def shown(clip: ClipMotions, label: str, window: WorstWindow) -> ShownClip:
    """What the page shows of one clip; `label` is what it calls the captured motion."""
    worst = window.start, window.end
    return ShownClip(
        {
            "animated": ShownMotion("flat animation", clip.animated, motion_data.ANIMATED),
            "before": ShownMotion("before the fit", clip.before, motion_data.BEFORE),
            "captured": ShownMotion(label, clip.captured, motion_data.CAPTURED, visible=True),
            "fitted": ShownMotion("fitted", clip.fitted, motion_data.FITTED, True, worst),
        },
        clip.stance,
        clip.ground,
        watched="fitted",
    )


def _content(
    fitted: Fit, motions: Sequence[ClipMotions], activities: Sequence[ClipActivity]
) -> dict[str, Any]:
    """The variables of the template."""
    summary, space = fitted.summary, fitted.problem.space
    docs = parameter_tree.docs(space.system)

    def rows(parameters: Sequence[FittedParameter]) -> list[fit_figures.ParameterRow]:
        return fit_figures.parameter_rows(
            parameters,
            {parameter.name: parameter.scale for parameter in space.parameters},
            {parameter.name: docs.get(parameter.leaf, "") for parameter in space.parameters},
            fitted.known_values,
        )

    accuracies = fit_motions.summarised(motions)
    limits, idle = fit_figures.limit_table(activities)
    return {
        "title": fitted.experiment.name,
        "verdict": sentences.verdict_word(fitted),
        "good": summary["converged"] and fitted.verdict.fits,
        "findings": sentences.findings(fitted, motions, accuracies),
        "technical": f"{summary['goodness']['sentence']} {summary['message']}",
        "requested": _asked(fitted),
        "rows": rows(goodness_report.of_system(summary["parameters"])),
        "capture_rows": rows(goodness_report.of_capture(summary["parameters"])),
        "capture_signs": goodness_report.sentences(fitted),
        "recovered": fit_tables.recovered(summary["parameters"], fitted.known_values)
        if fitted.known_values
        else "",
        "cost": (f"{summary['cost_before']:.6g}", f"{summary['cost']:.6g}"),
        "distances": goodness_report.distance_table(fitted.distances),
        "accuracy": fit_figures.accuracy_table(accuracies),
        "placements": [fit_figures.placement_table(_placements(clip)) for clip in motions],
        "names": [entry.reference.name for entry in fitted.experiment.clips],
        "visible": f"{100 * motions[0].fitted.placement.visible:.2g} cm",
        "missing": missing_table(fitted, activities)[1:],
        "activity": fit_tables.activity_table(activities),
        "limits": limits,
        "idle": idle,
        "remarks": _remarks(fitted),
    }


def _placements(clip: ClipMotions) -> dict[str, Placement]:
    motions = {"flat animation": clip.animated, "before": clip.before}
    motions |= {"fitted": clip.fitted, "captured": clip.captured}
    return {name: motion.placement for name, motion in motions.items()}


def _asked(fitted: Fit) -> Table:
    """What the experiment asks for."""
    experiment = fitted.experiment
    sigmas = fitted.playbacks[0].sigmas
    rows = [
        ["System", pages.system(experiment)],
        ["Free parameters", f"{len(experiment.free)}"],
    ]
    if experiment.capture:
        rows.append(["Of the captures", f"{experiment.free_count - len(experiment.free)}"])
    for number, (clip, entry) in enumerate(zip(fitted.clips, experiment.clips, strict=True), 1):
        frames = clip.reference.frame_count
        rows.append(
            [
                f"Clip {number}" if len(fitted.clips) > 1 else "Clip",
                f"{entry.reference.name}: {frames} frames at {clip.reference.fps:g} Hz, "
                f"{clip.reference.seconds:.1f} s, on {entry.terrain.name}",
            ]
        )
    kinds = [f"{kind} {float(sigmas[kind]):.3g}" for kind in fitted.playbacks[0].fitted_kinds]
    rows.append(["Noise, m and rad", ", ".join(kinds)])
    return [*rows, pages.loss_and_seed(experiment)]


def _remarks(fitted: Fit) -> list[str]:
    """What limits the data of each clip."""
    remarks = list(fitted.check.lines)
    entries = fitted.experiment.clips
    for clip, entry, scene in zip(fitted.clips, entries, fitted.problem.data, strict=True):
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
