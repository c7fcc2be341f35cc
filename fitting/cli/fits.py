"""Commands that search: fits, their posteriors, and studies of many fits."""

import argparse
import functools
from contextlib import ExitStack
from pathlib import Path

from fitting.runtime import activity

from . import status
from .options import (
    ADDRESS,
    CLIP_OPTIONS,
    TERRAIN_OPTIONS,
    Option,
    argument,
    clip_options,
    command,
    compiled,
    count,
    flag,
    number,
    output,
    rate,
    terrain_options,
)
from .start import interruptible

EXPERIMENT = argument(
    "experiment", type=Path, metavar="EXPERIMENT.toml", help="as `jaxik fit` takes it"
)


def _workers(default: int | None, meaning: str) -> tuple[Option, Option]:
    """Which processes compute."""
    return (
        argument(
            "--workers", type=count(0, 1024), default=default, metavar="N",
            help="compute in N other processes of this machine, with the extra `dask`; 0 computes "
            f"in this one (default: {meaning})",
        ),
        argument(
            "--scheduler", metavar="ADDRESS", help="compute on the Dask cluster of this scheduler"
        ),
    )  # fmt: skip


@command(
    argument("clips", type=Path, nargs="+", metavar="CLIP", help="captured motion"),
    argument(
        "--terrain", type=Path, nargs="+", default=[], metavar="MESH",
        help="the ground: one for all clips, or one for each (default: reconstructed)",
    ),
    argument(
        "--base", type=Path, nargs="+", default=[], metavar="FLAT",
        help="flat animations, one for each clip (default: made from the clips)",
    ),
    argument(
        "--preset",
        help="what is fitted (default: stride; record where a foot never stands, or with "
        "--record-only)",
    ),
    flag("--faithful", "the original, where the preset differs from it"),
    flag("--record-only", "only what the game's record has room for"),
    output("DIR", "folder for the experiment"),
    CLIP_OPTIONS,
    TERRAIN_OPTIONS,
)  # fmt: skip
@compiled
def init(options: argparse.Namespace) -> int:
    """Make an experiment of your clips that runs as it is.

    jaxik init walk.bvh -o walk
    jaxik init walk.bvh stairs.bvh --terrain floor.obj stairs.obj -o walks
    jaxik init walk.bvh --terrain ground.ply --record-only -o game

    Looks at the clips, reconstructs the ground where none is given, tries every parameter over
    its range, and writes experiment.toml with all keys and what they mean. Says what it
    assumes, what the clips say for it, and what would be better.
    """
    from fitting import jobs
    from fitting.experiment.systems import DEFAULT_PRESET, Preset
    from fitting.studies.draft import DraftRequest

    preset = None
    if options.preset is not None or options.faithful:
        preset = Preset(options.preset or DEFAULT_PRESET.name, options.faithful)

    request = DraftRequest(
        clips=tuple(options.clips),
        terrains=tuple(options.terrain),
        bases=tuple(options.base),
        preset=preset,
        record_only=options.record_only,
        reading=clip_options(options),
        terrain_reading=terrain_options(options),
    )
    jobs.init(request, options.output)
    return 0


@command(
    argument(
        "experiment", type=Path, metavar="EXPERIMENT.toml", help="clips, terrain, free parameters",
    ),
    output("RUN", "run folder"),
    flag(
        "--record-only",
        "leave out what the game's record has no room for, and say what that costs",
    ),
    flag("--view", "show the best point so far as `jaxik view` does"),
    *ADDRESS,
)  # fmt: skip
@compiled
def fit(options: argparse.Namespace) -> int:
    """Fit an experiment's free parameters to its clips.

    jaxik fit data/experiments/uneven_walk.toml -o runs/walk
    jaxik fit data/experiments/uneven_walk.toml --record-only -o runs/game
    jaxik fit data/experiments/uneven_walk.toml --view -o runs/walk   best so far, in a browser

    Status 0: converged, and fits. 3: not converged. 4: converged, but not close enough to the
    capture; the summary says where. 7: further from the capture than without foot IK, or than
    before the fit. Ctrl-C ends the search; the best point so far
    is written as any other fit, with status 130. The same command then goes on, as it does
    after a kill.
    """
    from fitting import jobs
    from fitting.experiment.experiment_files import load_experiment
    from fitting.experiment.record_files import restrict
    from fitting.viewer.views import Address, FitWatch

    experiment = load_experiment(options.experiment)
    if options.record_only and not experiment.record_only:
        experiment = restrict(experiment)
    with interruptible(), ExitStack() as stack:
        if options.view:
            watch = FitWatch(options.output, Address(options.host, options.port))
            stack.enter_context(activity.watched_by(stack.enter_context(watch)))
        fitted = jobs.fit(experiment, options.output)
    return status.of_fit(fitted)


