"""What each word of the command line does."""

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import jaxik
from fitting.analysis import accuracy
from fitting.bench import measure as bench
from fitting.bench import report as bench_report
from fitting.bench import tasks as bench_tasks
from fitting.datasets import clip_frames, clips
from fitting.datasets.clips import summary
from fitting.datasets.clips.formats.npz import is_blocks_file
from fitting.datasets.flat_animation import load_flat_animation
from fitting.datasets.terrain import mesh_files
from fitting.datasets.terrain.reconstruction import reconstruct
from fitting.experiments import experiment, parameter_files, record_files, systems
from fitting.inference.identifiability import assess_identifiability
from fitting.inference.optimisation.solution import Solution
from fitting.problem.problem import Problem
from fitting.report import (
    ablation_report,
    fit_report,
    fit_tables,
    formatting,
    terrain_report,
    translation_report,
)
from fitting.runtime import files, validation
from fitting.studies import ablation as contributing
from fitting.studies import comparison as comparing
from fitting.studies import run_folder, study
from fitting.studies import translation as translate
from jaxik import record

from . import progress


def fit(options: argparse.Namespace) -> int:
    """Fits, and leaves a run folder with tables and plots."""
    _prepare_jax()
    asked = experiment_files.load_experiment(options.experiment)
    truth = known_values.load_known_values(asked)
    run_folder.check_place(options.output)
    problem = problems.make_problem(asked)
    print(f"fitting {len(asked.free)} parameters of {asked.preset} to {len(asked.clips)} clip(s)")
    with progress.Line(progress.fit_line) as line:
        solution = study.search(problem, asked, line)
    fitted = _keep_fit(options.output, asked, problem, solution)
    fit_report.write_fit(options.output, fitted)
    print("\n" + fit_report.fit_text(run_folder.describe_fit(fitted), truth))
    return _told_where(options.output, fitted)


def contribution(options: argparse.Namespace) -> int:
    """Fits an experiment without each of its rules, and leaves a folder with what that costs."""
    _prepare_jax()
    asked = experiment_files.load_experiment(options.experiment)
    run_folder.check_place(options.output)
    with progress.Line(progress.fit_line) as line:
        rows = contributing.contribution(
            asked, options.folds, options.output,
            progress=line, told=ablation_report.tell, between=jax.clear_caches,
        )  # fmt: skip
    ablation_report.write(options.output, asked, rows)
    for part, title in ablation_report.titles(rows).items():
        print(f"\n{title}:\n\n{formatting.aligned(ablation_report.group(rows, part))}")
    print(f"written to {options.output}; read {options.output / ablation_report.TABLE}")
    return 0


def sample(options: argparse.Namespace) -> int:
    """Samples the posterior of a run, or goes on with it."""
    _prepare_jax()
    asked, told = run_folder.load_fit(options.run)
    if options.max_steps is not None:
        asked = experiment.with_max_steps(asked, options.max_steps)
    truth = known_values.load_known_values(asked)
    problem = problems.make_problem(asked)
    names = [row["name"] for row in told["parameters"]]
    if names != list(problem.space.names):
        raise ValueError(
            f"{options.run}: fit.json has {names}, the experiment {problem.space.names}"
        )
    start_u = np.array([row["u"] for row in told["parameters"]])
    start_sd = np.array([row["start_sd"] for row in told["parameters"]])
    chain = options.run / run_folder.CHAIN
    with progress.Line(progress.sample_line) as line:
        posterior = study.sample_start(problem, asked, start_u, start_sd, chain, line)
    run_folder.save_posterior(options.run, posterior)
    fit_report.write_posterior(options.run, asked, posterior)
    print("\n" + fit_report.posterior_text(posterior, truth))
    print(f"written to {options.run}; read {options.run / run_folder.SUMMARY}")
    if posterior.interrupted:
        raise KeyboardInterrupt
    return 0


