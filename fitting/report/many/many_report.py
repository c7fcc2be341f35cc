"""The report of many fits: how many there are, what they found, and which failed."""

import statistics
from collections import Counter
from collections.abc import Sequence

from fitting.report.formatting import Table, aligned, bullets, joined, markdown, number, percent
from fitting.report.plots import style
from fitting.runtime import files
from fitting.studies.many.progress import ManyFits, ManyProgress
from fitting.studies.many.rows import Row

from . import many_plots

SUMMARY, FIGURE = "summary.md", "fits.png"
MANY = 50  # rows of a table for people; all are in the file
SPREAD = (
    "Of each parameter: the median of the fitted values of all fits that determine it, where 80 % "
    "of them lie, and how many fits determine it."
)


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


def progress_line(progress: ManyProgress) -> str:
    """Rate, time left and failures."""
    failed = f", {progress.failed} failed" if progress.failed else ""
    left = progress.remaining
    time_left = f"{left:.0f} s" if left < 100 else f"{left / 60:.0f} min"
    return f"{progress.rate:.1f} fits a minute, {time_left} left{failed}"


def many_text(fits: ManyFits) -> str:
    """The result, for the terminal."""
    parts = [bullets(remarks(fits))]
    if fits.finished:
        parts.append(aligned(parameter_table(fits)))
    if fits.failed:
        parts.append(aligned(failure_table(fits)))
    return joined(parts, apart=True)


def remarks(fits: ManyFits) -> list[str]:
    """How the fits went, a sentence each."""
    count, lines = len(fits.finished), []
    lines.append(f"Finished: {count} of {fits.total} fits.")
    if fits.interrupted:
        missing = fits.total - len(fits.rows)
        rest = "fit that is missing" if missing == 1 else f"{missing} fits that are missing"
        lines.append(f"Interrupted: the same command makes the {rest}.")
    if fits.failed:
        lines.append(f"**Failed**: {len(fits.failed)}; the same command tries them again.")
    if fits.unconverged:
        lines.append(f"**Not converged**: {len(fits.unconverged)}.")
    if bad := misfits(fits):
        does = "does" if bad == 1 else "do"
        lines.append(
            f"{bad} of {count} finished fits {does} not match the motion to within the given "
            "sigmas, whether converged or not."
        )
    if made := [row["effort"] for row in fits.finished if "effort" in row]:
        seconds = statistics.median(effort["seconds"] for effort in made)
        cpu = statistics.median(effort["cpu_seconds"] for effort in made)
        peaks = [effort["peak_mb"] for effort in made if effort["peak_mb"] is not None]
        memory = f", and at most {max(peaks):.0f} MB in a process" if peaks else ""
        lines.append(f"A fit took {seconds:.1f} s, {cpu:.1f} s of CPU time (medians){memory}.")
    return lines


def misfits(fits: ManyFits) -> int:
    """How many finished fits leave more of the motion over than noise of the given sigmas."""
    return sum(not row["outcome"]["fits"] for row in fits.finished if "outcome" in row)


def parameter_table(fits: ManyFits) -> Table:
    """A row for each parameter of each experiment: where its fitted values lie."""
    rows = [["experiment", "parameter", "unit", "median", "10 %", "90 %", "determined"]]
    by_experiment: dict[str, list[Row]] = {}
    for row in fits.finished:
        by_experiment.setdefault(row["experiment"], []).append(row)
    for experiment, members in by_experiment.items():
        outcomes = [row["outcome"] for row in members if "outcome" in row]
        for name in dict.fromkeys(name for of in outcomes for name in of["parameters"]):
            of_name = [of["parameters"][name] for of in outcomes if name in of["parameters"]]
            values = sorted(fitted["value"] for fitted in of_name if fitted["determined"])
            figures = [number(q) for q in _quantiles(values)] or ["–"] * 3
            known = f"{len(values)} of {len(of_name)}"
            rows.append([experiment, name, of_name[0]["unit"], *figures, known])
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


def write(fits: ManyFits, tables: Sequence[str]) -> None:
    """Writes summary.md and fits.png into the folder of the fits."""
    title = f"{fits.total} fits"
    parts = [f"# {title}", bullets(remarks(fits))]
    if fits.finished:
        style.save(fits.folder / FIGURE, many_plots.overview(fits, title))
        parts += ["## Parameters", markdown(parameter_table(fits)), SPREAD]
        parts += [f"![Fitted values and times]({FIGURE})"]
    if fits.failed:
        parts += ["## Failed", markdown(failure_table(fits))]
    parts += ["## Fits", markdown(fit_table(fits)), f"All of them: {', '.join(tables)}."]
    files.write_text(fits.folder / SUMMARY, "\n\n".join(parts) + "\n")
