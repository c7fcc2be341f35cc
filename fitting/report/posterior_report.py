"""The report of a sampling: text for the terminal, and its section of the run's summary.md."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fitting.experiments.experiment import Experiment
from fitting.inference.sampling.posterior import Posterior
from fitting.runtime import files
from fitting.studies.fit import FittedParameter
from fitting.studies.run_folder import SUMMARY

from . import posterior_tables
from .fit_report import gallery, save_plot
from .formatting import aligned, bullets, markdown, percent
from .plots import posterior_plots

HEADING = "## Posterior"  # what follows it in summary.md is replaced


def posterior_text(posterior: Posterior, known_values: Mapping[str, float] | None) -> str:
    """The result of a sampling, for the terminal."""
    table = aligned(posterior_tables.posterior_table(posterior, known_values, {}))
    parts = [*_health(posterior), "", table]
    if known_values:
        covered = posterior_tables.covered(posterior, known_values, posterior.names)
        parts += ["", f"The 95 % intervals contain the true values of {covered} parameters."]
    return "\n".join(parts)


def write_posterior(
    run: Path,
    experiment: Experiment,
    posterior: Posterior,
    fitted: Sequence[FittedParameter],
    known_values: Mapping[str, float] | None,
) -> None:
    """Writes the plots of a posterior and its section of summary.md, in place of an older one.

    Args:
        run: the folder of the run.
        experiment: what was fitted.
        posterior: the samples.
        fitted: the parameters of the fit around which it was sampled.
        known_values: parameters that made a synthetic reference, by name.
    """
    rows = {row["name"]: row for row in fitted}
    units = {name: row["unit"] for name, row in rows.items()}
    labels = [f"{name}, {units[name]}" if units[name] != "1" else name for name in posterior.names]
    values = {name: row["value"] for name, row in rows.items()}
    title = f"{experiment.name}: posterior of the parameters"
    figure = posterior_plots.corner(posterior, labels, values, known_values, title)
    plots = save_plot(run, "corner.png", title, figure)
    title = f"{experiment.name}: walkers"
    figure = posterior_plots.chain(posterior, labels, known_values, title)
    plots |= save_plot(run, "chain.png", title, figure)

    parts = [HEADING, bullets(_health(posterior))]
    parts.append(markdown(posterior_tables.posterior_table(posterior, known_values, units)))
    if known_values:
        determined = [name for name, row in rows.items() if row["determined"]]
        covered = posterior_tables.covered(posterior, known_values, posterior.names)
        covered_determined = posterior_tables.covered(posterior, known_values, determined)
        parts.append(
            f"The 95 % intervals contain the true values of {covered} parameters; among those that "
            f"the fit calls determined, of {covered_determined}."
        )
    parts.append(gallery(plots))
    summary = run / SUMMARY
    text = summary.read_text(encoding="utf-8") if summary.is_file() else f"# {experiment.name}\n"
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
        f"Stuck walkers: {stuck}; left out of the summary: "
        f"{', '.join(map(str, posterior.isolated)) or 'none'}.",
    ]
