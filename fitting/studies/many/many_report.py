"""The report of many fits: how many there are, what they found, and which failed."""

import statistics
from collections import Counter
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from fitting.experiment.experiment import Experiment
from fitting.report import pages
from fitting.report.document import Document, Finding, Grid, Plot, Points, Section, Text
from fitting.report.formatting import Table, number, percent
from fitting.report.style import AFTER, BEFORE, CAPTURED, panels, styled
from fitting.studies.fit.sentences import listed

from .many_tasks import FittedValue, ManyFits, Row

SUMMARY, FIGURE = "summary.md", "fits.png"
MANY = 50  # rows of a table for people; all are in the file
SPREAD = (
    "Of each parameter: the median of the fitted values of all fits that determine it, where 80 % "
    "of them lie, and how many fits determine it."
)

COLUMNS = 4
SHOWN = 15  # parameters
SHORTEST = 1e-3  # s, of a fit as the histogram shows it
SINGLE = 150  # fits, up to which each has its interval

LIMITS = [
    "Each clip is fitted as if there were no others: that values differ does not say that people "
    "do. `jaxik population` tells spread from uncertainty.",
    "Fits of one clip with several seeds differ by their search only.",
]
TABLES = {"fits.csv": "a row for each fit", "fits.parquet": "the same for pandas and the like"}


def plan_line(experiments: int, tasks: int, missing: int, seeds: int) -> str:
    """What is about to be done."""
    of = f"{experiments} experiment{'s' * (experiments != 1)}"
    seed = f", {seeds} seeds for each clip" if seeds > 1 else ""
    left = "" if missing == tasks else f"; {tasks - missing} are there already"
    return f"{tasks} fit{'s' * (tasks != 1)} of {of}{seed}{left}"


def row_line(row: Row) -> str:
    """A fit that ended, in one line."""
    if "outcome" not in row:
        return f"{row['run']}: FAILED: {row['error']}"
    outcome = row["outcome"]
    state = "" if outcome["converged"] else ", not converged"
    seconds = f", {row['effort']['seconds']:.1f} s" if "effort" in row else ""
    return f"{row['run']}: cost {number(outcome['cost'])}{seconds}{state}"


def parameter_table(fits: ManyFits) -> Table:
    """A row for each parameter of each experiment: where its fitted values lie."""
    rows = [["experiment", "parameter", "unit", "median", "10 %", "90 %", "determined"]]
    for (experiment, name), values in _by_parameter(fits.finished).items():
        known = sorted(fitted["value"] for fitted in values if fitted["determined"])
        figures = [number(q) for q in _quantiles(known)] or ["–"] * 3
        count = f"{len(known)} of {len(values)}"
        rows.append([experiment, name, values[0]["unit"], *figures, count])
    return rows


def _quantiles(values: Sequence[float]) -> list[float]:
    """The median, and where the middle 80 % end; nothing of nothing."""
    if not values:
        return []
    if len(values) == 1:
        return [values[0]] * 3
    tenths = statistics.quantiles(values, n=10, method="inclusive")
    return [tenths[4], tenths[0], tenths[8]]


def failure_table(fits: ManyFits) -> Table:
    """The fits that failed, each with its error; of very many the first ones."""
    rows = [["run", "error"]]
    rows += [[row["run"], row["error"]] for row in fits.failed[:MANY]]
    if len(fits.failed) > MANY:
        rows.append(["…", f"and {len(fits.failed) - MANY} others"])
    return rows


