"""Whole jobs, from files to a folder with results and a report: what the command line runs.

Each job checks everything the user gave before it computes anything, writes its results as soon as
they exist, and draws its report last. Without an `output` nothing is written. `progress` is called
with reports of a running search or sampling; `log` with lines and tables as the command line prints
them, so `log=print` shows the same.

Jobs compute in 64 bits, whatever JAX is set to, and leave that setting alone. Their arrays keep 64
bits; a system that was made in 32 bits is taken with the values it has there.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TypeAlias

import numpy as np

import jaxik
from fitting.analysis import accuracy
from fitting.datasets.clips import Clip, load_clip, save_clip
from fitting.datasets.clips.formats.npz import check_clip_file, is_blocks_file
from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.known_values import load_known_values
from fitting.experiments.parameter_files import load_system
from fitting.experiments.problems import make_problem
from fitting.inference.identifiability import assess_identifiability
from fitting.inference.optimisation.solution import Progress, Solution
from fitting.inference.sampling.posterior import Posterior, SamplingProgress
from fitting.problem.problem import Problem
from fitting.report import (
    ablation_report,
    comparison_report,
    fit_report,
    fit_tables,
    placement_report,
    posterior_report,
    translation_report,
)
from fitting.report.formatting import aligned
from fitting.runtime.precision import in_float64, with_floats
from fitting.studies import ablation, comparison, run_folder, translation
from fitting.studies.animations import AnimationFiles, load_animation
from fitting.studies.comparison import Comparison
from fitting.studies.fit import Fit, search
from fitting.studies.sample import sample_around
from fitting.studies.translation import TranslationRequest

Log: TypeAlias = Callable[[str], object]


def _silent(text: str) -> None:
    """Drops a line of the log."""


@in_float64
def fit(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
    *,
    progress: Callable[[Progress], None] | None = None,
    log: Log = _silent,
) -> Fit:
    """Fits the free parameters of an experiment to its clips.

    KeyboardInterrupt (Ctrl-C) ends the search; the best point so far is assessed, written and
    returned as any other fit, with `solution.interrupted` set.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the run.
        progress: called as the search goes on.
        log: called with what the command line prints.

    Raises:
        ValueError: the experiment is wrong or does not fit its clips or its preset, or the folder
            cannot be made.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    known_values = load_known_values(experiment)
    run = _checked(output)
    roots: list[str] = []
    problem = make_problem(experiment, roots.append)
    free, preset = len(experiment.free), experiment.preset
    log("\n".join([f"fitting {free} parameters of {preset} to {len(roots)} clip(s)", *roots]))
    solution = search(problem, experiment, progress)
    fitted = _assess_and_save(run, experiment, problem, solution, known_values)
    if run is not None:
        fit_report.write_fit(run, fitted)
    log(f"\n{fit_report.fit_text(fitted)}")
    _log_output(log, run, run_folder.SUMMARY)
    return fitted


@in_float64
def sample(
    fitted: Fit | str | Path,
    *,
    max_steps: int | None = None,
    progress: Callable[[SamplingProgress], None] | None = None,
    log: Log = _silent,
) -> Posterior:
    """Samples the posterior around a fit; a fit with a folder has its chain and report there.

    A chain that is there is continued. KeyboardInterrupt (Ctrl-C) ends the sampling; the chain so
    far is summarised, written and returned with `interrupted` set.

    Args:
        fitted: a fit, or the folder of its run.
        max_steps: limit to the steps of the sampler over all calls, instead of the experiment's.
        progress: called as the sampling goes on.
        log: called with what the command line prints.

    Raises:
        ValueError: the folder holds no fit, or its experiment does not fit its clips any more.
    """
    if isinstance(fitted, Fit):
        run, experiment, problem = fitted.run, fitted.experiment, fitted.problem
        parameters, known_values = fitted.summary["parameters"], fitted.known_values
    else:
        run = Path(fitted)
        experiment, summary = run_folder.load_fit(run)
        parameters, known_values = summary["parameters"], load_known_values(experiment)
        problem = make_problem(experiment)
    if max_steps is not None:
        experiment = experiment.with_max_sample_steps(max_steps)
    chain = None if run is None else run / run_folder.CHAIN
    posterior = sample_around(parameters, problem, experiment, chain, progress)
    if run is not None:
        run_folder.save_posterior(run, posterior)
        posterior_report.write_posterior(run, experiment, posterior, parameters, known_values)
    log(f"\n{posterior_report.posterior_text(posterior, known_values)}")
    _log_output(log, run, run_folder.SUMMARY)
    return posterior


