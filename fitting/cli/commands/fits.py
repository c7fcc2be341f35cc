"""Commands that fit and sample."""

import argparse
import functools

from fitting import jobs
from fitting.cli import progress
from fitting.cli.terminal import show
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.record_files import restrict
from fitting.experiment.systems import Preset
from fitting.runtime import cache_folder
from fitting.runtime.precision import in_float64
from fitting.studies import translation
from fitting.studies.animations import AnimationFiles
from fitting.studies.draft import DraftRequest
from fitting.studies.translation import TranslationRequest
from fitting.viewer.views import Address, FitWatch

from . import reading, status


def fit(options: argparse.Namespace) -> int:
    """Fits an experiment."""
    cache_folder.use_default()
    experiment = load_experiment(options.experiment)
    if options.record_only and not experiment.record_only:
        experiment = restrict(experiment)
    if not options.view:
        with progress.ProgressLine(progress.fit_line) as line:
            fitted = jobs.fit(experiment, options.output, progress=line, log=show)
        return status.of_fit(fitted)
    address = Address(options.host, options.port)
    with (
        progress.ProgressLine(progress.fit_line) as line,
        FitWatch(options.output, address, line, show) as watch,
    ):
        fitted = jobs.fit(experiment, options.output, progress=watch, log=show, loaded=watch.load)
    return status.of_fit(fitted)


def init(options: argparse.Namespace) -> int:
    """Makes a first experiment of clips."""
    cache_folder.use_default()
    request = DraftRequest(
        clips=tuple(options.clips),
        terrains=tuple(options.terrain),
        bases=tuple(options.base),
        preset=Preset(options.preset, options.faithful or options.record_only),
        record_only=options.record_only,
        reading=reading.clip_options(options),
        terrain_reading=reading.terrain_options(options),
    )
    jobs.init(request, options.output, log=show)
    return 0


def ablate(options: argparse.Namespace) -> int:
    """Fits an experiment without each of its rules."""
    cache_folder.use_default()
    with progress.ProgressLine(progress.fit_line) as line:
        jobs.ablate(
            options.experiment, options.output, folds=options.folds, progress=line, log=show
        )
    return 0


def calibrate(options: argparse.Namespace) -> int:
    """Fits an experiment to simulated motion; status 5 if something is outside."""
    if options.truth is not None and options.chains:
        raise ValueError(
            "--chains ranks true values among a posterior's, and under another system than the "
            "experiment's none is true; leave --chains or --truth out"
        )
    cache_folder.use_default()
    with progress.ProgressLine(progress.calibration_line) as line:
        job = (
            functools.partial(jobs.calibrate, chains=options.chains)
            if options.truth is None
            else functools.partial(jobs.calibrate_wrong_model, truth=options.truth)
        )
        assessment = job(
            options.experiment,
            output=options.output,
            replicates=options.replicates,
            noise_factor=options.noise_factor,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=line,
            log=show,
        )
    return 0 if assessment.inside else status.OUTSIDE


def population(options: argparse.Namespace) -> int:
    """Fits several clips and subjects as a population."""
    cache_folder.use_default()
    with progress.ProgressLine(progress.fit_line) as line:
        fitted = jobs.population(options.experiment, options.output, progress=line, log=show)
    return 0 if fitted.converged else status.NOT_CONVERGED


def sample(options: argparse.Namespace) -> int:
    """Samples the posterior of a run, or continues its chain."""
    cache_folder.use_default()
    with progress.ProgressLine(progress.sample_line) as line:
        posterior = jobs.sample(options.run, max_steps=options.max_steps, progress=line, log=show)
    return status.of_job(interrupted=posterior.interrupted)


@in_float64
def translate(options: argparse.Namespace) -> int:
    """Fits one system to the motion of another."""
    cache_folder.use_default()
    if len(options.clip) != len(options.terrain):
        raise ValueError(
            f"{len(options.clip)} clip(s) and {len(options.terrain)} terrain(s); wanted a terrain "
            "for each clip"
        )
    how_clip, how_terrain = reading.clip_options(options), reading.terrain_options(options)
    how_clip.check_use(options.clip, "--clip")
    animations = tuple(
        AnimationFiles(clip, mesh, clip_options=how_clip.of_file(clip), terrain_options=how_terrain)
        for clip, mesh in zip(options.clip, options.terrain, strict=True)
    )
    rig = animations[0].flat_clip.rig
    source = translation.load_named_system(options.source, "--from", rig)
    target = translation.load_named_system(options.target, "--to", rig)
    free = None if options.free is None else translation.read_free(options.free, target.ik, rig)
    request = TranslationRequest(source, target, animations, free, options.fps)
    with progress.ProgressLine(progress.fit_line) as line:
        fitted = jobs.translate(request, options.output, progress=line, log=show)
    return status.of_fit(fitted)
