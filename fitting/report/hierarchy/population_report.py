"""The report of a population: what its clips and subjects have in common, and how they differ."""

from pathlib import Path

from fitting.report.formatting import aligned, bullets, interval, joined, markdown, number
from fitting.report.plots import style
from fitting.runtime import files
from fitting.runtime.storage.json_files import write_json
from fitting.studies.hierarchy.estimates import ParameterEstimates
from fitting.studies.hierarchy.kept_searches import Found
from fitting.studies.hierarchy.population import Population

from . import population_plots
from .population_tables import CM, error_table, mean_error, parameter_table

NUMBERS, SUMMARY, FIGURE = "population.json", "summary.md", "population.png"
FEW = 5  # clips or subjects, from which little is known of a spread
PARAMETERS = (
    "Intervals are those of 95 %. **Fitted alone** is a fit of one clip, and **pooled** one of all "
    "clips with the same values. In the population, what varies is normal around the centre, in "
    "`u`, the coordinate of the prior; the spread is its standard deviation there. What a clip "
    "leaves open comes from the others."
)
ERRORS = (
    "Distance of pelvis, knees and ankles from the captured ones, rms over joints and frames. "
    "**Left out** is the error of a clip that had no part in the fit: with the values pooled over "
    "the others, and with those that the population of the others expects of it."
)


def found_line(found: Found) -> str:
    """A finished search in one line, for the terminal."""
    return f"{found['name']}: cost {number(found['cost'])}, {found['seconds']:.1f} s"


def population_text(population: Population) -> str:
    """The result, for the terminal."""
    tables = [aligned(parameter_table(population)), aligned(error_table(population))]
    return joined([*tables, bullets(remarks(population))], apart=True)


def write(folder: Path, population: Population) -> None:
    """Writes population.json, summary.md and population.png into an existing folder."""
    name = population.experiment.name
    title = f"{name}: clips and their population"
    style.save(folder / FIGURE, population_plots.overview(population, title))
    write_json(folder / NUMBERS, population.summary)
    parts = [
        f"# {title}",
        bullets(remarks(population)),
        "## Parameters",
        markdown(parameter_table(population)),
        PARAMETERS,
        f"![Clips and their population]({FIGURE})",
        "## Errors",
        markdown(error_table(population)),
        ERRORS,
    ]
    files.write_text(folder / SUMMARY, "\n\n".join(parts) + "\n")


def remarks(population: Population) -> list[str]:
    """What was found, a sentence each."""
    lines = [f"**Not converged**: {line}" for line in population.unconverged]
    lines += [
        _difference(population, row) for row in population.parameters if row["spread"] is not None
    ]
    lines.append(prediction(population))
    if (leg_length := population.leg_length) is not None:
        lines.append(
            f"Values are those of a body with legs of {number(leg_length)} m; those of each clip's "
            "body are dynamically similar."
        )
    return lines


def _difference(population: Population, row: ParameterEstimates) -> str:
    """Whether clips or subjects differ in a parameter."""
    spread, things = row["spread"], f"{row['level']}s"
    assert spread is not None and spread["interval"] is not None  # of a parameter that varies
    low, high = spread["interval"]
    found = f"spread {number(spread['value'])}"
    count = len(set(population.subjects if row["level"] == "subject" else population.clips))
    few = f", from {count} {things} only" if count < FEW else ""
    if low > 0:
        words = f"differs between {things}: {found} ({interval(low, high)})"
    elif spread["value"] > 0:
        words = f"may differ between {things}: {found}, at most {high:.4g}"
    else:
        words = f"is alike in all {things} as far as they tell: spread at most {high:.4g}"
    return f"`{row['name']}` {words}{few}."


def prediction(population: Population) -> str:
    """How well a clip is predicted from the others."""
    by_population, by_pooled, alone = (
        f"{CM * mean_error(population, key):.2f} cm"
        for key in ("left_out_population", "left_out_pooled", "alone")
    )
    return (
        f"A clip that is left out is predicted to {by_population} by the population of the others "
        f"and to {by_pooled} by their pooled fit; fitted alone, {alone} are left."
    )
