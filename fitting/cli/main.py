"""The command `jaxik`."""

import argparse
import math
import os
import sys
import textwrap
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fitting.runtime import xla

MISTAKE, INTERRUPTED = 2, 130  # exit status

EXAMPLES = """examples:
  jaxik fit data/experiments/uneven_walk.toml -o runs/walk     fit, with plots and a summary
  jaxik contribution data/experiments/blocks.toml -o runs/c    the fit without each of its rules
  jaxik sample runs/walk                                       its posterior; again goes on
  jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.npz
  jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --preset record
  jaxik compare walk.bvh --terrain steps.obj --presets ozz,unreal,mec,record -o compared
  jaxik translate --from mec --to record --clip walk.bvh --terrain steps.obj -o translated
  jaxik inspect walk.bvh
  jaxik terrain walk.bvh -o ground.ply
  jaxik record to-toml footik.bin -o footik.toml
  jaxik bench --quick

exit status: 0 when done, 2 for a mistake in what was given (one line says which), 130 when
interrupted with Ctrl-C: `fit` then has written the best point so far, `sample` its chain, and
`contribution` each finished fit.
`jaxik COMMAND --help` has more examples.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and gives its exit status; a user's mistake makes one line on stderr."""
    options = parser().parse_args(arguments)
    xla.configure_xla()
    try:
        from . import commands  # imports JAX: `--help` need not wait for it

        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            status = commands.COMMANDS[options.command](options)
            sys.stdout.flush()
            return status
    except BrokenPipeError:  # whoever reads, such as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError) as error:
        print(f"jaxik {options.command}: {_sentence(error)}", file=sys.stderr)
        return MISTAKE
    except KeyboardInterrupt:
        print(f"\njaxik {options.command}: interrupted", file=sys.stderr)
        return INTERRUPTED


