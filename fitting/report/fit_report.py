"""What is read after a fit or a sampling: texts for the terminal, and the run's summary.md."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import jaxik
from fitting.analysis import limit_activity, playback, worst_window
from fitting.analysis.playback import Playback
from fitting.experiments.experiment import Experiment, bare_system
from fitting.experiments.systems import with_parameters
from fitting.inference.sampling.posterior import Posterior
from fitting.runtime import files
from fitting.runtime.validation import flatten, read_toml
from fitting.studies import run_folder
from fitting.studies.study import Fit

from . import fit_tables, formatting, posterior_tables, worst_window_report
from .fit_tables import Truth
from .formatting import markdown
from .plots import fit_plots, posterior_plots, style, worst_window_plots

HEADING = "## Posterior"  # what follows it in summary.md is of `write_posterior`
WORST = "## The worst two seconds"
KNEE_LIMITS = ("min_knee_angle", "max_knee_angle")
Pictures = dict[str, str]  # captions by file name


def truth_of(experiment: Experiment) -> dict[str, float] | None:
    """Known parameters by dotted name, from the first clip that has a file of them; None without.

    Tables that are no stage's are left out, and so are switches. Of a leaf that holds several
    values there is each with its `[index]`, and their mean by the leaf's own name.

    Raises:
        ValueError: for a file that is not TOML, a name that is unknown, a value that is no number.
    """
    path = next((clip.truth for clip in experiment.clips if clip.truth is not None), None)
    if path is None:
        return None
    ik = bare_system(experiment)
    content = read_toml(path, "a truth")
    values = flatten({stage: table for stage, table in content.items() if stage in vars(ik)}, 2)
    with_parameters(ik, values, str(path))
    found: dict[str, float] = {}
    for name, value in values.items():
        if not isinstance(value, bool):
            several = value if isinstance(value, list) else []
            found |= {f"{name}[{i}]": float(one) for i, one in enumerate(several)}
            found[name] = float(np.mean(value))
    for name in experiment.free:  # one leg's element of a leaf that all legs share
        leaf = name.partition("[")[0]
        if leaf in found:
            found.setdefault(name, found[leaf])
    return found


def fit_text(told: Mapping[str, Any], truth: Truth) -> str:
    """What a fit found, for the terminal.

    Args:
        told: `store.describe_fit`.
        truth: known parameters, where there are any.
    """
    rows = told["parameters"]
    parts = [
        told["message"],
        _cost(told),
        "",
        formatting.aligned(fit_tables.parameter_table(rows, truth)),
    ]
    if any("half_life" in row for row in rows):
        parts += ["", formatting.aligned(fit_tables.gain_table(rows))]
    if truth:
        parts += ["", fit_tables.recovered(rows, truth)]
    return "\n".join(parts)


def write_fit(
    run: Path, fitted: Fit, opening: Sequence[str] = (), details: Sequence[str] = ()
) -> None:
    """Writes the pictures of a fit and a new summary.md into the folder of its run.

    Paragraphs of Markdown may be added: an `opening` before the parameters, `details` before the
    pictures.
    """
    pictures: Pictures = {}
    results = [playback.run(fitted.ik, scene) for scene in fitted.problem.data]
    last = [
        playback.play(scene, result)
        for scene, result in zip(fitted.problem.data, results, strict=True)
    ]
    for index, play in enumerate(last):
        pictures |= _draw_clip(run, fitted, index, play)
    told = [*_worst(run, fitted, last), *details]
    title = f"{fitted.experiment.name}: cost of the fit over time"
    figure = fit_plots.cost(fitted.solution.history, fitted.solution.cost_before, title)
    pictures |= _keep(run, "cost.png", title, figure)
    files.write_text(
        run / run_folder.SUMMARY, _fit_summary(fitted, results, pictures, opening, told)
    )


def posterior_text(posterior: Posterior, truth: Truth) -> str:
    """What a sampling found, for the terminal."""
    table = formatting.aligned(posterior_tables.posterior_table(posterior, truth, {}))
    parts = [*_health(posterior), "", table]
    if truth:
        covered = posterior_tables.covered(posterior, truth, posterior.names)
        parts += ["", f"The 95 % intervals cover the truth of {covered} parameters."]
    return "\n".join(parts)


def write_posterior(run: Path, experiment: Experiment, posterior: Posterior) -> None:
    """Writes the pictures of a posterior, and its section of summary.md over an older one."""
    rows = {
        row["name"]: row for row in json.loads((run / run_folder.FIT).read_text())["parameters"]
    }
    truth = truth_of(experiment)
    units = {name: row["unit"] for name, row in rows.items()}
    labels = [f"{one}, {units[one]}" if units[one] != "1" else one for one in posterior.names]
    values = {name: row["value"] for name, row in rows.items()}
    title = f"{experiment.name}: posterior of the parameters"
    figure = posterior_plots.corner(posterior, labels, values, truth, title)
    pictures = _keep(run, "corner.png", title, figure)
    title = f"{experiment.name}: walkers"
    figure = posterior_plots.chain(posterior, labels, truth, title)
    pictures |= _keep(run, "chain.png", title, figure)

    parts = [HEADING, "\n".join(f"- {line}" for line in _health(posterior))]
    parts.append(markdown(posterior_tables.posterior_table(posterior, truth, units)))
    if truth:
        determined = [name for name, row in rows.items() if row["determined"]]
        covered = posterior_tables.covered(posterior, truth, posterior.names)
        judged = posterior_tables.covered(posterior, truth, determined)
        parts.append(
            f"The 95 % intervals cover the truth of {covered} parameters; of those that the fit "
            f"calls determined, of {judged}."
        )
    parts.append(_gallery(pictures))
    summary = run / run_folder.SUMMARY
    before = summary.read_text() if summary.is_file() else f"# {experiment.name}\n"
    kept = before.partition(f"\n{HEADING}\n")[0].rstrip()
    files.write_text(summary, kept + "\n\n" + "\n\n".join(parts) + "\n")


def _names(fitted: Fit, index: int) -> tuple[str, str]:
    """What titles call a clip, and how the names of its pictures end."""
    several = len(fitted.problem.data) > 1
    clip = fitted.experiment.name + (f", clip {index + 1}" if several else "")
    return clip, f"_{index + 1}.png" if several else ".png"


def _worst(run: Path, fitted: Fit, plays: Sequence[Playback]) -> list[str]:
    """Draws the worst two seconds of each clip; the section that tells of them."""
    parts = [WORST]
    for index, play in enumerate(plays):
        legs, found = fitted.problem.data[index].rig.names, worst_window.find_worst_window(play)
        clip, end = _names(fitted, index)
        title = f"{clip}: the worst {play.time[found.end] - play.time[found.start]:.1f} seconds"
        picture = _keep(
            run, f"worst{end}", title, worst_window_plots.worst_window(play, legs, found, title)
        )
        parts.append(
            "\n".join(f"- {line}" for line in worst_window_report.describe(play, found, legs))
        )
        parts.append(_gallery(picture))
    return parts


def _draw_clip(run: Path, fitted: Fit, index: int, last: Playback) -> Pictures:
    """The pictures of one clip, which is played as it was fitted."""
    scene = fitted.problem.data[index]
    clip, end = _names(fitted, index)
    preset = fitted.problem.space.unpack(fitted.problem.space.pack({}))
    first = playback.play(scene, playback.run(preset, scene))
    legs, leg = scene.rig.names, fitted.ik.leg
    limits = [float(np.mean(getattr(leg, name))) for name in KNEE_LIMITS if hasattr(leg, name)]
    found: Pictures = {}
    for name, words, draw in (
        ("motion", "heights of feet and pelvis", lambda title: fit_plots.motion(last, legs, title)),
        ("side_view", "legs over the ground", lambda title: fit_plots.side_view(last, legs, title)),
        ("knees", "knee angles", lambda title: fit_plots.knees(last, legs, limits, title)),
        ("residuals", "residuals", lambda title: fit_plots.residuals(first, last, title)),
        ("locks", "contact and locks", lambda title: fit_plots.locks(last, legs, title)),
    ):
        title = f"{clip}: {words}"
        found |= _keep(run, f"{name}{end}", title, draw(title))
    return found


def _keep(run: Path, name: str, caption: str, figure: Figure) -> Pictures:
    """Saves a figure and tells where."""
    style.save(run / name, figure)
    return {name: caption}


def _gallery(pictures: Pictures) -> str:
    return "\n\n".join(f"![{caption}]({name})" for name, caption in pictures.items())


def _cost(told: Mapping[str, Any]) -> str:
    return (
        f"Cost {told['cost_before']:.6g} before, {told['cost']:.6g} after: {told['steps']} steps "
        f"in {told['seconds']:.1f} s."
    )


def _health(posterior: Posterior) -> list[str]:
    """How the sampling went, a sentence each."""
    steps, walkers = posterior.u.shape[0] * posterior.thin_by, posterior.u.shape[1]
    stuck = ", ".join(map(str, posterior.stuck)) or "none"
    return [
        posterior.message,
        f"{walkers} walkers, {steps} steps, the first {posterior.burn_in * posterior.thin_by} left "
        f"out as burn-in; {posterior.seconds:.0f} s in the last call.",
        f"Mean acceptance {formatting.percent(float(posterior.acceptance.mean()))}; slowest "
        f"autocorrelation time {posterior.autocorrelation_time.max():.0f} steps.",
        f"Stuck walkers: {stuck}; left out of the summary: "
        f"{', '.join(map(str, posterior.isolated)) or 'none'}.",
    ]


def _fit_summary(
    fitted: Fit,
    results: Sequence[jaxik.Result],
    pictures: Pictures,
    opening: Sequence[str],
    details: Sequence[str],
) -> str:
    experiment, found = fitted.experiment, fitted.identifiability
    told, truth = run_folder.describe_fit(fitted), truth_of(experiment)
    rows = told["parameters"]
    parts = [f"# {experiment.name}", f"{told['message']} {_cost(told)}"]
    other = "".join(f", `{stage}` by `{name}`" for stage, name in experiment.rules.items())
    parts.append(
        f"Preset `{experiment.preset}`{other}, loss `{experiment.loss}`, seed {experiment.seed}."
    )
    parts += [*opening, "## Parameters", markdown(fit_tables.parameter_table(rows, truth))]
    if truth:
        parts.append(f"{fit_tables.recovered(rows, truth)}.")
    if any("half_life" in row for row in rows):
        parts.append(markdown(fit_tables.gain_table(rows)))

    parts.append("## What these clips do not determine")
    names = ", ".join(f"`{name}`" for name in found.undetermined)
    parts.append(f"Undetermined: {names}." if names else "All free parameters are determined.")
    parts.append(
        "Contraction is 1 where the clips alone decide and 0 where the prior is all that is known."
    )
    parts.append(markdown(fit_tables.contraction_table(rows)))
    if found.correlated:
        pairs = (f"- `{a}` and `{b}`: {value:+.3f}" for a, b, value in found.correlated)
        parts.append("Pairs of which these clips mostly determine one combination (correlation):")
        parts.append("\n".join(pairs))
    if found.weakest:
        together = ", ".join(f"`{name}`" for name in found.weakest)
        parts.append(f"The least determined direction moves {together}.")

    clips = [
        limit_activity.measure(fitted.ik, scene, result)
        for scene, result in zip(fitted.problem.data, results, strict=True)
    ]
    parts += ["## What the clips ask of the fitted system", "Shares of all frames, a foot each:"]
    parts.append(markdown(fit_tables.activity_table(clips)))
    parts.append("Share of frames that would look different if the limit were out of the way:")
    parts.append(markdown(fit_tables.limit_table(clips)))
    if found.profiles:
        flips = limit_activity.flipped_decisions(fitted.problem, fitted.solution.u)
        parts.append(
            "Share of the feet's decisions (planted, lifted, locked, ground found) that flip when "
            "a threshold moves by 10 % of its range, and by how much the cost rises:"
        )
        parts.append(markdown(fit_tables.flip_table(flips, found.profiles)))
    parts += [*details, "## Pictures", _gallery(pictures)]
    return "\n\n".join(parts) + "\n"
