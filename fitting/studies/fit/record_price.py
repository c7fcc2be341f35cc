"""What it costs to fit only what the game's record holds."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.record_files import left_out, set_aside
from fitting.motion import goodness, playback
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.space import Vector
from fitting.report.document import Block, Grid, Section, Text
from fitting.report.formatting import RESIDUALS, Table, number
from fitting.runtime.precision import in_float64

from .assess import search
from .fit import Fit


@dataclasses.dataclass(frozen=True)
class RecordPrice:
    """A fit of what the record holds, beside one of all that the experiment would have free."""

    left_out: tuple[str, ...]
    """Free parameters of the experiment that the record has no room for."""
    cost: float
    """Of the fit of what the record holds."""
    whole_cost: float
    """With all of them free; one search from there, so that it is not a lower bound."""
    errors: Mapping[str, tuple[float, float]]
    """Root mean square of both by kind of residual; m, rad, ..."""


@in_float64
def measure(fitted: Fit) -> RecordPrice | None:
    """Fits what the experiment would have free without the restriction, from where its fit ended.

    Returns:
        None if the restriction left nothing out, or if Ctrl-C ended either search.
    """
    names, whole = left_out(fitted.experiment), fitted.experiment.whole
    if not names or whole is None or fitted.solution.interrupted:
        return None
    rig = fitted.problem.data[0].rig
    space = whole.space(whole.starting_system(rig), rig)
    problem = dataclasses.replace(fitted.problem, space=space)
    begin = {**whole.start, **dict(zip(fitted.solution.names, fitted.solution.values, strict=True))}
    options = dataclasses.replace(whole.fit, starts=1)
    settings = dataclasses.replace(whole, fit=options)
    freed = search(problem, settings, np.asarray(space.pack(begin)))
    if freed.interrupted:
        return None
    before, after = _errors(fitted.problem, fitted.solution.u), _errors(problem, freed.u)
    errors = {kind: (before[kind], after[kind]) for kind in before}
    return RecordPrice(tuple(names), fitted.solution.cost, freed.cost, errors)


def _errors(problem: Problem[jaxik.FootIK], u: Vector) -> dict[str, float]:
    """Root mean square of the errors by kind at a point, over all clips."""
    squares: dict[str, list[np.ndarray]] = {}
    for play in playback.play_all(*system_and_scenes(problem, u)):
        for kind in play.fitted_kinds:
            in_sigmas, _, counts = goodness.series(play, kind)
            sizes = in_sigmas[counts] * float(play.sigmas[kind])
            squares.setdefault(kind, []).append(sizes**2)
    return {kind: math.sqrt(np.concatenate(parts).mean()) for kind, parts in squares.items()}


def section(experiment: Experiment, price: RecordPrice | None) -> Section:
    """What the report says of the price."""
    blocks: list[Block] = [Text(_sentence(experiment, price), brief=True)]
    if price is not None:
        blocks.append(Grid(_table(price), "Errors with and without the restriction"))
    return Section("What the record costs", blocks)


def _sentence(experiment: Experiment, price: RecordPrice | None) -> str:
    head = "Only what the 128 bytes of the game's record hold was fitted, "
    names = left_out(experiment)
    head += f"not {', '.join(names)}" if names else "which is all that the experiment has free"
    head += ": `record to-bytes` loses nothing."
    if aside := set_aside(experiment):
        listed = ", ".join(f"{name} is {now}, not {was}" for name, (was, now) in aside.items())
        head += f" Where the experiment fixes what they do not hold, their reader's: {listed}."
    if not names:
        return head
    if price is None:
        return f"{head} What that costs was not measured, as a search was interrupted."
    return (
        f"{head} The cost is {price.cost:.6g}; with these free, too, a search from there ends "
        f"at {price.whole_cost:.6g}."
    )


def _table(price: RecordPrice) -> Table:
    table = [["error, rms", "record only", "all free"]]
    for kind, sizes in price.errors.items():
        name, unit, factor = RESIDUALS[kind]
        table.append([name, *(f"{number(factor * size)} {unit}" for size in sizes)])
    return table