@in_float64
def ablate(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
    *,
    folds: int = 2,
    progress: Callable[[Progress], None] | None = None,
    log: Log = _silent,
) -> list[ablation.Row]:
    """Fits an experiment as it is and without each of its rules, cross-validated.

    What is left out stands in the experiment's [[without]] tables. Each finished fit is written at
    once, and a call with the same folder continues where an interrupted one ended.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the fits and the report.
        folds: number of parts into which each clip is cut.
        progress: called as a fit goes on; its stage names the variant and the part.
        log: called with what the command line prints.

    Raises:
        ValueError: as `studies.ablation.ablate`, or the folder cannot be made.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    folder = _checked(output)

    def log_row(row: ablation.Row) -> None:
        log(ablation_report.row_text(row))

    rows = ablation.ablate(experiment, folder, folds=folds, progress=progress, on_row=log_row)
    if folder is not None:
        ablation_report.write(folder, experiment, rows)
    log(ablation_report.tables_text(rows))
    _log_output(log, folder, ablation_report.TABLE)
    return rows


@in_float64
def compare(
    systems: Mapping[str, jaxik.FootIK],
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    during: Callable[[str], AbstractContextManager] = nullcontext,
    log: Log = _silent,
) -> Comparison:
    """Runs several systems on a flat animation and measures them side by side; warns as `solve`.

    Args:
        systems: by name.
        animation: the clip, the terrain, and where the root is put for all systems.
        output: folder for the table, the numbers and the figure.
        during: makes a context for the run of each system, from its name.
        log: called with what the command line prints.

    Raises:
        ValueError: a file cannot be read, a system does not fit the clip or gives poses that are
            not finite, or the folder cannot be made.
    """
    folder = _checked(output)
    systems = {name: with_floats(ik, np.float64) for name, ik in systems.items()}
    title = f"{Path(animation.clip).name} on {Path(animation.terrain).name}"
    loaded = load_animation(animation)
    compared = comparison.compare(systems, loaded, title=title, during=during)
    if folder is not None:
        comparison_report.write(folder, compared)
    table = aligned(comparison_report.transposed(comparison_report.table(compared)))
    log(f"{table}\n\nroot: {loaded.root.reason}")
    _log_output(log, folder, comparison_report.TABLE)
    for name, (placement, cause) in compared.placements.items():
        placement_report.warn(placement, cause, name)
    return compared


@in_float64
def translate(
    request: TranslationRequest,
    output: str | Path | None = None,
    *,
    progress: Callable[[Progress], None] | None = None,
    log: Log = _silent,
) -> Fit:
    """Fits the parameters of one system to the motion of another.

    KeyboardInterrupt (Ctrl-C) ends the search, as in `fit`. The folder is a run: `sample` and
    `apply` take it.

    Args:
        request: which system is fitted to which, and on what.
        output: a new folder for the run.
        progress: called as the search goes on.
        log: called with what the command line prints.

    Raises:
        ValueError: as `studies.translation.prepare`, or the folder holds something already.
    """
    run = None if output is None else Path(output)
    if run is not None:
        run_folder.check_new_folder(run)
    prepared = translation.prepare(request, Path() if run is None else run)
    experiment, problem = prepared.experiment, prepared.problem
    log(
        f"fitting {len(experiment.free)} parameters of {request.target.name} to "
        f"{request.source.name} on {len(prepared.motions)} clip(s)"
    )
    start = translation.starting_point(problem)
    solution = search(problem, experiment, progress, start)
    known_values = None
    if run is not None:
        translation.save_source(run, prepared)
        known_values = load_known_values(experiment)
    fitted = _assess_and_save(run, experiment, problem, solution, known_values)
    differences = translation_report.differences(fitted)
    if run is not None:
        translation_report.write(run, prepared, fitted, differences)
    log(f"\n{translation_report.translation_text(prepared, differences)}")
    _log_output(log, run, run_folder.SUMMARY)
    return fitted


@in_float64
def apply(
    run: str | Path,
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    log: Log = _silent,
) -> Clip:
    """Solves a flat animation with the fitted system of a run; see `solve`.

    Raises:
        ValueError: as `solve`, or the folder holds no finished fit.
    """
    run_folder.load_fit(Path(run))
    ik, _ = load_system(Path(run) / run_folder.PARAMETERS)
    return solve(ik, animation, output, log=log)


@in_float64
def solve(
    ik: jaxik.FootIK,
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    log: Log = _silent,
) -> Clip:
    """Solves a flat animation, and measures how its feet are placed on the ground.

    Where a captured motion is known, the log also shows the difference. Feet that are visibly off
    the ground, slide or pop are a warning, with the most likely cause.

    Args:
        ik: the system.
        animation: the clip, the terrain, and where the root is put.
        output: .npz file for the solved clip.
        log: called with what the command line prints.

    Raises:
        ValueError: a file cannot be read or written, or the system does not fit the clip or gives
            poses that are not finite.
    """
    path = None if output is None else Path(output)
    if path is not None:
        check_clip_file(path)
    ik, loaded = with_floats(ik, np.float64), load_animation(animation)
    loaded.check_shapes(ik)
    began = time.perf_counter()
    result, solved = loaded.solve(ik)
    seconds = time.perf_counter() - began
    placement, cause = loaded.assess(solved)
    if path is not None:
        save_clip(path, solved, joints=placement_report.arrays(solved, placement))
    log(placement_report.solved_text(result, seconds, path))
    log(f"root: {loaded.root.reason}\n\n{placement_report.text(placement)}")
    if is_blocks_file(animation.clip):
        errors = accuracy.clip_errors(solved, load_clip(animation.clip), loaded.placed_clip)
        log(f"\n{aligned(fit_tables.accuracy_table(accuracy.summarise([errors])))}")
    placement_report.warn(placement, cause)
    return solved


def _checked(output: str | Path | None) -> Path | None:
    if output is None:
        return None
    run_folder.check_output_folder(Path(output))
    return Path(output)


def _assess_and_save(
    run: Path | None,
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    solution: Solution,
    known_values: Mapping[str, float] | None,
) -> Fit:
    """The fit; its solution is on disk before the assessment, which may fail."""
    if run is not None:
        run_folder.save_solution(run, experiment, problem, solution)
    identifiability = assess_identifiability(problem, solution)
    fitted = Fit(experiment, problem, solution, identifiability, known_values, run)
    if run is not None:
        run_folder.save_fit(run, fitted)
    return fitted


def _log_output(log: Log, folder: Path | None, text: str) -> None:
    if folder is not None:
        log(f"written to {folder}; read {folder / text}")
