"""Tables of a population, as text: each parameter per clip, pooled and as a population; errors."""

import math

from fitting.report.formatting import Table, interval, number
from fitting.studies.hierarchy.estimates import Estimate, ParameterEstimates
from fitting.studies.hierarchy.population import Population

ERRORS = {
    "alone": "fitted alone",
    "pooled": "pooled",
    "population": "population",
    "left_out_pooled": "left out, pooled",
    "left_out_population": "left out, population",
}
CM = 100.0  # in a metre


def parameter_table(population: Population) -> Table:
    """For each parameter a row per clip, one for all pooled, and one to three for the population.

    What clips share has its value in the population's row only.
    """
    table = [["parameter", "", "fitted alone", "in the population"]]
    for row in population.parameters:
        varies = row["spread"] is not None
        lines = [
            [clip_label(population, c), shown(alone), shown(within) if varies else ""]
            for c, (alone, within) in enumerate(zip(row["alone"], row["clips"], strict=True))
        ]
        lines += [["pooled", shown(row["pooled"]), ""], ["population", "", shown(row["centre"])]]
        if row["spread"] is not None and row["range"] is not None:
            lines.append(["spread, of u", "", shown(row["spread"])])
            lines.append([f"95 % of {row['level']}s", "", interval(*row["range"])])
        heading = f"`{row['name']}`, {_unit(row)}{_level(row)}"
        table += [[heading, *lines[0]], *(["", *line] for line in lines[1:])]
    return table


def error_table(population: Population) -> Table:
    """A row for each clip, and one for all; rms distances in cm."""
    table = [["error, cm", *ERRORS.values()]]
    for row in population.errors:
        table.append([row.clip, *(f"{CM * getattr(row, key):.2f}" for key in ERRORS)])
    table.append(["all", *(f"{CM * mean_error(population, key):.2f}" for key in ERRORS)])
    return table


def mean_error(population: Population, key: str) -> float:
    """Root mean square over the clips of one column of the errors, m."""
    squares = [getattr(row, key) ** 2 for row in population.errors]
    return math.sqrt(sum(squares) / len(squares))


def clip_label(population: Population, clip: int) -> str:
    """A clip's name, with its subject if the experiment names that."""
    name, subject = population.clips[clip], population.experiment.clips[clip].subject
    return name if subject is None else f"{name} ({subject})"


def shown(estimate: Estimate) -> str:
    """A value with its interval in brackets."""
    ends = estimate["interval"]
    return number(estimate["value"]) + ("" if ends is None else f" ({interval(*ends)})")


def _unit(row: ParameterEstimates) -> str:
    return "" if row["unit"] == "1" else f"{row['unit']}, "


def _level(row: ParameterEstimates) -> str:
    return row["level"] if row["level"] == "shared" else f"per {row['level']}"
