"""The report of a population: what its clips and subjects have in common, and how they differ."""

import math
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.experiment import file_tables, parameter_files
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import experiment_to_toml, load_experiment
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import make_problem
from fitting.experiment.systems import Preset
from fitting.report import pages
from fitting.report.document import Document, Finding, Grid, Plot, Points, Section, Text
from fitting.report.formatting import Table, interval, number
from fitting.report.style import AFTER, BEFORE, CAPTURED, PRIOR, STAGES, legend, panels, styled
from fitting.runtime import activity, files
from fitting.runtime.precision import in_float64
from fitting.studies.fit import run_folder
from fitting.studies.fit.sentences import listed
from fitting.studies.output import output_folder, publish

from .population import Estimate, ParameterEstimates, Population, fit_clips_and_population

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

ERROR_NAMES = {
    "alone": "fitted alone",
    "pooled": "pooled",
    "population": "population",
    "left_out_pooled": "left out, pooled",
    "left_out_population": "left out, population",
}
CM = 100.0  # in a metre


APART = 0.16  # of a row, from its middle to an estimate
COLOURS = dict(zip(ERROR_NAMES, (BEFORE, CAPTURED, AFTER, STAGES[1], STAGES[4]), strict=True))
PANELS_PER_ROW = 3


def document(population: Population) -> Document:
    """What a population says."""
    count = len(population.unconverged)
    title = f"{population.experiment.name}: clips and their population"
    return Document(
        file=SUMMARY,
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
                    Text(PARAMETERS),
                    Plot(FIGURE, title, lambda: overview(population, title)),
                ],
            ),
            Section("Errors", [Grid(error_table(population), "Errors"), Text(ERRORS)]),
            Section("In detail", [Points(remarks(population), brief=True)]),
            _limits(population),
        ],
        asked=[*pages.rows(population.experiment), ["What varies", _varying(population)]],
        numbers={NUMBERS: population.summary},
        files={run_folder.PARAMETERS: "the population's centre"},
    )


def remarks(population: Population) -> list[str]:
    """What the findings leave out, a sentence each."""
    lines = [f"**Not converged**: {line}" for line in population.unconverged]
    lines += [
        _difference(population, row) for row in population.parameters if row["spread"] is not None
    ]
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
    table = [["error, cm", *ERROR_NAMES.values()]]
    for row in population.errors:
        table.append([row.clip, *(f"{CM * getattr(row, key):.2f}" for key in ERROR_NAMES)])
    table.append(["all", *(f"{CM * mean_error(population, key):.2f}" for key in ERROR_NAMES)])
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


@styled
def overview(population: Population, title: str) -> Figure:
    """A panel for each parameter that varies, and one with the errors of all clips."""
    varying = [row for row in population.parameters if row["spread"] is not None]
    labels = [clip_label(population, c) for c in range(len(population.clips))]
    columns = min(PANELS_PER_ROW, len(varying) + 1)
    height, width = 0.45 * len(labels) + 1.6, 5.6 * columns
    count = len(varying) + 1
    figure, grid = panels(count, columns, title, height, 1.6, width=width, sharey=True)
    for axes, row in zip(grid, varying, strict=False):
        _estimates(axes, row)
    _errors(grid[-1], population)
    for axes in grid[::columns]:
        axes.set_yticks(range(len(labels)), labels)
    grid[0].set_ylim(len(labels) - 0.4, -0.6)
    legend(
        figure,
        Line2D([], [], marker="o", color=BEFORE, label="fitted alone, 95 %"),
        Line2D([], [], marker="o", color=AFTER, label="in the population, 95 %"),
        Line2D([], [], color=PRIOR, label="centre of the population"),
        Patch(color=PRIOR, alpha=0.15, label="95 % of clips or subjects"),
        Line2D([], [], color=CAPTURED, linestyle="--", label="pooled"),
        *(
            Line2D([], [], marker="D", linestyle="", color=COLOURS[key], label=f"error, {words}")
            for key, words in ERROR_NAMES.items()
        ),
        columns=5,
    )
    return figure


