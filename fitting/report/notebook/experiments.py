"""What notebooks show of an experiment: its clips and what is free."""

import jaxik
from fitting.experiments.experiment import Experiment
from fitting.report.formatting import Table, interval, number
from fitting.runtime.display import notebook
from jaxik.maths import parameter_tree

from . import parts


@notebook.html.register
def experiment_html(experiment: Experiment) -> str:
    """Tables of the clips, and of the free parameters with their ranges."""
    preset = f"{experiment.preset}{' (faithful)' if experiment.faithful else ''}"
    system = f"preset {preset}" if experiment.system is None else "a system in memory"
    rules = [f"{stage} by {rule}" for stage, rule in experiment.rules.items()]
    lines = [", ".join([system, *rules]) + "."]
    if _rig(experiment) is None and experiment.system is None and experiment.body == "clip":
        lines.append("Numbers are for an adult; a fit scales them to the body of its first clip.")
    return parts.page(
        f"Experiment: {experiment.name}",
        parts.sentences(lines),
        parts.table(_clips(experiment)),
        parts.table(_free(experiment)),
    )


def _clips(experiment: Experiment) -> Table:
    rows = [["captured motion", "flat animation", "terrain", "from", "to"]]
    for entry in experiment.clips:
        base = "made of the captured motion" if entry.base is None else entry.base.name
        end = "its end" if entry.end is None else f"{number(entry.end)} s"
        rows.append(
            [entry.reference.name, base, entry.terrain.name, f"{number(entry.start)} s", end]
        )
    return rows


def _rig(experiment: Experiment) -> jaxik.Rig | None:
    """Of the first clip, if that is in memory."""
    loaded = experiment.clips[0].loaded
    return None if loaded is None else loaded.reference.rig


def _free(experiment: Experiment) -> Table:
    rig = _rig(experiment)
    ik = experiment.starting_system(rig)
    shown = experiment.with_capture(ik)
    declared = parameter_tree.declarations(shown)
    rows = [["free parameter", "value", "unit", "range", "meaning"]]
    for free in experiment.free_parameters(ik, rig):
        meaning = declared[free.leaf]
        value = parameter_tree.shown(shown, free.leaf)
        rows.append([free.name, value, meaning.unit, interval(free.low, free.high), meaning.doc])
    return rows
