"""What is read of an experiment without each of its rules: tables and a picture."""

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.experiments.ablations import WHOLE
from fitting.experiments.experiment import Experiment
from fitting.runtime import files
from fitting.studies.ablation import Row

from . import formatting
from .formatting import Table, markdown
from .labels import ACCURACY, explanations, headings
from .plots import style
from .plots.style import AFTER, CAPTURED, STAGES, legend, styled

TABLE, CELLS, FIGURE = "table.md", "table.csv", "contribution.png"
PANELS = 4  # in a row
TOLD = ("pelvis", "ankle", "ankle_stance", "knee", "knee_angle", "straight", "pop")
OTHER = STAGES[1]


def write(folder: Path, experiment: Experiment, rows: Sequence[Row]) -> None:
    """Writes the tables and the picture into a folder that is there."""
    style.save(folder / FIGURE, bars(rows, f"{experiment.name}: without each of its rules"))
    files.write_text(folder / CELLS, cells(rows))
    files.write_text(folder / TABLE, _summary(experiment, rows))


def tell(row: Row) -> None:
    """Prints a line of a row that has just been fitted."""
    shown = ", ".join(
        f"{ACCURACY[key].heading} {ACCURACY[key].format(getattr(row.agreement, key))}"
        for key in TOLD
    )
    print(f"{_where(row)}: {shown}; {row.seconds:.0f} s", flush=True)


def titles(rows: Sequence[Row]) -> dict[int, str]:
    """What each group of rows is, by the part that was held out."""
    parts = sorted({row.part for row in rows} - {0})
    found = {
        part: f"Part {part} of {len(parts)} held out: fitted on all else, measured on it"
        for part in parts
    }
    return found | {0: "Everything fitted, everything measured"}


def group(rows: Sequence[Row], part: int) -> Table:
    """A row a variant, with what the figure rises by where the rule is left out."""
    those = [row for row in rows if row.part == part]
    whole = those[0].agreement
    table = [["", *headings(ACCURACY)]]
    for row in those:
        shown = []
        for key in ACCURACY:
            value, before = getattr(row.agreement, key), getattr(whole, key)
            shown.append(ACCURACY[key].format(value) + _rise(key, value - before))
        table.append([_name(row.variant), *shown])
    return table


def cells(rows: Sequence[Row]) -> str:
    """All figures as CSV, in the units of their columns."""
    out = io.StringIO()
    sheet = csv.writer(out, lineterminator="\n")
    units = [f"{key} [{column.unit}]" for key, column in ACCURACY.items()]
    sheet.writerow(["variant", "held out", *units, "fitted", "converged", "seconds"])
    for row in rows:
        figures = [
            f"{column.factor * value:.6g}"
            for column, value in zip(ACCURACY.values(), astuple(row.agreement), strict=True)
        ]
        part = row.part or "nothing"
        ended = [len(row.values), row.converged, f"{row.seconds:.1f}"]
        sheet.writerow([row.variant, part, *figures, *ended])
    return out.getvalue()