def _sentence(error: Exception) -> str:
    """An error in one line."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split("\n"))


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    print(f"jaxik: {message}", file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    """The words of the command line."""
    top = argparse.ArgumentParser(
        prog="jaxik",
        description="Fits the parameters of foot IK to captured motion, and says how sure it is.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    fit = _add(
        commands, "fit", "fit an experiment's free parameters to its clips",
        """
        jaxik fit data/experiments/uneven_walk.toml -o runs/walk

        Ctrl-C ends the search; the best point so far is written as any other fit, with status 130.
        """,
    )  # fmt: skip
    fit.add_argument(
        "experiment", type=Path, metavar="EXPERIMENT.toml", help="clips, terrain, free parameters"
    )
    fit.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="run folder")

    contribution = _add(
        commands, "contribution", "fit an experiment without each of its rules, cross-validated",
        """
        jaxik contribution data/experiments/blocks.toml -o runs/contribution

        The experiment's [[without]] tables say what is left out. Each fit is kept when it is done:
        after Ctrl-C (status 130) the same command goes on.
        """,
    )  # fmt: skip
    contribution.add_argument(
        "experiment", type=Path, metavar="EXPERIMENT.toml", help="as `jaxik fit` takes it"
    )
    contribution.add_argument(
        "--folds", type=int, default=2, metavar="N", help="parts of each clip (default: 2)"
    )
    contribution.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")

    sample = _add(
        commands, "sample", "sample the posterior around a run's fit; goes on where it was",
        """
        jaxik sample runs/walk
        jaxik sample runs/walk --max-steps 40000      on, if 20000 were not enough

        Ctrl-C keeps the chain and ends with status 130; the same command goes on with it, also
        after a kill.
        """,
    )  # fmt: skip
    sample.add_argument("run", type=Path, metavar="RUN", help="folder that `jaxik fit` made")
    sample.add_argument("--max-steps", type=int, metavar="N", help="of the sampler, over all calls")

    apply = _add(
        commands, "apply", "run a run's fitted parameters on another clip",
        """
        jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.npz
        jaxik apply runs/walk walk.amc --terrain yard.glb --file-up z --floor -0.03 -o yard.npz
        """,
    )  # fmt: skip
    apply.add_argument("run", type=Path, metavar="RUN", help="folder that `jaxik fit` made")
    _clip_and_ground(apply)

    run = _add(
        commands, "run", "run a preset, or a parameter file, on a clip without fitting",
        """
        jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz
        jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --parameters footik.toml
        """,
    )  # fmt: skip
    _clip_and_ground(run)
    system = run.add_mutually_exclusive_group()
    system.add_argument("--preset", default="record", help="of jaxik.presets (default: record)")
    system.add_argument("--parameters", type=Path, metavar="TOML", help="instead of a preset")

    compare = _add(
        commands, "compare", "run several systems on a clip and measure them side by side",
        """
        jaxik compare walk.bvh --terrain steps.obj --presets ozz,unreal,mec,record -o compared
        jaxik compare walk.bvh --terrain steps.obj --presets record --parameters a.toml,b.toml -o ab
        """,
    )  # fmt: skip
    _clip_and_ground(compare, output="DIR")
    for option, what in (("--presets", "of jaxik.presets"), ("--parameters", "TOML files")):
        compare.add_argument(
            option, dest="systems", action="append", default=[], metavar="NAME,...",
            type=lambda text, option=option: (option, text), help=f"{what}, in this order",
        )  # fmt: skip

    compare.add_argument(
        "--roots", choices=("ground", "animated"), default="ground",
        help="where unreal and mec, whose games put characters on the ground, have the root",
    )  # fmt: skip

    translate = _add(
        commands, "translate", "fit a system's parameters to what another makes of a clip",
        """
        jaxik translate --from mec.toml --to record --clip walk.bvh --terrain hill.obj -o runs/mec
        jaxik translate --from unreal --to record --fps 30 --clip a.npz --terrain a.obj -o runs/a

        Ctrl-C ends the search; the best point so far is written as any other fit, with status 130.
        The folder is a run: `jaxik sample` and `jaxik apply` take it.
        """,
    )  # fmt: skip
    for option, dest, what in (
        ("--from", "source", "whose motion is reproduced"),
        ("--to", "target", "whose parameters are fitted, from these values on"),
    ):
        translate.add_argument(
            option, dest=dest, required=True, metavar="SYSTEM",
            help=f"preset or parameter .toml {what}",
        )  # fmt: skip
    for option, metavar, what in (
        ("--clip", "CLIP", "over flat ground, as `jaxik run` takes it"),
        ("--terrain", "MESH", "of the clip in the same place"),
    ):
        translate.add_argument(
            option, type=Path, action="append", required=True, metavar=metavar,
            help=f"{what}; may be given several times",
        )  # fmt: skip
    translate.add_argument(
        "--free", metavar="NAME,...", help="what is fitted, or a .toml with a [free] table "
        "(default: every parameter that moves these clips)",
    )  # fmt: skip
    translate.add_argument(
        "--fps", type=_finite, metavar="HZ", help="resample the clips first (default: as they are)"
    )
    translate.add_argument(
        "--file-up", choices=("y", "z"), default="y", help="up axis of the meshes"
    )
    translate.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")

    inspect = _add(
        commands, "inspect", "print what a loader understood of a clip",
        """
        jaxik inspect walk.bvh
        jaxik inspect walk.amc --asf skeleton.asf --json
        """,
    )  # fmt: skip
    inspect.add_argument("clip", type=Path, metavar="CLIP", help=".bvh, .amc or .npz")
    inspect.add_argument("--json", action="store_true", help="as JSON")
    inspect.add_argument("--asf", type=Path, help="skeleton of an .amc, where it is not beside it")
    inspect.add_argument("--scale", type=float, help="metres per unit of the file")

    terrain = _add(
        commands, "terrain", "reconstruct the ground of a captured clip from its stances",
        """
        jaxik terrain walk.bvh -o ground.ply
        jaxik terrain walk.amc -o ground.obj --sole 0.045 --model smooth --margin 2

        A plane, a smooth surface and level blocks on a grid are put through the stances. The table
        tells how well each predicts a stance from all the others; the simplest that is not clearly
        worse is written. A picture and all numbers go beside it: ground.png, ground.json.
        """,
    )  # fmt: skip
    terrain.add_argument("clip", type=Path, metavar="CLIP", help="captured: .bvh, .amc or .npz")
    terrain.add_argument(
        "-o", "--output", type=Path, required=True, metavar="MESH", help=".ply, .obj or .stl"
    )
    terrain.add_argument(
        "--sole", type=_finite, default=0.055, metavar="M",
        help="height of the ball joint over the sole, m (default: 0.055, an adult's in shoes)",
    )  # fmt: skip
    terrain.add_argument(
        "--model", choices=("auto", "plane", "smooth", "blocks"), default="auto",
        help="what is written (default: chosen by the error of prediction)",
    )  # fmt: skip
    terrain.add_argument(
        "--margin", type=_finite, default=1.0, metavar="M", help="of ground around the stances, m"
    )

    bench = _add(
        commands, "bench", "measure how fast all of it is on this machine",
        """
        jaxik bench                          everything, in half an hour
        jaxik bench --quick                  smaller sizes, and neither fit nor curves
        jaxik bench --only legs,rays --json bench.json

        Ctrl-C prints, and writes, what was measured until then, with status 130.
        """,
    )  # fmt: skip
    bench.add_argument("--quick", action="store_true", help="smaller sizes, fewer runs and rows")
    bench.add_argument("--only", metavar="NAME,...", help="these rows (default: all of them)")
    bench.add_argument("--json", type=Path, metavar="FILE", help="all numbers, each run's too")
    bench.add_argument("--plot", type=Path, metavar="FILE.png", help="curves of time against size")

    record = _add(
        commands, "record", "the game's parameter record: show it, or turn it around",
        """
        jaxik record show footik.bin
        jaxik record to-toml footik.bin -o footik.toml
        jaxik record to-bytes footik.toml --base footik.bin -o edited.bin
        """,
    )  # fmt: skip
    ways = record.add_subparsers(dest="way", required=True, metavar="show|to-toml|to-bytes")
    show = _add(
        ways, "show", "print a record under its own names and ours",
        """
        jaxik record show footik.bin
        jaxik record show footik.bin --csv > footik.csv
        """,
    )  # fmt: skip
    show.add_argument("file", type=Path, help="binary record, .csv or parameter .toml")
    show.add_argument("--csv", action="store_true", help="as CSV under the record's own names")
    to_toml = _add(
        ways, "to-toml", "a record as parameters in our names and units",
        "jaxik record to-toml footik.bin --length-unit cm -o footik.toml",
    )  # fmt: skip
    to_toml.add_argument("file", type=Path, help="binary record or .csv")
    to_toml.add_argument("-o", "--output", type=Path, required=True, metavar="TOML")
    to_bytes = _add(
        ways, "to-bytes", "parameters as a binary record",
        """
        jaxik record to-bytes footik.toml --base footik.bin -o edited.bin

        With the record as its base that `to-toml` read, and the same options, what was not edited
        comes out as it was, to the byte.
        """,
    )  # fmt: skip
    to_bytes.add_argument("file", type=Path, help="parameter .toml, or .csv")
    to_bytes.add_argument("-o", "--output", type=Path, required=True, metavar="BIN")
    to_bytes.add_argument("--base", type=Path, help="record with padding, tail and knee axis")
    for way in (show, to_toml, to_bytes):
        way.add_argument(
            "--length-unit", choices=("auto", "m", "cm"), default="auto",
            help="of rays and ankle heights in the record (default: by their size)",
        )  # fmt: skip
        way.add_argument(
            "--knee", choices=("interior", "flexion"), default="interior",
            help="which angle the record's knee limits are (default: interior)",
        )  # fmt: skip
        way.add_argument(
            "--lean-sign", type=int, choices=(1, -1), default=1, help="of the undulation rates"
        )
        way.add_argument(
            "--tick-hz", type=_finite, default=30.0, help="rate of the gains' ticks (default: 30)"
        )
    return top


def _add(commands: Any, name: str, what: str, example: str) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        help=what,
        description=what[0].upper() + what[1:] + ".",
        epilog="example:\n" + textwrap.indent(textwrap.dedent(example).strip(), "  "),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _clip_and_ground(command: argparse.ArgumentParser, output: str = "OUT.npz") -> None:
    command.add_argument(
        "clip", type=Path, metavar="CLIP",
        help=".bvh, .amc or .npz over flat ground; of a blocks .npz its base",
    )  # fmt: skip
    command.add_argument(
        "--terrain", type=Path, required=True, metavar="MESH", help=".ply, .obj, .stl, .glb, ..."
    )
    command.add_argument("--file-up", choices=("y", "z"), default="y", help="up axis of the mesh")
    command.add_argument(
        "--floor", type=_finite, default=0.0, metavar="M", help="height of the clip's floor, m"
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar=output)


def _finite(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}; wanted a finite number")
    return value


if __name__ == "__main__":
    sys.exit(main())
