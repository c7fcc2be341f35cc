"""Commands that run systems on flat animations."""

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from fitting import jobs, viewer
from fitting.cli.terminal import show
from fitting.experiment import parameter_files, systems
from fitting.experiment.systems import Preset
from fitting.runtime import activity, cache_folder
from fitting.runtime.precision import in_float64
from fitting.studies import comparison
from fitting.studies import suite as suite_suite
from fitting.studies.animations import AnimationFiles
from fitting.viewer.views import Address, check_folder
from jaxik import FootIK, Rig

from . import reading, status

OF_CLIPS = {  # options of a clip and a terrain, as they are where they are not used
    "--floor": 0.0, "--root": "auto", "--speed": 1.0, "--tracks": None, "--joints": None,
    "--scale": None, "--up": None, "--asf": None, "--animation": None, "--travel": None,
    "--sole": None, "--file-up": "y", "--terrain-offset": (0.0, 0.0, 0.0),
    "--terrain-scale": None, "--terrain-cell": None,
}  # fmt: skip


def apply(options: argparse.Namespace) -> int:
    """Runs the fitted parameters of a run on a clip."""
    cache_folder.use_default()
    jobs.apply(
        options.run, _animation(options), options.output,
        with_terrain=options.with_terrain, log=show,
    )  # fmt: skip
    return 0


@in_float64
def run(options: argparse.Namespace) -> int:
    """Runs a preset or a parameter file on a clip."""
    cache_folder.use_default()
    animation = _animation(options)
    rig = animation.flat_clip.rig
    if options.parameters is not None:
        ik, _ = parameter_files.load_system(options.parameters, rig)
    else:
        ik = systems.preset_system(options.preset, rig)
    jobs.solve(ik, animation, options.output, with_terrain=options.with_terrain, log=show)
    return 0


@in_float64
def view(options: argparse.Namespace) -> int:
    """Shows a run, or a preset or a parameter file on a clip, in the browser."""
    cache_folder.use_default()
    address = Address(options.host, options.port)
    if options.terrain is None:
        _check_run(options)
        jobs.view_run(options.clip, options.output, address, log=show)
        return 0
    folder = options.output or Path()
    check_folder(folder)
    animation, preset, given = _animation(options), Preset(options.preset), None
    if options.parameters is not None:
        given, preset = parameter_files.load_system(options.parameters, animation.flat_clip.rig)
    subject = viewer.subject_of_animation(animation, preset, given)
    jobs.view(subject, folder, address, log=show)
    return 0


def _check_run(options: argparse.Namespace) -> None:
    """Raises ValueError for options of a clip beside a run, which has clips of its own."""
    if not options.clip.is_dir() and options.clip.is_file():
        raise ValueError(f"{options.clip}: a clip needs --terrain; a run is a folder")
    own = {"--parameters": None, "--preset": "record", **OF_CLIPS}
    for name, unused in own.items():
        given = getattr(options, name.strip("-").replace("-", "_"))
        if given != unused:
            raise ValueError(f"{name} is {given}; a run has its own clips and system")


@in_float64
def compare(options: argparse.Namespace) -> int:
    """Runs several systems on a clip or through the suite, or compares runs."""
    cache_folder.use_default()
    if options.suite:
        return _compare_in_suite(options)
    if options.runs is not None:
        return _compare_runs(options)
    _check_comparison(options)
    animation = _animation(options)
    requested = comparison.named_systems(options.systems, animation.flat_clip.rig)
    jobs.compare(
        requested, animation, options.output,
        rates=options.rates, during=_running, log=show,
    )  # fmt: skip
    return 0


def _compare_in_suite(options: argparse.Namespace) -> int:
    """Runs systems, or else all presets, through made situations."""
    if options.runs is not None:
        raise ValueError("--runs and --suite exclude each other")
    own = {"CLIP": None, "--terrain": None, "--rates": [], **OF_CLIPS}
    for name, unused in own.items():
        given = getattr(options, name.strip("-").replace("-", "_").lower())
        if given != unused:
            raise ValueError(f"{name} is {given}; the suite has animations and grounds of its own")
    requested = options.systems or [("--presets", ",".join(systems.preset_names()))]
    comparison.named_systems(requested)  # reports mistakes before anything runs
    plan = suite_suite.choose(options.only, quick=options.quick)

    def systems_of(rig: Rig) -> dict[str, FootIK]:
        return comparison.named_systems(requested, rig)

    total = len(plan.situations)
    with activity.announced(f"Running {total} situations", total) as suite:
        finished = jobs.run_suite(systems_of, plan, options.output, during=suite.part, log=show)
    return status.of_job(interrupted=finished.interrupted)


def _compare_runs(options: argparse.Namespace) -> int:
    """Compares sampled runs by what they predict."""
    own = {"CLIP": options.clip, "--terrain": options.terrain, "--rates": options.rates}
    for name, given in own.items():
        if given:
            raise ValueError(f"{name} is {given}; runs are compared on the clips of their fits")
    if options.systems:
        raise ValueError(f"{options.systems[0][0]} and --runs exclude each other")
    jobs.compare_runs(options.runs.split(","), options.output, log=show)
    return 0


def _check_comparison(options: argparse.Namespace) -> None:
    """Raises ValueError for what only the suite takes, or only a comparison on a clip needs."""
    for name in ("only", "quick"):
        if getattr(options, name):
            raise ValueError(f"--{name} belongs to --suite, which is not given")
    needed = {"CLIP": options.clip, "--terrain": options.terrain, "-o/--output": options.output}
    if missing := [name for name, given in needed.items() if given is None]:
        raise ValueError(f"the following are required: {', '.join(missing)}; or --suite, or --runs")


def _running(name: str) -> AbstractContextManager:
    return activity.announced(f"Compiling and running {name}")


def _animation(options: argparse.Namespace) -> AnimationFiles:
    return AnimationFiles(
        options.clip,
        options.terrain,
        options.floor,
        options.root,
        options.speed,
        options.tracks,
        reading.clip_options(options),
        reading.terrain_options(options),
    )
