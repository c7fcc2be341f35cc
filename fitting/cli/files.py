"""Commands that read and convert files."""

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fitting.runtime import activity
from fitting.runtime.validation import error_context

from .options import (
    CLIP_GROUP,
    CLIP_OPTIONS,
    CLIP_UNITS,
    CLIPS,
    Command,
    argument,
    clip_options,
    command,
    compiled,
    count,
    flag,
    group,
    number,
    output,
    subcommands,
)
from .terminal import show

if TYPE_CHECKING:
    from jaxik.record import Reading, Record

LANGUAGES = ("c", "cs", "js")  # of code
ADDON = "blender-addon"
TEMPLATE = Path()
"""What `--joints` is without a file: no name that a file can have."""


@command(
    argument("clip", type=Path, metavar="CLIP", help=CLIPS),
    flag("--json", "as JSON"),
    flag("--contacts", "print when each foot stands, as a contacts file to be edited"),
    group(
        CLIP_GROUP,
        argument(
            "--joints", type=Path, nargs="?", const=TEMPLATE, metavar="MAP.toml",
            help="which joint is which; without a file, print a map of this clip to be edited",
        ),
        *CLIP_UNITS,
    ),
)  # fmt: skip
def inspect(options: argparse.Namespace) -> int:
    """Print what a loader understood of a clip.

    jaxik inspect walk.bvh
    jaxik inspect walk.amc --asf skeleton.asf --json
    jaxik inspect walk.bvh --joints > map.toml     a joint map to be edited, and then used:
    jaxik inspect walk.bvh --joints map.toml
    jaxik inspect walk.bvh --contacts > walk.contacts.toml    beside the clip, it is always read
    """
    from fitting.clips import load_clip, stances, summary
    from fitting.clips.load import draft_joint_map
    from fitting.report.formatting import TableText

    reading = clip_options(options)
    if options.joints == TEMPLATE:
        if options.json or options.contacts:
            raise ValueError("a joint map is not printed with --json or --contacts; leave that out")
        with activity.announced(f"Reading {options.clip.name}"):
            drafted = draft_joint_map(options.clip, reading)
        print(drafted)
        return 0
    with activity.announced(f"Reading {options.clip.name}"):
        # Redirected to where it is read, the contacts file is already empty.
        clip = load_clip(options.clip, contacts=not options.contacts, **reading.given)
    if options.contacts:
        if options.json:
            raise ValueError("--json is for what was understood, and not for contacts")
        print(stances.to_toml(clip), end="")
        return 0
    described = summary.describe(clip)
    if options.json:
        print(summary.as_json(described))
    else:
        show(TableText(summary.as_text(described), summary.rows(described), is_prose=True))
    return 0


@command(
    argument(
        "clip", type=Path, metavar="CLIP", help=f"captured: {CLIPS}",
    ),
    output("MESH", ".ply, .obj or .stl"),
    argument(
        "--model", choices=("auto", "plane", "smooth", "blocks"), default="auto",
        help="what is written (default: chosen by the error of prediction)",
    ),
    argument(
        "--margin", type=number(0, 100, "metres"), default=1.0, metavar="M",
        help="of ground around the stances, m",
    ),
    CLIP_OPTIONS,
)  # fmt: skip
@compiled
def terrain(options: argparse.Namespace) -> int:
    """Reconstruct the ground of a captured clip from its stances.

    jaxik terrain walk.bvh -o ground.ply
    jaxik terrain walk.amc -o ground.obj --sole 0.045 --model smooth --margin 2

    Three models are fitted to the stances: a plane, a smooth surface, and level blocks on a
    grid. The table shows how well each predicts a stance from all the others; the simplest one
    that is not clearly worse is written. A plot and all numbers go beside it: ground.png,
    ground.json.
    """
    from fitting import jobs

    jobs.reconstruct_terrain(
        options.clip,
        options.output,
        model=None if options.model == "auto" else options.model,
        margin=options.margin,
        options=clip_options(options),
    )
    return 0


