"""The words and options of the command `jaxik`. Imports no JAX, so that `--help` is fast."""

import argparse
import math
import textwrap
from pathlib import Path
from typing import TypeAlias

EXAMPLES = """examples:
  jaxik fit data/experiments/uneven_walk.toml -o runs/walk     fit, with plots and a summary
  jaxik ablate data/experiments/blocks.toml -o runs/ablation   the fit without each of its rules
  jaxik sample runs/walk                                       its posterior; again to continue
  jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.npz
  jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --preset record
  jaxik compare walk.bvh --terrain steps.obj --presets ozz,unreal,mec,record -o compared
  jaxik translate --from mec --to record --clip walk.bvh --terrain steps.obj -o translated
  jaxik inspect walk.bvh
  jaxik terrain walk.bvh -o ground.ply
  jaxik record to-toml footik.bin -o footik.toml
  jaxik bench --quick
  jaxik cache                                                  where compiled programs are kept

exit status: 0 when done, 2 for a mistake in the input (one line says which), 130 when
interrupted with Ctrl-C: `fit` then has written the best point so far, `sample` its chain, and
`ablate` each finished fit.
`jaxik COMMAND --help` has more examples.
"""

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = argparse.ArgumentParser(
        prog="jaxik",
        description="Fits the parameters of foot IK to captured motion, with their uncertainty.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (
        _add_fit, _add_ablate, _add_sample, _add_apply, _add_run, _add_compare, _add_translate,
        _add_inspect, _add_terrain, _add_bench, _add_record, _add_cache,
    ):  # fmt: skip
        add(commands)
    return top


def _add_fit(commands: Commands) -> None:
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
    _add_output(fit, "RUN", "run folder")


def _add_ablate(commands: Commands) -> None:
    ablate = _add(
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
        "--folds", type=int, default=2, metavar="N", help="parts of each clip (default: 2)"
    )
    _add_output(ablate, "DIR")


def _add_sample(commands: Commands) -> None:
    sample = _add(
        commands, "sample", "sample the posterior around a run's fit, or continue its chain",
        """
        jaxik sample runs/walk
        jaxik sample runs/walk --max-steps 40000      continue, if 20000 were not enough

        Ctrl-C keeps the chain and ends with status 130; the same command continues it, even after
        the process was killed.
        """,
    )  # fmt: skip
    sample.add_argument("run", type=Path, metavar="RUN", help="folder made by `jaxik fit`")
    sample.add_argument("--max-steps", type=int, metavar="N", help="of the sampler, over all calls")


def _add_apply(commands: Commands) -> None:
    apply = _add(
        commands, "apply", "run a run's fitted parameters on another clip",
        """
        jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.npz
        jaxik apply runs/walk walk.amc --terrain yard.glb --file-up z --floor -0.03 -o yard.npz
        """,
    )  # fmt: skip
    apply.add_argument("run", type=Path, metavar="RUN", help="folder made by `jaxik fit`")
    _add_animation(apply)
    _add_output(apply, "OUT.npz")


def _add_run(commands: Commands) -> None:
    run = _add(
        commands, "run", "run a preset, or a parameter file, on a clip without fitting",
        """
        jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz
        jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --parameters footik.toml
        """,
    )  # fmt: skip
    _add_animation(run)
    _add_output(run, "OUT.npz")
    system = run.add_mutually_exclusive_group()
    system.add_argument("--preset", default="record", help="of jaxik.presets (default: record)")
    system.add_argument("--parameters", type=Path, metavar="TOML", help="instead of a preset")


def _add_compare(commands: Commands) -> None:
    compare = _add(
        commands, "compare", "run several systems on a clip and measure them side by side",
        """
        jaxik compare walk.bvh --terrain steps.obj --presets ozz,unreal,mec,record -o compared
        jaxik compare walk.bvh --terrain steps.obj --presets record --parameters a.toml,b.toml -o ab
        """,
    )  # fmt: skip
    _add_animation(compare)
    _add_output(compare, "DIR")
    for option, description in (("--presets", "of jaxik.presets"), ("--parameters", "TOML files")):
        compare.add_argument(
            option, dest="systems", action="append", default=[], metavar="NAME,...",
            type=lambda text, option=option: (option, text), help=f"{description}, in this order",
        )  # fmt: skip


