"""Sentences on where a chain contradicts its fit."""

from collections.abc import Iterator
from pathlib import Path

from fitting.report.formatting import interval, number
from fitting.studies.posterior.contradictions import Disagreement
from fitting.studies.run_folder import LOWER_POINT
from fitting.studies.sample import SampledFit


def contradiction_sentences(sampled: SampledFit, run: Path | None) -> list[str]:
    """What contradicts the fit, a sentence each, with how to go on; none if nothing does.

    Args:
        sampled: the posterior and the fit.
        run: the folder of the run, if there is one.
    """
    return [*_lower_point(sampled, run), *map(_describe, sampled.disagreements)]


def _lower_point(sampled: SampledFit, run: Path | None) -> Iterator[str]:
    if not sampled.has_lower_point:
        return
    gain = sampled.posterior.improvement
    if run is None:
        go_on = "fit again with `[start]` at `Posterior.best_values`"
    else:
        go_on = f"go on from there with `jaxik fit {run / LOWER_POINT} -o {run}-lower`"
    yield (
        f"The chain contradicts its fit: it met a point whose log-probability is {gain:.3g} higher."
        f" The fit is not the best one; {go_on}."
    )


def _describe(found: Disagreement) -> str:
    sampled, fitted = interval(*found["interval"]), interval(*found["interval_of_fit"])
    if found["reason"] == "leaves out the fit":
        return (
            f"The chain contradicts its fit: the 95 % interval of {found['name']}, {sampled}, "
            f"leaves out the fitted value {number(found['value'])}."
        )
    return (
        f"The chain contradicts its fit: the 95 % interval of {found['name']}, {sampled}, is "
        f"clearly {found['reason']} than the fit's, {fitted}."
    )
