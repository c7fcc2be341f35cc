"""How a command is declared beside the call that runs it, and options that several share."""

import argparse
import functools
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from fitting.runtime import declarations

if TYPE_CHECKING:
    from fitting.clips.load import ClipOptions
    from fitting.ground.meshes import TerrainOptions

Number = TypeVar("Number", int, float)
Call: TypeAlias = Callable[[argparse.Namespace], int]
"""Runs a command and returns its exit status."""
Option: TypeAlias = Callable[[Any], object]
"""Adds words to a parser, or to a group of its options."""


@dataclass(frozen=True)
class Command:
    """A word after `jaxik`, with its options and what it does."""

    name: str
    text: str
    """What the command does, in a sentence; then examples of its use."""
    options: tuple[Option, ...]
    call: Call | None = None
    """None where one of `subcommands` is called."""
    needs_jax: bool = True
    """Whether JAX is started before the call."""

    def add_to(self, commands: "argparse._SubParsersAction[Any]") -> None:
        """Adds the command to those of a parser."""
        summary, _, example = self.text.partition("\n")
        parser = commands.add_parser(
            self.name,
            help=summary[:1].lower() + summary[1:].rstrip("."),
            description=summary,
            epilog="example:\n" + textwrap.indent(textwrap.dedent(example).strip(), "  "),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser.set_defaults(call=self.call, parser=parser, needs_jax=self.needs_jax)
        for add in self.options:
            add(parser)


def command(*options: Option, name: str = "", needs_jax: bool = True) -> Callable[[Call], Command]:
    """Makes a command of the call that runs it, whose docstring is the help."""

    def make(call: Call) -> Command:
        own_name = name or call.__name__.replace("_", "-")
        return Command(own_name, call.__doc__ or "", options, call, needs_jax)

    return make


def compiled(call: Call) -> Call:
    """The call with 64-bit floats, and with its compiled programs cached for later commands."""

    @functools.wraps(call)
    def run(options: argparse.Namespace) -> int:
        from fitting.runtime import cache_folder, precision

        cache_folder.use_default()
        return precision.in_float64(call)(options)

    return run


def argument(*names: str, **properties: Any) -> Option:
    """An argument or option, as `argparse` takes it."""
    return lambda parser: parser.add_argument(*names, **properties)


def flag(name: str, description: str) -> Option:
    """An option without a value."""
    return argument(name, action="store_true", help=description)


def output(metavar: str, description: str | None = None) -> Option:
    """`-o`, where results are written."""
    return argument("-o", "--output", type=Path, required=True, metavar=metavar, help=description)


def group(title: str, *options: Option) -> Option:
    """Options under a title of their own."""

    def add(parser: argparse.ArgumentParser) -> None:
        titled = parser.add_argument_group(title)
        for option in options:
            option(titled)

    return add


def subcommands(metavar: str, *commands: Command) -> Option:
    """One of these words after that of the command."""

    def add(parser: argparse.ArgumentParser) -> None:
        words = parser.add_subparsers(required=True, metavar=metavar)
        for each in commands:
            each.add_to(words)

    return add


def number(low: int | float, high: int | float, unit: str = "") -> Callable[[str], float]:
    """A number in a range, as the `type` of an option."""
    return _read(float, declarations.number(low, high, unit))


def count(low: int, high: int) -> Callable[[str], int]:
    """A whole number in a range, as the `type` of an option."""
    return _read(int, declarations.count(low, high))


def rates(text: str) -> list[float]:
    """Frame rates with commas between them, as the `type` of an option."""
    return [rate(part) for part in text.split(",")]


def _read(
    convert: Callable[[str], Number], wanted: declarations.Constraint
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


rate = number(1, 1000, "Hz")

CLIP_GROUP = "how the clip is read (default: recognised or guessed)"
CLIPS = ".bvh, .amc, .glb, .gltf, .c3d, .trc, .csv, .npy or .npz"
CLIP_UNITS = (
    argument(
        "--scale", type=number(1e-9, 1e6), metavar="M", help="metres per unit of the clip's file"
    ),
    argument("--up", choices=("y", "z"), help="up axis of the clip's file"),
    argument(
        "--asf", type=Path, metavar="ASF", help="skeleton of an .amc, where it is not beside it"
    ),
    argument(
        "--animation", metavar="NAME", help="which animation of a .glb or .gltf that has several"
    ),
    argument(
        "--travel", choices=("auto", "stances", "none"),
        help="move the root so that standing feet stay put (stances), leave it (none), or move it "
        "where the clip is clearly a cycle in place (default: auto)",
    ),
    argument(
        "--sole", type=number(0, 10, "metres"), metavar="M",
        help="height of the ball joints over the soles, m (default: measured or estimated)",
    ),
)  # fmt: skip
CLIP_OPTIONS = group(
    CLIP_GROUP,
    argument(
        "--joints", type=Path, metavar="MAP.toml",
        help="which joint is which; `jaxik inspect CLIP --joints` writes a map to be edited",
    ),
    *CLIP_UNITS,
)  # fmt: skip
"""What the user knows better than a motion file."""


def clip_options(options: argparse.Namespace) -> "ClipOptions":
    """What `CLIP_OPTIONS` add."""
    from fitting.clips.load import ClipOptions

    return ClipOptions(**{name: getattr(options, name) for name in declarations.keys(ClipOptions)})


TERRAIN_OPTIONS = group(
    "how the terrain is read",
    argument("--file-up", choices=("y", "z"), default="y", help="up axis of its file (default: y)"),
    argument(
        "--terrain-scale", type=number(1e-9, 1e6), metavar="M",
        help="metres per unit of its file, 0.01 for centimetres (default: 1); of a .png, per level",
    ),
    argument(
        "--terrain-offset", type=number(-1e6, 1e6, "metres"), nargs=3,
        metavar=("X", "Y", "Z"), help="then move it, m, y up",
    ),
    argument(
        "--terrain-cell", type=number(1e-3, 1e4, "metres"), metavar="M",
        help="between the heights of a .png or .npy, m",
    ),
)  # fmt: skip
"""How the numbers of a terrain's file become metres."""


def terrain_options(options: argparse.Namespace) -> "TerrainOptions":
    """What `TERRAIN_OPTIONS` add."""
    from fitting.ground.meshes import TerrainOptions

    known = declarations.keys(TerrainOptions)
    values = {name: getattr(options, name) for name in known if getattr(options, name) is not None}
    return TerrainOptions(**{name: known[name].constraint.convert(v) for name, v in values.items()})


ADDRESS = (
    argument(
        "--host", default="127.0.0.1", metavar="ADDRESS",
        help="where the page listens (default: 127.0.0.1, for this machine only)",
    ),
    argument(
        "--port", type=count(0, 65535), default=8080, metavar="N",
        help="of the page; the next free one where it is in use, 0 for any (default: 8080)",
    ),
)  # fmt: skip
"""Where a page is served."""
