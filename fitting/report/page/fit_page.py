"""The page of a fit: `report.html` in its run's folder."""

from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxik
from fitting.analysis import worst_window
from fitting.analysis.limit_activity import ClipActivity
from fitting.analysis.worst_window import WorstWindow
from fitting.datasets.clips import flight
from fitting.report import fit_tables, worst_window_report
from fitting.report.formatting import Table
from fitting.report.identifiability.sections import missing_table
from fitting.runtime.precision import in_float64
from fitting.studies.fit import Fit
from fitting.studies.motions import fit_motions
from fitting.studies.motions.fit_motions import ClipMotions
from fitting.studies.run_folder import PAGE
from jaxik.maths import parameter_tree

from . import figures, motion_data, rendering, sentences


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
        for results in zip(fitted.clips, measured.before, fitted.results, strict=True)
    ]
    windows = [worst_window.find_worst_window(play) for play in fitted.playbacks]
    content = _content(fitted, motions, measured.activities)
    content["worst"] = [
        worst_window_report.describe(play, window, scene.rig.names)
        for play, window, scene in zip(fitted.playbacks, windows, fitted.problem.data, strict=True)
    ]
    data = {"clips": _packed(fitted, motions, windows)}
    rendering.write(run / PAGE, "fit.html", data, **content)


def _packed(
    fitted: Fit, motions: Sequence[ClipMotions], windows: Sequence[WorstWindow]
) -> list[dict[str, Any]]:
    clips = []
    steps = motion_data.steps_between_frames(motions)
    labels = [scene.reference.label for scene in fitted.problem.data]
    for clip, step, label, window in zip(motions, steps, labels, windows, strict=True):
        names = {"animated": "flat animation", "before": "before the fit", "fitted": "fitted"}
        worst = {"start": window.start // step, "end": window.end // step}
        packed = motion_data.pack(clip, step, names | {"captured": label})
        clips.append({"worst": worst, **packed})
    return clips


def _content(
    fitted: Fit, motions: Sequence[ClipMotions], activities: Sequence[ClipActivity]
) -> dict[str, Any]:
    """The variables of the template."""
    summary, space = fitted.summary, fitted.problem.space
    docs = parameter_tree.docs(space.system)
    rows = figures.parameter_rows(
        summary["parameters"],
        {parameter.name: parameter.scale for parameter in space.parameters},
        {parameter.name: docs.get(parameter.leaf, "") for parameter in space.parameters},
        fitted.known_values,
    )
    accuracies = fit_motions.summarised(motions)
    limits, idle = figures.limit_table(activities)
    return {
        "title": fitted.experiment.name,
        "verdict": sentences.verdict_word(fitted),
        "good": summary["converged"] and fitted.verdict.fits,
        "findings": sentences.findings(fitted, motions, accuracies),
        "technical": f"{summary['message']} {summary['goodness']['sentence']}",
        "asked": _asked(fitted),
        "rows": rows,
        "recovered": fit_tables.recovered(summary["parameters"], fitted.known_values)
        if fitted.known_values
        else "",
        "cost": (f"{summary['cost_before']:.6g}", f"{summary['cost']:.6g}"),
        "accuracy": figures.accuracy_table(accuracies),
        "placements": [figures.placement_table(clip) for clip in motions],
        "names": [entry.reference.name for entry in fitted.experiment.clips],
        "visible": f"{100 * motions[0].fitted.placement.visible:.2g} cm",
        "missing": missing_table(fitted, activities)[1:],
        "activity": fit_tables.activity_table(activities),
        "limits": limits,
        "idle": idle,
        "remarks": _remarks(fitted),
        "version": metadata.version("jaxik"),
    }


def _asked(fitted: Fit) -> Table:
    """What the experiment asks for."""
    experiment = fitted.experiment
    rules = [f"{stage} by {rule}" for stage, rule in experiment.rules.items()]
    preset = experiment.preset + (", faithful to its original" if experiment.faithful else "")
    sigmas = fitted.playbacks[0].sigmas
    rows = [
        ["System", ", ".join([preset, *rules])],
        ["Free parameters", f"{len(experiment.free)}"],
    ]
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
    rows.append(["Loss and seed", f"{experiment.loss}, {experiment.seed}"])
    return rows


def _remarks(fitted: Fit) -> list[str]:
    """What limits the data of each clip."""
    remarks = []
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
