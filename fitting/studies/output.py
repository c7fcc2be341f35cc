"""What jobs share: reading an experiment, claiming a folder, publishing results."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.report import pages
from fitting.report.document import Document, text
from fitting.report.formatting import joined
from fitting.runtime import activity
from fitting.runtime.claimed_folder import claimed

from .fit import run_folder


def as_experiment(experiment: Experiment | str | Path) -> Experiment:
    """The experiment, read if it is the path of a file.

    Raises:
        ValueError: it cannot be read.
    """
    return experiment if isinstance(experiment, Experiment) else load_experiment(experiment)


@contextmanager
def output_folder(output: str | Path | None) -> Iterator[Path | None]:
    """The folder for the results, if one is wanted, claimed while a job fills it.

    Raises:
        ValueError: it cannot be made, or another process is filling it.
    """
    if output is None:
        yield None
        return
    run_folder.check_output_folder(Path(output))
    with claimed(Path(output)):
        yield Path(output)


def publish(folder: Path | None, document: Document) -> None:
    """Writes a document into the folder, if there is one, and logs it in brief."""
    if folder is not None:
        with activity.announced("Drawing the report"):
            document.write(folder)
    activity.log(joined(["", text(document)]))
    log_output(folder, document.file)


def log_output(folder: Path | None, name: str) -> None:
    """Logs where the results are, and the name of the file to read first."""
    if folder is not None:
        page = folder / pages.PAGE
        in_browser = f", or open {page} in a browser" if page.is_file() else ""
        activity.log(f"written to {folder}; read {folder / name}{in_browser}")
