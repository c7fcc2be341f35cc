"""The section of a run's summary.md on what was known before any clip."""

from collections.abc import Sequence

from fitting.report.formatting import Table, interval, markdown, number
from fitting.studies.fit import FittedParameter


def prior_section(rows: Sequence[FittedParameter]) -> list[str]:
    """Paragraphs of Markdown: what a prior is, and the table of them."""
    return [
        "## Priors",
        "What was known of the parameters before these clips, beside what the fit leaves of it. A "
        "normal prior is one of `u`, the parameter's range stretched to a coordinate without "
        "bounds; the spread is its standard deviation there. A uniform prior is the range itself.",
        markdown(prior_table(rows)),
    ]


def prior_table(rows: Sequence[FittedParameter]) -> Table:
    """Free parameters: shape, centre and spread of the prior, its interval and the fit's."""
    table = [["parameter", "unit", "prior", "centre", "spread of u"]]
    table[0] += ["95 % of the prior", "95 % interval of the fit"]
    for row in rows:
        prior = row["prior"]
        cells = [row["name"], row["unit"], prior["shape"]]
        cells += ["" if prior[key] is None else number(prior[key]) for key in ("centre", "spread")]
        table.append([*cells, interval(*prior["interval"]), interval(*row["interval"])])
    return table
