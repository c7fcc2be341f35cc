"""Commands that read and convert files."""

import argparse
import warnings
from contextlib import AbstractContextManager
from pathlib import Path

from fitting import jobs
from fitting.cli.parsers.files import TEMPLATE
from fitting.cli.terminal import show
from fitting.clips import load_clip, summary
from fitting.clips.load import draft_joint_map
from fitting.experiment import parameter_files, record_files, systems
from fitting.ground.reconstruction import reconstruct
from fitting.report.formatting import TableText, aligned
from fitting.runtime import activity, files
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from fitting.studies import terrain_report
from jaxik import record

from . import reading


def inspect(options: argparse.Namespace) -> int:
    """Prints what a loader understood of a clip, or a joint map of it."""
    how = reading.clip_options(options)
    if options.joints == TEMPLATE:
        if options.json:
            raise ValueError("--json is for what was understood, and not for a joint map")
        with _announced(options.clip):
            drafted = draft_joint_map(options.clip, how)
        print(drafted)
        return 0
    with _announced(options.clip):
        clip = load_clip(options.clip, **vars(how))
    described = summary.describe(clip)
    if options.json:
        print(summary.as_json(described))
    else:
        show(TableText(summary.as_text(described), summary.rows(described), is_prose=True))
    return 0


def _announced(clip: Path) -> AbstractContextManager[activity.Work]:
    return activity.announced(f"Reading {clip.name}")


@in_float64
def terrain(options: argparse.Namespace) -> int:
    """Reconstructs the ground of a clip; writes a mesh, its numbers and a plot."""
    terrain_report.check_output_files(options.output)
    with _announced(options.clip):
        clip = load_clip(options.clip, **vars(reading.clip_options(options)))
    kind = None if options.model == "auto" else options.model
    with activity.announced(f"Reconstructing the ground of {options.clip.name}"):
        ground = reconstruct(clip, kind=kind)
    with activity.announced("Drawing and writing the ground"):
        terrain_report.write(options.output, ground, clip, options.margin)
    print(f"{terrain_report.count_stances(ground)}\n")
    show(aligned(terrain_report.prediction_table(ground)))
    print(f"\n{terrain_report.describe_surface(ground)}; written to {options.output}")
    return 0


@in_float64
def convert_record(options: argparse.Namespace) -> int:
    """Shows the game's record, or converts it from or to our parameters."""
    units = record.Reading(options.length_unit, options.knee, options.lean_sign, options.tick_hz)
    base_path = getattr(options, "base", None)  # an option of to-bytes only
    base = None if base_path is None else record_files.read_binary(base_path)
    drop = options.way != "to-bytes" or options.drop  # what is only shown is not lost
    records = record_files.read(options.file, units, base, drop=drop)
    if options.way == "show":
        if options.csv:
            print(record.to_csv(records).rstrip())
        else:
            with error_context(options.file):
                print("\n\n".join(record_files.describe(entry, units) for entry in records))
        return 0
    (only, *more) = records
    if more:
        raise ValueError(f"{options.file} has {1 + len(more)} rows; give a file with one record")
    if options.way == "to-toml":
        with error_context(options.file):
            text = parameter_files.system_to_toml(
                record.to_ik(only, units), systems.Preset("record", faithful=True)
            )
        files.write_text(options.output, text)
        if (rest := record.besides_parameters(only)) != record.besides_parameters(record.Record()):
            warnings.warn(
                f"{', '.join(rest)}: no parameters, so not in {options.output}; `record to-bytes` "
                f"takes them from --base {options.file}",
                stacklevel=2,
            )
    else:
        files.write(options.output, lambda path: path.write_bytes(record.to_bytes(only)))
    print(f"written to {options.output}")
    return 0


def export(options: argparse.Namespace) -> int:
    """Writes parameters in another form."""
    jobs.export(options.source, options.output, system=options.system, drop=options.drop)
    print(f"written to {options.output}")
    return 0
