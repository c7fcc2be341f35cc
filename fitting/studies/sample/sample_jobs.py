"""The job of a sampling, and the files that it writes into the folder of its run."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxik
from fitting.experiment.experiment_files import experiment_to_toml
from fitting.experiment.problems import ClipData, load
from fitting.inference.noise import NoiseModel, with_noise
from fitting.inference.sample import blocks, inference_data
from fitting.inference.sample.blocks import BlockLogLikelihood, LeaveOneOut
from fitting.inference.sample.posterior import Posterior
from fitting.problem.problem import Problem
from fitting.report.formatting import joined
from fitting.runtime import activity
from fitting.runtime.json_files import write_json
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from fitting.studies import translation
from fitting.studies.fit import fit_report, run_folder
from fitting.studies.fit.assess import assess_solution, search
from fitting.studies.fit.fit import Fit
from fitting.studies.output import log_output, output_folder

from .posterior_report import posterior_text, write_posterior
from .replay import Band, PredictiveCheck, Replay, Statistic, replay
from .sample import SampledFit, minus_cost_at, sample_around, with_predictive_noise

STATISTICS = ("rms", "autocorrelation", "largest")


@in_float64
def sample(
    fitted: Fit | str | Path,
    *,
    max_steps: int | None = None,
) -> Posterior:
    """Samples the posterior around a fit; a fit with a folder has its chain and report there.

    A chain that is there is continued. KeyboardInterrupt (Ctrl-C) ends the sampling; the chain so
    far is summarised, written and returned with `interrupted` set. Where a chain meets a point that
    is better than the fit of a folder, the fit goes on from there and takes the old one's place.

    Args:
        fitted: a fit, or the folder of its run.
        max_steps: limit to the steps of the sampler over all calls, instead of the experiment's.

    Raises:
        ValueError: the folder holds no fit, or its experiment does not fit its clips any more.
    """
    if isinstance(fitted, Fit):
        run, experiment, problem = fitted.run, fitted.experiment, fitted.problem
        parameters, known_values = fitted.summary["parameters"], fitted.known_values
        clips = fitted.clips
    else:
        run = Path(fitted)
        experiment, summary = run_folder.load_fit(run)
        parameters = summary["parameters"]
        experiment, clips, problem, known_values = load(experiment)
        if "noise" in summary:
            problem = with_noise(problem, NoiseModel(**summary["noise"]))
    if max_steps is not None:
        experiment = experiment.with_max_sample_steps(max_steps)
    with output_folder(run):
        chain = None if run is None else run / run_folder.CHAIN
        posterior = sample_around(parameters, problem, experiment, chain)
        posterior = replace(posterior, source=(problem, clips))
        if posterior.interrupted:
            activity.log("interrupted; summarising and writing the chain so far")
        played = None
        try:
            if not posterior.interrupted:
                u = np.array([row["u"] for row in parameters])
                played = replay(
                    with_predictive_noise(problem, experiment, u), posterior, experiment.seed
                )
                posterior = replace(posterior, blocks=played.blocks)
        except KeyboardInterrupt:
            posterior = replace(posterior, interrupted=True)
        sampled = SampledFit(experiment, problem.space, parameters, posterior, known_values, played)
        written = ""
        if run is not None:
            written = _save_and_report(run, sampled)
            if sampled.has_lower_point and not posterior.interrupted:
                sampled = _adopt_lower_point(run, problem, clips, sampled)
                posterior = sampled.posterior
        activity.log(joined(["", posterior_text(sampled, run)]))
        log_output(run, written)
        return posterior


def _save_and_report(run: Path, sampled: SampledFit) -> str:
    """The name of the file to read."""
    save_posterior(run, sampled)
    return write_posterior(run, sampled)


def _adopt_lower_point(
    run: Path,
    problem: Problem[jaxik.FootIK],
    clips: tuple[ClipData, ...],
    sampled: SampledFit,
) -> SampledFit:
    """The chain with a fit that went on from its best point, which takes the run's old fit's place.

    The old fit stays until the new one is finished; that of a translation stays in any case, and
    so does a fit that is not better by the chain's own account.
    """
    experiment, posterior = sampled.experiment, sampled.posterior
    if translation.is_translation(run):
        return sampled
    activity.log(
        f"the chain met a point whose cost is {posterior.improvement:.3g} lower than the fit's; "
        "the fit goes on from there"
    )
    try:
        first = np.asarray(problem.space.pack(posterior.best_values))
        solution = search(problem, experiment, first=first)
        at_solution = minus_cost_at(problem, experiment, solution.u)
        if solution.interrupted or at_solution <= posterior.start_minus_cost:
            return sampled
        known = sampled.known_values
        fitted = assess_solution(experiment, problem, solution, known_values=known, clips=clips)
    except KeyboardInterrupt:
        return sampled
    at_solution = minus_cost_at(problem, experiment, fitted.solution.u)
    run_folder.save_solution(run, experiment, problem, fitted.solution)
    run_folder.save_fit(run, fitted)
    fit_report.write_fit(run, fitted)
    activity.log(joined(["", fit_report.fit_text(fitted)]))
    sampled = replace(
        sampled,
        parameters=fitted.summary["parameters"],
        posterior=replace(posterior, start_minus_cost=at_solution),
    )
    _save_and_report(run, sampled)
    return sampled


@activity.announced("Writing the posterior")
def save_posterior(run: Path, sampled: SampledFit) -> None:
    """Writes the summary of a posterior beside its chain."""
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
                "weight": mode.weight,
                "error": mode.error if mode.is_weighed else None,
                "exchanges": mode.exchanges,
                "walkers": mode.walkers,
                "log_probability": mode.log_probability,
            }
            for mode in posterior.modes
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
    write_json(run / run_folder.POSTERIOR, numbers)
    (run / run_folder.LOWER_POINT).unlink(missing_ok=True)
    if sampled.has_lower_point:
        begun_there = replace(sampled.experiment, start=posterior.best_values)
        run_folder.write_toml(run / run_folder.LOWER_POINT, experiment_to_toml(begun_there, run))
    if blocks.is_available():
        inference_data.write_inference_data(
            run / run_folder.INFERENCE_DATA, posterior, sampled.space
        )


def summarise_replay(played: Replay | None, left_out: LeaveOneOut | None) -> Content:
    """Predictive checks and leave-one-out; None where there are none."""
    if played is None:
        return {"predictive_checks": None, "leave_one_out": None}
    pairs = zip(played.checks, played.bands, strict=True)
    return {
        "predictive_checks": [_check(check, band) for check, band in pairs],
        "leave_one_out": None if left_out is None else _left_out(left_out, played.blocks),
    }


def _check(check: PredictiveCheck, band: Band) -> Content:
    statistics = {name: _statistic(getattr(check, name)) for name in STATISTICS}
    return {
        "clip": check.clip + 1,
        "kind": check.kind,
        **statistics,
        "outside_band": band.outside,
        "surprises": check.surprises,
    }


def _statistic(statistic: Statistic) -> Content:
    """Medians over the draws, and the posterior predictive p-value."""
    return {
        "captured": statistic.median,
        "replicated": list(statistic.replicated_interval),
        "p": statistic.p,
    }


def _left_out(left_out: LeaveOneOut, blocks: BlockLogLikelihood) -> Content:
    columns = (blocks.clip, blocks.start, blocks.end, left_out.elpd_of_block)
    names = ("clip", "start", "end", "elpd", "pareto_k")
    shapes = map(_finite, left_out.pareto_k.tolist())
    rows = zip(*(column.tolist() for column in columns), shapes, strict=True)
    return {
        "elpd": left_out.elpd,
        "error": left_out.error,
        "parameters": left_out.parameters,
        "max_k": left_out.max_k,
        "neighbours": _finite(left_out.neighbours),
        "data": blocks.data,
        "blocks": [dict(zip(names, row, strict=True)) for row in rows],
    }


def _finite(value: float) -> float | None:
    """None for what JSON does not have."""
    return value if math.isfinite(value) else None
