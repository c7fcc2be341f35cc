"""What notebooks show of fits, posteriors and comparisons."""

from fitting.inference.sampling.posterior import Posterior
from fitting.report import comparison_report, fit_tables, posterior_report
from fitting.report.plots import comparison_plots, posterior_plots, profile_plots
from fitting.runtime.display import notebook
from fitting.studies.comparison import Comparison
from fitting.studies.fit import Fit

from . import parts


@notebook.html.register
def fit_html(fitted: Fit) -> str:
    """Whether it fits, the parameters with their intervals, and their profiles."""
    parameters = {parameter.name: parameter for parameter in fitted.problem.space.parameters}
    units = {row["name"]: row["unit"] for row in fitted.parameters}
    title = f"{fitted.experiment.name}: lowest cost by each parameter"
    profiles = fitted.identifiability.profiles
    figure = profile_plots.profiles(parameters, profiles, units, fitted.known_values, title)
    return parts.page(
        f"Fit: {fitted.experiment.name}",
        parts.sentences([fitted.solution.message, fitted.verdict.sentence]),
        parts.table(fit_tables.parameter_table(fitted.parameters, fitted.known_values)),
        parts.picture(figure, title),
    )


@notebook.html.register
def posterior_html(posterior: Posterior) -> str:
    """How the sampling went, the parameters with their intervals, and the corner plot."""
    title = "posterior of the parameters"
    figure = posterior_plots.corner(posterior, posterior.names, {}, None, title)
    return parts.page(
        "Posterior",
        parts.sentences([posterior.message]),
        parts.table(posterior_report.posterior_table(posterior, None, {})),
        parts.picture(figure, title),
    )


@notebook.html.register
def comparison_html(comparison: Comparison) -> str:
    """The measures of each system, and its motion."""
    rows = comparison_report.transposed(comparison_report.table(comparison))
    return parts.page(
        f"Comparison: {comparison.title}",
        parts.table(rows),
        parts.picture(comparison_plots.overview(comparison), comparison.title),
    )
