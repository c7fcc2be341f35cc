"""Goodness of fit as `fit.json` holds it."""

from collections.abc import Sequence
from typing import NotRequired, TypedDict

from fitting.analysis.goodness.distances import Distances
from fitting.analysis.goodness.groups import Group
from fitting.analysis.goodness.verdict import Verdict, describe_setback


class GroupSummary(TypedDict):
    """The residuals of one kind in one clip, as `fit.json` holds them; None where not measured."""

    clip: int
    """From 1."""
    kind: str
    count: int
    """Active residuals."""
    degrees: float
    """Of freedom of the reduced chi-square, after correlation and fitted parameters."""
    chi_square: float
    """Reduced."""
    p: float | None
    sigma: float
    """That was given."""
    noise: float
    """The sigma that the residuals imply."""
    correlation: float
    """From frame to frame, that was given."""
    correlation_found: float
    correlation_left: float
    correlation_left_p: float | None
    """Of the Ljung-Box test."""
    independent_every: float
    """s, that would be right beside the given correlation."""
    swing_ratio: float | None
    """Size in swing over size in stance."""
    swing_p: float | None
    beyond_3: float
    """Fraction beyond 3 standard deviations, these taken from the median."""
    beyond_5: float


class GoodnessSummary(TypedDict):
    """Goodness of fit, as `fit.json` holds it."""

    fits: bool
    sentence: str
    groups: list[GroupSummary]


class DistancesSummary(TypedDict):
    """How far motions are from the captured one, as `fit.json` holds it."""

    fitted: NotRequired[dict[str, dict[str, float]]]
    """On fitted frames: m and rad, by motion (animation, before, fitted) and kind of joint."""
    held_out: NotRequired[dict[str, dict[str, float]]]
    """The same on frames that were held out."""
    setbacks: list[str]
    """Where the fit has made it visibly worse, in words."""
    kept: str
    """Whose parameters are in `parameters.toml`: fitted, or before."""


def summarise_distances(distances: Distances) -> DistancesSummary:
    """The distances, and what follows from them."""
    parts = {
        part: {motion: dict(kinds) for motion, kinds in motions.items()}
        for part, motions in distances.parts.items()
    }
    setbacks = [describe_setback(setback) for setback in distances.setbacks]
    return {**parts, "setbacks": setbacks, "kept": distances.better}  # type: ignore[typeddict-item]


def summarise(verdict: Verdict, groups: Sequence[Group]) -> GoodnessSummary:
    """The verdict, and the numbers of all groups."""
    return {
        "fits": verdict.fits,
        "sentence": verdict.sentence,
        "groups": [_summarise_group(group) for group in groups],
    }


def _summarise_group(group: Group) -> GroupSummary:
    measured = group.is_measured
    return {
        "clip": group.clip + 1,
        "kind": group.kind,
        "count": group.left.count,
        "degrees": group.left.degrees,
        "chi_square": group.left.mean_square,
        "p": group.left.p if measured else None,
        "sigma": group.sigma,
        "noise": group.sigma * group.plain.scale,
        "correlation": group.correlation,
        "correlation_found": group.plain.autocorrelation,
        "correlation_left": group.left.autocorrelation,
        "correlation_left_p": group.left.autocorrelation_p if measured else None,
        "independent_every": group.left.spacing * group.dt,
        "swing_ratio": group.swing_ratio,
        "swing_p": group.swing_p if measured else None,
        "beyond_3": group.near,
        "beyond_5": group.far,
    }
