"""Runs on disk: a folder with the experiment, the fit, the chain, tables and plots.

experiment.toml   what was fitted, with absolute paths
fit.json          the numbers of the fit
parameters.toml   the fitted system
chain.h5          the walkers; posterior.json their summary
summary.md, *.png to read
"""

import dataclasses
import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from jaxik import rule

from . import settings
from .experiment import Experiment, load_experiment
from .files import write_text
from .posterior import Posterior
from .study import Fit

EXPERIMENT, FIT, PARAMETERS = "experiment.toml", "fit.json", "parameters.toml"
CHAIN, POSTERIOR, SUMMARY = "chain.h5", "posterior.json", "summary.md"
TICKS = (30.0, 60.0)  # Hz, at which a gain is also reported


def prepare(run: Path) -> None:
    """The folder of a run, made where it is not there.

    Raises:
        ValueError: where a file is in its way.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{run}: cannot make the run's folder: {error.strerror}") from None


def save_fit(run: Path, fitted: Fit) -> None:
    """Keeps a fit in the folder of its run."""
    write_text(run / EXPERIMENT, resolved(fitted.experiment))
    write_text(run / PARAMETERS, settings.to_toml(fitted.ik, fitted.experiment.preset))
    write_text(run / FIT, json.dumps(describe_fit(fitted), indent=2))


def resolved(experiment: Experiment) -> str:
    """The experiment's file with absolute paths, so that the run may lie anywhere."""
    content = tomllib.loads(experiment.path.read_text())
    for table, entry in zip(content["clips"], experiment.clips, strict=True):
        for key in ("reference", "terrain", "base", "truth"):
            if key in table:
                table[key] = str(getattr(entry, key))
    return tomli_w.dumps(content)


def describe_fit(fitted: Fit) -> dict[str, Any]:
    """The numbers of a fit as JSON holds them."""
    solution, found = fitted.solution, fitted.identification
    declared = rule.declarations(fitted.problem.space.base)
    rows = []
    for i, one in enumerate(fitted.problem.space.frees):
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
    half_life = -math.log(2.0) / (tick_hz * math.log1p(-gain))
    readings = {"half_life": half_life}
    for hz in TICKS:
        readings[f"gain_at_{hz:.0f}_hz"] = -math.expm1(tick_hz / hz * math.log1p(-gain))
    return readings


def load_fit(run: Path) -> tuple[Experiment, dict[str, Any]]:
    """The experiment and the numbers of a run.

    Raises:
        ValueError: for a folder that holds no finished fit.
    """
    for name in (EXPERIMENT, FIT):
        if not (run / name).is_file():
            there = sorted(one.name for one in run.iterdir()) if run.is_dir() else "nothing"
            raise ValueError(f"{run}: no {name}; there is {there}. `jaxik fit` makes a run")
    try:
        told = json.loads((run / FIT).read_text())
        if not told["parameters"]:
            raise KeyError("parameters")
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{run / FIT}: not the numbers of a fit: {error}") from None
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
