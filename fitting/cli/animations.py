"""Commands that run systems on flat animations."""

import argparse
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from . import status
from .options import (
    ADDRESS,
    CLIP_OPTIONS,
    CLIPS,
    TERRAIN_OPTIONS,
    Option,
    argument,
    clip_options,
    command,
    compiled,
    flag,
    group,
    number,
    output,
    rates,
    terrain_options,
)

if TYPE_CHECKING:
    from fitting.studies.animations import AnimationFiles

MOTION_OUTPUT = (
    output(
        "OUT", "the solved motion: .npz, .glb, .csv, or .bvh, with the channels, unit and rate of "
        "a .bvh that came in",
    ),
    flag("--with-terrain", "put the terrain into a .glb beside the motion"),
)  # fmt: skip


def _system(parser: argparse.ArgumentParser) -> None:
    """Adds the system that is run."""
    system = parser.add_mutually_exclusive_group()
    system.add_argument(
        "--preset", help="of jaxik.presets (default: stride, or record where a foot never stands)"
    )
    system.add_argument("--parameters", type=Path, metavar="TOML", help="instead of a preset")


def _animation_and_terrain(*, required: bool = True) -> tuple[Option, ...]:
    """A flat animation, its terrain, and how they lie."""
    clip = argument(
        "clip", type=Path, metavar="CLIP", nargs=None if required else "?",
        help=f"{CLIPS} over flat ground (an .npz may also hold the captured motion)",
    )  # fmt: skip
    return clip, *_terrain(required=required)


def _terrain(*, required: bool = True) -> tuple[Option, ...]:
    """The terrain of a flat animation, and how both lie."""
    return (
        argument(
            "--terrain", type=Path, required=required, metavar="MESH",
            help=".ply, .obj, .glb, ..., or heights as .npz, .npy, .png",
        ),
        argument(
            "--floor", type=number(-1e6, 1e6, "metres"), default=0.0, metavar="M",
            help="height of the clip's floor, m",
        ),
        argument(
            "--root", choices=("auto", "animation", "ground"), default="auto",
            help="keep the root of the clip, or let it follow the ground below it; auto keeps it "
            "where foot IK reaches the ground from there, or where the feet follow this terrain "
            "already",
        ),
        argument(
            "--speed", type=number(0.01, 100), default=1.0, metavar="X",
            help="let the root travel X times as far as in the clip; strides are scaled with it",
        ),
        argument(
            "--direction", type=number(-90, 90, "degrees"), default=0.0, metavar="DEG",
            help="let the root travel that far to the left of its way in the clip; feet and pelvis "
            "are turned with it, the spine back",
        ),
        argument(
            "--tracks", type=Path, metavar="TOML",
            help="what changes along the clip: grounded, weights of legs, and any parameter",
        ),
        CLIP_OPTIONS,
        TERRAIN_OPTIONS,
    )  # fmt: skip


OF_CLIPS = (  # options of a clip and its terrain
    "--floor", "--root", "--speed", "--direction", "--tracks", "--joints", "--scale", "--up",
    "--asf", "--animation", "--travel", "--sole", "--file-up", "--terrain-offset",
    "--terrain-scale", "--terrain-cell",
)  # fmt: skip


@command(
    argument("run", type=Path, metavar="RUN", help="folder made by `jaxik fit`"),
    *_animation_and_terrain(),
    *MOTION_OUTPUT,
)  # fmt: skip
@compiled
def apply(options: argparse.Namespace) -> int:
    """Run a run's fitted parameters on another clip.

    jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.bvh
    jaxik apply runs/walk walk.amc --terrain yard.glb --file-up z --floor -0.03 -o yard.npz
    """
    from fitting import jobs

    jobs.apply(
        options.run, _animation(options), options.output,
        with_terrain=options.with_terrain,
    )  # fmt: skip
    return 0