def _estimates(axes: Axes, row: ParameterEstimates) -> None:
    """One parameter: each clip alone and in the population."""
    assert row["range"] is not None  # of a parameter that varies
    axes.axvspan(*row["range"], color=PRIOR, alpha=0.15, linewidth=0)
    axes.axvline(row["centre"]["value"], color=PRIOR)
    axes.axvline(row["pooled"]["value"], color=CAPTURED, linestyle="--")
    for c, (alone, within) in enumerate(zip(row["alone"], row["clips"], strict=True)):
        _bar(axes, c - APART, alone, BEFORE)
        _bar(axes, c + APART, within, AFTER)
    axes.set_title(row["name"])
    axes.set_xlabel("" if row["unit"] == "1" else row["unit"])


def _bar(axes: Axes, place: float, estimate: Estimate, colour: str) -> None:
    axes.plot([estimate["value"]], [place], "o", color=colour, markersize=6)
    if estimate["interval"] is not None:
        axes.plot(estimate["interval"], [place, place], color=colour)


def _errors(axes: Axes, population: Population) -> None:
    """Errors of all clips."""
    for c, row in enumerate(population.errors):
        for place, key in zip(np.linspace(-0.24, 0.24, len(ERROR_NAMES)), ERROR_NAMES, strict=True):
            axes.plot([CM * getattr(row, key)], [c + place], "D", color=COLOURS[key], markersize=6)
    axes.set_xlim(left=0.0)
    axes.set_title("Error")
    axes.set_xlabel("cm, rms")


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
    few = len(population.clips) < FEW
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
    if len(population.clips) < FEW:
        lines.append(f"There are {len(population.clips)} clips: a spread is hardly known.")
    return Section("Limits of the data", [Points(lines)])


@in_float64
def population(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
) -> Population:
    """Fits the clips of an experiment each alone, all pooled, and as a population.

    What varies between clips or subjects stands in the experiment's table [hierarchy]. Each clip is
    also predicted from the others. Each finished search is written at once, and a call with the
    same folder continues where an interrupted one ended.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the searches and the report.

    Raises:
        ValueError: the experiment is wrong, fits a capture, too, nothing in it varies, or a
            threshold does; it does not fit its clips; the folder cannot be made or holds something
            else.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    file_tables.refuse(experiment.capture, str(experiment.path), "population")
    with output_folder(output) as folder:
        experiment = replace(with_files(experiment, folder), holdout=0.0)
        problem = make_problem(experiment)
        activity.log(
            f"fitting {problem.space.size} parameters of {experiment.preset} to "
            f"{len(experiment.clips)} clips, {len(experiment.hierarchy.varying)} of them varying"
        )
        fitted = fit_clips_and_population(experiment, problem, folder)
        if folder is not None:
            _write_systems(folder, fitted)
        publish(folder, document(fitted))
        return fitted


def _write_systems(folder: Path, fitted: Population) -> None:
    """The experiment, and parameter files: of the population's centre, and of each clip."""
    experiment, space = fitted.experiment, fitted.problem.space
    preset = Preset(experiment.preset, experiment.faithful)
    folder.mkdir(parents=True, exist_ok=True)
    clips = folder / "clips"
    clips.mkdir(exist_ok=True)
    files.write_text(folder / run_folder.EXPERIMENT, experiment_to_toml(experiment, folder))
    paths = [folder / run_folder.PARAMETERS, *(clips / f"{name}.toml" for name in fitted.clips)]
    for path, u in zip(paths, [fitted.fit.centre, *fitted.fit.clips], strict=True):
        ik = space.unpack(jnp.asarray(u))
        files.write_text(path, parameter_files.system_to_toml(ik, preset, fitted.leg_length))
