"""The job that fits several clips and subjects as a population."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp

from fitting.experiments import captures, parameter_files
from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import experiment_to_toml, load_experiment
from fitting.experiments.in_memory.saving import with_files
from fitting.experiments.problems import make_problem
from fitting.experiments.systems import Preset
from fitting.inference.optimisation.solution import Progress
from fitting.report.formatting import joined
from fitting.report.hierarchy import population_report
from fitting.report.page.studies import population_page
from fitting.runtime import activity, files
from fitting.runtime.precision import in_float64
from fitting.studies import run_folder
from fitting.studies.hierarchy.population import Population, fit_clips_and_population

from .output import Log, log_output, output_folder, silent


@in_float64
def population(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
    *,
    progress: Callable[[Progress], None] | None = None,
    log: Log = silent,
) -> Population:
    """Fits the clips of an experiment each alone, all pooled, and as a population.

    What varies between clips or subjects stands in the experiment's table [hierarchy]. Each clip is
    also predicted from the others. Each finished search is written at once, and a call with the
    same folder continues where an interrupted one ended.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the searches and the report.
        progress: called as a search goes on; its stage names what is fitted.
        log: called with what the command line prints.

    Raises:
        ValueError: the experiment is wrong, fits a capture, too, nothing in it varies, or a
            threshold does; it does not fit its clips; the folder cannot be made or holds something
            else.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    captures.refuse(experiment.capture, str(experiment.path), "population")
    with output_folder(output) as folder:
        experiment = replace(with_files(experiment, folder), holdout=0.0)
        problem = make_problem(experiment)
        log(
            f"fitting {problem.space.size} parameters of {experiment.preset} to "
            f"{len(experiment.clips)} clips, {len(experiment.hierarchy.varying)} of them varying"
        )
        fitted = fit_clips_and_population(
            experiment,
            problem,
            folder,
            progress,
            lambda found: log(population_report.found_line(found)),
        )
        if folder is not None:
            _write_systems(folder, fitted)
            with activity.announced("Drawing the report"):
                population_report.write(folder, fitted)
                population_page.write(folder, fitted)
        log(joined(["", population_report.population_text(fitted)]))
        log_output(log, folder, population_report.SUMMARY)
        return fitted


def _write_systems(folder: Path, fitted: Population) -> None:
    """The experiment, and parameter files: of the population's centre, and of each clip."""
    experiment, space = fitted.experiment, fitted.problem.space
    preset = Preset(experiment.preset, experiment.faithful)
    folder.mkdir(parents=True, exist_ok=True)
    clips = folder / "clips"
    clips.mkdir(exist_ok=True)
    files.write_text(folder / run_folder.EXPERIMENT, experiment_to_toml(experiment, folder))
    paths = [folder / run_folder.PARAMETERS, *(clips / f"{name}.toml" for name in fitted.clips)]
    for path, u in zip(paths, [fitted.fit.centre, *fitted.fit.clips], strict=True):
        ik = space.unpack(jnp.asarray(u))
        files.write_text(path, parameter_files.system_to_toml(ik, preset, fitted.leg_length))
