"""A run on disk: a folder with the experiment, the fit, the chain, tables and plots.

experiment.toml   what was fitted; paths are relative, and it says from where they led
fit.json          the numbers of the fit
parameters.toml   the fitted system, or the one before the fit where that is better
parameters_fitted.toml   in that case, the fitted system
base.npz          the flat animation, and fitted.npz the fitted motion; numbered for several clips
chain.h5          the walkers; posterior.json is their summary
posterior.nc      the draws after burn-in for ArviZ, if it is installed
search.json       how far an unfinished fit is
lower_point.toml  the experiment, to begin at a point that the chain met below the fit
summary.md, report.html, *.png to read
report.json       that report, which is written anew with a posterior

Each file says in which format it is; one that does not is of an earlier release.
"""

import dataclasses
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import jaxik
from fitting.clips import save_clip
from fitting.experiment import experiment_files, former, parameter_files
from fitting.experiment.experiment import Experiment
from fitting.experiment.systems import Preset
from fitting.inference.noise import NoiseModel, NoiseOptions
from fitting.inference.optimise.solution import Solution
from fitting.problem.capture_system import alone, is_of_capture
from fitting.problem.problem import Problem
from fitting.runtime import activity
from fitting.runtime.claimed_folder import LOCK
from fitting.runtime.files import TEMPORARY, write_text
from fitting.runtime.json_files import JsonFile, check_version
from fitting.runtime.validation import flatten, read_toml

from .fit import Fit, FitRecord, FittedParameter
from .fit_motions import saved_clips

EXPERIMENT, FIT, PARAMETERS = "experiment.toml", "fit.json", "parameters.toml"
FITTED_PARAMETERS = "parameters_fitted.toml"
CHAIN, POSTERIOR, SUMMARY = "chain.h5", "posterior.json", "summary.md"
INFERENCE_DATA, LOWER_POINT = "posterior.nc", "lower_point.toml"
SEARCH = "search.json"
SAMPLER_KEYS = ("name", "unit", "u", "start_sd", "value", "determined")  # that sampling reads
HINT = "`jaxik fit` makes a run"
UNFINISHED = "its fit is going on, or was stopped and goes on when its command is called again"
FIT_FILE = JsonFile(
    FitRecord, "the numbers of a fit", HINT, essential={"parameters", *SAMPLER_KEYS}
)
FORMAT = 1  # of the two TOML files, in their first line, which is a comment to other readers
FORMAT_LINE = re.compile(r"# jaxik run, format (\w+)\n")


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
    """Checks that a new folder can be made here.

    An empty one counts as new, and so does one in which a search was killed.

    Raises:
        ValueError: the folder holds something, or cannot be made.
    """
    check_output_folder(folder)
    if not folder.is_dir():
        return
    own = {name for name in os.listdir(folder) if TEMPORARY.fullmatch(name)} | {LOCK, SEARCH}
    if present := sorted(set(os.listdir(folder)) - own):
        raise ValueError(f"{folder}: there is something in it already: {present}; name a new one")


def save_solution(
    run: Path, experiment: Experiment, problem: Problem[jaxik.FootIK], solution: Solution
) -> None:
    """Starts the run's folder with the fitted system, before anything else may go wrong.

    A `fit.json` of an earlier fit is deleted: a run is complete once it has one.
    """
    run.mkdir(parents=True, exist_ok=True)
    for name in (FIT, FITTED_PARAMETERS):
        (run / name).unlink(missing_ok=True)
    write_toml(run / EXPERIMENT, experiment_files.experiment_to_toml(experiment, run))
    _write_system(run / PARAMETERS, experiment, problem, alone(problem.space.unpack(solution.u)))


def _write_system(
    path: Path, experiment: Experiment, problem: Problem[jaxik.FootIK], ik: jaxik.FootIK
) -> None:
    preset = Preset(experiment.preset, experiment.faithful)
    leg_length = experiment.leg_length(problem.data[0].rig)
    write_toml(path, parameter_files.system_to_toml(ik, preset, leg_length))


def save_fit(run: Path, fitted: Fit) -> None:
    """Completes a run's folder, after `save_solution`, with the motions and numbers of its fit.

    Where the system from before the fit is better, the run's parameters become that one's.
    """
    with activity.announced("Writing the motions and numbers of the fit"):
        if fitted.distances.better != "fitted":
            system = fitted.experiment, fitted.problem
            _write_system(run / FITTED_PARAMETERS, *system, fitted.ik)
            _write_system(run / PARAMETERS, *system, fitted.selected_system)
        for name, clip in saved_clips(fitted).items():
            save_clip(run / name, clip)
        FIT_FILE.write(run / FIT, fitted.summary)


