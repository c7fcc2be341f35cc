"""Commands that explain: parameters, keys of experiment files, examples."""

import argparse
import json
import shutil
from pathlib import Path

from fitting.cli.terminal import show
from fitting.experiment import systems
from fitting.experiment.schema import experiment_schema
from fitting.report import guides
from fitting.report.formatting import aligned
from fitting.runtime import files
from fitting.studies import exports


def parameters(options: argparse.Namespace) -> int:
    """Lists the parameters of a preset."""
    ik = systems.preset_system(options.preset, faithful=options.faithful)
    listed = guides.list_parameters(ik, options.search or "")
    if not listed:
        raise ValueError(f"no parameter of {options.preset} mentions {options.search!r}")
    match options.format:
        case "text":
            text = guides.parameters_as_text(listed, _width(options.output))
        case "markdown":
            text = guides.parameters_as_markdown(listed)
        case _:
            text = guides.as_json(listed)
    return _print_or_write(text, options.output)


def schema(options: argparse.Namespace) -> int:
    """Lists the keys of experiment files, or writes their JSON Schema."""
    match options.format:
        case "text":
            text = guides.keys_as_text(experiment_schema(), _width(options.output))
        case "markdown":
            text = guides.keys_as_markdown(experiment_schema())
        case _:
            text = _schema_as_json()
    return _print_or_write(text, options.output)


def example(options: argparse.Namespace) -> int:
    """Lists the shipped experiments, or copies one with its files."""
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
    return json.dumps(experiment_schema(), indent=1, ensure_ascii=False, allow_nan=False)


def _width(output: Path | None) -> int:
    """Columns of the terminal; of a file 100."""
    return 100 if output is not None else shutil.get_terminal_size((100, 24)).columns


def _print_or_write(text: str, output: Path | None) -> int:
    if output is None:
        show(text)
    else:
        files.write_text(output, text + "\n")
        print(f"written to {output}")
    return 0
