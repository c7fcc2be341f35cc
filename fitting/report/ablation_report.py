"""The report of an ablation: tables, as text and as CSV, and a figure."""

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

import numpy as np

from fitting.experiments.experiment import Experiment
from fitting.runtime import files
from fitting.studies.ablation import Row

from .formatting import Table, aligned, bullets, joined, markdown, number
from .labels import ACCURACY, explanations, headings
from .plots import ablation_plots, style
from .plots.ablation_plots import variant_name

TABLE, CELLS, FIGURE = "table.md", "table.csv", "contribution.png"
SHOWN = ("pelvis", "ankle", "ankle_stance", "knee", "knee_angle", "straight", "pop")


def write(folder: Path, experiment: Experiment, rows: Sequence[Row]) -> None:
    """Writes table.md, table.csv and contribution.png into an existing folder."""
    title = f"{experiment.name}: without each of its rules"
    style.save(folder / FIGURE, ablation_plots.overview(rows, title))
    files.write_text(folder / CELLS, cells(rows))
    files.write_text(folder / TABLE, _summary(experiment, rows))


def row_text(row: Row) -> str:
    """A finished row in one line, for the terminal."""
    figures = ", ".join(
        f"{ACCURACY[key].heading} {ACCURACY[key].format(getattr(row.agreement, key))}"
        for key in SHOWN
    )
    return f"{row_name(row)}: {figures}; {row.seconds:.0f} s"


def tables_text(rows: Sequence[Row]) -> str:
    """All groups of rows, for the terminal."""
    groups = [
        joined(["", f"{title}:", "", aligned(group(rows, part))])
        for part, title in titles(rows).items()
    ]
    return joined(groups)


def titles(rows: Sequence[Row]) -> dict[int, str]:
    """The title of each group of rows, by the part that was held out."""
    parts = sorted({row.part for row in rows} - {0})
    held_out = {
        part: f"Part {part} of {len(parts)} held out: fitted on all else, measured on it"
        for part in parts
    }
    return held_out | {0: "Everything fitted, everything measured"}


def group(rows: Sequence[Row], part: int) -> Table:
    """A row for each variant; in brackets, how much each figure rises without the rule."""
    members = [row for row in rows if row.part == part]
    complete = members[0].agreement
    table = [["", *headings(ACCURACY)]]
    for row in members:
        figures = []
        for key, column in ACCURACY.items():
            value, before = getattr(row.agreement, key), getattr(complete, key)
            figures.append(column.format(value) + _rise(key, value - before))
        table.append([variant_name(row.variant), *figures])
    return table


def cells(rows: Sequence[Row]) -> str:
    """All figures as CSV, in the units of their columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{key} [{column.unit}]" for key, column in ACCURACY.items()]
    writer.writerow(["variant", "held out", *columns, "fitted", "converged", "seconds"])
    for row in rows:
        figures = [
            f"{column.factor * value:.6g}"
            for column, value in zip(ACCURACY.values(), astuple(row.agreement), strict=True)
        ]
        fit = [len(row.values), row.converged, f"{row.seconds:.1f}"]
        writer.writerow([row.variant, row.part or "nothing", *figures, *fit])
    return text.getvalue()


def _summary(experiment: Experiment, rows: Sequence[Row]) -> str:
    parts = [
        f"# {experiment.name}: without each of its rules",
        "Each row is a fit of its own. In brackets: how much a figure rises without the rule. "
        "Measured at the rate of the clips.",
    ]
    for part, title in titles(rows).items():
        parts += [f"## {title}", markdown(group(rows, part))]
    parts += [f"![All figures]({FIGURE})", "## What is left out", bullets(changes(experiment))]
    parts += ["## Fitted values, on everything", markdown(values(rows))]
    if unconverged := [row for row in rows if not row.converged]:
        parts.append("Fits that did not converge:")
        parts.append(bullets([f"{row_name(row)}: {row.message}" for row in unconverged]))
    parts += ["## What the columns mean", explanations(ACCURACY)]
    return "\n\n".join(parts) + "\n"


def changes(experiment: Experiment) -> list[str]:
    """What each variant changes, a line each."""
    lines = []
    for ablation in experiment.without:
        changes = [f"`{stage}` is `{name}`" for stage, name in ablation.rules.items()]
        changes += [f"`{name}` = {value}" for name, value in ablation.parameters.items()]
        lines.append(f"**{ablation.name}**: {', '.join(changes)}")
    return lines or ["Nothing."]


def values(rows: Sequence[Row]) -> Table:
    """A row for each parameter, a column for each variant; a dash where it is not free."""
    everything = [row for row in rows if not row.part]
    names = list(dict.fromkeys(name for row in everything for name in row.values))
    table = [["parameter", *(variant_name(row.variant) for row in everything)]]
    for name in names:
        fitted = [row.values.get(name) for row in everything]
        table.append([f"`{name}`", *("–" if v is None else number(v) for v in fitted)])
    return table


def row_name(row: Row) -> str:
    """A variant, and what was held out."""
    split = f"part {row.part} held out" if row.part else "everything"
    return f"{variant_name(row.variant)}, {split}"


def _rise(key: str, rise: float) -> str:
    """A rise in brackets; nothing where it is unknown or rounds to 0."""
    column = ACCURACY[key]
    text = f"{column.factor * rise:+.{column.digits}f}"
    return "" if np.isnan(rise) or float(text) == 0.0 else f" ({text})"
