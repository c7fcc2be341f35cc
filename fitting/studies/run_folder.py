"""Runs on disk: a folder with the experiment, the fit, the chain, tables and plots.

experiment.toml   what was fitted, with absolute paths but to files of the run itself
fit.json          the numbers of the fit
parameters.toml   the fitted system
chain.h5          the walkers; posterior.json their summary
summary.md, *.png to read
"""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tomli_w

from fitting.experiments import parameter_files
from fitting.experiments.experiment import Experiment, load_experiment
from fitting.inference.optimisation.solution import Solution
from fitting.inference.sampling.posterior import Posterior
from fitting.problem.problem import Problem
from fitting.runtime.files import write_text
from fitting.runtime.validation import nest
from jaxik.maths import parameter_tree, smoothing

from .study import Fit

EXPERIMENT, FIT, PARAMETERS = "experiment.toml", "fit.json", "parameters.toml"
CHAIN, POSTERIOR, SUMMARY = "chain.h5", "posterior.json", "summary.md"
READ = ("name", "unit", "u", "start_sd", "value", "determined")  # of fit.json when sampling
HINT = "`jaxik fit` makes a run"
TICKS = (30.0, 60.0)  # Hz, at which a gain is also reported


def check_place(run: Path) -> None:
    """ValueError where no folder for a run can be; makes nothing yet."""
    there = next(one for one in (run, *run.absolute().parents) if one.exists())
    if not there.is_dir():
        raise ValueError(f"{run}: no folder for the run can be made, as {there} is a file")
    if not os.access(there, os.W_OK):
        raise ValueError(f"{run}: no folder for the run can be made, as {there} is read-only")


def save_solution(run: Path, experiment: Experiment, problem: Problem, solution: Solution) -> None:
    """Begins the folder of a run with the fitted system, before anything else may go wrong."""
    run.mkdir(parents=True, exist_ok=True)
    (run / FIT).unlink(missing_ok=True)  # of an earlier fit: the run is finished when it is there
    ik = problem.space.unpack(jnp.asarray(solution.u))
    write_text(run / EXPERIMENT, resolved(experiment, run))
    write_text(run / PARAMETERS, parameter_files.system_to_toml(ik, experiment.preset))


def save_fit(run: Path, fitted: Fit) -> None:
    """Keeps a fit in the folder of its run."""
    save_solution(run, fitted.experiment, fitted.problem, fitted.solution)
    write_text(run / FIT, json.dumps(describe_fit(fitted), indent=2))


def resolved(experiment: Experiment, run: Path | None = None) -> str:
    """The experiment as TOML with absolute paths, so that the run may lie anywhere.

    Paths into the folder `run` are relative to it: these files go where it goes.
    """
    content = _plain(dataclasses.asdict(experiment), run and run.resolve())
    del content["path"]
    for name in ("free", "parameters"):
        content[name] = nest(content[name])
    return tomli_w.dumps(content)


def _plain(value: Any, run: Path | None) -> Any:
    """What TOML can hold: no paths, and nothing where there is None."""
    if isinstance(value, Mapping):
        return {key: _plain(one, run) for key, one in value.items() if one is not None}
    if isinstance(value, tuple | list):
        return [_plain(one, run) for one in value]
    if not isinstance(value, Path):
        return value
    if run is None or not value.is_relative_to(run):
        return str(value)
    return value.relative_to(run).as_posix()


def describe_fit(fitted: Fit) -> dict[str, Any]:
    """The numbers of a fit as JSON holds them."""
    solution, found = fitted.solution, fitted.identifiability
    declared = parameter_tree.declarations(fitted.problem.space.system)
    rows = []
    for i, one in enumerate(fitted.problem.space.parameters):
        row: dict[str, Any] = {
            "name": one.name,
            "kind": one.kind,
            "unit": declared[one.leaf].unit,
            "u": float(solution.u[i]),
            "start_sd": float(fitted.start_sd[i]),
            "value": float(solution.values[i]),
            "before": float(np.asarray(fitted.problem.space.values(fitted.problem.space.u0))[i]),
            "low": one.low,
            "high": one.high,
            "interval": [float(v) for v in found.interval[i]],
            "contraction": float(found.contraction[i]),
            "at_bound": found.at_bound[i],
            "determined": one.name not in found.undetermined,
        }
        if one.scale == "gain":
            row |= gain_readings(row["value"])
        rows.append(row)
    return {
        "experiment": fitted.experiment.name,
        "converged": solution.converged,
        "message": solution.message,
        "cost_before": solution.cost_before,
        "cost": solution.cost,
        "steps": solution.steps,
        "seconds": solution.seconds,
        "parameters": rows,
        "correlated": [list(pair) for pair in found.correlated],
        "weakest": list(found.weakest),
        "history": [dataclasses.asdict(step) for step in solution.history],
    }


def gain_readings(gain: float, tick_hz: float = 30.0) -> dict[str, float]:
    """The half-life of a gain per tick, s, and the gains that it means at other rates."""
    given, rate = jnp.asarray(gain), jnp.asarray(tick_hz)
    readings = {"half_life": float(smoothing.half_life_of_gain(given, rate))}
    for hz in TICKS:
        share = smoothing.fraction_of_gain(given, jnp.asarray(1.0 / hz), rate)
        readings[f"gain_at_{hz:.0f}_hz"] = float(share)
    return readings


def load_fit(run: Path) -> tuple[Experiment, dict[str, Any]]:
    """The experiment and the numbers of a run.

    Raises:
        ValueError: for a folder that holds no finished fit.
    """
    if not run.is_dir():
        raise ValueError(f"{run}: {'a file' if run.exists() else 'no such folder'}; {HINT}")
    for name in (EXPERIMENT, FIT, PARAMETERS):
        if not (run / name).is_file():
            there = sorted(one.name for one in run.iterdir()) or "nothing"
            raise ValueError(f"{run}: no {name}; there is {there}; {HINT}")
    try:
        told = json.loads((run / FIT).read_text(encoding="utf-8"))
        missing = {key for row in told["parameters"] for key in READ if key not in row}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{run / FIT}: not the numbers of a fit: {error!r}; {HINT}") from None
    if missing:
        raise ValueError(f"{run / FIT}: parameters without {sorted(missing)}; {HINT}")
    return load_experiment(run / EXPERIMENT), told


def save_posterior(run: Path, posterior: Posterior) -> None:
    """Keeps the summary of a posterior beside its chain."""
    told = {
        "converged": posterior.converged,
        "message": posterior.message,
        "steps": len(posterior.u) * posterior.thin_by,
        "walkers": posterior.u.shape[1],
        "burn_in": posterior.burn_in * posterior.thin_by,
        "autocorrelation_time": posterior.autocorrelation_time.tolist(),
        "acceptance": float(posterior.acceptance.mean()),
        "stuck": posterior.stuck,
        "seconds": posterior.seconds,
        "parameters": posterior.summary,
    }
    write_text(run / POSTERIOR, json.dumps(told, indent=2, default=float))