@command(
    EXPERIMENT,
    argument(
        "--folds", type=count(2, 1000), default=2, metavar="N",
        help="parts of each clip (default: 2)",
    ),
    output("DIR"),
)  # fmt: skip
@compiled
def ablate(options: argparse.Namespace) -> int:
    """Fit an experiment without each of its rules, cross-validated.

    jaxik ablate data/experiments/blocks.toml -o runs/ablation

    The experiment's [[without]] tables say what is left out. Each fit is written when it is
    done: after Ctrl-C (status 130) the same command continues.
    """
    from fitting import jobs

    with interruptible():
        jobs.ablate(options.experiment, options.output, folds=options.folds)
    return 0


@command(
    EXPERIMENT,
    argument(
        "-n", "--replicates", type=count(1, 100_000), default=200, metavar="N",
        help="truths (default: 200)",
    ),
    argument(
        "--chains", action=argparse.BooleanOptionalAction, default=False,
        help="sample each posterior too, which takes much longer than the fits (default: no)",
    ),
    argument(
        "--truth", metavar="SYSTEM",
        help="preset or parameter .toml that makes the motion (default: the experiment's system)",
    ),
    argument(
        "--noise-factor", type=number(1e-3, 1e3), default=1.0, metavar="X",
        help="simulate noise X times as large as the experiment says, or with --truth errors X "
        "times as large as usual (default: 1)",
    ),
    *_workers(0, "0"),
    output("DIR"),
)  # fmt: skip
@compiled
def calibrate(options: argparse.Namespace) -> int:
    """Check what fits and posteriors say on motion with known truths.

    jaxik calibrate data/experiments/ozz.toml -n 200 -o runs/calibration
    jaxik calibrate data/experiments/ozz.toml -n 200 --chains --workers 8 -o runs/calibration
    jaxik calibrate walk.toml --truth stride -n 100 -o runs/wrong_model

    Truths are drawn from the experiment's prior. Each fit is written when it is done: after
    Ctrl-C (status 130) the same command continues, also with a larger -n or with --chains. The
    exit status is 0 if everything is inside its bounds, else 5. With --truth another system
    makes the motion, a capture's errors are added, and the question is whether the fit is worth
    saving and its verdict true on frames that were held out.
    """
    from fitting import jobs

    if options.truth is not None and options.chains:
        raise ValueError(
            "--chains ranks true values among a posterior's, and under another system than the "
            "experiment's none is true; leave --chains or --truth out"
        )
    with interruptible():
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
        )
    return 0 if assessment.inside else status.OUTSIDE


@command(
    EXPERIMENT,
    output("DIR"),
)  # fmt: skip
@compiled
def population(options: argparse.Namespace) -> int:
    """Fit several clips and subjects, and how they differ.

    jaxik population walks.toml -o runs/walks

    The experiment's table [hierarchy] says what varies between clips or subjects. Each clip is
    fitted alone, all are pooled, and as a population; each is predicted from the others, and each
    subject measured with parameters of others.
    Each search is written when it is done: after Ctrl-C (status 130) the same command
    continues. Status 0: converged. 3: not converged.
    """
    from fitting import jobs

    with interruptible():
        fitted = jobs.population(options.experiment, options.output)
    return 0 if fitted.converged else status.NOT_CONVERGED


@command(
    argument(
        "experiments", type=Path, nargs="+", metavar="EXPERIMENT.toml",
        help="as `jaxik fit` takes them",
    ),
    output("DIR", "folder for all runs, the table and the report"),
    argument(
        "--seeds", type=count(1, 10_000), default=1, metavar="N",
        help="fits of each clip, from the experiment's seed on (default: 1)",
    ),
    flag(
        "--together",
        "fit the clips of an experiment together, as `jaxik fit` does (default: each alone)",
    ),
    flag("--record-only", "leave out what the game's record has no room for"),
    argument(
        "--no-reports", dest="reports", action="store_false",
        help="only the numbers and motions of each run: no tables, pictures and pages",
    ),
    *_workers(None, "one for each core"),
)  # fmt: skip
@compiled
def fit_many(options: argparse.Namespace) -> int:
    """Fit each clip of many experiments alone, on many cores or machines.

    jaxik fit-many walks.toml runs.toml -o runs/all
    jaxik fit-many walks.toml --seeds 3 --workers 8 -o runs/walks
    jaxik fit-many walks.toml --scheduler tcp://10.0.0.1:8786 --no-reports -o /shared/walks

    Each fit is a run folder, DIR/runs/EXPERIMENT/CLIP/seed_N, as `jaxik fit` makes it; all are
    a row each of fits.csv and, with the extra `parquet`, of fits.parquet. The same command goes
    on after Ctrl-C (status 130), a kill, or failures, and repeats no finished fit. Needs the
    extra `dask` unless --workers is 0. Status 0: all fits converged. 3: at least one has not.
    6: at least one failed; the table says why. Whether a fit fits is in the table only.
    """
    from fitting import jobs
    from fitting.experiment.experiment_files import load_experiment
    from fitting.experiment.record_files import restrict

    experiments = [load_experiment(path) for path in options.experiments]
    if options.record_only:
        experiments = [entry if entry.record_only else restrict(entry) for entry in experiments]
    fits = jobs.fit_many(
        experiments,
        options.output,
        seeds=options.seeds,
        together=options.together,
        report=options.reports,
        workers=options.workers,
        scheduler=options.scheduler,
    )
    return status.of_many(fits)


