"""Commands that explain: parameters, keys of experiment files, examples."""

import argparse
import json
import shutil
from collections.abc import Callable
from pathlib import Path

from .options import argument, command, flag
from .terminal import show

FORMAT = (
    argument("--format", choices=("text", "markdown", "json"), default="text"),
    argument("-o", "--output", type=Path, metavar="FILE", help="instead of printing"),
)


@command(
    argument(
        "preset", nargs="?", default="record", metavar="PRESET",
        help="of jaxik.presets (default: record)",
    ),
    flag("--faithful", "the original, where the preset differs from it"),
    argument("--search", metavar="WORD", help="only those with this word in their name or meaning"),
    *FORMAT,
)  # fmt: skip
def parameters(options: argparse.Namespace) -> int:
    """List a preset's parameters: default, unit, range, meaning.

    jaxik parameters
    jaxik parameters stride --search knee
    jaxik parameters ozz --format json -o ozz.json
    """
    from fitting.experiment.systems import preset_system
    from fitting.report import guides

    ik = preset_system(options.preset, faithful=options.faithful)
    listed = guides.list_parameters(ik, options.search or "")
    if not listed:
        raise ValueError(f"no parameter of {options.preset} mentions {options.search!r}")
    table = guides.parameter_table(listed, headings=options.format == "text")
    return _print_or_write(options, table, lambda: guides.as_json(listed))


@command(*FORMAT)
def schema(options: argparse.Namespace) -> int:
    """List all keys of experiment files, or write their JSON Schema.

    jaxik schema                                         as text
    jaxik schema --format json -o experiment.schema.json

    With the first line `#:schema experiment.schema.json` in an experiment file beside it,
    editors with a TOML language server, such as Taplo, complete and check the file.
    """
    from fitting.experiment.schema import experiment_schema
    from fitting.report import guides

    return _print_or_write(options, guides.key_table(experiment_schema()), _schema_as_json)


def _print_or_write(
    options: argparse.Namespace, table: list[list[str]], as_json: Callable[[], str]
) -> int:
    """Prints or writes as `FORMAT` says; as wide as the terminal, or 100 columns in a file."""
    from fitting.report import formatting
    from fitting.runtime import files

    width = 100 if options.output is not None else shutil.get_terminal_size((100, 24)).columns
    match options.format:
        case "text":
            text = formatting.wrapped(table, width)
        case "markdown":
            text = formatting.markdown(table)
        case _:
            text = as_json()
    if options.output is None:
        show(text)
    else:
        files.write_text(options.output, text + "\n")
        print(f"written to {options.output}")
    return 0


@command(
    argument("name", nargs="?", metavar="NAME", help="left out, they are listed"),
    argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="folder for the experiment with its clips and terrain (default: NAME)",
    ),
)  # fmt: skip
def example(options: argparse.Namespace) -> int:
    """List the experiments that come with jaxik, or copy one.

    jaxik example
    jaxik example uneven_walk -o walk
    jaxik fit walk/uneven_walk.toml -o runs/walk
    """
    from fitting.report.formatting import aligned
    from fitting.studies import exports

    if options.name is None:
        if options.output is not None:
            raise ValueError("-o needs the NAME of an experiment; `jaxik example` lists them")
        rows = [[name, title] for name, title in exports.names().items()]
        show(aligned([["name", "experiment"], *rows]))
        return 0
    folder = Path(options.name).name if options.output is None else options.output
    path = exports.copy(options.name, Path(folder), _schema_as_json())
    print(f"written to {path}; now: jaxik fit {path} -o runs/{path.stem}")
    return 0


def _schema_as_json() -> str:
    from fitting.experiment.schema import experiment_schema

    return json.dumps(experiment_schema(), indent=1, ensure_ascii=False, allow_nan=False)
