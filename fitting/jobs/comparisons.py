"""The job that compares sampled runs."""

from collections.abc import Sequence
from pathlib import Path

from fitting.report.formatting import aligned, joined
from fitting.report.page.comparisons import runs_page
from fitting.report.uncertainty import run_comparison as report
from fitting.runtime import activity
from fitting.studies.posterior import run_comparison
from fitting.studies.posterior.run_comparison import ComparedRun

from .output import Log, log_output, output_folder, silent


def compare_runs(
    runs: Sequence[str | Path], output: str | Path | None = None, *, log: Log = silent
) -> list[ComparedRun]:
    """Compares sampled runs of several systems by what they predict of the same motion.

    Args:
        runs: folders that `fit` and `sample` have filled.
        output: folder for the table, the numbers and the page.
        log: called with what the command line prints.

    Raises:
        ValueError: as `studies.posterior.run_comparison.compare_runs`, or the folder cannot be
            made.
    """
    with output_folder(output) as folder:
        with activity.announced(f"Comparing {len(runs)} runs"):
            compared = run_comparison.compare_runs([Path(run) for run in runs])
            if folder is not None:
                report.write(folder, compared)
                runs_page.write(folder, compared)
        log(joined([aligned(report.table(compared)), report.explanation()], apart=True))
        log_output(log, folder, report.TABLE)
        return compared