@command(
    argument("run", type=Path, metavar="RUN", help="folder made by `jaxik fit`"),
    argument(
        "--max-steps", type=count(1, 10**9), metavar="N", help="of the sampler, over all calls",
    ),
)  # fmt: skip
@compiled
def sample(options: argparse.Namespace) -> int:
    """Sample the posterior around a run's fit, or continue its chain.

    jaxik sample runs/walk
    jaxik sample runs/walk --max-steps 40000      continue, if 20000 were not enough

    Ctrl-C saves the chain and ends with status 130; the same command continues it, even after
    the process was killed.
    """
    from fitting import jobs

    with interruptible():
        posterior = jobs.sample(options.run, max_steps=options.max_steps)
    return status.of_job(interrupted=posterior.interrupted)


@command(
    *(
        argument(
            name, dest=dest, required=True, metavar="SYSTEM",
            help=f"preset or parameter .toml {meaning}",
        )
        for name, dest, meaning in (
            ("--from", "source", "whose motion is reproduced"),
            ("--to", "target", "whose parameters are fitted, starting from these values"),
        )
    ),
    *(
        argument(
            name, type=Path, action="append", required=True, metavar=metavar,
            help=f"{meaning}; may be given several times",
        )
        for name, metavar, meaning in (
            ("--clip", "CLIP", "over flat ground, as `jaxik run` takes it"),
            ("--terrain", "MESH", "for the clip in the same position"),
        )
    ),
    argument(
        "--free", metavar="NAME,...",
        help="what is fitted, or a .toml with a [free] table (default: every parameter that moves "
        "these clips)",
    ),
    argument(
        "--fps", type=rate, metavar="HZ", help="resample the clips first (default: as they are)",
    ),
    CLIP_OPTIONS,
    TERRAIN_OPTIONS,
    output("DIR"),
)  # fmt: skip
@compiled
def translate(options: argparse.Namespace) -> int:
    """Fit the parameters of one system to the motion of another.

    jaxik translate --from mec.toml --to record --clip walk.bvh --terrain hill.obj -o runs/mec
    jaxik translate --from unreal --to record --fps 30 --clip a.npz --terrain a.obj -o runs/a

    Status 0: converged, however much of the motion is reproduced. 3: not converged. Ctrl-C ends
    the search; the best point so far is written as any other fit, with status 130.
    After a kill during the search the same command goes on. The folder is a run:
    `jaxik sample` and `jaxik apply` take it.
    """
    from fitting import jobs
    from fitting.studies.animations import AnimationFiles
    from fitting.studies.translation import TranslationRequest, load_named_system, read_free

    if len(options.clip) != len(options.terrain):
        raise ValueError(
            f"{len(options.clip)} clip(s) and {len(options.terrain)} terrain(s); wanted a terrain "
            "for each clip"
        )
    clip_reading, terrain_reading = clip_options(options), terrain_options(options)
    clip_reading.check_use(options.clip, "--clip")
    animations = tuple(
        AnimationFiles(
            clip, mesh, clip_options=clip_reading.of_file(clip), terrain_options=terrain_reading
        )
        for clip, mesh in zip(options.clip, options.terrain, strict=True)
    )
    rig = animations[0].flat_clip.rig
    source = load_named_system(options.source, "--from", rig)
    target = load_named_system(options.target, "--to", rig)
    free = None if options.free is None else read_free(options.free, target.ik, rig)
    request = TranslationRequest(source, target, animations, free, options.fps)
    with interruptible():
        fitted = jobs.translate(request, options.output)
    return status.of_fit(fitted)
