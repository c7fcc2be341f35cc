"""The page of an ablation: what each rule is worth on motion that no fit has seen."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from fitting.experiments.ablations import COMPLETE
from fitting.experiments.experiment import Experiment
from fitting.report import ablation_report
from fitting.report.formatting import transposed
from fitting.report.labels import ACCURACY, meanings
from fitting.report.page import asked, pictures
from fitting.report.page.sentences import listed
from fitting.report.page.study_page import (
    Block,
    Finding,
    Grid,
    Points,
    Section,
    StudyPage,
    Terms,
    Text,
)
from fitting.studies.ablation import NUMBERS, Row

MARGIN = 5e-5  # m: what tables of cm with two digits round to 0
FILES = {
    ablation_report.TABLE: "the tables",
    ablation_report.CELLS: "all figures",
    NUMBERS: "all fits",
    ablation_report.FIGURE: "the figure",
}


class Rise(NamedTuple):
    """How much further ankles are from the captured ones without a rule, on parts held out."""

    variant: str
    mean: float
    """Metres."""
    everywhere: bool
    """Whether they are further in every part."""


def write(folder: Path, experiment: Experiment, rows: Sequence[Row]) -> None:
    """Writes the page into the folder of an ablation, whose figure is there."""
    unconverged = [row for row in rows if not row.converged]
    StudyPage(
        kind="An experiment without each of its rules",
        title=experiment.name,
        verdict=f"{len(unconverged)} fits not converged" if unconverged else "All fits converged",
        good=not unconverged,
        findings=findings(rows),
        sections=[
            _figures(folder, experiment, rows),
            Section("What is left out", [Points(ablation_report.changes(experiment))]),
            Section(
                "Fitted values, on everything",
                [Grid(ablation_report.values(rows), "Fitted values of all variants")],
            ),
            _limits(rows, unconverged),
        ],
        asked=[*asked.rows(experiment), ["Parts of each clip", f"{_parts(rows)}"]],
        files=FILES,
    ).write(folder)


def rises(rows: Sequence[Row]) -> list[Rise]:
    """Of each variant, the largest first; without those of which nothing is known."""
    held_out = {(row.variant, row.part): row.agreement.ankle for row in rows if row.part}
    parts = sorted({part for _, part in held_out})
    findings = []
    for variant in dict.fromkeys(row.variant for row in rows if row.variant != COMPLETE):
        each = [held_out[variant, part] - held_out[COMPLETE, part] for part in parts]
        mean = sum(each) / len(each)
        if not math.isnan(mean):
            findings.append(Rise(variant, mean, all(rise > 0.0 for rise in each)))
    return sorted(findings, key=lambda rise: -rise.mean)


def findings(rows: Sequence[Row]) -> list[Finding]:
    """Whether all fits converged and hold elsewhere, which rules matter, which could go."""
    return [_soundness(rows), *_rules(rises(rows))]


def _parts(rows: Sequence[Row]) -> int:
    return max(row.part for row in rows)


def _soundness(rows: Sequence[Row]) -> Finding:
    complete = [row for row in rows if row.variant == COMPLETE]
    held_out = [row.agreement.ankle for row in complete if row.part]
    seen = next(row.agreement.ankle for row in complete if not row.part)
    distance = (
        f"with all rules the ankles are {100 * sum(held_out) / len(held_out):.2f} cm from the "
        f"captured ones (rms) on parts that were held out, {100 * seen:.2f} cm where everything "
        "was fitted"
    )
    count = sum(not row.converged for row in rows)
    if count:
        return Finding(
            f"{count} of {len(rows)} fits did not converge, so that differences between them may "
            f"be those of the search; {distance}.",
            bad=True,
        )
    return Finding(f"All {len(rows)} fits converged; {distance}.")


def _rules(rises: Sequence[Rise]) -> list[Finding]:
    if not rises:
        nothing = "No variant could be measured, so nothing is known of single rules."
        return [Finding(nothing, bad=True)]
    first = rises[0]
    size = f"{100 * first.mean:.2f} cm"
    if first.mean <= MARGIN:
        most = Finding(
            "No rule is needed: without any one of them, ankles of held-out parts are no further "
            "from the captured ones.",
            bad=True,
        )
    else:
        where = "in every part" if first.everywhere else "on average, though not in every part"
        most = Finding(
            f"Without `{first.variant}` the ankles of held-out parts are {size} further off, the "
            f"most of all, {where}."
        )
    idle = [f"`{rise.variant}`" for rise in rises if rise.mean <= MARGIN]
    if idle:
        return [
            most,
            Finding(
                f"{listed(idle)} {'earns' if len(idle) == 1 else 'earn'} nothing here: without "
                f"{'it' if len(idle) == 1 else 'any of them'} held-out ankles are as close, or "
                f"closer by up to {max(0.0, -100 * rises[-1].mean):.2f} cm.",
                bad=True,
            ),
        ]
    if len(rises) == 1:
        return [most, Finding("Nothing else is left out, so nothing is known of other rules.")]
    last = rises[-1]
    return [
        most,
        Finding(
            f"Each of the {len(rises)} variants is worse than the whole; least is missed "
            f"`{last.variant}`, with {100 * last.mean:.2f} cm."
        ),
    ]


def _figures(folder: Path, experiment: Experiment, rows: Sequence[Row]) -> Section:
    blocks: list[Block] = [
        Text(
            "Each column is a fit. In brackets: how much a figure rises without the rule. "
            "Measured at the rate of the clips."
        )
    ]
    for part, title in ablation_report.titles(rows).items():
        blocks.append(Grid(transposed(ablation_report.group(rows, part)), title, title))
    captions = {ablation_report.FIGURE: f"{experiment.name}: all figures without each of its rules"}
    blocks += pictures.embed(folder, captions)
    return Section("With and without each rule", [*blocks, Terms(meanings(ACCURACY))])


def _limits(rows: Sequence[Row], unconverged: Sequence[Row]) -> Section:
    lines = [
        f"Clips are cut into {_parts(rows)} parts; differences that are not the same in all of "
        "them may be chance.",
        "Parts of one clip show the same person on the same ground: on others a rule may be worth "
        "more or less.",
        *(f"Not converged: {ablation_report.row_name(row)}: {row.message}" for row in unconverged),
    ]
    return Section("Limits of the data", [Points(lines)])