def load_record(run: Path) -> FitRecord:
    """The numbers of a run.

    Raises:
        ValueError: the folder holds no finished fit.
    """
    _check_files(run, (FIT,))
    summary = FIT_FILE.read(run / FIT, _check_numbers)
    rows = map(former.row_with_half_life, summary["parameters"])
    return {**summary, "parameters": cast(list[FittedParameter], list(rows))}


def load_fit(run: Path) -> tuple[Experiment, FitRecord]:
    """The experiment and the numbers of a run.

    Raises:
        ValueError: the folder holds no finished fit, or a clip of its experiment is gone.
    """
    _check_files(run, (EXPERIMENT, FIT, PARAMETERS))
    summary = load_record(run)
    _check_toml_format(run / EXPERIMENT)
    experiment = experiment_files.load_experiment(run / EXPERIMENT)
    if "distances" not in summary:  # of an earlier release, with its defaults
        noise = experiment.noise if "noise" in summary else NoiseOptions(correlation="given")
        experiment = dataclasses.replace(experiment, holdout=0.0, noise=noise)
    return experiment, summary


def load_fitted_system(run: Path, rig: jaxik.Rig | None = None) -> jaxik.FootIK:
    """The fitted system of a run, for the body of a rig; all but its parameters may be gone.

    Raises:
        ValueError: the folder has no parameters, those of an unfinished fit, or its system lacks a
            fitted parameter.
    """
    _check_files(run, (PARAMETERS,))
    path = run / PARAMETERS
    if (run / FIT).exists() or (run / SEARCH).exists():  # without both, the parameters came alone
        _check_has_parameters(path, load_record(run))
    _check_toml_format(path)
    ik, _ = parameter_files.load_system(path, rig)
    return ik


def _check_has_parameters(path: Path, summary: FitRecord) -> None:
    """Raises ValueError for the parameters of another fit."""
    present = {
        former.HALF_LIVES.get(name, name) for name in flatten(read_toml(path, "a parameter"), 2)
    }
    names = {
        row["name"].partition("[")[0]
        for row in summary["parameters"]
        if not is_of_capture(row["name"])
    }
    if missing := sorted(names - present):
        raise ValueError(f"{path}: not the system of this fit: no {', '.join(missing)}; {HINT}")


def _check_files(run: Path, names: Sequence[str]) -> None:
    """Raises ValueError for a folder that lacks one of these files."""
    if not run.is_dir():
        raise ValueError(f"{run}: {'a file' if run.exists() else 'no such folder'}; {HINT}")
    for name in names:
        if not (run / name).is_file():
            if (run / SEARCH).is_file() or (run / LOCK).is_file():
                raise ValueError(f"{run}: no {name} yet: {UNFINISHED}")
            present = sorted(path.name for path in run.iterdir()) or "nothing"
            raise ValueError(f"{run}: no {name}; there is {present}; {HINT}")


def _check_numbers(summary: FitRecord) -> None:
    """Raises ValueError where the numbers of a fit contradict each other."""
    if "noise" in summary:
        NoiseModel(**summary["noise"])  # checks its numbers
    rows = summary["parameters"]
    names = [row["name"] for row in rows]
    if len(set(names)) < len(names):
        raise ValueError(f"its parameters are {names}; wanted each once")
    for row in rows:
        for minimum in row.get("valleys", ()):
            if len(minimum.get("values", rows)) != len(rows):
                raise ValueError(
                    f"a minimum of {row['name']} has {len(minimum.get('values', ()))} values; "
                    f"wanted {len(rows)}, one of each parameter"
                )


def write_toml(path: Path, text: str) -> None:
    """Writes a TOML file of a run, which says its format."""
    write_text(path, f"# jaxik run, format {FORMAT}\n{text}")


def _check_toml_format(path: Path) -> None:
    """Raises ValueError for an unknown format; files of the first release name none."""
    with open(path, encoding="utf-8", errors="replace") as file:
        version = FORMAT_LINE.fullmatch(file.readline())
    if version is not None:
        number = version[1]
        check_version(path, int(number) if number.isdecimal() else number, FORMAT)
