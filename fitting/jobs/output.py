"""Where a job's results and its lines of text go."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from fitting.studies import run_folder

Log: TypeAlias = Callable[[str], object]
"""Takes a line or a table, as the command line prints it."""


def silent(text: str) -> None:
    """Drops a line of the log."""


def checked_folder(output: str | Path | None) -> Path | None:
    """The folder for the results, if there is to be one; ValueError if it cannot be made."""
    if output is None:
        return None
    run_folder.check_output_folder(Path(output))
    return Path(output)


def log_output(log: Log, folder: Path | None, text: str) -> None:
    """Logs where the results are, and the name of the file to read first."""
    if folder is not None:
        log(f"written to {folder}; read {folder / text}")
