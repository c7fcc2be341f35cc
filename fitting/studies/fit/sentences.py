"""What a fit found, in three sentences that need no other page."""

import math
from collections.abc import Mapping, Sequence

from fitting.motion.accuracy import Accuracy
from fitting.report.formatting import percent

from . import fit_motions
from .fit import Fit
from .fit_motions import ClipMotions

NAMED = 3  # parameters that are not determined, of which all are named if there are no more


def findings(fitted: Fit, motions: Sequence[ClipMotions]) -> list[str]:
    """How close the motion is, what is determined, and how the feet stand: a sentence each.

    What the fit has made worse comes first. Without the motions, the rest is what is determined.
    """
    worse = [fitted.verdict.sentence] if is_worse(fitted) else []
    if not motions:
        return [*worse, _determined(fitted)]
    closeness = _closeness(fitted, fit_motions.summarised(motions))
    return [*worse, closeness, _determined(fitted), _feet(motions)]


def is_worse(fitted: Fit) -> bool:
    """Whether the fit is visibly further from a capture than what there was before it."""
    return fitted.has_noise and bool(fitted.distances.setbacks)


def verdict_word(fitted: Fit) -> str:
    """The verdict in two or three words."""
    if is_worse(fitted):
        return "Worse"
    if not fitted.summary["converged"]:
        return "Not converged"
    if fitted.has_noise:
        return "Fits" if fitted.verdict.fits else "Does not fit"
    return "The same motion" if fitted.verdict.fits else "Not the same motion"


def _closeness(fitted: Fit, accuracies: Mapping[str, Accuracy]) -> str:
    before, after = (_centimetres(accuracies[name].ankle) for name in ("before", "fitted"))
    whose = "the captured ones" if fitted.has_noise else "those of the source"
    figures = f"its ankles are {after} from {whose} (root mean square), {before} before the fit"
    if not fitted.summary["converged"]:
        return f"The search did not settle on one solution; in the best that it met, {figures}."
    motion = "captured motion" if fitted.has_noise else "source's motion"
    if fitted.verdict.fits:
        degree = "as closely as its noise allows" if fitted.has_noise else "within the tolerances"
        return f"The fitted system reproduces the {motion} {degree}: {figures}."
    return f"The fitted system does not reproduce the whole {motion}: {figures}."


def _determined(fitted: Fit) -> str:
    rows = fitted.summary["parameters"]
    if not rows:
        return "No parameter was fitted: this is the system as it comes."
    names = [row["name"] for row in rows if not row["determined"]]
    count = len(rows) - len(names)
    if not names:
        every = "the parameter" if len(rows) == 1 else f"all {len(rows)} parameters"
        return f"The clips determine {every}."
    left = f"{listed(names)} {'stays' if len(names) == 1 else 'stay'} open"
    return f"The clips determine {count} of {len(rows)} parameters; {left}."


def _feet(motions: Sequence[ClipMotions]) -> str:
    before, after, captured = (
        [getattr(clip, name).measures for clip in motions]
        for name in ("before", "fitted", "captured")
    )
    shares = [
        max((m.penetration_stance for m in each), key=_known) for each in (before, after, captured)
    ]
    if math.isnan(shares[1]):
        return "No standing foot has ground under it, so nothing can be said of feet in the ground."
    visible = f"{100 * motions[0].fitted.measures.visible:.2g} cm"
    where = " of the worst clip" if len(motions) > 1 else ""
    text = (
        f"Standing feet are {visible} or more in the ground in {percent(shares[1])} of their "
        f"frames{where}, {percent(shares[0])} before the fit"
    )
    if not math.isnan(shares[2]):
        text += f" and {percent(shares[2])} as captured"
    return f"{text}."


def _known(share: float) -> float:
    return -1.0 if math.isnan(share) else share


def listed(names: Sequence[str]) -> str:
    """Names in a sentence; of many only the first."""
    if len(names) > NAMED:
        return f"{', '.join(names[: NAMED - 1])} and {len(names) - NAMED + 1} others"
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _centimetres(length: float) -> str:
    return "an unknown distance" if math.isnan(length) else f"{100 * length:.1f} cm"
