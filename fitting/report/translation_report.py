"""What is read after a translation: numbers, a picture, and its sections of the run's summary."""

import json
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fitting.analysis import difference, playback
from fitting.analysis.difference import Difference
from fitting.experiments import parameter_files, systems
from fitting.inference import sensitivity
from fitting.runtime import files
from fitting.studies.study import Fit
from fitting.studies.translation import Translation
from jaxik.maths import parameter_tree

from . import difference_report, fit_report, formatting
from .plots import style
from .plots.difference_plots import difference as draw

NUMBERS = "translation.json"


def write(run: Path, made: Translation, fitted: Fit) -> str:
    """Writes parameters, numbers, pictures and summary of a translation; what to print of it."""
    found = [
        difference.measure(scene, playback.run(fitted.ik, scene)) for scene in fitted.problem.data
    ]
    told = {
        "source": made.source.name,
        "target": made.target.name,
        "reproduced": difference_report.numbers(found),
        "clips": [difference_report.numbers([one]) for one in found],
        "shortcomings": difference_report.shortcomings(found, made.source.name, made.target.name),
    }
    files.write_text(run / NUMBERS, json.dumps(told, indent=2))
    text = parameter_files.system_to_toml(fitted.ik, made.target.preset)
    files.write_text(run / f"{made.target.preset}.toml", text)
    opening = _opening(made, fitted, found) + [_pictures(run, made, found)]
    fit_report.write_fit(run, fitted, opening, _both(made, fitted))
    phases = difference.summarise(found)
    parts = [difference_report.headline(phases["all frames"], made.source.name, made.target.name)]
    for phase, row in phases.items():
        aligned = formatting.aligned(difference_report.table(row, made.source.name))
        parts += ["", f"{phase.capitalize()}:", aligned]
    return "\n".join([*parts, "", *told["shortcomings"]])


def _pictures(run: Path, made: Translation, found: Sequence[Difference]) -> str:
    """Draws what remains of each clip; the pictures as Markdown."""
    lines = []
    for i, one in enumerate(found):
        several = len(found) > 1
        name = f"difference_{i + 1}.png" if several else "difference.png"
        clip = f", clip {i + 1}" if several else ""
        title = f"{made.experiment.name}{clip}: what remains"
        style.save(run / name, draw(one, made.source.name, made.target.name, title))
        lines.append(f"![{title}]({name})")
    return "\n\n".join(lines)


def _opening(made: Translation, fitted: Fit, found: Sequence[Difference]) -> list[str]:
    """The first section of the summary: how close it came, and what it could not do."""
    source, target = made.names
    phases = difference.summarise(found)
    parts = [
        f"## How much of {source} {target} reproduces",
        difference_report.headline(phases["all frames"], source, target),
        "Reproduced is 1 - rms(what remains) / rms(source - animation): 100 % is the same motion, "
        "0 % no better than the animation, less is worse; – where the source corrects nothing.",
    ]
    for phase, row in phases.items():
        parts += [
            f"{phase.capitalize()}:",
            formatting.markdown(difference_report.table(row, source)),
        ]
    if said := difference_report.shortcomings(found, source, target):
        parts += [f"What {target} does not do as {source} does:", _listed(said)]
    pairs = zip(fitted.identifiability.names, fitted.identifiability.at_bound, strict=True)
    if ends := [f"`{name}`" for name, end in pairs if end]:
        parts.append(f"At an end of their range, which may be too narrow: {', '.join(ends)}.")
    still = [n for n in sensitivity.declared(made.target.ik) if n not in made.experiment.free]
    kept = ", ".join(f"`{name}`" for name in still) or "none"
    why = "as asked" if made.chosen else "as they move nothing in these clips"
    parts.append(
        f"Parameters of {target} that kept their values, {why}: {kept}. The source is without "
        "noise; the sigmas of the fit (5 mm, 0.03 rad) say how far off still counts as the same, "
        "and so does what is called determined below."
    )
    return parts


def _both(made: Translation, fitted: Fit) -> list[str]:
    """The section that puts all values of both systems side by side."""
    source, target = made.names
    iks = made.source.ik, fitted.ik
    leaves = [systems.leaf_names(ik) for ik in iks]
    declared = [parameter_tree.declarations(ik) for ik in iks]
    table = [["parameter", "unit", source, f"{target}, fitted", "remarks"]]
    free_leaves = {name.partition("[")[0] for name in made.experiment.free}
    for name in dict.fromkeys([*leaves[0], *leaves[1]]):
        units = [one[name].unit for one in declared if name in one]
        shown = [
            _shown(parameter_tree.get(ik, name)) if name in there else "–"
            for ik, there in zip(iks, leaves, strict=True)
        ]
        stage = name.partition(".")[0]
        rules = {type(getattr(ik, stage)) for ik in iks}
        remarks = ["fitted"] if name in free_leaves else []
        remarks += ["of another rule"] if "–" not in shown and len(rules) > 1 else []
        table.append([f"`{name}`", units[0] if units else "", *shown, ", ".join(remarks)])
    return ["## Parameters of both systems", formatting.markdown(table)]


def _shown(value: jnp.ndarray) -> str:
    """A parameter's values, a switch's word."""
    one = np.asarray(value)
    words = {"b": lambda x: "on" if x else "off", "f": lambda x: formatting.number(float(x))}
    show = words.get(one.dtype.kind, str)
    return ", ".join(show(x) for x in one.ravel())


def _listed(lines: Sequence[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)
