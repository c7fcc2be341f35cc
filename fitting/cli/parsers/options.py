"""Options that several commands share, and how a command is added to the parser."""

import argparse
import math
import textwrap
from pathlib import Path
from typing import TypeAlias

Commands: TypeAlias = argparse._SubParsersAction


def add_command(
    commands: Commands, name: str, summary: str, example: str
) -> argparse.ArgumentParser:
    """Adds a command to the parser; the example may be indented."""
    return commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog="example:\n" + textwrap.indent(textwrap.dedent(example).strip(), "  "),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_output(command: argparse.ArgumentParser, metavar: str, description: str = "") -> None:
    """Adds `-o`, where results are written."""
    command.add_argument(
        "-o", "--output", type=Path, required=True, metavar=metavar, help=description or None
    )


def add_animation(command: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Adds a flat animation, its terrain, and how they lie."""
    command.add_argument(
        "clip", type=Path, metavar="CLIP", nargs=None if required else "?",
        help=".bvh, .amc or .npz over flat ground; for a blocks .npz its flat animation",
    )  # fmt: skip
    command.add_argument(
        "--terrain",
        type=Path,
        required=required,
        metavar="MESH",
        help=".ply, .obj, .npz, .glb, ...",
    )
    command.add_argument("--file-up", choices=("y", "z"), default="y", help="up axis of the mesh")
    command.add_argument(
        "--floor", type=finite, default=0.0, metavar="M", help="height of the clip's floor, m"
    )
    command.add_argument(
        "--root", choices=("auto", "animation", "ground"), default="auto",
        help="keep the root of the clip, or let it follow the ground below it; auto keeps it where "
        "foot IK reaches the ground from there, or where the feet follow this terrain already",
    )  # fmt: skip
    command.add_argument(
        "--speed", type=positive, default=1.0, metavar="X",
        help="let the root travel X times as far as in the clip; strides are scaled with it",
    )  # fmt: skip
    command.add_argument(
        "--tracks", type=Path, metavar="TOML",
        help="what changes along the clip: grounded, weights of legs, and any parameter",
    )  # fmt: skip


def finite(text: str) -> float:
    """A finite number, as the `type` of an option."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}; wanted a finite number")
    return value


def positive(text: str) -> float:
    """A finite number above 0, as the `type` of an option."""
    value = finite(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r}; wanted a number above 0")
    return value


def rates(text: str) -> list[float]:
    """Finite numbers above 0 with commas between them, as the `type` of an option."""
    return [positive(part) for part in text.split(",")]
