"""Options that several commands share, and how a command is added to the parser."""

import argparse
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, TypeAlias, TypeVar

from fitting.runtime import validation

Number = TypeVar("Number", int, float)
Commands: TypeAlias = argparse._SubParsersAction


class Parser(argparse.ArgumentParser):
    """A parser that reports a mistake as the commands do: in one line, with status 2."""

    def error(self, message: str) -> NoReturn:
        """Prints what is wrong with the words, without the usage, and exits."""
        line = validation.in_one_line(ValueError(message))
        self.exit(2, f"{self.prog}: {line}; see `{self.prog} --help`\n")


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
        "--floor",
        type=number(-1e6, 1e6, "metres"),
        default=0.0,
        metavar="M",
        help="height of the clip's floor, m",
    )
    command.add_argument(
        "--root", choices=("auto", "animation", "ground"), default="auto",
        help="keep the root of the clip, or let it follow the ground below it; auto keeps it where "
        "foot IK reaches the ground from there, or where the feet follow this terrain already",
    )  # fmt: skip
    command.add_argument(
        "--speed", type=number(0.01, 100), default=1.0, metavar="X",
        help="let the root travel X times as far as in the clip; strides are scaled with it",
    )  # fmt: skip
    command.add_argument(
        "--tracks", type=Path, metavar="TOML",
        help="what changes along the clip: grounded, weights of legs, and any parameter",
    )  # fmt: skip


def number(low: int | float, high: int | float, unit: str = "") -> Callable[[str], float]:
    """A number in a range, as the `type` of an option."""
    return _read(float, validation.number(low, high, unit))


def count(low: int, high: int) -> Callable[[str], int]:
    """A whole number in a range, as the `type` of an option."""
    return _read(int, validation.count(low, high))


def rates(text: str) -> list[float]:
    """Frame rates with commas between them, as the `type` of an option."""
    return [rate(part) for part in text.split(",")]


def _read(
    convert: Callable[[str], Number], wanted: validation.Constraint
) -> Callable[[str], Number]:
    def read(text: str) -> Number:
        try:
            value = convert(text)
        except ValueError:
            value = None
        if value is None or not wanted.accepts(value):
            raise argparse.ArgumentTypeError(f"{text!r}; wanted {wanted.description}")
        return value

    return read


rate = _read(float, validation.RATE)
