"""The job of a fit, and its checkpoints."""

from contextlib import nullcontext
from pathlib import Path

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import load, remarks
from fitting.experiment.record_files import left_out
from fitting.inference.optimise.checkpoints import Checkpoints
from fitting.problem.problem import Problem
from fitting.report import style
from fitting.report.document import Section
from fitting.report.formatting import joined
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies.output import log_output, output_folder

from . import capture_check, fit_report, record_price, run_folder
from .assess import assess_solution, search_identity, search_with_noise
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
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
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
        price = record_price.measure(fitted)
    except KeyboardInterrupt:  # the fit is finished: its report must be written
        price = None
    return [record_price.section(experiment, price)]


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