def fit_table(fits: ManyFits) -> Table:
    """A row for each fit; of very many the first ones."""
    rows = [["run", "state", "cost", "determined", "seconds"]]
    for row in fits.rows[:MANY]:
        if "outcome" not in row:
            rows.append([row["run"], "failed!", "–", "–", "–"])
            continue
        outcome = row["outcome"]
        known = sum(fitted["determined"] for fitted in outcome["parameters"].values())
        state = "converged" if outcome["converged"] else "not converged!"
        seconds = f"{row['effort']['seconds']:.1f}" if "effort" in row else "–"
        count = f"{known} of {len(outcome['parameters'])}"
        rows.append([row["run"], state, number(outcome["cost"]), count, seconds])
    if len(fits.rows) > MANY:
        rows.append([f"and {len(fits.rows) - MANY} others", "", "", "", ""])
    return rows


def share_by_error(fits: ManyFits) -> list[str]:
    """Errors without what differs from fit to fit, the most frequent first."""
    counts = Counter(row["error"].rpartition(": ")[2] for row in fits.failed)
    return [f"{percent(count / fits.total, 0)}: {error}" for error, count in counts.most_common(3)]


def document(fits: ManyFits, experiments: Sequence[Experiment], tables: Sequence[str]) -> Document:
    """What many fits say; `tables` are the files that have a row for each."""
    title = (
        "Fitted values with their 95 % intervals, blue where the clip determines the parameter and "
        "grey where it does not; and how long fits took, on a logarithmic axis"
    )
    sections = []
    if fits.finished:
        grid = Grid(parameter_table(fits), "Fitted values of all fits")
        plot = Plot(FIGURE, title, lambda: overview(fits, f"{fits.total} fits"))
        sections.append(Section("Parameters", [grid, Text(SPREAD), plot]))
    return Document(
        file=SUMMARY,
        kind="Many fits, each in a folder of its own",
        title=listed([experiment.name for experiment in experiments]),
        verdict=_verdict(fits),
        good=not (fits.failed or fits.unconverged or fits.interrupted or fits.misfits),
        findings=findings(fits),
        sections=[
            *sections,
            Section("Failed", [Grid(failure_table(fits), "Fits that failed")]),
            Section("Fits", [Grid(fit_table(fits), "All fits", brief=False)]),
            Section("Limits of the data", [Points(LIMITS)]),
        ],
        asked=[
            [experiment.name, f"{pages.system(experiment)}; {_clips(experiment)}"]
            for experiment in experiments[:MANY]
        ],
        files={name: TABLES[name] for name in tables},
    )


@styled
def overview(fits: ManyFits, title: str) -> Figure:
    """Of each parameter the values of all fits; and the seconds that they took."""
    series = list(_by_parameter(fits.finished).items())[:SHOWN]
    figure, grid = panels(len(series) + 1, COLUMNS, title, 3.6, 1.0)
    for axes, ((experiment, name), values) in zip(grid, series, strict=False):
        _values(axes, values)
        axes.set_title(f"{name}\n{experiment}", fontsize=12)
    _seconds(grid[-1], fits.finished)
    return figure


def _by_parameter(rows: Sequence[Row]) -> dict[tuple[str, str], list[FittedValue]]:
    """What fits say of each parameter of each experiment."""
    series: dict[tuple[str, str], list[FittedValue]] = {}
    for row in rows:
        for name, fitted in row["outcome"]["parameters"].items() if "outcome" in row else ():
            series.setdefault((row["experiment"], name), []).append(fitted)
    return series


