"""The job of a sampling, with its files in the folder of its run; sampled runs compared."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

import jaxik
from fitting.experiment.experiment_files import experiment_to_toml
from fitting.experiment.problems import ClipData, load
from fitting.inference.noise import NoiseModel, with_noise
from fitting.inference.sample import blocks, inference_data
from fitting.inference.sample.blocks import SECONDS, BlockLogLikelihood, LeaveOneOut
from fitting.inference.sample.posterior import Posterior
from fitting.problem.problem import Problem
from fitting.report.document import Document, Finding, Grid, Points, Section, Text
from fitting.report.formatting import Table, joined, listed
from fitting.runtime import activity, files
from fitting.runtime.json_files import write_json
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from fitting.studies import translation
from fitting.studies.fit import fit_report, run_folder
from fitting.studies.fit.assess import assess_solution, search
from fitting.studies.fit.fit import Fit
from fitting.studies.output import log_output, output_folder, publish

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


# Fits of several systems to the same motion, compared by what they predict of it.

TABLE, NUMBERS = "runs.md", "runs.json"

CLEAR = 2.0  # standard errors, from which a difference says something
COLUMNS = (
    "elpd is the expected log predictive density of the captured motion: blocks of "
    f"{SECONDS:g} s, each predicted from the others by Pareto-smoothed importance sampling. "
    "Larger is better. A difference of less than twice its standard error (±) says little, and "
    "unreliable blocks make it worse. Parameters is their effective number."
)
LIMITS = [
    "The order is that of these runs on this motion: the best of them may still not fit it, which "
    "the page of its run says.",
    "Blocks of one motion depend on each other a little; errors may be larger than they are said "
    "to be.",
]


@dataclass(frozen=True)
class ComparedRun:
    """One of several runs that were fitted to the same motion."""

    name: str
    elpd: float
    """Expected log predictive density of blocks of frames, each left out in turn."""
    error: float
    """Its standard error."""
    behind: float
    """Below the best run's; 0 for the best."""
    behind_error: float
    """Standard error of this difference, block by block."""
    parameters: float
    """Effective number of them."""
    unreliable: int
    """Blocks whose figure is unreliable."""
    clips: Mapping[int, float]
    """The part of each clip, from 1, in the expected log predictive density."""


def compare_posteriors(folders: Sequence[Path]) -> list[ComparedRun]:
    """Compares sampled runs, the best one first.

    Raises:
        ImportError: ArviZ is not installed.
        ValueError: there are fewer than two, one has no log-likelihood, or they were not fitted
            to the same motion.
    """
    if len(set(folders)) < max(2, len(folders)):
        raise ValueError(f"runs are {[str(f) for f in folders]}; wanted two or more different ones")
    read = {str(folder): _read(folder) for folder in folders}
    first, *others = read
    for name in others:
        if read[name].data != read[first].data:
            raise ValueError(
                f"{first} and {name} were fitted to different motion, or count different kinds of "
                "residuals; wanted the same clips, frames and kinds, so that predictions of the "
                "same motion are compared"
            )
    left_out = {name: _leave_one_out(name, each) for name, each in read.items()}
    best = max(left_out, key=lambda name: left_out[name].elpd)
    order = sorted(left_out, key=lambda name: -left_out[name].elpd)
    return [_compare(name, left_out[name], left_out[best], read[name]) for name in order]


def _read(folder: Path) -> BlockLogLikelihood:
    run_folder.load_fit(folder)
    path = folder / run_folder.INFERENCE_DATA
    if not path.is_file():
        raise ValueError(
            f"{folder}: no {path.name}; `jaxik sample {folder}` makes it, with the packages of pip "
            'install "jaxik[posterior]"'
        )
    return inference_data.read_blocks(path)


def _leave_one_out(name: str, read: BlockLogLikelihood) -> LeaveOneOut:
    left_out = blocks.leave_one_out(read)
    if left_out is None:
        raise ValueError(
            f"{name}: {len(read.values)} draws of {len(read.clip)} blocks of {blocks.SECONDS:g} s; "
            f"wanted {blocks.MIN_DRAWS} draws and two blocks or more; sample longer"
        )
    return left_out