RECORD_UNITS = (
    argument(
        "--length-unit", choices=("auto", "m", "cm"), default="auto",
        help="of rays and ankle heights in the record (default: by their size)",
    ),
    argument(
        "--knee", choices=("interior", "flexion"), default="interior",
        help="which angle the record's knee limits are (default: interior)",
    ),
    argument("--lean-sign", type=int, choices=(1, -1), default=1, help="of the undulation rates"),
    argument(
        "--tick-hz", type=number(1, 1000, "Hz"), default=30.0,
        help="rate of the gains' ticks (default: 30)",
    ),
)  # fmt: skip


@command(
    argument("file", type=Path, help="binary record, .csv or parameter .toml"),
    flag("--csv", "as CSV with the record's own names"),
    *RECORD_UNITS,
    name="show",
)
@compiled
def show_record(options: argparse.Namespace) -> int:
    """Print a record with its own names and ours.

    jaxik record show footik.bin
    jaxik record show footik.bin --csv > footik.csv
    """
    from fitting.experiment import record_files
    from jaxik.record import to_csv

    units = _record_units(options)
    records = record_files.read(options.file, units, None, drop=True)  # of what is only shown
    if options.csv:
        print(to_csv(records).rstrip())
    else:
        with error_context(options.file):
            print("\n\n".join(record_files.describe(entry, units) for entry in records))
    return 0


@command(argument("file", type=Path, help="binary record or .csv"), output("TOML"), *RECORD_UNITS)
@compiled
def to_toml(options: argparse.Namespace) -> int:
    """A record as parameters with our names and units.

    jaxik record to-toml footik.bin --length-unit cm -o footik.toml
    """
    from fitting.experiment import parameter_files, record_files, systems
    from fitting.runtime import files
    from jaxik.record import Record, besides_parameters, to_ik

    units = _record_units(options)
    only = _only_record(options.file, record_files.read(options.file, units, None, drop=True))
    with error_context(options.file):
        ik = to_ik(only, units)
        text = parameter_files.system_to_toml(ik, systems.Preset("record", faithful=True))
    files.write_text(options.output, text)
    if (rest := besides_parameters(only)) != besides_parameters(Record()):
        warnings.warn(
            f"{', '.join(rest)}: no parameters, so not in {options.output}; `record to-bytes` "
            f"takes them from --base {options.file}",
            stacklevel=2,
        )
    print(f"written to {options.output}")
    return 0


@command(
    argument("file", type=Path, help="parameter .toml, or .csv"),
    output("BIN"),
    argument("--base", type=Path, help="record with padding, tail and knee axis"),
    flag("--drop", "leave out what the record has no room for"),
    *RECORD_UNITS,
)
@compiled
def to_bytes(options: argparse.Namespace) -> int:
    """Parameters as a binary record.

    jaxik record to-bytes footik.toml --base footik.bin -o edited.bin

    With the record that `to-toml` read as the base, and the same options, everything that was
    not edited comes out unchanged, to the byte. Parameters for which the record has no room are
    named, and nothing is written, unless --drop leaves them out.
    """
    from fitting.experiment import record_files
    from fitting.runtime import files
    from jaxik.record import to_bytes as as_bytes

    base = None if options.base is None else record_files.read_binary(options.base)
    records = record_files.read(options.file, _record_units(options), base, drop=options.drop)
    only = _only_record(options.file, records)
    files.write(options.output, lambda path: path.write_bytes(as_bytes(only)))
    print(f"written to {options.output}")
    return 0


def _record_units(options: argparse.Namespace) -> "Reading":
    """What `RECORD_UNITS` add."""
    from jaxik.record import Reading

    return Reading(options.length_unit, options.knee, options.lean_sign, options.tick_hz)


def _only_record(path: Path, records: "Sequence[Record]") -> "Record":
    """The record of a file that must not hold several."""
    (only, *more) = records
    if more:
        raise ValueError(f"{path} has {1 + len(more)} rows; give a file with one record")
    return only


record = Command(
    "record",
    """Show or convert the game's parameter record.

    jaxik record show footik.bin
    jaxik record to-toml footik.bin -o footik.toml
    jaxik record to-bytes footik.toml --base footik.bin -o edited.bin
    """,
    (subcommands("show|to-toml|to-bytes", show_record, to_toml, to_bytes),),
)


