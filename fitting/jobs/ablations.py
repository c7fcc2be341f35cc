"""The job that fits an experiment without each of its rules."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fitting.experiments import captures
from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.in_memory.saving import with_files
from fitting.inference.optimisation.solution import Progress
from fitting.report import ablation_report
from fitting.report.page.studies import ablation_page
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies import ablation
from fitting.studies.ablation import Row

from .output import Log, log_output, output_folder, silent


@in_float64
def ablate(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
    *,
    folds: int = 2,
    progress: Callable[[Progress], None] | None = None,
    log: Log = silent,
) -> list[Row]:
    """Fits an experiment as it is and without each of its rules, cross-validated.

    What is left out stands in the experiment's [[without]] tables. Each finished fit is written at
    once, and a call with the same folder continues where an interrupted one ended.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the fits and the report.
        folds: number of parts into which each clip is cut.
        progress: called as a fit goes on; its stage names the variant and the part.
        log: called with what the command line prints.

    Raises:
        ValueError: as `studies.ablation.ablate`, the experiment fits a capture, too, or the folder
            cannot be made.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    captures.refuse(experiment.capture, str(experiment.path), "ablate")
    with output_folder(output) as folder:
        experiment = replace(with_files(experiment, folder), holdout=0.0)

        def log_row(row: Row) -> None:
            log(ablation_report.row_text(row))

        rows = ablation.ablate(experiment, folder, folds=folds, progress=progress, on_row=log_row)
        if folder is not None:
            with activity.announced("Drawing the report"):
                ablation_report.write(folder, experiment, rows)
                ablation_page.write(folder, experiment, rows)
        log(ablation_report.tables_text(rows))
        log_output(log, folder, ablation_report.TABLE)
        return rows