def _values(axes: Axes, values: Sequence[FittedValue]) -> None:
    """Each fit's value with its 95 % interval, or a histogram of very many."""
    unit = values[0]["unit"]
    if len(values) > SINGLE:
        known = [fitted["value"] for fitted in values if fitted["determined"]]
        axes.hist([fitted["value"] for fitted in values], 40, color=BEFORE, label="all")
        axes.hist(known, 40, color=AFTER, label="determined")
        axes.set(xlabel=unit, ylabel="fits")
        return
    for row, fitted in enumerate(values, 1):
        colour = AFTER if fitted["determined"] else BEFORE
        axes.plot([row, row], fitted["interval"], color=colour, linewidth=1.2)
        axes.plot(row, fitted["value"], ".", color=colour)
    axes.set(xlabel="fit", ylabel=unit, xlim=(0.5, len(values) + 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _seconds(axes: Axes, rows: Sequence[Row]) -> None:
    """How long fits took, and how much of that was their search."""
    pairs = [
        (row["effort"]["seconds"], row["outcome"]["search_seconds"])
        for row in rows
        if "effort" in row and "outcome" in row
    ]
    whole, search = np.array(pairs).T
    # Logarithmic, for first fits compile and take a hundred times as long as those that follow.
    ends = min(whole.min(), search.min()), max(whole.max(), search.max())
    bins = np.geomspace(max(ends[0], SHORTEST) / 1.1, max(ends[1], SHORTEST) * 1.1, 30).tolist()
    axes.hist(whole, bins, color=AFTER, alpha=0.8, label="fit")
    axes.hist(search, bins, color=CAPTURED, alpha=0.6, label="its search")
    axes.set(xlabel="time, s", ylabel="fits", xscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title("time of a fit", fontsize=12)
    axes.margins(y=0.35)  # room for the legend
    axes.legend(loc="upper right")


def findings(fits: ManyFits) -> list[Finding]:
    """Whether all are there, whether they converged, and what a fit takes."""
    return [_completeness(fits), _convergence(fits), _effort(fits)]


def _clips(experiment: Experiment) -> str:
    count = len(experiment.clips)
    return f"{count} clip{'s' * (count != 1)}"


def _verdict(fits: ManyFits) -> str:
    if fits.failed:
        return f"{len(fits.failed)} failed"
    if len(fits.finished) < fits.total:
        return f"{fits.total - len(fits.finished)} are missing"
    if fits.unconverged:
        return f"{len(fits.unconverged)} not converged"
    bad = fits.misfits
    return f"All converged, {bad} do{'es' * (bad == 1)} not match" if bad else "All converged"


def _completeness(fits: ManyFits) -> Finding:
    missing = fits.total - len(fits.rows)
    rest = f"the {missing} that {'is' if missing == 1 else 'are'} missing"
    if fits.failed:
        reasons = "; ".join(share_by_error(fits)).rstrip(".")
        also = f" and makes {rest}" if missing else ""
        return Finding(
            f"{len(fits.failed)} of {fits.total} fits failed: {reasons}; the same command tries "
            f"them again{also}.",
            bad=True,
        )
    if missing:
        return Finding(
            f"{len(fits.finished)} of {fits.total} fits are finished; the same command makes "
            f"{rest}.",
            bad=True,
        )
    return Finding(f"All {fits.total} fits are finished.")


def _convergence(fits: ManyFits) -> Finding:
    outcomes = fits.outcomes
    if not outcomes:
        return Finding("No fit is finished, so nothing was found.", bad=True)
    bad = fits.misfits
    text = f"{len(outcomes) - bad} of {len(outcomes)} match the motion to within the given sigmas"
    if fits.unconverged:
        runs = listed(fits.unconverged)
        return Finding(f"{len(fits.unconverged)} did not converge ({runs}); {text}.", bad=True)
    return Finding(f"All finished searches converged; {text}.", bad=bad > 0)


def _effort(fits: ManyFits) -> Finding:
    efforts = fits.efforts
    if not efforts:
        return Finding("Nothing is known of what a fit takes.")
    seconds = statistics.median(effort["seconds"] for effort in efforts)
    peaks = [effort["peak_mb"] for effort in efforts if effort["peak_mb"] is not None]
    memory = f", and at most {max(peaks):.0f} MB in a process" if peaks else ""
    minutes = sum(effort["cpu_seconds"] for effort in efforts) / 60
    cpu = f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
    hosts = len({effort["host"] for effort in efforts})
    return Finding(
        f"A fit took {seconds:.1f} s (median), all together {cpu} of CPU time on {hosts} "
        f"machine{'s' * (hosts != 1)}{memory}."
    )