@command(
    argument(
        "source", type=Path, metavar="SOURCE", nargs="?",
        help="folder of a run, parameter .toml or .json, record .bin or .csv, or settings; none "
        "for the add-on",
    ),
    output("FILE", ".toml, .json, .csv or .bin"),
    argument(
        "--as", dest="form", choices=("ozz", "unreal", "mec", *LANGUAGES, ADDON),
        help="write the settings of this system, code, or the add-on for Blender (default: "
        "parameters, or a record)",
    ),
    flag("--drop", "leave out what the record or settings cannot hold"),
    group(
        "of code",
        argument(
            "--trace", type=Path, metavar="CLIP",
            help="also write what the system makes of this clip, and a program that replays it",
        ),
        argument(
            "--terrain", type=Path, metavar="MESH",
            help="under that clip: .ply, .obj, ..., .npz, .npy, .png (default: a level floor)",
        ),
        argument(
            "--legs", type=count(1, 64), metavar="N",
            help="of a character (default: those of the clip, or 2)",
        ),
        argument("--name", metavar="NAME", help="prefix of all names (default: footik)"),
        argument(
            "--axes", choices=("unreal", "unity", "godot"),
            help="convert from the axes and units of this engine, and back",
        ),
    ),
)  # fmt: skip
def export(options: argparse.Namespace) -> int:
    """Write parameters as TOML, JSON, the game's record, settings or code; or Blender's add-on.

    jaxik export runs/walk -o walk.json               parameters under our names
    jaxik export runs/walk -o footik.bin              the game's record, or as .csv
    jaxik export runs/walk --as unreal -o walk.csv    settings under Unreal's names, in cm
    jaxik export walk.csv -o parameters.toml          and back
    jaxik export runs/walk --as c -o walk             the system itself, as C code
    jaxik export runs/walk --as c -o walk --trace walk.bvh --terrain steps.obj
    jaxik export runs/walk --as cs -o walk --axes unity    and in C#, for Unity
    jaxik export runs/walk --as js -o walk            and as a module of JavaScript
    jaxik export --as blender-addon -o addon          what Blender installs from disk

    What a record or settings cannot hold is named, and nothing is written, unless --drop leaves
    it out. Settings are those of ozz's foot IK sample, of Unreal's character or of Mec's
    inspector, as .toml, .json or .csv. Code needs no library, and says in its head how an engine
    calls it and casts its rays.
    """
    from fitting import jobs

    code = {name: getattr(options, name) for name in ("trace", "terrain", "legs", "name", "axes")}
    wanted = [f"--{name}" for name, value in code.items() if value is not None]
    if options.form == ADDON:
        if options.source is not None or options.drop or wanted:
            raise ValueError(
                f"--as {ADDON} takes only -o: in Blender one chooses a preset or a parameter file"
            )
        path = jobs.export_blender_addon(options.output)
        print(f"written to {path}; in Blender, choose Install from Disk under Get Extensions")
        return 0
    if options.source is None:
        raise ValueError("there is no SOURCE; wanted a run, or a file of parameters")
    if options.form in LANGUAGES:
        _export_code(options)
    elif wanted:
        raise ValueError(f"{', '.join(wanted)}: only for code; wanted --as c as well")
    else:
        jobs.export(options.source, options.output, system=options.form, drop=options.drop)
    print(f"written to {options.output}")
    return 0


def _export_code(options: argparse.Namespace) -> None:
    from fitting import jobs

    if options.drop:
        raise ValueError("--drop: only for a record and for settings; code holds everything")
    if options.form == "js" and options.axes is not None:
        raise ValueError("--axes: only for C and C#; pages have our axes")
    if options.trace is None and options.terrain is not None:
        raise ValueError("--terrain: the ground under a clip; wanted --trace CLIP as well")
    if options.trace is not None and options.legs is not None:
        raise ValueError("--legs: a trace has the legs of its clip; leave out one of the two")
    jobs.export_code(
        options.source, options.output,
        language=options.form, name=options.name or "footik", axes=options.axes,
        legs=options.legs or 2, trace=options.trace, terrain=options.terrain,
    )  # fmt: skip
