"""The report of a sampling: text for the terminal, and its section of the run's summary.md."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fitting.inference.sampling.diagnostics import ParameterSummary
from fitting.inference.sampling.posterior import Posterior
from fitting.runtime import activity, files
from fitting.studies.run_folder import SUMMARY
from fitting.studies.sample import SampledFit

from .fit_report import gallery, save_plot
from .fit_tables import Truth
from .formatting import Table, aligned, bullets, interval, joined, markdown, number, percent
from .goodness import noise_report
from .page import posterior_section
from .plots import posterior_plots
from .uncertainty import band_plots, left_out, predictive
from .uncertainty.contradictions import contradiction_sentences
from .uncertainty.islands import island_section, island_sentences
from .uncertainty.priors import posterior_prior_section

HEADING = "## Posterior"  # what follows it in summary.md is replaced


def posterior_text(sampled: SampledFit, run: Path | None = None) -> str:
    """The result of a sampling, for the terminal; `run` is the folder where it is written."""
    posterior, known_values = sampled.posterior, sampled.known_values
    table = aligned(posterior_table(posterior, known_values, {}))
    parts = [*_health(posterior), *contradiction_sentences(sampled, run)]
    if sampled.replay is not None:
        parts.append(predictive.sentence(sampled.replay.checks))
    if sampled.left_out is not None:
        parts.append(left_out.sentence(sampled.left_out))
    parts += ["", table]
    if posterior.sigmas:
        parts += ["", aligned(noise_report.sigma_table(posterior.sigmas))]
    if known_values:
        count = covered(posterior, known_values, posterior.names)
        parts += ["", f"The 95 % intervals contain the true values of {count} parameters."]
    return joined(parts)


def write_posterior(run: Path, sampled: SampledFit) -> None:
    """Writes the plots of a posterior, and its part of summary.md and page in place of older ones.

    Args:
        run: the folder of the run.
        sampled: the posterior and the fit.
    """
    experiment, posterior = sampled.experiment, sampled.posterior
    known_values = sampled.known_values
    rows = {row["name"]: row for row in sampled.parameters}
    units = {name: row["unit"] for name, row in rows.items()}
    labels = [f"{name}, {units[name]}" if units[name] != "1" else name for name in posterior.names]
    values = {name: row["value"] for name, row in rows.items()}
    with activity.announced("Drawing the posterior"):
        title = f"{experiment.name}: posterior of the parameters"
        figure = posterior_plots.corner(
            posterior, labels, values, known_values, title, space=sampled.space
        )
        plots = save_plot(run, "corner.png", title, figure)
        title = f"{experiment.name}: walkers"
        figure = posterior_plots.chain(posterior, labels, known_values, title)
        plots |= save_plot(run, "chain.png", title, figure)

    contradictions = contradiction_sentences(sampled, run)
    table = posterior_table(posterior, known_values, units)
    posterior_section.insert(run, contradictions, _health(posterior), table)
    parts = [HEADING, *(f"**{line}**" for line in contradictions)]
    parts += [bullets(_health(posterior)), markdown(table)]
    if posterior.sigmas:
        parts.append("Sigmas of the noise, which were sampled along:")
        parts.append(markdown(noise_report.sigma_table(posterior.sigmas)))
    if known_values:
        determined = [name for name, row in rows.items() if row["determined"]]
        all_count = covered(posterior, known_values, posterior.names)
        determined_count = covered(posterior, known_values, determined)
        parts.append(
            f"The 95 % intervals contain the true values of {all_count} parameters; among those "
            f"that the fit calls determined, of {determined_count}."
        )
    parts += island_section(posterior, sampled.space, units)
    parts += posterior_prior_section(sampled, units)
    if sampled.replay is not None:
        parts += predictive.section(sampled.replay)
        title = f"{experiment.name}: the capture inside what the posterior would make"
        figure = band_plots.bands(sampled.replay.bands, title)
        plots |= save_plot(run, "predictive.png", title, figure)
    if sampled.left_out is not None and sampled.replay is not None:
        parts += left_out.section(sampled.left_out, sampled.replay.blocks)
    parts.append(gallery(plots))
    summary = run / SUMMARY
    text = f"# {experiment.name}\n"
    if summary.is_file():
        text = summary.read_text(encoding="utf-8", errors="replace")  # what is damaged may stay
    before = text.partition(f"\n{HEADING}\n")[0].rstrip()
    files.write_text(summary, before + "\n\n" + "\n\n".join(parts) + "\n")


def _health(posterior: Posterior) -> list[str]:
    """How the sampling went, a sentence each."""
    steps, walkers = posterior.u.shape[0] * posterior.thin_by, posterior.u.shape[1]
    stuck = ", ".join(map(str, posterior.stuck)) or "none"
    return [
        posterior.message,
        f"{walkers} walkers, {steps} steps, the first {posterior.burn_in * posterior.thin_by} left "
        f"out as burn-in; {posterior.seconds:.0f} s in the last call.",
        f"Mean acceptance {percent(float(posterior.acceptance.mean()))}; slowest "
        f"autocorrelation time {posterior.autocorrelation_time.max():.0f} steps.",
        f"Stuck walkers: {stuck}.",
        *island_sentences(posterior),
    ]


def posterior_table(posterior: Posterior, truth: Truth, units: Mapping[str, str]) -> Table:
    """Parameters of a posterior: moments, intervals, how well they are sampled.

    Args:
        posterior: after sampling.
        truth: known values by name; where there are any, the last column says whether the 95 %
            interval contains them.
        units: of the parameters, by name; empty to leave the column out.
    """
    heading = ["parameter", *(["unit"] if units else []), "mean", "sd", "median", "68 % interval"]
    heading += ["95 % interval", "ESS", "R-hat", "autocorrelation"]
    table = [heading + (["truth", "covered"] if truth else [])]
    for row, steps in zip(posterior.summary, posterior.autocorrelation_time, strict=True):
        cells = [row["name"], *([units[row["name"]]] if units else [])]
        cells += [number(row[key]) for key in ("mean", "sd", "median")]
        cells += [interval(row["low68"], row["high68"]), interval(row["low95"], row["high95"])]
        cells += [f"{row['ess']:.0f}", f"{row['r_hat']:.3f}", f"{steps:.0f} steps"]
        if truth:
            true = truth.get(row["name"])
            cells.append("unknown" if true is None else number(true))
            cells.append("" if true is None else "yes" if covers(row, true) else "no")
        table.append(cells)
    return table


def covered(posterior: Posterior, truth: Mapping[str, float], names: Sequence[str]) -> str:
    """How many of these parameters have their true value within their 95 % interval."""
    known = [row for row in posterior.summary if row["name"] in names and row["name"] in truth]
    inside = sum(covers(row, truth[row["name"]]) for row in known)
    return f"{inside} of {len(known)}"


def covers(row: ParameterSummary, true: float) -> bool:
    """Whether the 95 % interval of a posterior's row contains this value."""
    return row["low95"] <= true <= row["high95"]
