"""Words and options of the commands that run systems on flat animations."""

import argparse
from pathlib import Path

from .options import (
    Commands,
    add_address,
    add_animation,
    add_command,
    add_output,
    add_placement,
    rates,
)


def add_apply(commands: Commands) -> None:
    """`jaxik apply`."""
    apply = add_command(
        commands, "apply", "run a run's fitted parameters on another clip",
        """
        jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.bvh
        jaxik apply runs/walk walk.amc --terrain yard.glb --file-up z --floor -0.03 -o yard.npz
        """,
    )  # fmt: skip
    apply.add_argument("run", type=Path, metavar="RUN", help="folder made by `jaxik fit`")
    add_animation(apply)
    _add_motion_output(apply)


def add_run(commands: Commands) -> None:
    """`jaxik run`."""
    run = add_command(
        commands, "run", "run a preset, or a parameter file, on a clip without fitting",
        """
        jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.bvh
        jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --parameters footik.toml
        jaxik run hero.glb --animation Walk --terrain steps.obj -o walk.glb --with-terrain
        """,
    )  # fmt: skip
    add_animation(run)
    _add_motion_output(run)
    _add_system(run)


def _add_system(command: argparse.ArgumentParser) -> None:
    """Adds the system that is run."""
    system = command.add_mutually_exclusive_group()
    system.add_argument("--preset", default="record", help="of jaxik.presets (default: record)")
    system.add_argument("--parameters", type=Path, metavar="TOML", help="instead of a preset")


def add_view(commands: Commands) -> None:
    """`jaxik view`."""
    view = add_command(
        commands, "view", "move parameters in the browser, and see the motion at once",
        """
        jaxik view runs/walk                                      before, fitted and captured
        jaxik view walk.bvh --terrain steps.obj --preset stride
        jaxik view walk.bvh --terrain steps.obj --parameters footik.toml --port 9000

        Save on the page writes tuned.toml and, where it has room, the record tuned.bin; files
        that exist stay. Ctrl-C ends it. Needs the extra `view`: pip install "jaxik[view]".
        """,
    )  # fmt: skip
    view.add_argument(
        "clip", type=Path, metavar="RUN|CLIP",
        help="folder made by `jaxik fit`; or, with --terrain, a clip as `jaxik run` takes it",
    )  # fmt: skip
    add_placement(view, required=False)
    _add_system(view)
    view.add_argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="where Save writes (default: the run's folder, or this one)",
    )  # fmt: skip
    add_address(view)


def _add_motion_output(command: argparse.ArgumentParser) -> None:
    """Adds the file for the solved motion."""
    add_output(
        command, "OUT", "the solved motion: .npz, .glb, .csv, or .bvh, with the channels, unit and "
        "rate of a .bvh that came in",
    )  # fmt: skip
    command.add_argument(
        "--with-terrain", action="store_true", help="put the terrain into a .glb beside the motion"
    )


def add_compare(commands: Commands) -> None:
    """`jaxik compare`."""
    compare = add_command(
        commands, "compare", "run several systems on a clip and measure them side by side",
        """
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
        """,
    )  # fmt: skip
    add_animation(compare, required=False)
    compare.add_argument("-o", "--output", type=Path, metavar="DIR", help="needed with a CLIP")
    for option, description in (("--presets", "of jaxik.presets"), ("--parameters", "TOML files")):
        compare.add_argument(
            option, dest="systems", action="append", default=[], metavar="NAME,...",
            type=lambda text, option=option: (option, text), help=f"{description}, in this order",
        )  # fmt: skip
    compare.add_argument(
        "--runs", metavar="RUN,...", help="compare what these sampled runs predict, without a clip"
    )
    compare.add_argument(
        "--rates", type=rates, default=[], metavar="HZ,...",
        help="run at these frame rates too, and measure how far that is from the clip's own",
    )  # fmt: skip
    suite = compare.add_argument_group("made situations")
    suite.add_argument("--suite", action="store_true", help="run them instead of a clip")
    suite.add_argument("--only", metavar="NAME,...", help="these situations (default: all)")
    suite.add_argument("--quick", action="store_true", help="fewer situations, shorter clips")
