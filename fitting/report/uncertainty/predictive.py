"""Posterior predictive checks: a sentence for the terminal, and their section of summary.md."""

from collections.abc import Sequence

from fitting.report.formatting import Table, markdown, percent
from fitting.report.labels import RESIDUALS
from fitting.studies.posterior.predictive import SURPRISING, Band, PredictiveCheck, Statistic
from fitting.studies.posterior.replay import Replay


def sentence(checks: Sequence[PredictiveCheck]) -> str:
    """Whether the capture is like the replicates, and where not."""
    several = len({check.clip for check in checks}) > 1
    unlike = [
        f"{RESIDUALS[check.kind].name.lower()}{f' of clip {check.clip + 1}' if several else ''} "
        f"({', '.join(check.surprises)})"
        for check in checks
        if check.surprises
    ]
    if not unlike:
        return "The captured motion is like the posterior's replicates of it."
    return f"The captured motion is unlike the posterior's replicates: {'; '.join(unlike)}."


def section(replay: Replay) -> list[str]:
    """Paragraphs of Markdown."""
    count = len(replay.checks[0].rms.replicated) if replay.checks else 0
    return [
        "### The capture beside replicates",
        sentence(replay.checks),
        f"{count} draws of the posterior move the clip again, each with noise of its own from the "
        "model in force. Residuals are those from the draw's own motion, in sigmas: of the capture "
        "the median over the draws, of the replicates 95 %. p is how often a replicate's figure is "
        f"the larger one; an exclamation mark stands where it is below {SURPRISING:g} or above "
        f"{1 - SURPRISING:g}. About 5 % of the frames should be outside the band of the replicates "
        "that the picture shows.",
        markdown(check_table(replay.checks, replay.bands)),
    ]


def check_table(checks: Sequence[PredictiveCheck], bands: Sequence[Band]) -> Table:
    """One row for each kind of residual and clip."""
    table = [["clip", "residuals", "rms", "replicates", "p", "autocorrelation", "replicates", "p"]]
    table[0] += ["largest", "replicates", "p", "outside the band"]
    for check, band in zip(checks, bands, strict=True):
        cells = [str(check.clip + 1), RESIDUALS[check.kind].name]
        for statistic in (check.rms, check.autocorrelation, check.largest):
            cells += _cells(statistic)
        table.append([*cells, percent(band.outside)])
    return table


def _cells(statistic: Statistic) -> list[str]:
    low, high = statistic.replicated_interval
    mark = "!" if statistic.is_surprising else ""
    return [f"{statistic.median:.3g}", f"{low:.3g} to {high:.3g}", f"{statistic.p:.3f}{mark}"]
