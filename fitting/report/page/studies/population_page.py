"""The page of a population: what clips and subjects have in common, and how they differ."""

from pathlib import Path

from fitting.report.hierarchy import population_report
from fitting.report.hierarchy.population_tables import (
    CM,
    error_table,
    mean_error,
    parameter_table,
)
from fitting.report.page import asked, pictures
from fitting.report.page.sentences import listed
from fitting.report.page.study_page import Finding, Grid, Points, Section, StudyPage, Text
from fitting.studies import run_folder
from fitting.studies.hierarchy.population import Population

FILES = {
    population_report.SUMMARY: "the tables",
    population_report.NUMBERS: "all numbers",
    run_folder.PARAMETERS: "the population's centre",
    population_report.FIGURE: "the figure",
}


def write(folder: Path, population: Population) -> None:
    """Writes the page into the folder of a population, whose figure is there."""
    count = len(population.unconverged)
    caption = f"{population.experiment.name}: clips and their population"
    StudyPage(
        kind="Clips fitted alone, pooled and as a population",
        title=population.experiment.name,
        verdict="Converged" if population.converged else f"{count} not converged",
        good=population.converged,
        findings=findings(population),
        sections=[
            Section(
                "Parameters",
                [
                    Grid(parameter_table(population), "Parameters of clips and population"),
                    Text(population_report.PARAMETERS),
                    *pictures.embed(folder, {population_report.FIGURE: caption}),
                ],
            ),
            Section(
                "Errors",
                [Grid(error_table(population), "Errors"), Text(population_report.ERRORS)],
            ),
            Section("In detail", [Points(population_report.remarks(population))]),
            _limits(population),
        ],
        asked=[*asked.rows(population.experiment), ["What varies", _varying(population)]],
        files=FILES,
    ).write(folder)


def findings(population: Population) -> list[Finding]:
    """Whether all converged, what differs, and whether clips are predicted from each other."""
    return [_convergence(population), _differences(population), _prediction(population)]


def _convergence(population: Population) -> Finding:
    lines = population.unconverged
    if lines:
        return Finding(
            f"{len(lines)} of the searches did not converge, so that differences may be those of "
            f"the search: {listed(lines).rstrip('.')}.",
            bad=True,
        )
    count = len(population.alone) + len(population.others) + 1
    return Finding(f"All {count} searches and the fit of the population converged.")


def _differences(population: Population) -> Finding:
    clear, open_, alike = [], [], []
    for row in population.parameters:
        spread = row["spread"]
        if spread is None or spread["interval"] is None:
            continue
        differs = spread["interval"][0] > 0
        group = clear if differs else open_ if spread["value"] > 0 else alike
        group.append(f"`{row['name']}`")
    parts = [
        f"{listed(clear)} {_verb(clear, 'differs', 'differ')} between them" if clear else "",
        f"{listed(open_)} may differ" if open_ else "",
        f"{listed(alike)} {_verb(alike, 'is', 'are')} alike as far as they tell" if alike else "",
    ]
    count = len(set(population.subjects))
    who = f"{len(population.clips)} clips of {count} subject{'s' * (count != 1)}"
    few = len(population.clips) < population_report.FEW
    return Finding(
        f"Of {who}{', too few to say much of spreads' if few else ''}: "
        f"{'; '.join(filter(None, parts))}.",
        bad=few,
    )


def _verb(names: list[str], one: str, several: str) -> str:
    return one if len(names) == 1 else several


def _prediction(population: Population) -> Finding:
    by_population, by_pooled, alone = (
        mean_error(population, key) for key in ("left_out_population", "left_out_pooled", "alone")
    )
    text = (
        f"A clip that is left out is predicted to {CM * by_population:.2f} cm by the population of "
        f"the others and to {CM * by_pooled:.2f} cm by their pooled fit; fitted alone, "
        f"{CM * alone:.2f} cm are left"
    )
    if by_population > by_pooled:
        return Finding(f"The population predicts worse than one fit to all clips: {text}.", True)
    return Finding(f"{text}.")


def _varying(population: Population) -> str:
    rows = [row for row in population.parameters if row["level"] != "shared"]
    return ", ".join(f"`{row['name']}` per {row['level']}" for row in rows)


def _limits(population: Population) -> Section:
    lines = [
        "Spreads are of these clips and subjects; how far others differ follows only if they were "
        "chosen as these were.",
    ]
    if len(population.clips) < population_report.FEW:
        lines.append(f"There are {len(population.clips)} clips: a spread is hardly known.")
    return Section("Limits of the data", [Points(lines)])
