"""Goodness of fit: its text for the terminal, and its section of the run's summary.md."""

from fitting.analysis.goodness import groups
from fitting.report.formatting import Table, aligned, joined, markdown, percent
from fitting.studies.fit import Fit

from . import goodness_tables, noise_report

NOISE = (
    "Noise and found correlation are those of the errors themselves; left is the correlation from "
    "one frame to the next once the given one is taken out. Swing over stance compares the sizes "
    "of the residuals in the two phases (of the body: while a foot swings, and while none does). "
    f"Normal noise has {percent(groups.EXPECTED[groups.NEAR], 2)} of its residuals beyond 3 "
    f"standard deviations and {percent(groups.EXPECTED[groups.FAR], 5)} beyond 5; these are taken "
    "from the median here."
)

TOLERANCES = (
    "The reference has no noise, so the sigmas are tolerances, and the table says how much of the "
    "motion is not reproduced."
)


def text(fitted: Fit) -> str:
    """The verdict and the sizes of the residuals, for the terminal."""
    distances = aligned(goodness_tables.distance_table(fitted.distances))
    return joined([fitted.verdict.sentence, distances, aligned(_size_table(fitted))], apart=True)


def section(fitted: Fit) -> list[str]:
    """Paragraphs of Markdown."""
    parts = ["## Goodness of fit", f"**{fitted.verdict.sentence}**"]
    parts.append(markdown(goodness_tables.distance_table(fitted.distances)))
    if not fitted.has_noise:
        return [*parts, TOLERANCES, markdown(goodness_tables.tolerance_table(fitted.groups))]
    parts += [_describe_sizes(fitted), markdown(_size_table(fitted))]
    parts += noise_report.section(fitted)
    return [*parts, NOISE, markdown(goodness_tables.noise_table(fitted.groups))]


def _size_table(fitted: Fit) -> Table:
    judged = not (fitted.assumed.sigmas_estimated or fitted.assumed.counted)
    return goodness_tables.size_table(fitted.groups, judged=judged)


def _describe_sizes(fitted: Fit) -> str:
    """What the table of sizes says, and how it was made."""
    squares = "mean of the squared residuals"
    if (loss := fitted.assumed.loss) != "squares":
        squares = f"square of the residuals' median size, before the loss `{loss}`,"
    every = fitted.experiment.independent_every
    taken = f" One in {every:g} s counts as independent in the fit." if every else ""
    if fitted.assumed.counted:
        return (
            f"Sigmas say what a difference weighs. Reduced chi-square is the {squares} in units of "
            "what noise of this size would have; intervals do not rest on it, but on size and "
            f"correlation of the residuals.{taken}"
        )
    return (
        f"Reduced chi-square is the {squares} in units of what is expected: 1 if sigmas and system "
        "are right. p is the probability of one at least as far from 1; its degrees of freedom are "
        "the active residuals (observed, of present legs, with a finite sigma), less what their "
        f"correlation and the fitted parameters take.{taken} Contact labels and accelerations "
        "(`smooth`) have no normal noise, so they are not tested."
    )
