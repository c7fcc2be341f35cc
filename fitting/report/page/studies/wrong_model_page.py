"""The page of a calibration under a wrong model."""

from collections.abc import Sequence
from pathlib import Path

from fitting.experiments.experiment import Experiment
from fitting.report.calibration import calibration_report, wrong_model_report
from fitting.report.formatting import percent
from fitting.report.page import asked
from fitting.report.page.study_page import Finding, Grid, Points, Section, StudyPage, Text
from fitting.studies.calibration.wrong_model import WrongModelFit
from fitting.studies.calibration.wrong_model_assessment import WrongModelAssessment

from .calibration_page import WIDE

FILES = {calibration_report.SUMMARY: "the tables", calibration_report.NUMBERS: "all numbers"}
LIMITS = [
    "Errors and truths are drawn at random, and sizes of errors are those of a careful capture: a "
    "worse one, or a person who walks as no system does, may leave more.",
    "A part that is held out goes on with the same walk over the same ground.",
]


def write(
    folder: Path,
    experiment: Experiment,
    truth: str,
    fits: Sequence[WrongModelFit],
    assessment: WrongModelAssessment,
) -> None:
    """Writes the page into the folder of a calibration."""
    sections = [
        Section(
            "Checks",
            [
                Text(wrong_model_report.explanation(truth)),
                Grid(wrong_model_report.checks_table(assessment), "All checks"),
            ],
        ),
        Section(
            "Distances",
            [Grid(wrong_model_report.distances_table(assessment), "Distances by motion")],
        ),
    ]
    if assessment.coverage_of:
        covered = Grid(
            wrong_model_report.coverage_table(assessment), "Intervals of shared parameters"
        )
        sections.append(
            Section("Parameters of both systems", [Text(wrong_model_report.COVERED), covered])
        )
    sections.append(
        Section(
            "Limits of the data", [Points([*LIMITS, *wrong_model_report.remarks(assessment, fits)])]
        )
    )
    StudyPage(
        kind="Fits of motion that another system makes",
        title=experiment.name,
        verdict="True" if assessment.inside else "Not true",
        good=assessment.inside,
        findings=_findings(assessment),
        sections=sections,
        asked=[
            *asked.rows(experiment),
            ["Made by", truth],
            ["Simulated motions", f"{assessment.replicates}"],
        ],
        files=FILES,
    ).write(folder)


def _findings(assessment: WrongModelAssessment) -> list[Finding]:
    """What was found, and whether there are too few motions for it."""
    found = Finding(wrong_model_report.sentence(assessment), bad=not assessment.inside)
    true = assessment.verdicts
    if true.high - true.low <= WIDE:
        return [found]
    bounds = f"{percent(true.low, 0)} to {percent(true.high, 0)}"
    few = f"So few motions prove little: the share of true verdicts may be {bounds}."
    return [found, Finding(few, bad=True)]
