"""The job of a fit, and its checkpoints."""

import dataclasses
import math
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path

import numpy as np

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import load, remarks
from fitting.experiment.record_files import left_out, set_aside
from fitting.inference.optimise.checkpoints import Checkpoints
from fitting.motion import goodness, playback
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.space import Vector
from fitting.report import style
from fitting.report.document import Block, Grid, Section, Text
from fitting.report.formatting import RESIDUALS, Table, joined, number
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies.output import as_experiment, log_output, output_folder

from . import capture_check, fit_report, run_folder
from .assess import assess_solution, search, search_identity, search_with_noise
from .fit import Fit
from .fit_motions import WarmUp

INTERRUPTED = "interrupted; assessing and writing the best point so far"


@in_float64
def fit(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
    *,
    report: bool = True,
) -> Fit:
    """Fits the free parameters of an experiment to its clips.

    KeyboardInterrupt (Ctrl-C) ends the search; the best point so far is assessed, written and
    returned as any other fit, with `solution.interrupted` set. Called again with the same folder,
    an interrupted or killed fit goes on, to the same result as in one go.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the run.
        report: whether the folder gets tables, pictures and a page beside the numbers.

    Raises:
        ValueError: the experiment is wrong or does not fit its clips or its preset, or the folder
            cannot be made.
    """
    experiment = as_experiment(experiment)
    with output_folder(output) as run:
        loaded = load(with_files(experiment, run))
        experiment, clips, problem, known = loaded
        what = f"{len(experiment.free) or 'no'} parameters of {experiment.preset}"
        if of_captures := experiment.free_count - len(experiment.free):
            what += f" and {of_captures} of the capture"
        heading = f"fitting {what} to {len(clips)} clip(s)"
        lines = [heading, *remarks(clips), *capture_check.check(clips).lines]
        activity.log("\n".join(lines))
        activity.report(loaded)
        checkpoints = open_checkpoints(run, experiment, problem)
        warm_up = WarmUp(problem) if run is not None and report else None
        with checkpoints:
            with nullcontext() if warm_up is None else activity.watched_by(warm_up):
                problem, solution = search_with_noise(problem, experiment)
            if solution.interrupted:
                activity.log(INTERRUPTED)
            if run is not None and report:
                style.prepare_saving()
            fitted = assess_solution(
                experiment, problem, solution, known_values=known, run=run, clips=clips
            )
            if run is not None:
                run_folder.save_fit(run, fitted)
            opening = _price_of_record(fitted)
        if run is not None and report:
            fit_report.write_fit(run, fitted, opening, warm_up=warm_up)
        if not fitted.solution.interrupted:
            checkpoints.remove()
        activity.log(joined(["", fit_report.fit_text(fitted, opening)]))
        log_output(run, run_folder.SUMMARY)
        return fitted


def _price_of_record(fitted: Fit) -> list[Section]:
    """What it costs to fit only what the record holds."""
    experiment = fitted.experiment
    if not (experiment.record_only and experiment.free):
        return []
    if (names := left_out(experiment)) and not fitted.solution.interrupted:
        activity.log(f"what the record costs: a search in which {', '.join(names)} are free, too")
    try:
        price = measure_record_price(fitted)
    except KeyboardInterrupt:  # the fit is finished: its report must be written
        price = None
    return [record_price_section(experiment, price)]


def open_checkpoints(
    run: Path | None, experiment: Experiment, problem: Problem[jaxik.FootIK]
) -> Checkpoints:
    """The finished stages of a fit that was killed in this folder, and room for those of this."""
    checkpoints = Checkpoints(run, run_folder.SEARCH, search_identity(problem, experiment))
    if checkpoints.count:
        stages = f"{checkpoints.count} stages of its search"
        if checkpoints.profile_count:
            stages += f" and {checkpoints.profile_count} of its profiles"
        activity.log(f"a fit that was interrupted here goes on after {stages}")
    return checkpoints


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
def measure_record_price(fitted: Fit) -> RecordPrice | None:
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
    before, after = _rms_errors(fitted.problem, fitted.solution.u), _rms_errors(problem, freed.u)
    errors = {kind: (before[kind], after[kind]) for kind in before}
    return RecordPrice(tuple(names), fitted.solution.cost, freed.cost, errors)


def _rms_errors(problem: Problem[jaxik.FootIK], u: Vector) -> dict[str, float]:
    """Root mean square of the errors by kind at a point, over all clips."""
    squares: dict[str, list[np.ndarray]] = {}
    for play in playback.play_all(*system_and_scenes(problem, u)):
        for kind in play.fitted_kinds:
            in_sigmas, _, counts = goodness.series(play, kind)
            sizes = in_sigmas[counts] * float(play.sigmas[kind])
            squares.setdefault(kind, []).append(sizes**2)
    return {kind: math.sqrt(np.concatenate(parts).mean()) for kind, parts in squares.items()}


def record_price_section(experiment: Experiment, price: RecordPrice | None) -> Section:
    """What the report says of the price."""
    blocks: list[Block] = [Text(_record_price_sentence(experiment, price), brief=True)]
    if price is not None:
        blocks.append(Grid(_record_price_table(price), "Errors with and without the restriction"))
    return Section("What the record costs", blocks)


def _record_price_sentence(experiment: Experiment, price: RecordPrice | None) -> str:
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


def _record_price_table(price: RecordPrice) -> Table:
    table = [["error, rms", "record only", "all free"]]
    for kind, sizes in price.errors.items():
        name, unit, factor = RESIDUALS[kind]
        table.append([name, *(f"{number(factor * size)} {unit}" for size in sizes)])
    return table
