"""Words and options of the commands that read and convert files."""

from pathlib import Path

from .options import (
    Commands,
    add_clip_options,
    add_clip_units,
    add_command,
    add_output,
    number,
)

TEMPLATE = Path()
"""What `--joints` is without a file: no name that a file can have."""


def add_inspect(commands: Commands) -> None:
    """`jaxik inspect`."""
    inspect = add_command(
        commands, "inspect", "print what a loader understood of a clip",
        """
        jaxik inspect walk.bvh
        jaxik inspect walk.amc --asf skeleton.asf --json
        jaxik inspect walk.bvh --joints > map.toml     a joint map to be edited, and then used:
        jaxik inspect walk.bvh --joints map.toml
        """,
    )  # fmt: skip
    inspect.add_argument(
        "clip", type=Path, metavar="CLIP", help=".bvh, .amc, .glb, .gltf, .c3d or .npz"
    )
    inspect.add_argument("--json", action="store_true", help="as JSON")
    group = inspect.add_argument_group("how the clip is read (default: recognised or guessed)")
    group.add_argument(
        "--joints", type=Path, nargs="?", const=TEMPLATE, metavar="MAP.toml",
        help="which joint is which; without a file, print a map of this clip to be edited",
    )  # fmt: skip
    add_clip_units(group)


def add_terrain(commands: Commands) -> None:
    """`jaxik terrain`."""
    terrain = add_command(
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
    terrain.add_argument(
        "clip", type=Path, metavar="CLIP", help="captured: .bvh, .amc, .glb, .gltf, .c3d or .npz"
    )
    add_output(terrain, "MESH", ".ply, .obj or .stl")
    terrain.add_argument(
        "--model", choices=("auto", "plane", "smooth", "blocks"), default="auto",
        help="what is written (default: chosen by the error of prediction)",
    )  # fmt: skip
    terrain.add_argument(
        "--margin",
        type=number(0, 100, "metres"),
        default=1.0,
        metavar="M",
        help="of ground around the stances, m",
    )
    add_clip_options(terrain)


def add_record(commands: Commands) -> None:
    """`jaxik record`."""
    record = add_command(
        commands, "record", "show or convert the game's parameter record",
        """
        jaxik record show footik.bin
        jaxik record to-toml footik.bin -o footik.toml
        jaxik record to-bytes footik.toml --base footik.bin -o edited.bin
        """,
    )  # fmt: skip
    ways = record.add_subparsers(dest="way", required=True, metavar="show|to-toml|to-bytes")
    show = add_command(
        ways, "show", "print a record with its own names and ours",
        """
        jaxik record show footik.bin
        jaxik record show footik.bin --csv > footik.csv
        """,
    )  # fmt: skip
    show.add_argument("file", type=Path, help="binary record, .csv or parameter .toml")
    show.add_argument("--csv", action="store_true", help="as CSV with the record's own names")
    to_toml = add_command(
        ways, "to-toml", "a record as parameters with our names and units",
        "jaxik record to-toml footik.bin --length-unit cm -o footik.toml",
    )  # fmt: skip
    to_toml.add_argument("file", type=Path, help="binary record or .csv")
    add_output(to_toml, "TOML")
    to_bytes = add_command(
        ways, "to-bytes", "parameters as a binary record",
        """
        jaxik record to-bytes footik.toml --base footik.bin -o edited.bin

        With the record that `to-toml` read as the base, and the same options, everything that was
        not edited comes out unchanged, to the byte. Parameters for which the record has no room are
        named, and nothing is written, unless --drop leaves them out.
        """,
    )  # fmt: skip
    to_bytes.add_argument("file", type=Path, help="parameter .toml, or .csv")
    add_output(to_bytes, "BIN")
    to_bytes.add_argument("--base", type=Path, help="record with padding, tail and knee axis")
    to_bytes.add_argument(
        "--drop", action="store_true", help="leave out what the record has no room for"
    )
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
            "--tick-hz",
            type=number(1, 1000, "Hz"),
            default=30.0,
            help="rate of the gains' ticks (default: 30)",
        )


def add_export(commands: Commands) -> None:
    """`jaxik export`."""
    export = add_command(
        commands, "export", "write parameters as TOML, JSON, the game's record, or settings",
        """
        jaxik export runs/walk -o walk.json               parameters under our names
        jaxik export runs/walk -o footik.bin              the game's record, or as .csv
        jaxik export runs/walk --as unreal -o walk.csv    settings under Unreal's names, in cm
        jaxik export walk.csv -o parameters.toml          and back

        What a record or settings cannot hold is named, and nothing is written, unless --drop leaves
        it out. Settings are those of ozz's foot IK sample, of Unreal's character or of Mec's
        inspector, as .toml, .json or .csv.
        """,
    )  # fmt: skip
    export.add_argument(
        "source", type=Path, metavar="SOURCE",
        help="folder of a run, parameter .toml or .json, record .bin or .csv, or settings",
    )  # fmt: skip
    add_output(export, "FILE", ".toml, .json, .csv or .bin")
    export.add_argument(
        "--as", dest="system", choices=("ozz", "unreal", "mec"),
        help="write the settings of this system (default: parameters, or a record)",
    )  # fmt: skip
    export.add_argument(
        "--drop", action="store_true", help="leave out what the record or settings cannot hold"
    )
