"""A run on disk: a folder with the experiment, the fit, the chain, tables and plots.

experiment.toml   what was fitted; paths are absolute, except to files of the run itself
fit.json          the numbers of the fit
parameters.toml   the fitted system
chain.h5          the walkers; posterior.json is their summary
posterior.nc      the kept draws for ArviZ, if it is installed
lower_point.toml  the experiment, to begin at a point that the chain met below the fit
summary.md, *.png to read
"""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np

import jaxik
from fitting.experiments import experiment_files, parameter_files
from fitting.experiments.experiment import Experiment
from fitting.experiments.systems import Preset
from fitting.inference.optimisation.solution import Solution
from fitting.inference.sampling import inference_data
from fitting.problem.problem import Problem
from fitting.runtime.files import write_text
from fitting.runtime.validation import read_json

from .fit import Fit, FitSummary
from .posterior.replay_summary import summarise_replay
from .sample import SampledFit

EXPERIMENT, FIT, PARAMETERS = "experiment.toml", "fit.json", "parameters.toml"
CHAIN, POSTERIOR, SUMMARY = "chain.h5", "posterior.json", "summary.md"
INFERENCE_DATA, LOWER_POINT = "posterior.nc", "lower_point.toml"
SAMPLER_KEYS = ("name", "unit", "u", "start_sd", "value", "determined")  # that sampling reads
HINT = "`jaxik fit` makes a run"


def check_output_folder(folder: Path) -> None:
    """Checks, before anything is computed, that a folder can be made here; makes nothing yet.

    Raises:
        ValueError: a file is in the way, or the nearest existing folder is read-only.
    """
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise ValueError(f"{folder}: no folder can be made here, as {nearest} is a file")
    if not os.access(nearest, os.W_OK):
        raise ValueError(f"{folder}: no folder can be made here, as {nearest} is read-only")


def check_new_folder(folder: Path) -> None:
    """Checks that a new folder can be made here; an empty one counts as new.

    Raises:
        ValueError: the folder holds something, or cannot be made.
    """
    check_output_folder(folder)
    if folder.is_dir() and (present := sorted(os.listdir(folder))):
        raise ValueError(f"{folder}: there is something in it already: {present}; name a new one")


def save_solution(
    run: Path, experiment: Experiment, problem: Problem[jaxik.FootIK], solution: Solution
) -> None:
    """Starts the run's folder with the fitted system, before anything else may go wrong.

    A `fit.json` of an earlier fit is deleted: a run is complete once it has one.
    """
    run.mkdir(parents=True, exist_ok=True)
    (run / FIT).unlink(missing_ok=True)
    ik = problem.space.unpack(solution.u)
    write_text(run / EXPERIMENT, experiment_files.experiment_to_toml(experiment, run))
    preset = Preset(experiment.preset, experiment.faithful)
    leg_length = experiment.leg_length(problem.data[0].rig)
    write_text(run / PARAMETERS, parameter_files.system_to_toml(ik, preset, leg_length))


def save_fit(run: Path, fitted: Fit) -> None:
    """Completes a run's folder, after `save_solution`, with the numbers of its fit."""
    write_text(run / FIT, json.dumps(fitted.summary, indent=2))


def load_fit(run: Path) -> tuple[Experiment, FitSummary]:
    """The experiment and the numbers of a run.

    Raises:
        ValueError: the folder holds no finished fit.
    """
    if not run.is_dir():
        raise ValueError(f"{run}: {'a file' if run.exists() else 'no such folder'}; {HINT}")
    for name in (EXPERIMENT, FIT, PARAMETERS):
        if not (run / name).is_file():
            present = sorted(path.name for path in run.iterdir()) or "nothing"
            raise ValueError(f"{run}: no {name}; there is {present}; {HINT}")
    try:
        summary = read_json(run / FIT)
        missing = {key for row in summary["parameters"] for key in SAMPLER_KEYS if key not in row}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{run / FIT}: not the numbers of a fit: {error!r}; {HINT}") from None
    if missing:
        raise ValueError(f"{run / FIT}: parameters without {sorted(missing)}; {HINT}")
    return experiment_files.load_experiment(run / EXPERIMENT), summary


def save_posterior(run: Path, sampled: SampledFit) -> None:
    """Writes the summary of a posterior, and of what it makes of the prior, beside its chain."""
    posterior = sampled.posterior
    of_prior = {
        name: {"prior": prior, "prior_sensitivity": sampled.prior_sensitivity[name]}
        for name, prior in sampled.priors.items()
    }
    lower = {"gain": posterior.improvement, "values": posterior.best_values}
    numbers = {
        "converged": posterior.converged,
        "message": posterior.message,
        "steps": len(posterior.u) * posterior.thin_by,
        "walkers": posterior.u.shape[1],
        "burn_in": posterior.burn_in * posterior.thin_by,
        "autocorrelation_time": posterior.autocorrelation_time.tolist(),
        "acceptance": float(posterior.acceptance.mean()),
        "stuck": posterior.stuck,
        "left_out": {"walkers": posterior.isolated, "weight": posterior.isolated_mass},
        "islands": [
            {
                "weight": island.weight,
                "error": island.error if island.is_weighed else None,
                "exchanges": island.exchanges,
                "walkers": island.walkers,
                "log_probability": island.log_probability,
            }
            for island in posterior.islands
        ],
        "seconds": posterior.seconds,
        "lower_point": lower if sampled.has_lower_point else None,
        "disagreements": sampled.disagreements,
        **summarise_replay(sampled.replay, sampled.left_out),
        "parameters": [{**row, **of_prior[row["name"]]} for row in posterior.summary],
        "sigmas": {
            kind: np.percentile(draws, [2.5, 50, 97.5]).tolist()
            for kind, draws in posterior.sigmas.items()
        },
    }
    write_text(run / POSTERIOR, json.dumps(numbers, indent=2, default=float))
    (run / LOWER_POINT).unlink(missing_ok=True)
    if sampled.has_lower_point:
        begun_there = dataclasses.replace(sampled.experiment, start=posterior.best_values)
        write_text(run / LOWER_POINT, experiment_files.experiment_to_toml(begun_there, run))
    if inference_data.is_available():
        inference_data.write_inference_data(run / INFERENCE_DATA, posterior, sampled.space)