@command(
    *_animation_and_terrain(),
    *MOTION_OUTPUT,
    _system,
)  # fmt: skip
@compiled
def run(options: argparse.Namespace) -> int:
    """Run a preset, or a parameter file, on a clip without fitting.

    jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.bvh
    jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --parameters footik.toml
    jaxik run hero.glb --animation Walk --terrain steps.obj -o walk.glb --with-terrain
    """
    from fitting import jobs
    from fitting.experiment import parameter_files, systems

    animation, ik = _animation(options), None
    if options.parameters is not None:
        ik, _ = parameter_files.load_system(options.parameters, animation.flat_clip.rig)
    elif options.preset is not None:
        ik = systems.preset_system(options.preset, animation.flat_clip.rig)
    jobs.solve(ik, animation, options.output, with_terrain=options.with_terrain)
    return 0


@command(
    argument(
        "clip", type=Path, metavar="RUN|CLIP",
        help="folder made by `jaxik fit`; or, with --terrain, a clip as `jaxik run` takes it",
    ),
    *_terrain(required=False),
    _system,
    argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="where Save writes (default: the run's folder, or this one)",
    ),
    *ADDRESS,
)  # fmt: skip
@compiled
def view(options: argparse.Namespace) -> int:
    """Move parameters in the browser, and see the motion at once.

    jaxik view runs/walk                                      before, fitted and captured
    jaxik view walk.bvh --terrain steps.obj
    jaxik view walk.bvh --terrain steps.obj --parameters footik.toml --port 9000

    Save on the page writes tuned.toml and, where it has room, the record tuned.bin; files
    that exist stay. On the time line stances are put right by hand; Save contacts writes
    CLIP.contacts.toml beside the clip. Ctrl-C ends it.
    """
    from fitting import jobs, viewer
    from fitting.experiment.parameter_files import load_system
    from fitting.experiment.systems import Preset
    from fitting.viewer.views import Address, check_folder

    address = Address(options.host, options.port)
    if options.terrain is None:
        _check_run(options)
        jobs.view_run(options.clip, options.output, address)
        return 0
    folder = options.output or Path()
    check_folder(folder)
    animation, ik = _animation(options), None
    preset = None if options.preset is None else Preset(options.preset)
    if options.parameters is not None:
        ik, preset = load_system(options.parameters, animation.flat_clip.rig)
    session = viewer.session_of_animation(animation, preset, ik)
    jobs.view(session, folder, address)
    return 0


def _check_run(options: argparse.Namespace) -> None:
    """Raises ValueError for options of a clip beside a run, which has clips of its own."""
    if not options.clip.is_dir() and options.clip.is_file():
        raise ValueError(f"{options.clip}: a clip needs --terrain; a run is a folder")
    own = ("--parameters", "--preset", *OF_CLIPS)
    _check_unused(options, own, "a run has its own clips and system")


def _check_unused(options: argparse.Namespace, names: Iterable[str], reason: str) -> None:
    """Raises ValueError for the first of these options that is not at its default."""
    for name in names:
        key = name.strip("-").replace("-", "_").lower()
        value = getattr(options, key)
        if value != options.parser.get_default(key):
            raise ValueError(f"{name} is {value}; {reason}")


