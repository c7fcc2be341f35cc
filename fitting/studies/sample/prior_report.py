"""Sections of a run's summary.md on the prior: beside the fit, and beside the posterior."""

from collections.abc import Mapping, Sequence

from fitting.inference.sample.prior_sensitivity import MAX_K, Reweighted
from fitting.report.document import Block, Grid, Heading, Section, Text
from fitting.report.formatting import Table, interval, number
from fitting.studies.fit.fit import FittedParameter

from .sample import SampledFit


def prior_section(rows: Sequence[FittedParameter]) -> Section:
    """What a prior is, and the table of them."""
    explanation = (
        "What was known of the parameters before these clips, beside what the fit leaves of it. A "
        "normal prior is one of `u`, the parameter's range stretched to a coordinate without "
        "bounds; the spread is its standard deviation there. Unless the experiment says otherwise, "
        "it is centred at the system's value, or, where that is in the outer sixth of the range, a "
        "sixth inside. A uniform prior is the range itself."
    )
    grid = Grid(prior_table(rows), "Priors", brief=False)
    return Section("Priors", [Text(explanation), grid], on_page=False)


def prior_table(rows: Sequence[FittedParameter]) -> Table:
    """Free parameters: shape, centre and spread of the prior, its interval and the fit's."""
    table = [["parameter", "unit", "prior", "centre", "spread of u"]]
    table[0] += ["95 % of the prior", "95 % interval of the fit"]
    for row in rows:
        prior = row["prior"]
        cells = [row["name"], row["unit"], prior["shape"], _centre(row)]
        cells.append("" if prior["spread"] is None else number(prior["spread"]))
        table.append([*cells, interval(*prior["interval"]), interval(*row["interval"])])
    return table


def _centre(row: FittedParameter) -> str:
    """The centre of a prior, and the system's value where it is another one."""
    centre = row["prior"]["centre"]
    if centre is None:
        return ""
    other = number(row["before"]) != number(centre)
    return number(centre) + (f" (system: {number(row['before'])})" if other else "")


def posterior_prior_blocks(sampled: SampledFit, units: Mapping[str, str]) -> list[Block]:
    """Prior beside posterior, and how much the one decides the other."""
    sensitivity = sampled.prior_sensitivity.items()
    moved = [name for name, rows in sensitivity if any(row["sensitive"] for row in rows)]
    unknown = [
        name
        for name, rows in sensitivity
        if name not in moved and any(row["sensitive"] is None for row in rows)
    ]
    table = prior_and_posterior_table(sampled, units)
    sentences = []
    if moved:
        sentences.append(
            f"Sensitive to their prior, for an end of the interval moves by more than a quarter of "
            f"its width: {_names(moved)}."
        )
    if unknown:
        sentences.append(
            f"The draws cannot tell how sensitive these are; sample with another `[prior]` to see: "
            f"{_names(unknown)}."
        )
    return [
        Heading("Prior and posterior"),
        Text(
            "The last columns are the median and the 95 % interval if the parameter's own prior "
            "had half or twice the spread in `u`, by weighting the draws. `k` is the Pareto shape "
            f"of the weights; above {MAX_K:g} they are unreliable, and no figure is given."
        ),
        Grid(table, "Prior and posterior", brief=False),
        *map(Text, sentences or ["No parameter is sensitive to its prior."]),
    ]


def prior_and_posterior_table(sampled: SampledFit, units: Mapping[str, str]) -> Table:
    """Free parameters: intervals of the prior, of the posterior, and under other priors."""
    table = [["parameter", "unit", "prior", "95 % of the prior", "95 % of the posterior"]]
    table[0] += ["with half the spread", "with twice the spread"]
    for row in sampled.posterior.summary:
        name = row["name"]
        prior = sampled.priors[name]
        cells = [name, units[name], prior["shape"], interval(*prior["interval"])]
        cells.append(interval(row["low95"], row["high95"]))
        table.append([*cells, *map(_reweighted, sampled.prior_sensitivity[name])])
    return table


def _reweighted(row: Reweighted) -> str:
    if row["median"] is None or row["interval"] is None:
        return f"unreliable (k {row['pareto_k']:.2f})"
    return f"{number(row['median'])}, {interval(*row['interval'])} (k {row['pareto_k']:.2f})"


def _names(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
