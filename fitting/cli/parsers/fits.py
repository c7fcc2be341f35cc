"""Words and options of the commands that search."""

import argparse
from pathlib import Path

from .many import add_workers
from .options import (
    Commands,
    add_address,
    add_clip_options,
    add_command,
    add_output,
    add_terrain_options,
    count,
    number,
    rate,
)


def add_init(commands: Commands) -> None:
    """`jaxik init`."""
    init = add_command(
        commands, "init", "make an experiment of your clips that runs as it is",
        """
        jaxik init walk.bvh -o walk
        jaxik init walk.bvh stairs.bvh --terrain floor.obj stairs.obj --preset stride -o walks
        jaxik init walk.bvh --terrain ground.ply --record-only -o game

        Looks at the clips, reconstructs the ground where none is given, tries every parameter over
        its range, and writes experiment.toml with all keys and what they mean. Says what it
        assumes, what the clips say for it, and what would be better.
        """,
    )  # fmt: skip
    init.add_argument("clips", type=Path, nargs="+", metavar="CLIP", help="captured motion")
    init.add_argument(
        "--terrain", type=Path, nargs="+", default=[], metavar="MESH",
        help="the ground: one for all clips, or one for each (default: reconstructed)",
    )  # fmt: skip
    init.add_argument(
        "--base", type=Path, nargs="+", default=[], metavar="FLAT",
        help="flat animations, one for each clip (default: made from the clips)",
    )  # fmt: skip
    init.add_argument("--preset", default="record", help="what is fitted (default: record)")
    init.add_argument(
        "--faithful", action="store_true", help="the original, where the preset differs from it"
    )
    init.add_argument(
        "--record-only", action="store_true", help="only what the game's record has room for"
    )
    add_output(init, "DIR", "folder for the experiment")
    add_clip_options(init)
    add_terrain_options(init)


def add_fit(commands: Commands) -> None:
    """`jaxik fit`."""
    fit = add_command(
        commands, "fit", "fit an experiment's free parameters to its clips",
        """
        jaxik fit data/experiments/uneven_walk.toml -o runs/walk
        jaxik fit data/experiments/uneven_walk.toml --record-only -o runs/game
        jaxik fit data/experiments/uneven_walk.toml --view -o runs/walk   best so far, in a browser

        Status 0: converged, and fits. 3: not converged. 4: converged, but not close enough to the
        capture; the summary says where. 7: further from the capture than without foot IK, or than
        before the fit. Ctrl-C ends the search; the best point so far
        is written as any other fit, with status 130. The same command then goes on, as it does
        after a kill.
        """,
    )  # fmt: skip
    fit.add_argument(
        "experiment", type=Path, metavar="EXPERIMENT.toml", help="clips, terrain, free parameters"
    )
    add_output(fit, "RUN", "run folder")
    fit.add_argument(
        "--record-only", action="store_true",
        help="leave out what the game's record has no room for, and say what that costs",
    )  # fmt: skip
    fit.add_argument(
        "--view", action="store_true", help="show the best point so far as `jaxik view` does"
    )
    add_address(fit)


def add_ablate(commands: Commands) -> None:
    """`jaxik ablate`."""
    ablate = add_command(
        commands, "ablate", "fit an experiment without each of its rules, cross-validated",
        """
        jaxik ablate data/experiments/blocks.toml -o runs/ablation

        The experiment's [[without]] tables say what is left out. Each fit is written when it is
        done: after Ctrl-C (status 130) the same command continues.
        """,
    )  # fmt: skip
    ablate.add_argument(
        "experiment", type=Path, metavar="EXPERIMENT.toml", help="as `jaxik fit` takes it"
    )
    ablate.add_argument(
        "--folds",
        type=count(2, 1000),
        default=2,
        metavar="N",
        help="parts of each clip (default: 2)",
    )
    add_output(ablate, "DIR")