@command(
    *_animation_and_terrain(required=False),
    argument("-o", "--output", type=Path, metavar="DIR", help="needed with a CLIP"),
    *(
        argument(
            name, dest="systems", action="append", default=[], metavar="NAME,...",
            type=lambda text, name=name: (name, text), help=f"{source}, in this order",
        )
        for name, source in (("--presets", "of jaxik.presets"), ("--parameters", "TOML files"))
    ),
    argument(
        "--runs", metavar="RUN,...", help="compare what these sampled runs predict, without a clip",
    ),
    argument(
        "--rates", type=rates, default=[], metavar="HZ,...",
        help="run at these frame rates too, and measure how far that is from the clip's own",
    ),
    group(
        "made situations",
        flag("--suite", "run them instead of a clip"),
        argument("--only", metavar="NAME,...", help="these situations (default: all)"),
        flag("--quick", "fewer situations, shorter clips"),
    ),
)  # fmt: skip
@compiled
def compare(options: argparse.Namespace) -> int:
    """Run several systems on a clip and measure them side by side.

    jaxik compare walk.bvh --terrain steps.obj --presets ozz,unreal,mec,record -o compared
    jaxik compare walk.bvh --terrain steps.obj --presets record --parameters a.toml,b.toml -o ab
    jaxik compare walk.bvh --terrain steps.obj --parameters runs/walk/parameters.toml \
        --rates 30,60 -o rates                       how much it depends on the frame rate
    jaxik compare --suite -o suite                   every preset in every made situation
    jaxik compare --suite --quick --presets record   a shorter suite, without files
    jaxik compare --suite --only "stairs up,curb" --presets record --parameters a.toml
    jaxik compare --runs runs/ozz,runs/mec           sampled fits to the same clips

    The suite has its own animations and grounds, from a flat walk to stairs and a train, and
    states a bound for every measure; what is beyond it has a !. After Ctrl-C (status 130) the
    situations that were finished are written.
    """
    from fitting import jobs
    from fitting.studies.comparison import named_systems

    if options.suite:
        return _compare_in_suite(options)
    if options.runs is not None:
        return _compare_runs(options)
    _check_comparison(options)
    animation = _animation(options)
    requested = named_systems(options.systems, animation.flat_clip.rig)
    jobs.compare(
        requested,
        animation,
        options.output,
        rates=options.rates,
    )
    return 0


def _compare_in_suite(options: argparse.Namespace) -> int:
    """Runs systems, or else all presets, through made situations."""
    from fitting import jobs
    from fitting.experiment.systems import preset_names
    from fitting.studies import suite
    from fitting.studies.comparison import named_systems
    from jaxik import FootIK, Rig

    if options.runs is not None:
        raise ValueError("--runs and --suite exclude each other")
    own = ("CLIP", "--terrain", "--rates", *OF_CLIPS)
    _check_unused(options, own, "the suite has animations and grounds of its own")
    requested = options.systems or [("--presets", ",".join(preset_names()))]
    named_systems(requested)  # reports mistakes before anything runs
    plan = suite.choose(options.only, quick=options.quick)

    def systems_of(rig: Rig) -> dict[str, FootIK]:
        return named_systems(requested, rig)

    finished = jobs.run_suite(systems_of, plan, options.output)
    return status.of_job(interrupted=finished.interrupted)


def _compare_runs(options: argparse.Namespace) -> int:
    """Compares sampled runs by what they predict."""
    from fitting import jobs

    own = ("CLIP", "--terrain", "--rates")
    _check_unused(options, own, "runs are compared on the clips of their fits")
    if options.systems:
        raise ValueError(f"{options.systems[0][0]} and --runs exclude each other")
    jobs.compare_runs(options.runs.split(","), options.output)
    return 0


def _check_comparison(options: argparse.Namespace) -> None:
    """Raises ValueError for what only the suite takes, or only a comparison on a clip needs."""
    for name in ("only", "quick"):
        if getattr(options, name):
            raise ValueError(f"--{name} belongs to --suite, which is not given")
    needed = {"CLIP": options.clip, "--terrain": options.terrain, "-o/--output": options.output}
    if missing := [name for name, value in needed.items() if value is None]:
        raise ValueError(f"the following are required: {', '.join(missing)}; or --suite, or --runs")


def _animation(options: argparse.Namespace) -> "AnimationFiles":
    """The animation and its terrain, as the options say."""
    from fitting.studies.animations import AnimationFiles

    return AnimationFiles(
        options.clip,
        options.terrain,
        options.floor,
        options.root,
        options.speed,
        options.tracks,
        clip_options(options),
        terrain_options(options),
        math.radians(options.direction),
    )
