"""The page of a calibration: whether what fits and posteriors say is true."""

from pathlib import Path

from fitting.experiments.experiment import Experiment
from fitting.report.calibration import calibration_report
from fitting.report.calibration.calibration_tables import checks_table, parameter_table
from fitting.report.formatting import percent
from fitting.report.page import asked, pictures
from fitting.report.page.sentences import listed
from fitting.report.page.study_page import Finding, Grid, Points, Section, StudyPage, Text
from fitting.studies.calibration.assessment import NEAR, Assessment

WIDE = 0.2  # of bounds, from which being inside them proves little
FILES = {
    calibration_report.SUMMARY: "the tables",
    calibration_report.NUMBERS: "all numbers",
    calibration_report.RECOVERY: "fitted against true values",
}


def write(folder: Path, experiment: Experiment, assessment: Assessment) -> None:
    """Writes the page into the folder of a calibration, whose pictures are there."""
    captions = {calibration_report.RECOVERY: f"{experiment.name}: fitted against true values"}
    if assessment.ranks:
        captions[calibration_report.RANKS] = f"{experiment.name}: ranks of the truths"
    recovery, *ranks = pictures.embed(folder, captions)
    sections = [
        Section(
            "Checks",
            [
                Text(calibration_report.explanation(assessment)),
                Grid(checks_table(assessment), "All checks"),
            ],
        ),
        Section(
            "Parameters",
            [
                Grid(parameter_table(assessment), "What was found for each parameter"),
                Text(calibration_report.CAME_BACK),
                recovery,
            ],
        ),
    ]
    if assessment.ranks:
        sections.append(Section("Ranks", [Text(calibration_report.RANKED), *ranks]))
    StudyPage(
        kind="Fits of simulated motion whose truth is known",
        title=experiment.name,
        verdict="Calibrated" if assessment.inside else "Not calibrated",
        good=assessment.inside,
        findings=findings(assessment),
        sections=[*sections, _limits(assessment)],
        asked=[*asked.rows(experiment), ["Simulated motions", f"{assessment.replicates}"]],
        files=FILES | ({calibration_report.RANKS: "ranks"} if ranks else {}),
    ).write(folder)


def findings(assessment: Assessment) -> list[Finding]:
    """Whether intervals are true, whether fits find the right valley, and what comes back."""
    return [_intervals(assessment), _valleys(assessment), _recovery(assessment)]


def _intervals(assessment: Assessment) -> Finding:
    cover = assessment.fit_coverage
    count = assessment.replicates
    motions = f"{count} simulated motion{'s' * (count != 1)}"
    bounds = f"{percent(cover.low, 0)} to {percent(cover.high, 0)}"
    share = percent(cover.fraction, 0)
    coverage = f"the fit's 95 % intervals contain {share} of the true values ({bounds})"
    if not assessment.inside:
        return Finding(
            f"Of {motions}, outside their bounds: {listed(assessment.outside)}; {coverage}.",
            bad=True,
        )
    if cover.high - cover.low > WIDE:
        return Finding(
            f"Everything is inside its bounds, but {motions} prove little, as these bounds are "
            f"wide: {coverage}.",
            bad=True,
        )
    return Finding(f"On {motions} everything is inside its bounds: {coverage}.")


def _valleys(assessment: Assessment) -> Finding:
    valley = assessment.valley
    text = f"{valley.hits} of {valley.total} fits end where a descent from the truth does"
    wrong, unconverged = len(assessment.wrong_but_converged), len(assessment.unconverged)
    short = len(assessment.short_chains)
    faults = [
        f"{wrong} of the others say that they converged" if wrong else "",
        f"{unconverged} did not converge" if unconverged else "",
        f"{short} of the chains did not converge, or are too short" if short else "",
    ]
    details = "; ".join(filter(None, [text, *faults]))
    return Finding(f"{details}.", bad=any(faults))


def _recovery(assessment: Assessment) -> Finding:
    back = assessment.recovery
    if not back.total:
        return Finding("No fit called a parameter determined.", bad=True)
    text = (
        f"Of the parameters that fits called determined, {percent(back.fraction, 0)} came back "
        f"within {percent(NEAR, 0)} of their range"
    )
    each = {name: of for name, of in assessment.recovery_of.items() if of.total}
    least = min(each, key=lambda name: each[name].fraction)
    if each[least].fraction < back.fraction:
        text += f", fewest of `{least}` ({each[least].hits} of {each[least].total})"
    never = [f"`{name}`" for name in assessment.names if not assessment.recovery_of[name].total]
    if never:
        text += f"; {listed(never)} {'was' if len(never) == 1 else 'were'} never determined"
    return Finding(f"{text}.")


def _limits(assessment: Assessment) -> Section:
    lines = [
        "Motion is simulated by the system itself with the noise that the experiment assumes: that "
        "intervals are true here does not say that the system can move as people do.",
        *calibration_report.remarks(assessment),
    ]
    if not assessment.ranks:
        lines.append("No posterior was sampled (`--chains`), so only fits are judged.")
    return Section("Limits of the data", [Points(lines)])