def add_calibrate(commands: Commands) -> None:
    """`jaxik calibrate`."""
    calibrate = add_command(
        commands, "calibrate", "check what fits and posteriors say on motion with known truths",
        """
        jaxik calibrate data/experiments/ozz.toml -n 200 -o runs/calibration
        jaxik calibrate data/experiments/ozz.toml -n 200 --chains --workers 8 -o runs/calibration
        jaxik calibrate walk.toml --truth stride -n 100 -o runs/wrong_model

        Truths are drawn from the experiment's prior. Each fit is written when it is done: after
        Ctrl-C (status 130) the same command continues, also with a larger -n or with --chains. The
        exit status is 0 if everything is inside its bounds, else 5. With --truth another system
        makes the motion, a capture's errors are added, and asked is whether the fit is worth
        keeping and its verdict true on frames that were held out.
        """,
    )  # fmt: skip
    calibrate.add_argument(
        "experiment", type=Path, metavar="EXPERIMENT.toml", help="as `jaxik fit` takes it"
    )
    calibrate.add_argument(
        "-n",
        "--replicates",
        type=count(1, 100_000),
        default=200,
        metavar="N",
        help="truths (default: 200)",
    )
    calibrate.add_argument(
        "--chains", action=argparse.BooleanOptionalAction, default=False,
        help="sample each posterior too, which takes much longer than the fits (default: no)",
    )  # fmt: skip
    calibrate.add_argument(
        "--truth", metavar="SYSTEM",
        help="preset or parameter .toml that makes the motion (default: the experiment's system)",
    )  # fmt: skip
    calibrate.add_argument(
        "--noise-factor", type=number(1e-3, 1e3), default=1.0, metavar="X",
        help="simulate noise X times as large as the experiment says, or with --truth errors X "
        "times as large as usual (default: 1)",
    )  # fmt: skip
    add_workers(calibrate, 0, "0")
    add_output(calibrate, "DIR")


def add_population(commands: Commands) -> None:
    """`jaxik population`."""
    population = add_command(
        commands, "population", "fit several clips and subjects, and how they differ",
        """
        jaxik population walks.toml -o runs/walks

        The experiment's table [hierarchy] says what varies between clips or subjects. Each clip is
        fitted alone, all are pooled, and as a population; and each is predicted from the others.
        Each search is written when it is done: after Ctrl-C (status 130) the same command
        continues. Status 0: converged. 3: not converged.
        """,
    )  # fmt: skip
    population.add_argument(
        "experiment", type=Path, metavar="EXPERIMENT.toml", help="as `jaxik fit` takes it"
    )
    add_output(population, "DIR")


def add_sample(commands: Commands) -> None:
    """`jaxik sample`."""
    sample = add_command(
        commands, "sample", "sample the posterior around a run's fit, or continue its chain",
        """
        jaxik sample runs/walk
        jaxik sample runs/walk --max-steps 40000      continue, if 20000 were not enough

        Ctrl-C keeps the chain and ends with status 130; the same command continues it, even after
        the process was killed.
        """,
    )  # fmt: skip
    sample.add_argument("run", type=Path, metavar="RUN", help="folder made by `jaxik fit`")
    sample.add_argument(
        "--max-steps", type=count(1, 10**9), metavar="N", help="of the sampler, over all calls"
    )


def add_translate(commands: Commands) -> None:
    """`jaxik translate`."""
    translate = add_command(
        commands, "translate", "fit the parameters of one system to the motion of another",
        """
        jaxik translate --from mec.toml --to record --clip walk.bvh --terrain hill.obj -o runs/mec
        jaxik translate --from unreal --to record --fps 30 --clip a.npz --terrain a.obj -o runs/a

        Status 0: converged, however much of the motion is reproduced. 3: not converged. Ctrl-C ends
        the search; the best point so far is written as any other fit, with status 130.
        After a kill during the search the same command goes on. The folder is a run:
        `jaxik sample` and `jaxik apply` take it.
        """,
    )  # fmt: skip
    for option, dest, description in (
        ("--from", "source", "whose motion is reproduced"),
        ("--to", "target", "whose parameters are fitted, starting from these values"),
    ):
        translate.add_argument(
            option, dest=dest, required=True, metavar="SYSTEM",
            help=f"preset or parameter .toml {description}",
        )  # fmt: skip
    for option, metavar, description in (
        ("--clip", "CLIP", "over flat ground, as `jaxik run` takes it"),
        ("--terrain", "MESH", "for the clip in the same position"),
    ):
        translate.add_argument(
            option, type=Path, action="append", required=True, metavar=metavar,
            help=f"{description}; may be given several times",
        )  # fmt: skip
    translate.add_argument(
        "--free", metavar="NAME,...", help="what is fitted, or a .toml with a [free] table "
        "(default: every parameter that moves these clips)",
    )  # fmt: skip
    translate.add_argument(
        "--fps", type=rate, metavar="HZ", help="resample the clips first (default: as they are)"
    )
    add_clip_options(translate)
    add_terrain_options(translate)
    add_output(translate, "DIR")
