"""The report of a calibration under a wrong model: what fits are worth, and whether they say so."""

from collections.abc import Sequence

from fitting.experiment.experiment import Experiment
from fitting.motion.goodness import CLOSE, NAMES, PART_NAMES, UNSEEN, describe_distances, size
from fitting.report import pages
from fitting.report.document import Document, Finding, Grid, Points, Section, Text
from fitting.report.formatting import Table, percent

from .calibration_report import NUMBERS, SUMMARY, WIDE, listed_replicates, share_row
from .wrong_model import (
    LEVEL,
    TRUE_VERDICTS,
    WORSE,
    WrongModelAssessment,
    WrongModelFit,
    distances_of,
    summarise,
)

MOTIONS = {
    "animation": "the flat animation",
    "before": "the system before the fit",
    "fitted": "the fitted system",
    "kept": "the kept system",
}
COVERED = (
    "How often the fit's 95 % intervals contain the value of the system that made the motion, for "
    "parameters that both have. Nothing says that they should: under a wrong model a parameter "
    "also does the work of what the system lacks."
)

LIMITS = [
    "Errors and truths are drawn at random, and sizes of errors are those of a careful capture: a "
    "worse one, or a person who walks as no system does, may leave more.",
    "A part that is held out goes on with the same walk over the same ground.",
]


def sentence(assessment: WrongModelAssessment) -> str:
    """What was found, in two sentences."""
    count = assessment.replicates
    motions = f"{count} motion{'s' * (count != 1)} of another system"
    kept, true = assessment.kept_no_worse, assessment.verdicts
    shares = (
        f"The kept system is no worse than the animation in {kept.hits} of {kept.total} cases, and "
        f"{true.hits} of {true.total} verdicts are true."
    )
    if assessment.inside:
        return f"True under a wrong model: on {motions} everything is inside its bounds. {shares}"
    outside = " and ".join(assessment.outside)
    return f"Not true under a wrong model: on {motions}, outside their bounds: {outside}. {shares}"


def explanation(truth: str) -> str:
    """What was done, and what the words mean."""
    unseen = ", ".join(f"{NAMES[kind]} {size(kind, value)}" for kind, value in UNSEEN.items())
    return (
        f"Systems were drawn around `{truth}`, and their motion was captured with errors: a drift "
        "of the floor, constant offsets of joints, jumps of markers, swings as no system makes "
        "them, and noise. Each was fitted as `jaxik fit` does; distances are those on frames that "
        "were held out. A motion is worse if it is further off by more than "
        f"{1000 * WORSE:.0f} mm, the root mean square over ankles, knees and pelvis. A verdict is "
        "true unless the motion without errors contradicts it by more than nobody sees "
        f'({unseen}): one that says "fits" if this motion is further off than what looks the same '
        f'({describe_distances(CLOSE)}) or the fit has made it worse, "worse" if the distance that '
        'it names is not larger than the other. "Does not fit" is said of the capture, whose drift '
        "and offsets no system has: it is false if the capture without noise and jumps is nearer "
        "everywhere. "
        f"Bounds are those of the probability behind a share, at {percent(LEVEL, 0)}."
    )


def checks_table(assessment: WrongModelAssessment) -> Table:
    """A row for each claim, checked ones first."""
    rows = [["", "found", "share", "bounds", "wanted", "inside"]]
    wanted = f"{percent(TRUE_VERDICTS, 0)} or more"
    rows.append(
        share_row("the kept system no worse than the animation", assessment.kept_no_worse, "all")
    )
    rows.append(share_row("true verdicts", assessment.verdicts, wanted))
    others = {
        f'true where the verdict is "{said}"': of for said, of in assessment.verdicts_of.items()
    }
    others |= {
        "the kept system no worse, by the motion without errors": (
            assessment.kept_no_worse_noise_free
        ),
        "the kept system no worse in any kind of joint": assessment.kept_no_worse_anywhere,
        "the fitted system no worse, kept or not": assessment.fitted_no_worse,
    }
    return rows + [[*share_row(words, of, "")[:-1], ""] for words, of in others.items()]


def distances_table(assessment: WrongModelAssessment) -> Table:
    """A row for each motion: medians of its distances."""
    rows = [["median off the motion without errors", *(NAMES[kind] for kind in CLOSE)]]
    for motion, kinds in assessment.medians.items():
        rows.append([MOTIONS[motion], *(size(kind, kinds[kind]) for kind in CLOSE)])
    return rows


def coverage_table(assessment: WrongModelAssessment) -> Table:
    """A row for each parameter that both systems have."""
    rows = [["parameter", "found", "share", "bounds"]]
    for name, of in assessment.coverage_of.items():
        rows.append(share_row(name, of, "")[:4])
    return rows


def remarks(assessment: WrongModelAssessment, fits: Sequence[WrongModelFit]) -> list[str]:
    """What the tables do not say, a sentence each; nothing if there is nothing to say."""
    sentences = {
        "The kept system is worse than the animation in replicates": assessment.worse,
        "The verdict is not true in replicates": assessment.false,
        "Fits that did not converge": assessment.unconverged,
    }
    lines = listed_replicates(sentences)
    for number in assessment.false:
        fitted = fits[number - 1]
        off = "; ".join(
            f"{describe_distances(motions['fitted'])} in {PART_NAMES[part]}"
            for part, motions in distances_of(fitted["noise_free"]).parts.items()
        )
        said = fitted["captured"]["sentence"]
        lines.append(f'Replicate {number} says: "{said}" Without errors: {off}.')
    return lines


def document(
    experiment: Experiment,
    truth: str,
    fits: Sequence[WrongModelFit],
    assessment: WrongModelAssessment,
) -> Document:
    """What a calibration under a wrong model says."""
    checks = [
        Text(explanation(truth)),
        Grid(checks_table(assessment), "All checks"),
        Points(remarks(assessment, fits), brief=True),
    ]
    sections = [
        Section("Checks", checks),
        Section("Distances", [Grid(distances_table(assessment), "Distances by motion")]),
    ]
    if assessment.coverage_of:
        covered = Grid(coverage_table(assessment), "Intervals of shared parameters")
        sections.append(Section("Parameters of both systems", [Text(COVERED), covered]))
    return Document(
        file=SUMMARY,
        kind="Fits of motion that another system makes",
        title=experiment.name,
        verdict="True" if assessment.inside else "Not true",
        good=assessment.inside,
        findings=_findings(assessment),
        sections=[*sections, Section("Limits of the data", [Points(LIMITS)])],
        asked=[
            *pages.rows(experiment),
            ["Made by", truth],
            ["Simulated motions", f"{assessment.replicates}"],
        ],
        numbers={NUMBERS: {"experiment": experiment.name, "truth": truth, **summarise(assessment)}},
    )


def _findings(assessment: WrongModelAssessment) -> list[Finding]:
    """What was found, and whether there are too few motions for it."""
    found = Finding(sentence(assessment), bad=not assessment.inside)
    true = assessment.verdicts
    if true.high - true.low <= WIDE:
        return [found]
    bounds = f"{percent(true.low, 0)} to {percent(true.high, 0)}"
    few = f"So few motions prove little: the share of true verdicts may be {bounds}."
    return [found, Finding(few, bad=True)]
