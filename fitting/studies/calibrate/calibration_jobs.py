"""The job that asks whether what fits and posteriors say of an experiment is true."""

from dataclasses import replace
from pathlib import Path

from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import load_clips, make_problem, problem_from_clips
from fitting.experiment.systems import without_own_root
from fitting.runtime import activity, cluster
from fitting.runtime.precision import in_float64
from fitting.studies.output import output_folder, publish
from fitting.studies.translation import load_named_system

from . import calibration, calibration_report, wrong_model, wrong_model_report
from .assessment import Assessment, assess
from .wrong_model import WrongModelAssessment


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
        activity.log(
            f"{replicates} truths of {problem.space.size} parameters of {experiment.preset}"
        )
        with cluster.connect(workers, scheduler) as client:
            made = calibration.calibrate(
                experiment, problem, folder, replicates,
                chains=chains, noise_factor=noise_factor, client=client,
            )  # fmt: skip
        assessment = assess(made)
        document = calibration_report.document(experiment, made, assessment)
        publish(folder, document)
        return assessment


@in_float64
def calibrate_wrong_model(
    experiment: Experiment | str | Path,
    truth: str,
    output: str | Path | None = None,
    *,
    replicates: int = 200,
    noise_factor: float = 1.0,
    workers: int = 0,
    scheduler: str | None = None,
) -> WrongModelAssessment:
    """Fits an experiment to motion that another system makes, and judges what the fits say.

    Truths are drawn around the parameters of that system; each of their motions is captured with
    errors that a real capture has, and fitted as `fit` does, with a part held out. A call with the
    same folder continues where an interrupted one ended, as for `calibrate`.

    Args:
        experiment: an experiment, or the path of its file.
        truth: the system that makes the motion: a preset or a parameter .toml.
        output: folder for the replicates and the report.
        replicates: number of truths.
        noise_factor: how much larger the errors of the captures are than usual.
        workers: as for `calibrate`.
        scheduler: as for `calibrate`.

    Raises:
        ValueError: as `calibrate`; there is no such system; no frame is held out.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    with output_folder(output) as folder:
        experiment = with_files(experiment, folder)
        clips = load_clips(experiment)
        rig = clips[0].base.rig if experiment.body == "clip" else None
        system = load_named_system(truth, "truth", rig)
        if any(clip.root.rise is not None for clip in clips):
            system = replace(system, ik=without_own_root(system.ik))
        problem = problem_from_clips(experiment, clips)
        activity.log(f"{replicates} motions of {system.name}, fitted by {experiment.preset}")
        with cluster.connect(workers, scheduler) as client:
            fits = calibration.calibrate_wrong_model(
                experiment, problem, system, folder, replicates,
                noise_factor=noise_factor, client=client,
            )  # fmt: skip
        assessment = wrong_model.assess(fits)
        document = wrong_model_report.document(experiment, system.name, fits, assessment)
        publish(folder, document)
        return assessment
