"""The report of a translation: numbers, a plot, and its sections of the run's summary.md."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array

from fitting.analysis import difference
from fitting.analysis.difference import Difference
from fitting.experiments import parameter_files, systems
from fitting.inference import sensitivity
from fitting.runtime import files
from fitting.runtime.precision import in_float64
from fitting.runtime.storage.json_files import write_json
from fitting.studies.fit import Fit
from fitting.studies.translation import Translation
from jaxik.maths import parameter_tree

from . import difference_report, fit_report
from .formatting import aligned, bullets, joined, markdown, number
from .plots import difference_plots, style

NUMBERS = "translation.json"


@in_float64
def differences(fitted: Fit) -> list[Difference]:
    """What remains of the source's correction, for each clip."""
    return [
        difference.measure(scene, result)
        for scene, result in zip(fitted.problem.data, fitted.results, strict=True)
    ]


def translation_text(translation: Translation, clips: Sequence[Difference]) -> str:
    """The result of a translation, for the terminal."""
    source, target = translation.source.name, translation.target.name
    phases = difference.summarise(clips)
    parts = [difference_report.headline(phases["all frames"], source, target)]
    for phase, remainders in phases.items():
        parts += ["", f"{phase.capitalize()}:"]
        parts.append(aligned(difference_report.table(remainders, source)))
    return joined([*parts, "", *difference_report.shortcomings(clips, source, target)])


@in_float64
def write(run: Path, translation: Translation, fitted: Fit, clips: Sequence[Difference]) -> None:
    """Writes parameters, numbers, plots and summary of a translation into the folder of its run."""
    source, target = translation.source, translation.target
    numbers = {
        "source": source.name,
        "target": target.name,
        "reproduced": difference_report.numbers(clips),
        "clips": [difference_report.numbers([clip]) for clip in clips],
        "shortcomings": difference_report.shortcomings(clips, source.name, target.name),
    }
    write_json(run / NUMBERS, numbers)
    parameters = parameter_files.system_to_toml(fitted.ik, target.preset)
    files.write_text(run / f"{target.preset.name}.toml", parameters)
    opening = [*_opening(translation, fitted, clips), _plots(run, translation, clips)]
    fit_report.write_fit(run, fitted, opening, _parameters_of_both(translation, fitted))


def _plots(run: Path, translation: Translation, clips: Sequence[Difference]) -> str:
    """Draws what remains of each clip; returns the plots as Markdown."""
    source, target = translation.source.name, translation.target.name
    lines = []
    for number_of_clip, clip in enumerate(clips, 1):
        several = len(clips) > 1
        name = f"difference_{number_of_clip}.png" if several else "difference.png"
        subject = f", clip {number_of_clip}" if several else ""
        title = f"{translation.experiment.name}{subject}: what remains"
        style.save(run / name, difference_plots.difference(clip, source, target, title))
        lines.append(f"![{title}]({name})")
    return "\n\n".join(lines)


def _opening(translation: Translation, fitted: Fit, clips: Sequence[Difference]) -> list[str]:
    """The first section of the summary: how close the fit is, and what it cannot do."""
    source, target = translation.names
    phases = difference.summarise(clips)
    parts = [
        f"## How much of {source} {target} reproduces",
        difference_report.headline(phases["all frames"], source, target),
        "Reproduced is 1 - rms(what remains) / rms(source - animation): 100 % is the same motion, "
        "0 % is no better than the animation, and negative is worse; – where the source corrects "
        "nothing.",
    ]
    for phase, remainders in phases.items():
        table = difference_report.table(remainders, source)
        parts += [f"{phase.capitalize()}:", markdown(table)]
    if shortcomings := difference_report.shortcomings(clips, source, target):
        parts += [f"What {target} does not do as {source} does:", bullets(shortcomings)]
    ends = zip(fitted.identifiability.names, fitted.identifiability.at_bound, strict=True)
    if at_bound := [f"`{name}`" for name, end in ends if end]:
        parts.append(f"At an end of their range, which may be too narrow: {', '.join(at_bound)}.")
    free = translation.experiment.free
    fixed = [f"`{n}`" for n in sensitivity.all_parameters(translation.target.ik) if n not in free]
    reason = (
        "as requested" if translation.free_was_chosen else "as they move nothing in these clips"
    )
    parts.append(
        f"Parameters of {target} that kept their values, {reason}: {', '.join(fixed) or 'none'}. "
        "The source has no noise; the sigmas of the fit (5 mm, 0.03 rad) say how far apart still "
        "counts as the same, and so decide what is called determined below."
    )
    return parts


def _parameters_of_both(translation: Translation, fitted: Fit) -> list[str]:
    """The section with the values of both systems side by side."""
    source, target = translation.names
    iks = translation.source.ik, fitted.ik
    leaves = [systems.leaf_names(ik) for ik in iks]
    declarations = [parameter_tree.declarations(ik) for ik in iks]
    table = [["parameter", "unit", source, f"{target}, fitted", "remarks"]]
    free_leaves = {name.partition("[")[0] for name in translation.experiment.free}
    for name in dict.fromkeys([*leaves[0], *leaves[1]]):
        units = [declared[name].unit for declared in declarations if name in declared]
        values = [
            _value_text(parameter_tree.get(ik, name)) if name in own else "–"
            for ik, own in zip(iks, leaves, strict=True)
        ]
        stage = name.partition(".")[0]
        rules = {type(getattr(ik, stage)) for ik in iks}
        remarks = ["fitted"] if name in free_leaves else []
        remarks += ["of another rule"] if "–" not in values and len(rules) > 1 else []
        table.append([f"`{name}`", units[0] if units else "", *values, ", ".join(remarks)])
    return ["## Parameters of both systems", markdown(table)]


def _value_text(value: Array) -> str:
    """The values of a parameter, or the state of a switch."""
    array = np.asarray(value)
    formats = {"b": lambda x: "on" if x else "off", "f": lambda x: number(float(x))}
    return ", ".join(formats.get(array.dtype.kind, str)(x) for x in array.ravel())
