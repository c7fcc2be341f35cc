"""The page of many fits: how they went, what they found, and which failed."""

import statistics
from collections.abc import Sequence

from fitting.experiments.experiment import Experiment
from fitting.report.many import many_report
from fitting.report.page import asked, pictures
from fitting.report.page.sentences import listed
from fitting.report.page.study_page import Block, Finding, Grid, Points, Section, StudyPage, Text
from fitting.studies.many.progress import ManyFits

TABLES = {"fits.csv": "a row for each fit", "fits.parquet": "the same for pandas and the like"}


def write(fits: ManyFits, experiments: Sequence[Experiment], tables: Sequence[str]) -> None:
    """Writes the page into the folder of the fits, whose picture is there."""
    good = not (fits.failed or fits.unconverged or fits.interrupted or many_report.misfits(fits))
    caption = (
        "Fitted values with their 95 % intervals, blue where the clip determines the parameter and "
        "grey where it does not; and how long fits took, on a logarithmic axis"
    )
    sections = []
    if fits.finished:
        blocks: list[Block] = [
            Grid(many_report.parameter_table(fits), "Fitted values of all fits"),
            Text(many_report.SPREAD),
            *pictures.embed(fits.folder, {many_report.FIGURE: caption}),
        ]
        sections.append(Section("Parameters", blocks))
    if fits.failed:
        sections.append(
            Section("Failed", [Grid(many_report.failure_table(fits), "Fits that failed")])
        )
    sections.append(Section("Fits", [Grid(many_report.fit_table(fits), "All fits")]))
    sections.append(_limits())
    StudyPage(
        kind="Many fits, each in a folder of its own",
        title=listed([experiment.name for experiment in experiments]),
        verdict=_verdict(fits),
        good=good,
        findings=findings(fits),
        sections=sections,
        asked=[
            [experiment.name, f"{asked.system(experiment)}; {_clips(experiment)}"]
            for experiment in experiments[: many_report.MANY]
        ],
        files={many_report.SUMMARY: "the tables"} | {name: TABLES[name] for name in tables},
    ).write(fits.folder)


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
    bad = many_report.misfits(fits)
    return f"All converged, {bad} do{'es' * (bad == 1)} not match" if bad else "All converged"


def _completeness(fits: ManyFits) -> Finding:
    count = len(fits.finished)
    if fits.failed:
        reasons = "; ".join(many_report.share_by_error(fits)).rstrip(".")
        return Finding(f"{len(fits.failed)} of {fits.total} fits failed: {reasons}.", bad=True)
    if count < fits.total:
        return Finding(f"{count} of {fits.total} fits are there; the same command goes on.", True)
    return Finding(f"All {fits.total} fits are finished.")


def _convergence(fits: ManyFits) -> Finding:
    outcomes = [row["outcome"] for row in fits.finished if "outcome" in row]
    if not outcomes:
        return Finding("No fit is finished, so nothing was found.", bad=True)
    bad = many_report.misfits(fits)
    text = f"{len(outcomes) - bad} of {len(outcomes)} match the motion to within the given sigmas"
    if fits.unconverged:
        runs = listed([row["run"] for row in fits.unconverged])
        return Finding(f"{len(fits.unconverged)} did not converge ({runs}); {text}.", bad=True)
    return Finding(f"All finished searches converged; {text}.", bad=bad > 0)


def _effort(fits: ManyFits) -> Finding:
    efforts = [row["effort"] for row in fits.finished if "effort" in row]
    if not efforts:
        return Finding("Nothing is known of what a fit takes.")
    seconds = statistics.median(effort["seconds"] for effort in efforts)
    minutes = sum(effort["cpu_seconds"] for effort in efforts) / 60
    cpu = f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
    hosts = len({effort["host"] for effort in efforts})
    return Finding(
        f"A fit took {seconds:.1f} s (median), all together {cpu} of CPU time on {hosts} "
        f"machine{'s' * (hosts != 1)}."
    )


def _limits() -> Section:
    lines = [
        "Each clip is fitted as if there were no others: that values differ does not say that "
        "people do. `jaxik population` tells spread from uncertainty.",
        "Fits of one clip with several seeds differ by their search only.",
    ]
    return Section("Limits of the data", [Points(lines)])