@styled
def bars(rows: Sequence[Row], title: str) -> Figure:
    """Each figure of all variants: on parts held out, and where everything was fitted."""
    names = list(dict.fromkeys(row.variant for row in rows))
    count = -(-len(ACCURACY) // PANELS)
    figure = Figure(figsize=(17, count * (0.45 * len(names) + 1.2) + 1.8), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(count, PANELS, squeeze=False, sharey=True)
    for axes, key in zip(grid.flat, ACCURACY, strict=False):
        _bars(axes, key, rows, names)
    for axes in list(grid.flat)[len(ACCURACY) :]:
        axes.set_axis_off()
    legend(
        figure,
        Patch(color=AFTER, label=f"{WHOLE}: mean of the parts held out"),
        Patch(color=OTHER, label="without this one, likewise"),
        Line2D([], [], marker="o", linestyle="", color="black", label="each part"),
        Line2D([], [], marker="D", linestyle="", color=CAPTURED, label="fitted on everything"),
    )
    return figure


def _bars(axes: Axes, key: str, rows: Sequence[Row], names: Sequence[str]) -> None:
    """One figure of all variants."""
    column, most = ACCURACY[key], 0.0
    for place, name in enumerate(names):
        parts = [getattr(row.agreement, key) for row in rows if row.variant == name and row.part]
        whole = [getattr(r.agreement, key) for r in rows if r.variant == name and not r.part]
        mean = float(np.mean(parts))
        shown = column.factor * np.array([*parts, *whole])
        most = max(most, float(np.nan_to_num(shown).max()))
        colour = AFTER if name == WHOLE else OTHER
        axes.barh(place, column.factor * np.nan_to_num(mean), color=colour, height=0.7)
        axes.plot(shown[: len(parts)], [place] * len(parts), "o", color="black", markersize=5)
        axes.plot(shown[len(parts) :], [place], "D", color=CAPTURED, markersize=6)
        axes.annotate(
            ACCURACY[key].format(mean), (np.nan_to_num(shown).max(), place), xytext=(8, 0),
            textcoords="offset points", va="center",
        )  # fmt: skip
        if name == WHOLE and not np.isnan(mean):
            axes.axvline(column.factor * mean, color=AFTER, linestyle="--", linewidth=1.2)
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlim(0.0, 1.3 * max(most, 10.0 ** (1 - column.digits)))
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_yticks(range(len(names)), [_name(name) for name in names])
    axes.tick_params(axis="y", length=0)
    axes.grid(False, axis="y")
    axes.set_title(f"{column.heading.capitalize()}, {column.unit}")


def _summary(experiment: Experiment, rows: Sequence[Row]) -> str:
    """The tables as Markdown, with what they mean."""
    parts = [
        f"# {experiment.name}: without each of its rules",
        "Each row is fitted anew. In brackets: by how much a figure rises where the rule is left "
        "out. Measured at the rate of the clips.",
    ]
    for part, title in titles(rows).items():
        parts += [f"## {title}", markdown(group(rows, part))]
    parts += [f"![All figures]({FIGURE})", "## What is left out", _left_out(experiment)]
    parts += ["## Fitted values, on everything", markdown(_values(rows))]
    if poor := [row for row in rows if not row.converged]:
        parts.append("Fits that did not converge:")
        parts.append("\n".join(f"- {_where(row)}: {row.message}" for row in poor))
    parts.append("## What the columns mean")
    parts.append(explanations(ACCURACY))
    return "\n\n".join(parts) + "\n"


def _left_out(experiment: Experiment) -> str:
    """What each variant has otherwise, a line each."""
    lines = []
    for variant in experiment.without:
        said = [f"`{stage}` is `{name}`" for stage, name in variant.rules.items()]
        said += [f"`{name}` = {value}" for name, value in variant.parameters.items()]
        lines.append(f"- **{variant.name}**: {', '.join(said)}")
    return "\n".join(lines) or "Nothing."


def _values(rows: Sequence[Row]) -> Table:
    """A row a parameter, a column a variant; a dash where it is not free."""
    those = [row for row in rows if not row.part]
    names = list(dict.fromkeys(name for row in those for name in row.values))
    table = [["parameter", *(_name(row.variant) for row in those)]]
    for name in names:
        values = [row.values.get(name) for row in those]
        table.append([f"`{name}`", *("–" if v is None else formatting.number(v) for v in values)])
    return table


def _name(variant: str) -> str:
    return variant if variant == WHOLE else f"without {variant}"


def _where(row: Row) -> str:
    return _name(row.variant) + (f", part {row.part} held out" if row.part else ", everything")


def _rise(key: str, rise: float) -> str:
    """By how much a figure is larger, in brackets; nothing where that rounds to 0 or is unknown."""
    column = ACCURACY[key]
    told = f"{column.factor * rise:+.{column.digits}f}"
    return "" if np.isnan(rise) or float(told) == 0.0 else f" ({told})"
