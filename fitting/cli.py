"""The command `jaxik`."""

import os

# Before JAX is imported. XLA's fusion emitters take three times as long to compile a pipeline on a
# CPU and do not run faster; the flag does nothing on a GPU.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

EXAMPLES = """examples:
  jaxik fit data/experiments/uneven_walk.toml -o runs/walk     fit, with plots and a summary
  jaxik sample runs/walk                                       its posterior; again goes on
  jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.npz
  jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --preset record
  jaxik inspect walk.bvh
  jaxik record to-toml footik.bin -o footik.toml
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; a user's mistake ends it with one line and status 2."""
    options = parser().parse_args(arguments)
    from . import commands  # imports JAX: `--help` need not wait for it

    try:
        return commands.COMMANDS[options.command](options)
    except (ValueError, OSError) as error:
        print(f"jaxik {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\njaxik {options.command}: interrupted", file=sys.stderr)
        return 130


def parser() -> argparse.ArgumentParser:
    """The words of the command line."""
    top = argparse.ArgumentParser(
        prog="jaxik",
        description="Foot IK in JAX: fit its parameters to captured motion and say how sure that is.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    fit = _add(commands, "fit", "fit an experiment's free parameters to its clips")
    fit.add_argument("experiment", type=Path, metavar="EXPERIMENT.toml")
    fit.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="run folder")

    sample = _add(commands, "sample", "sample the posterior around a run's fit; goes on where it was")
    sample.add_argument("run", type=Path, metavar="RUN", help="folder that `jaxik fit` made")
    sample.add_argument("--max-steps", type=int, metavar="N", help="of the sampler, over all calls")

    apply = _add(commands, "apply", "run a run's fitted parameters on another clip")
    apply.add_argument("run", type=Path, metavar="RUN")
    _clip_and_ground(apply)

    run = _add(commands, "run", "run a preset, or a parameter file, on a clip without fitting")
    _clip_and_ground(run)
    run.add_argument("--preset", default="record", help="of jaxik.presets (default: record)")
    run.add_argument("--parameters", type=Path, metavar="TOML", help="instead of a preset")

    inspect = _add(commands, "inspect", "print what a loader understood of a clip")
    inspect.add_argument("clip", type=Path, metavar="CLIP", help=".bvh, .amc or .npz")
    inspect.add_argument("--json", action="store_true", help="as JSON")
    inspect.add_argument("--asf", type=Path, help="skeleton of an .amc, where it is not beside it")
    inspect.add_argument("--scale", type=float, help="metres per unit of the file")

    record = _add(commands, "record", "the game's parameter record: show it, or turn it around")
    ways = record.add_subparsers(dest="way", required=True, metavar="show|to-toml|to-bytes")
    show = _add(ways, "show", "print a record under its own names and ours")
    show.add_argument("file", type=Path, help="binary record, CSV or parameter TOML")
    show.add_argument("--csv", action="store_true", help="as CSV under the record's own names")
    to_toml = _add(ways, "to-toml", "a record as parameters in our names and units")
    to_toml.add_argument("file", type=Path, help="binary record or CSV")
    to_toml.add_argument("-o", "--output", type=Path, required=True, metavar="TOML")
    to_bytes = _add(ways, "to-bytes", "parameters as a binary record")
    to_bytes.add_argument("file", type=Path, help="parameter TOML or CSV")
    to_bytes.add_argument("-o", "--output", type=Path, required=True, metavar="BIN")
    to_bytes.add_argument("--base", type=Path, help="record that gives padding, tail and knee axis")
    for way in (show, to_toml, to_bytes):
        way.add_argument("--length-unit", choices=("auto", "m", "cm"), default="auto")
        way.add_argument("--knee", choices=("interior", "flexion"), default="interior")
        way.add_argument("--lean-sign", type=int, choices=(1, -1), default=1)
        way.add_argument("--tick-hz", type=float, default=30.0, help="rate of the gains' ticks")
    return top


def _add(commands, name: str, what: str) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=what, description=what[0].upper() + what[1:] + ".")


def _clip_and_ground(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "clip", type=Path, metavar="CLIP", help=".bvh, .amc or .npz over flat ground"
    )
    command.add_argument("--terrain", type=Path, required=True, metavar="MESH")
    command.add_argument("--file-up", choices=("y", "z"), default="y", help="up axis of the mesh")
    command.add_argument("--floor", type=float, default=0.0, help="height of the clip's floor, m")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.npz")


if __name__ == "__main__":
    sys.exit(main())
