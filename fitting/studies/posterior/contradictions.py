"""Where a chain contradicts the fit around which it was sampled."""

from collections.abc import Sequence
from typing import Literal, TypedDict

from fitting.inference.sampling.posterior import Posterior
from fitting.studies.fit import FittedParameter

# Widths of the posterior's interval, in units of the fit's, that are clearly another answer. The
# interval of a threshold's profile is meant to be wide (Hansen 2000).
NARROW = {"smooth": 0.5, "threshold": 0.25}
WIDE = 2.0

Reason = Literal["leaves out the fit", "narrower", "wider"]


class Disagreement(TypedDict):
    """A parameter of which fit and chain give clearly different intervals."""

    name: str
    reason: Reason
    value: float
    """Of the fit, in the parameter's unit."""
    interval_of_fit: list[float]
    """95 %."""
    interval: list[float]
    """95 %, of the posterior."""


def disagreements(
    parameters: Sequence[FittedParameter], posterior: Posterior
) -> list[Disagreement]:
    """Parameters whose posterior leaves out the fit, or is clearly narrower or wider than it says.

    A chain that has not converged contradicts nothing.
    """
    if not posterior.converged:
        return []
    found = []
    for fitted, sampled in zip(parameters, posterior.summary, strict=True):
        low, high = sampled["low95"], sampled["high95"]
        reason = _reason(fitted, low, high)
        if reason is not None:
            found.append(
                Disagreement(
                    name=fitted["name"],
                    reason=reason,
                    value=fitted["value"],
                    interval_of_fit=fitted["interval"],
                    interval=[low, high],
                )
            )
    return found


def _reason(fitted: FittedParameter, low: float, high: float) -> Reason | None:
    """Why an interval of the posterior contradicts the fit; None if it does not."""
    if not low <= fitted["value"] <= high:
        return "leaves out the fit"
    width = fitted["interval"][1] - fitted["interval"][0]
    if high - low < NARROW[fitted["kind"]] * width:
        return "narrower"
    return "wider" if high - low > WIDE * width else None
