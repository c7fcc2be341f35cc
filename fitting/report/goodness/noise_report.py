"""The noise that was estimated: its section of a fit's summary, and its table of a posterior."""

import math
from collections.abc import Mapping

import numpy as np

from fitting.analysis.goodness.noise import pooled
from fitting.experiments.experiment import DEFAULT_SIGMAS
from fitting.inference.identifiability import NORMAL
from fitting.report.formatting import Table, interval, markdown, number
from fitting.report.labels import RESIDUALS
from fitting.studies.fit import Fit

COUNTED = (
    "For intervals, each residual counts as {:.3g} independent ones of the size of its sigma, as "
    "their size and correlation say. The best point does not depend on that."
)


def section(fitted: Fit) -> list[str]:
    """Paragraphs of Markdown; none if nothing was estimated."""
    options = fitted.experiment.noise
    if not options.estimates_any:
        return []
    parts = ["### Noise"]
    if options.sigmas == "estimated":
        parts.append(markdown(_estimated_sigmas(fitted)))
    if options.correlation == "whitened":
        parts.append(markdown(_estimated_correlations(fitted)))
    if options.correlation == "counted":
        parts.append(COUNTED.format(fitted.noise.weight))
    if fitted.problem.loss == "student" and options.sigmas == "estimated":
        parts.append(f"Student's t has {fitted.noise.tails:.3g} degrees of freedom.")
    return parts


def sigma_table(draws: Mapping[str, np.ndarray]) -> Table:
    """Sampled sigmas: median and 95 % interval of each."""
    table = [["sigma", "unit", "median", "95 % interval"]]
    for kind, values in draws.items():
        name, unit, factor = RESIDUALS[kind]
        low, middle, high = np.percentile(factor * values, [2.5, 50, 97.5])
        table.append([name, unit, number(middle), interval(low, high)])
    return table


def _estimated_sigmas(fitted: Fit) -> Table:
    """Sigmas with the 95 % interval that their degrees of freedom give them."""
    table = [["sigma", "unit", "given", "estimated", "95 % interval"]]
    for kind, sigma in fitted.noise.sigmas.items():
        name, unit, factor = RESIDUALS[kind]
        given = fitted.experiment.sigmas.get(kind, DEFAULT_SIGMAS[kind])
        degrees = pooled([g.left for g in fitted.groups if g.kind == kind]).degrees
        spread = math.exp(NORMAL / math.sqrt(2 * max(degrees, 1)))
        ends = interval(factor * sigma / spread, factor * sigma * spread)
        table.append([name, unit, number(factor * given), number(factor * sigma), ends])
    return table


def _estimated_correlations(fitted: Fit) -> Table:
    """Correlations with the 95 % interval of an autoregression's coefficient."""
    table = [["correlation from one frame to the next", "estimated", "95 % interval"]]
    for kind, rho in fitted.noise.correlations.items():
        count = sum(group.left.count for group in fitted.groups if group.kind == kind)
        half = NORMAL * math.sqrt((1 - rho**2) / max(count, 1))
        ends = interval(rho - half, min(rho + half, 1.0))
        table.append([RESIDUALS[kind].name, f"{rho:.3f}", ends])
    return table
