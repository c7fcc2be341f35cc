"""Jobs that search: a fit, its posterior, and translations between systems."""

import dataclasses
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import ClipData, load, load_known_values, remarks
from fitting.experiment.record_files import left_out
from fitting.inference.noise import NoiseModel, with_noise
from fitting.inference.optimise.checkpoints import Checkpoints
from fitting.inference.optimise.solution import Solution
from fitting.inference.sample.posterior import Posterior
from fitting.problem.problem import Problem
from fitting.report import style
from fitting.report.document import Section, brief
from fitting.report.formatting import joined
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies import translation
from fitting.studies.output import log_output, output_folder
from fitting.studies.sample import posterior_report
from fitting.studies.sample.replay import replay
from fitting.studies.sample.sample import SampledFit, minus_cost_at, sample_around, shown_noise
from fitting.studies.translation import TranslationRequest

from . import capture_check, fit_report, record_price, run_folder
from .assess import assess_solution, search, search_identity, search_with_noise
from .fit import Fit
from .fit_motions import Rehearsal

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
        rehearsal = Rehearsal(problem) if run is not None and report else None
        with checkpoints:
            with nullcontext() if rehearsal is None else activity.watched_by(rehearsal):
                problem, solution = search_with_noise(problem, experiment)
            if solution.interrupted:
                activity.log(INTERRUPTED)
            if run is not None and report:
                style.prepare_saving()
            save = _saving(run, experiment, problem)
            fitted = assess_solution(
                experiment, problem, solution, save,
                known_values=known, run=run, clips=clips,
            )  # fmt: skip
            if run is not None:
                run_folder.save_fit(run, fitted)
            opening = _price_of_record(fitted)
        if run is not None and report:
            fit_report.write_fit(run, fitted, opening, rehearsal=rehearsal)
        if not fitted.solution.interrupted:
            checkpoints.remove()
        activity.log(joined(["", fit_report.fit_text(fitted, opening)]))
        log_output(run, run_folder.SUMMARY)
        return fitted


@in_float64
def sample(
    fitted: Fit | str | Path,
    *,
    max_steps: int | None = None,
) -> Posterior:
    """Samples the posterior around a fit; a fit with a folder has its chain and report there.

    A chain that is there is continued. KeyboardInterrupt (Ctrl-C) ends the sampling; the chain so
    far is summarised, written and returned with `interrupted` set. Where a chain meets a point that
    is better than the fit of a folder, the fit goes on from there and takes the old one's place.

    Args:
        fitted: a fit, or the folder of its run.
        max_steps: limit to the steps of the sampler over all calls, instead of the experiment's.

    Raises:
        ValueError: the folder holds no fit, or its experiment does not fit its clips any more.
    """
    if isinstance(fitted, Fit):
        run, experiment, problem = fitted.run, fitted.experiment, fitted.problem
        parameters, known_values = fitted.summary["parameters"], fitted.known_values
        clips = fitted.clips
    else:
        run = Path(fitted)
        experiment, summary = run_folder.load_fit(run)
        parameters = summary["parameters"]
        experiment, clips, problem, known_values = load(experiment)
        if "noise" in summary:
            problem = with_noise(problem, NoiseModel(**summary["noise"]))
    if max_steps is not None:
        experiment = experiment.with_max_sample_steps(max_steps)
    with output_folder(run):
        chain = None if run is None else run / run_folder.CHAIN
        posterior = sample_around(parameters, problem, experiment, chain)
        if posterior.interrupted:
            activity.log("interrupted; summarising and writing the chain so far")
        played = None
        try:
            if not posterior.interrupted:
                u = np.array([row["u"] for row in parameters])
                played = replay(shown_noise(problem, experiment, u), posterior, experiment.seed)
                posterior = dataclasses.replace(posterior, blocks=played.blocks)
        except KeyboardInterrupt:
            posterior = dataclasses.replace(posterior, interrupted=True)
        sampled = SampledFit(experiment, problem.space, parameters, posterior, known_values, played)
        written = ""
        if run is not None:
            written = _save_and_report(run, sampled)
            if sampled.has_lower_point and not posterior.interrupted:
                sampled = _adopt_lower_point(run, problem, clips, sampled)
                posterior = sampled.posterior
        activity.log(joined(["", posterior_report.posterior_text(sampled, run)]))
        log_output(run, written)
        return posterior


