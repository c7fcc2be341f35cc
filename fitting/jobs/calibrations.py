"""The job that asks whether what fits and posteriors say of an experiment is true."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.in_memory.saving import with_files
from fitting.experiments.problems import make_problem
from fitting.report.calibration import calibration_report
from fitting.report.formatting import joined
from fitting.report.page.studies import calibration_page
from fitting.runtime import activity
from fitting.runtime.parallel import cluster
from fitting.runtime.precision import in_float64
from fitting.studies.calibration import calibration
from fitting.studies.calibration.assessment import Assessment, assess
from fitting.studies.calibration.calibration import CalibrationProgress, Observers

from .output import Log, log_output, output_folder, silent


@in_float64
def calibrate(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
    *,
    replicates: int = 200,
    chains: bool = False,
    noise_factor: float = 1.0,
    workers: int = 0,
    scheduler: str | None = None,
    progress: Callable[[CalibrationProgress], None] = lambda report: None,
    log: Log = silent,
) -> Assessment:
    """Fits an experiment to motion simulated from random truths, and judges what the fits say.

    Truths are drawn from the experiment's prior; each is simulated with the experiment's noise and
    fitted as `fit` does. Each finished fit or chain is written at once, and a call with the same
    folder continues where an interrupted one ended, also with more replicates or with chains.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the replicates and the report.
        replicates: number of truths.
        chains: whether to sample each posterior as `sample` does; a chain takes much longer than a
            fit.
        noise_factor: how much larger the simulated noise is than the experiment says: whether fits
            notice, or estimate it.
        workers: processes on this machine that compute; 0 computes in this process.
        scheduler: address of the scheduler of a Dask cluster that computes instead.
        progress: called as fits and chains go on.
        log: called with what the command line prints.

    Raises:
        ValueError: the experiment is wrong or does not fit its clips; it is one whose noise cannot
            be simulated; the folder holds another calibration; there is not one replicate; there
            is no such cluster.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    with output_folder(output) as folder:
        experiment = replace(with_files(experiment, folder), holdout=0.0)
        problem = make_problem(experiment)
        log(f"{replicates} truths of {problem.space.size} parameters of {experiment.preset}")
        observers = Observers(
            progress,
            lambda fitted: log(calibration_report.fit_line(fitted)),
            lambda chain: log(calibration_report.chain_line(chain)),
        )
        with cluster.connect(workers, scheduler) as client:
            made = calibration.calibrate(
                experiment, problem, folder, replicates,
                chains=chains, noise_factor=noise_factor, client=client, observers=observers,
            )  # fmt: skip
        assessment = assess(made)
        if folder is not None:
            with activity.announced("Drawing the report"):
                calibration_report.write(folder, experiment, made, assessment)
                calibration_page.write(folder, experiment, assessment)
        log(joined(["", calibration_report.calibration_text(assessment)]))
        log_output(log, folder, calibration_report.SUMMARY)
        return assessment
