"""Options that several commands share, and how a command is added to the parser."""

import argparse
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, TypeVar

from fitting.cli.help_texts import help_formatter
from fitting.runtime import validation

Number = TypeVar("Number", int, float)
Commands: TypeAlias = argparse._SubParsersAction


class Parser(argparse.ArgumentParser):
    """A parser that reports a mistake as the commands do: in one line, with status 2."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(
            r"-(\.?\d|inf)"
        )  # argparse takes -1e3 for an option

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
        formatter_class=help_formatter(),
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
        help=".bvh, .amc, .glb, .gltf, .c3d or .npz over flat ground; of a blocks .npz its base",
    )  # fmt: skip
    add_placement(command, required=required)


def add_placement(command: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Adds the terrain of a flat animation, and how both lie."""
    command.add_argument(
        "--terrain",
        type=Path,
        required=required,
        metavar="MESH",
        help=".ply, .obj, .glb, ..., or heights as .npz, .npy, .png",
    )
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
    add_clip_options(command)
    add_terrain_options(command)


def add_clip_options(command: argparse.ArgumentParser) -> None:
    """Adds what the user knows better than a motion file; see `ClipOptions`."""
    group = command.add_argument_group("how the clip is read (default: recognised or guessed)")
    group.add_argument(
        "--joints", type=Path, metavar="MAP.toml",
        help="which joint is which; `jaxik inspect CLIP --joints` writes a map to be edited",
    )  # fmt: skip
    add_clip_units(group)


def add_clip_units(group: argparse._ArgumentGroup) -> None:
    """Adds the options of `add_clip_options` but for the joint map."""
    group.add_argument(
        "--scale", type=number(1e-9, 1e6), metavar="M", help="metres per unit of the clip's file"
    )
    group.add_argument("--up", choices=("y", "z"), help="up axis of the clip's file")
    group.add_argument(
        "--asf", type=Path, metavar="ASF", help="skeleton of an .amc, where it is not beside it"
    )
    group.add_argument(
        "--animation", metavar="NAME", help="which animation of a .glb or .gltf that has several"
    )
    group.add_argument(
        "--travel", choices=("auto", "stances", "none"),
        help="move the root so that standing feet stay put (stances), leave it (none), or move it "
        "where the clip is clearly a cycle in place (default: auto)",
    )  # fmt: skip
    group.add_argument(
        "--sole", type=number(0, 10, "metres"), metavar="M",
        help="height of the ball joints over the soles, m (default: measured or estimated)",
    )  # fmt: skip


def add_terrain_options(command: argparse.ArgumentParser) -> None:
    """Adds how the numbers of a terrain's file become metres; see `TerrainOptions`."""
    group = command.add_argument_group("how the terrain is read")
    group.add_argument(
        "--file-up", choices=("y", "z"), default="y", help="up axis of its file (default: y)"
    )
    group.add_argument(
        "--terrain-scale", type=number(1e-9, 1e6), metavar="M",
        help="metres per unit of its file, 0.01 for centimetres (default: 1); of a .png, per level",
    )  # fmt: skip
    group.add_argument(
        "--terrain-offset", type=number(-1e6, 1e6, "metres"), nargs=3, default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "Z"), help="then move it, m, y up",
    )  # fmt: skip
    group.add_argument(
        "--terrain-cell", type=number(1e-3, 1e4, "metres"), metavar="M",
        help="between the heights of a .png or .npy, m",
    )  # fmt: skip


def add_address(command: argparse.ArgumentParser) -> None:
    """Adds where a page is served."""
    command.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS",
        help="where the page listens (default: 127.0.0.1, for this machine only)",
    )  # fmt: skip
    command.add_argument(
        "--port", type=count(0, 65535), default=8080, metavar="N",
        help="of the page; the next free one where it is in use, 0 for any (default: 8080)",
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