@in_float64
def translate(
    request: TranslationRequest,
    output: str | Path | None = None,
) -> Fit:
    """Fits the parameters of one system to the motion of another.

    KeyboardInterrupt (Ctrl-C) ends the search, and a second call with the same folder goes on, as
    in `fit`. The folder is a run: `sample` and `apply` take it.

    Args:
        request: which system is fitted to which, and on what.
        output: a new folder for the run, or that of a translation that was killed or interrupted.

    Raises:
        ValueError: as `studies.translation.prepare`, or the folder holds something already.
    """
    run = None if output is None else Path(output)
    if run is not None:
        translation.check_folder(run)
    with output_folder(run):
        prepared = translation.prepare(request, Path() if run is None else run)
        experiment, problem = prepared.experiment, prepared.problem
        activity.log(
            f"fitting {len(experiment.free)} parameters of {request.target.name} to "
            f"{request.source.name} on {len(prepared.clips)} clip(s)"
        )
        start = translation.starting_point(problem)
        checkpoints = open_checkpoints(run, experiment, problem)
        with checkpoints:
            solution = search(problem, experiment, start)
            if solution.interrupted:
                activity.log(INTERRUPTED)
            known = None
            if run is not None:
                translation.save_source(run, prepared)
                known = load_known_values(experiment, problem.space.system)
            save = _saving(run, experiment, problem)
            fitted = assess_solution(
                experiment, problem, solution, save,
                known_values=known, run=run, has_noise=False, clips=prepared.clips,
            )  # fmt: skip
            if run is not None:
                run_folder.save_fit(run, fitted)
        differences = translation.differences(fitted)
        if run is not None:
            translation.write(run, prepared, fitted, differences)
        if not fitted.solution.interrupted:
            checkpoints.remove()
        activity.log(f"\n{solution.message} {fitted.verdict.sentence}\n")
        activity.log(brief([translation.opening(prepared, fitted, differences)]))
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


def _save_and_report(run: Path, sampled: SampledFit) -> str:
    """The name of the file to read."""
    run_folder.save_posterior(run, sampled)
    return posterior_report.write_posterior(run, sampled)


def _adopt_lower_point(
    run: Path,
    problem: Problem[jaxik.FootIK],
    clips: tuple[ClipData, ...],
    sampled: SampledFit,
) -> SampledFit:
    """The chain with a fit that went on from its best point, which takes the run's old fit's place.

    The old fit stays until the new one is finished; that of a translation stays in any case, and
    so does a fit that is not better by the chain's own account.
    """
    experiment, posterior = sampled.experiment, sampled.posterior
    if translation.is_translation(run):
        return sampled
    activity.log(
        f"the chain met a point whose cost is {posterior.improvement:.3g} lower than the fit's; "
        "the fit goes on from there"
    )
    try:
        first = np.asarray(problem.space.pack(posterior.best_values))
        solution = search(problem, experiment, first=first)
        at_solution = minus_cost_at(problem, experiment, solution.u)
        if solution.interrupted or at_solution <= posterior.start_minus_cost:
            return sampled
        known = sampled.known_values
        fitted = assess_solution(
            experiment, problem, solution, known_values=known, run=run, clips=clips
        )
    except KeyboardInterrupt:
        return sampled
    at_solution = minus_cost_at(problem, experiment, fitted.solution.u)
    run_folder.save_solution(run, experiment, problem, fitted.solution)
    run_folder.save_fit(run, fitted)
    fit_report.write_fit(run, fitted)
    activity.log(joined(["", fit_report.fit_text(fitted)]))
    sampled = dataclasses.replace(
        sampled,
        parameters=fitted.summary["parameters"],
        posterior=dataclasses.replace(posterior, start_minus_cost=at_solution),
    )
    _save_and_report(run, sampled)
    return sampled


def _saving(
    run: Path | None, experiment: Experiment, problem: Problem[jaxik.FootIK]
) -> Callable[[Solution], None]:
    """Writes each solution before its assessment, which may fail."""

    def save(solution: Solution) -> None:
        if run is not None:
            run_folder.save_solution(run, experiment, problem, solution)

    return save


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