def _add_translate(commands: Commands) -> None:
    translate = _add(
        commands, "translate", "fit the parameters of one system to the motion of another",
        """
        jaxik translate --from mec.toml --to record --clip walk.bvh --terrain hill.obj -o runs/mec
        jaxik translate --from unreal --to record --fps 30 --clip a.npz --terrain a.obj -o runs/a

        Ctrl-C ends the search; the best point so far is written as any other fit, with status 130.
        The folder is a run: `jaxik sample` and `jaxik apply` take it.
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
        "--fps", type=_finite, metavar="HZ", help="resample the clips first (default: as they are)"
    )
    translate.add_argument(
        "--file-up", choices=("y", "z"), default="y", help="up axis of the meshes"
    )
    _add_output(translate, "DIR")


def _add_inspect(commands: Commands) -> None:
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


def _add_terrain(commands: Commands) -> None:
    terrain = _add(
        commands, "terrain", "reconstruct the ground of a captured clip from its stances",
        """
        jaxik terrain walk.bvh -o ground.ply
        jaxik terrain walk.amc -o ground.obj --sole 0.045 --model smooth --margin 2

        Three models are fitted to the stances: a plane, a smooth surface, and level blocks on a
        grid. The table shows how well each predicts a stance from all the others; the simplest one
        that is not clearly worse is written. A plot and all numbers go beside it: ground.png,
        ground.json.
        """,
    )  # fmt: skip
    terrain.add_argument("clip", type=Path, metavar="CLIP", help="captured: .bvh, .amc or .npz")
    _add_output(terrain, "MESH", ".ply, .obj or .stl")
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


def _add_bench(commands: Commands) -> None:
    bench = _add(
        commands, "bench", "measure the speed of everything on this machine",
        """
        jaxik bench                          everything, in half an hour
        jaxik bench --quick                  smaller sizes, and neither fit nor curves
        jaxik bench --only legs,rays --json bench.json

        Ctrl-C prints, and writes, what has been measured so far, with status 130.
        """,
    )  # fmt: skip
    bench.add_argument("--quick", action="store_true", help="smaller sizes, fewer runs and rows")
    bench.add_argument("--only", metavar="NAME,...", help="these rows (default: all of them)")
    bench.add_argument("--json", type=Path, metavar="FILE", help="all numbers, of every run")
    bench.add_argument("--plot", type=Path, metavar="FILE.png", help="curves of time against size")


def _add_cache(commands: Commands) -> None:
    cache = _add(
        commands, "cache", "show where compiled programs are kept between calls, or remove them",
        """
        jaxik cache
        jaxik cache --clear     other files in that folder stay
        """,
    )  # fmt: skip
    cache.add_argument("--clear", action="store_true", help="remove the programs")


def _add_record(commands: Commands) -> None:
    record = _add(
        commands, "record", "show or convert the game's parameter record",
        """
        jaxik record show footik.bin
        jaxik record to-toml footik.bin -o footik.toml
        jaxik record to-bytes footik.toml --base footik.bin -o edited.bin
        """,
    )  # fmt: skip
    ways = record.add_subparsers(dest="way", required=True, metavar="show|to-toml|to-bytes")
    show = _add(
        ways, "show", "print a record with its own names and ours",
        """
        jaxik record show footik.bin
        jaxik record show footik.bin --csv > footik.csv
        """,
    )  # fmt: skip
    show.add_argument("file", type=Path, help="binary record, .csv or parameter .toml")
    show.add_argument("--csv", action="store_true", help="as CSV with the record's own names")
    to_toml = _add(
        ways, "to-toml", "a record as parameters with our names and units",
        "jaxik record to-toml footik.bin --length-unit cm -o footik.toml",
    )  # fmt: skip
    to_toml.add_argument("file", type=Path, help="binary record or .csv")
    _add_output(to_toml, "TOML")
    to_bytes = _add(
        ways, "to-bytes", "parameters as a binary record",
        """
        jaxik record to-bytes footik.toml --base footik.bin -o edited.bin

        With the record that `to-toml` read as the base, and the same options, everything that was
        not edited comes out unchanged, to the byte.
        """,
    )  # fmt: skip
    to_bytes.add_argument("file", type=Path, help="parameter .toml, or .csv")
    _add_output(to_bytes, "BIN")
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


def _add(commands: Commands, name: str, summary: str, example: str) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog="example:\n" + textwrap.indent(textwrap.dedent(example).strip(), "  "),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _add_output(command: argparse.ArgumentParser, metavar: str, description: str = "") -> None:
    command.add_argument(
        "-o", "--output", type=Path, required=True, metavar=metavar, help=description or None
    )


def _add_animation(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "clip", type=Path, metavar="CLIP",
        help=".bvh, .amc or .npz over flat ground; for a blocks .npz its flat animation",
    )  # fmt: skip
    command.add_argument(
        "--terrain", type=Path, required=True, metavar="MESH", help=".ply, .obj, .npz, .glb, ..."
    )
    command.add_argument("--file-up", choices=("y", "z"), default="y", help="up axis of the mesh")
    command.add_argument(
        "--floor", type=_finite, default=0.0, metavar="M", help="height of the clip's floor, m"
    )
    command.add_argument(
        "--root", choices=("auto", "animation", "ground"), default="auto",
        help="keep the root of the clip, or let it follow the ground below it; auto keeps it where "
        "foot IK reaches the ground from there, or where the feet follow this terrain already",
    )  # fmt: skip


def _finite(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}; wanted a finite number")
    return value