def _compare(
    name: str, left_out: LeaveOneOut, best: LeaveOneOut, read: BlockLogLikelihood
) -> ComparedRun:
    below = best.elpd_of_block - left_out.elpd_of_block
    return ComparedRun(
        name=name,
        elpd=left_out.elpd,
        error=left_out.error,
        behind=float(below.sum()),
        behind_error=float(math.sqrt(below.size) * below.std(ddof=1)),
        parameters=left_out.parameters,
        unreliable=left_out.unreliable,
        clips={
            int(clip): float(left_out.elpd_of_block[read.clip == clip].sum())
            for clip in np.unique(read.clip)
        },
    )


def table(runs: Sequence[ComparedRun]) -> Table:
    """A row for each run, the best first; a column for each clip if there are several."""
    clips = list(runs[0].clips)
    listed_clips = clips if len(clips) > 1 else []
    heading = ["run", "elpd", "±", "below the best", "±", "parameters", "unreliable blocks"]
    rows = [heading + [f"elpd of clip {clip}" for clip in listed_clips]]
    for run in runs:
        cells = [run.name, f"{run.elpd:.1f}", f"{run.error:.1f}", f"{run.behind:.1f}"]
        cells += [f"{run.behind_error:.1f}", f"{run.parameters:.1f}", str(run.unreliable)]
        rows.append([*cells, *(f"{run.clips[clip]:.1f}" for clip in listed_clips)])
    return rows


def document(runs: Sequence[ComparedRun]) -> Document:
    """What a comparison of runs says, the best run first."""
    tied = undecided(runs)
    return Document(
        file=TABLE,
        kind="Sampled fits to the same motion, by what they predict",
        title="Runs compared",
        verdict="Undecided" if tied else "Decided",
        good=not tied,
        findings=findings(runs),
        sections=[
            Section(
                "What the runs predict", [Grid(table(runs), "Runs"), Text(COLUMNS, brief=True)]
            ),
            Section("Limits of the data", [Points(LIMITS)]),
        ],
        setup=[["Runs", ", ".join(f"`{run.name}`" for run in runs)]],
        files={NUMBERS: "all numbers"},
    )


def undecided(runs: Sequence[ComparedRun]) -> list[ComparedRun]:
    """Runs whose predictions do not differ clearly from those of the best one."""
    return [run for run in runs[1:] if run.behind < CLEAR * run.behind_error]


def findings(runs: Sequence[ComparedRun]) -> list[Finding]:
    """Whether the figures are reliable, which run is best and by how much, and which is last."""
    best, second, last = runs[0], runs[1], runs[-1]
    reliable = Finding("All blocks are predicted reliably from the others.")
    if shaky := [f"`{run.name}` ({run.unreliable})" for run in runs if run.unreliable]:
        reliable = Finding(
            f"The figures are not fully reliable: there are blocks that the others do not predict "
            f"reliably, of {listed(shaky)}.",
            bad=True,
        )
    behind = f"{second.behind:.1f} ± {second.behind_error:.1f}"
    order = Finding(f"`{best.name}` predicts best; `{second.name}` is {behind} below.")
    if tied := [f"`{run.name}`" for run in undecided(runs)]:
        order = Finding(
            f"The motion does not tell `{best.name}`, which predicts best, from {listed(tied)}: "
            f"`{second.name}` is {behind} below, less than {CLEAR:g} standard errors.",
            bad=True,
        )
    furthest = (
        f"`{last.name}` predicts worst, {last.behind:.1f} ± {last.behind_error:.1f} below"
        if len(runs) > 2
        else f"The expected log predictive density of `{best.name}` is {best.elpd:.1f} ± "
        f"{best.error:.1f}"
    )
    numbers = [run.parameters for run in runs]
    used = f"the runs use {min(numbers):.1f} to {max(numbers):.1f} effective parameters"
    return [reliable, order, Finding(f"{furthest}; {used}.")]


def compare_runs(runs: Sequence[str | Path], output: str | Path | None = None) -> list[ComparedRun]:
    """Compares sampled runs of several systems by what they predict of the same motion.

    Args:
        runs: folders that `fit` and `sample` have filled.
        output: folder for the table, the numbers and the page.

    Raises:
        ValueError: as `compare_posteriors`, or the folder cannot be made.
    """
    with output_folder(output) as folder:
        with activity.announced(f"Comparing {len(runs)} runs"):
            compared = compare_posteriors([Path(run) for run in runs])
        if folder is not None:
            numbers = json.dumps([asdict(run) for run in compared], indent=2)
            files.write_text(folder / NUMBERS, numbers + "\n")
        publish(folder, document(compared))
        return compared