def apply(options: argparse.Namespace) -> int:
    """Runs a run's fitted parameters on a clip."""
    _prepare_jax()
    run_folder.load_fit(options.run)
    ik, _ = parameter_files.load_system(options.run / run_folder.PARAMETERS)
    return _solve_clip(ik, options)


def run(options: argparse.Namespace) -> int:
    """Runs a preset or a parameter file on a clip."""
    _prepare_jax()
    if options.parameters is not None:
        return _solve_clip(parameter_files.load_system(options.parameters)[0], options)
    return _solve_clip(systems.preset_system(options.preset), options)


def compare(options: argparse.Namespace) -> int:
    """Runs several systems on a clip, and leaves a folder with their measures and a figure."""
    _prepare_jax()
    systems = comparing.name_systems(options.systems, grounded=options.roots == "ground")
    run_folder.check_place(options.output)
    base = load_flat_animation(options.clip)
    ground = mesh_files.load_terrain(options.terrain, file_up=options.file_up)
    title = f"{options.clip.name} on {options.terrain.name}"
    compared = comparing.compare(
        systems, base, ground, floor=options.floor, title=title, during=progress.timed
    )
    comparing.write(options.output, compared)
    print(formatting.aligned([list(row) for row in zip(*comparing.table(compared), strict=True)]))
    print(f"written to {options.output}; read {options.output / comparing.TABLE}")
    return 0


def translation(options: argparse.Namespace) -> int:
    """The word `translate`: fits one system to another's motion, and leaves a run folder."""
    _prepare_jax()
    source = translate.read_system(options.source, "--from")
    target = translate.read_system(options.target, "--to")
    named = None if options.free is None else translate.read_free(options.free, target.ik)
    translate.check_place(options.output)
    made = translate.plan(
        source, target, options.clip, options.terrain, options.output,
        named=named, fps=options.fps, file_up=options.file_up,
    )  # fmt: skip
    count, several = len(made.experiment.free), len(made.motions)
    print(f"fitting {count} parameters of {target.name} to {source.name} on {several} clip(s)")
    with progress.Line(progress.fit_line) as line:
        start = translate.approach(made.problem)
        solution = study.search(made.problem, made.experiment, line, start)
    translate.save_source(options.output, made)
    fitted = _keep_fit(options.output, made.experiment, made.problem, solution)
    print("\n" + translation_report.write(options.output, made, fitted))
    return _told_where(options.output, fitted)


def inspect(options: argparse.Namespace) -> int:
    """Prints what a loader understood of a clip."""
    clip = clips.load_clip(options.clip, asf=options.asf, scale=options.scale)
    told = summary.describe(clip)
    print(summary.as_json(told) if options.json else summary.as_text(told))
    return 0


def terrain(options: argparse.Namespace) -> int:
    """Reconstructs a clip's ground, and leaves a mesh with its numbers and a picture."""
    jax.config.update("jax_enable_x64", True)
    for name in ("sole", "margin"):
        if getattr(options, name) < 0:
            raise ValueError(f"--{name} is {getattr(options, name):g}; wanted 0 or more metres")
    terrain_report.check_output_files(options.output)
    clip = clips.load_clip(options.clip)
    kind = None if options.model == "auto" else options.model
    found = reconstruct(clip, sole=options.sole, kind=kind)
    terrain_report.write(options.output, found, clip, options.sole, options.margin)
    print(f"{terrain_report.count_stances(found)}\n")
    print(formatting.aligned(terrain_report.prediction_table(found)))
    print(f"\n{terrain_report.describe_surface(found)}; written to {options.output}")
    return 0


def measure(options: argparse.Namespace) -> int:
    """The word `bench`: measures, and prints a table of what is reached; no cache of programs."""
    tasks = bench.choose(bench_tasks.TASKS, options.only, options.quick)
    drawn = bench_report.check_places(options.json, options.plot)
    sizes = bench_tasks.QUICK if options.quick else bench_tasks.FULL
    with progress.Line(str) as line:
        measured = bench.measure(tasks, sizes, options.quick, progress.say, line)
    written = bench_report.write(measured, options.json, drawn)
    print(bench_report.text(measured))
    for path in written:
        print(f"written to {path}")
    if measured.interrupted:
        raise KeyboardInterrupt  # all is told: it may go on
    return 0


