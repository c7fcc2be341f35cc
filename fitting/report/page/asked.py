"""What an experiment asks for, in words."""

from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.report.formatting import Table


def system(experiment: Experiment) -> str:
    """Its preset, with rules that are not the preset's."""
    rules = [f"{stage} by {rule}" for stage, rule in experiment.rules.items()]
    preset = experiment.preset + (", faithful to its original" if experiment.faithful else "")
    return ", ".join([preset, *rules])


def loss_and_seed(experiment: Experiment) -> list[str]:
    """A row with what else decides a fit."""
    return ["Loss and seed", f"{experiment.loss}, {experiment.seed}"]


def rows(experiment: Experiment) -> Table:
    """A name and a text each: the system, what is free, the clips, the loss."""
    free = ", ".join(f"`{name}`" for name in experiment.free) or "none"
    table = [
        ["System", system(experiment)],
        [f"Free parameters ({len(experiment.free)})", free],
    ]
    if experiment.capture:
        of_capture = ", ".join(f"`{name}`" for name in experiment.capture)
        table.append([f"Of the captures ({len(experiment.capture)})", of_capture])
    for number, entry in enumerate(experiment.clips, 1):
        heading = f"Clip {number}" if len(experiment.clips) > 1 else "Clip"
        table.append([heading, _clip(entry)])
    return [*table, loss_and_seed(experiment)]


def _clip(entry: ClipEntry) -> str:
    text = f"{entry.reference.name} on {entry.terrain.name}"
    if entry.start or entry.end is not None:
        end = "the end" if entry.end is None else f"{entry.end:g} s"
        text += f", from {entry.start:g} s to {end}"
    base = "made from it" if entry.base is None else entry.base.name
    subject = "" if entry.subject is None else f"; subject {entry.subject}"
    return f"{text}; flat animation {base}{subject}"
