"""The table of a posterior, and how many of its intervals contain known values."""

from collections.abc import Mapping, Sequence

from fitting.inference.sampling.diagnostics import ParameterSummary
from fitting.inference.sampling.posterior import Posterior

from .fit_tables import Truth
from .formatting import Table, interval, number


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