def convert(options: argparse.Namespace) -> int:
    """The word `record`: shows the game's record, or turns it into or out of our parameters."""
    jax.config.update("jax_enable_x64", True)
    reading = record.Reading(options.length_unit, options.knee, options.lean_sign, options.tick_hz)
    base = (
        record_files.read_bytes(options.base)
        if getattr(options, "base", None) is not None
        else None
    )
    read = record_files.read(options.file, reading, base)
    if options.way == "show":
        if options.csv:
            print(record.to_csv(read).rstrip())
        else:
            with validation.error_context(options.file):
                print("\n\n".join(record_files.shown(one, reading) for one in read))
        return 0
    (only, *more) = read
    if more:
        raise ValueError(f"{options.file} has {1 + len(more)} rows; give a file with one record")
    if options.way == "to-toml":
        with validation.error_context(options.file):
            text = parameter_files.system_to_toml(record.to_ik(only, reading))
        files.write_text(options.output, text)
    else:
        files.write(options.output, lambda path: path.write_bytes(record.to_bytes(only)))
    print(f"written to {options.output}")
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "fit": fit,
    "contribution": contribution,
    "sample": sample,
    "apply": apply,
    "run": run,
    "compare": compare,
    "translate": translation,
    "inspect": inspect,
    "terrain": terrain,
    "bench": measure,
    "record": convert,
}


def _prepare_jax() -> None:
    """Float64, and compiled programs kept between calls."""
    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        cache = Path.home() / ".cache" / "jaxik"
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    warnings.filterwarnings("ignore", message=".*persistent compilation cache.*")


def _keep_fit(
    run: Path, asked: experiment.Experiment, problem: Problem, solution: Solution
) -> study.Fit:
    """Writes a solution before anything may go wrong with it, then what is known of it."""
    run_folder.save_solution(run, asked, problem, solution)
    fitted = study.Fit(asked, problem, solution, assess_identifiability(problem, solution))
    run_folder.save_fit(run, fitted)
    return fitted


def _told_where(run: Path, fitted: study.Fit) -> int:
    """The last words of a fit, and its exit status."""
    print(f"written to {run}; read {run / run_folder.SUMMARY}")
    if fitted.solution.interrupted:
        raise KeyboardInterrupt  # all is written: it may go on
    return 0


def _solve_clip(ik: jaxik.FootIK, options: argparse.Namespace) -> int:
    if options.output.suffix.lower() != ".npz":
        raise ValueError(f"{options.output}: wanted a name that ends in .npz")
    files.check_output_file(options.output)
    base = load_flat_animation(options.clip)
    ground = mesh_files.load_terrain(options.terrain, file_up=options.file_up)
    motion = clip_frames.frames_from_clip(base, floor=options.floor)
    problems.check_shapes(ik, base.rig, ground, motion)
    began = time.perf_counter()
    result, solved = comparing.solve(ik, base, ground, motion, options.floor)
    clips.save_clip(options.output, solved, joints=clip_frames.positions_by_role(solved))
    reached = float(np.mean(result.reached))
    found = float(np.mean(result.trace.sensed.foothold.found))
    print(
        f"{base.frame_count} frames in {time.perf_counter() - began:.1f} s: ground under {found:.1%} of "
        f"the feet, {reached:.1%} of the targets reached; written to {options.output}"
    )
    if is_blocks_file(options.clip):
        captured = clips.load_clip(options.clip)
        found = accuracy.summarise([accuracy.clip_errors(solved, captured, base)])
        print("\n" + formatting.aligned(fit_tables.accuracy_table(found)))
    return 0
