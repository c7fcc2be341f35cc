"""The page of sampled runs that are compared by what they predict."""

from collections.abc import Sequence
from pathlib import Path

from fitting.report.page.sentences import listed
from fitting.report.page.study_page import Finding, Grid, Points, Section, StudyPage, Text
from fitting.report.uncertainty import run_comparison as report
from fitting.studies.posterior.run_comparison import ComparedRun

CLEAR = 2.0  # standard errors, from which a difference says something
FILES = {report.TABLE: "the table", report.NUMBERS: "all numbers"}


def write(folder: Path, runs: Sequence[ComparedRun]) -> None:
    """Writes the page into the folder of a comparison of runs, the best run first."""
    tied = undecided(runs)
    StudyPage(
        kind="Sampled fits to the same motion, by what they predict",
        title="Runs compared",
        verdict="Undecided" if tied else "Decided",
        good=not tied,
        findings=findings(runs),
        sections=[
            Section(
                "What the runs predict",
                [Grid(report.table(runs), "Runs"), Text(report.explanation())],
            ),
            Section(
                "Limits of the data",
                [
                    Points(
                        [
                            "The order is that of these runs on this motion: the best of them may "
                            "still not fit it, which the page of its run says.",
                            "Blocks of one motion depend on each other a little; errors may be "
                            "larger than they are said to be.",
                        ]
                    )
                ],
            ),
        ],
        asked=[["Runs", ", ".join(f"`{run.name}`" for run in runs)]],
        files=FILES,
    ).write(folder)


def undecided(runs: Sequence[ComparedRun]) -> list[ComparedRun]:
    """Runs whose predictions cannot be told from those of the best one."""
    return [run for run in runs[1:] if run.behind < CLEAR * run.behind_error]


def findings(runs: Sequence[ComparedRun]) -> list[Finding]:
    """Whether the figures are reliable, who is best and by how much, and who is last."""
    best, second, last = runs[0], runs[1], runs[-1]
    shaky = [f"`{run.name}` ({run.unreliable})" for run in runs if run.unreliable]
    if shaky:
        reliable = Finding(
            f"The figures are not fully reliable: there are blocks that the others do not predict "
            f"reliably, of {listed(shaky)}.",
            bad=True,
        )
    else:
        reliable = Finding("All blocks are predicted reliably from the others.")
    behind = f"{second.behind:.1f} ± {second.behind_error:.1f}"
    tied = [f"`{run.name}`" for run in undecided(runs)]
    if tied:
        order = Finding(
            f"The motion does not tell `{best.name}`, which predicts best, from {listed(tied)}: "
            f"`{second.name}` is {behind} below, less than {CLEAR:g} standard errors.",
            bad=True,
        )
    else:
        order = Finding(f"`{best.name}` predicts best; `{second.name}` is {behind} below.")
    furthest = (
        f"`{last.name}` predicts worst, {last.behind:.1f} ± {last.behind_error:.1f} below"
        if len(runs) > 2
        else f"The expected log predictive density of `{best.name}` is {best.elpd:.1f} ± "
        f"{best.error:.1f}"
    )
    numbers = [run.parameters for run in runs]
    return [
        reliable,
        order,
        Finding(
            f"{furthest}; the runs use {min(numbers):.1f} to {max(numbers):.1f} effective "
            "parameters."
        ),
    ]
