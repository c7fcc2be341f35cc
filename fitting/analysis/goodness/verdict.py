"""Whether a fit fits, in one sentence that rests on size and significance.

With ten thousand residuals everything is significant, so a finding must be large as well. The
sizes are those from which intervals are wrong by a quarter. `tests/analysis/test_goodness.py` holds
them against simulated noise: no false alarm in 95 % of fits whose noise is as assumed, and every
violation found.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from . import groups as kinds
from . import noise
from .distances import CLOSE, Distances, Part, Setback
from .groups import Assumed, Group

SIGNIFICANT = 1e-3  # p-value, over all groups, above which nothing is a finding
TOO_LARGE = 1.25  # noise over the sigma that was given; likewise its inverse
STRUCTURED = 0.2  # autocorrelation from which residuals larger than their sigma are a misfit
LOCAL = 1.5  # size of the worst seconds over that of the clip, from which they are a misfit
CROWDED = 1.75  # frames for each residual that counts as independent: 32 % too narrow
SPARSE = 0.5  # likewise: 41 % too wide
ABOUT_RIGHT = 0.1  # by which intervals may be too narrow or too wide and still be about right
SMALL = 1e-4  # a p-value below it is called so
ALMOST_NONE = 1e-6  # noise over its sigma, below which it is none
ALIKE = 1.25  # ratio of noises up to which one number stands for all kinds

NAMES = {
    "ankle": "ankles",
    "knee": "knees",
    "pelvis": "pelvis",
    "foot": "orientation of the feet",
    "body": "orientation of the pelvis",
}
PARTS: Mapping[Part, str] = {"fitted": "fitted frames", "held_out": "held-out frames"}


@dataclass(frozen=True)
class Verdict:
    """Whether a fit fits."""

    fits: bool
    sentence: str


def judge(groups: Sequence[Group], assumed: Assumed, distances: Distances) -> Verdict:
    """Whether a fit is close to the capture, and no further off than its sigmas allow.

    Too small a sigma is told from a misfit by the autocorrelation: what a system cannot follow
    lasts for many frames.
    """
    measured = [group for group in groups if group.is_measured and group.left.count]
    if not measured or not distances.parts:
        return Verdict(True, "Nothing was observed that could fit or not.")
    if setbacks := distances.setbacks:
        sentence = f"Worse: {describe_setback(setbacks[0])}"
        if len(setbacks) > 1:
            sentence += f", and in {len(setbacks) - 1} more of the distances below"
        kept = "of the fit" if distances.better == "fitted" else "from before the fit"
        sentence += f". The parameters {kept} are the better ones"
        if distances.best == "animation":
            sentence += ", but without foot IK the whole motion is nearer"
        return Verdict(False, f"{sentence}.")
    if far := distances.far:
        off = "; ".join(
            f"{NAMES[kind]} {size(kind, distance)} off the capture in {PARTS[part]}, and "
            f"{size(kind, CLOSE[kind])} would be seen"
            for part, kind, distance in far
        )
        return Verdict(False, f"Does not fit: {off}.")
    level = SIGNIFICANT / len(measured)
    if misfits := [group for group in measured if _is_misfit(group, level)]:
        return Verdict(False, f"Does not fit: {_describe_misfits(misfits)}.")
    findings = _noise_findings(measured, assumed, level)
    first, *others = [
        f"{describe_distances(motions['fitted'])} off the capture in {PARTS[part]}"
        for part, motions in distances.parts.items()
    ]
    off = "; ".join([first, *others])
    if findings:
        return Verdict(True, f"Fits, but {findings}; {off}.")
    if assumed.sigmas_estimated:
        return Verdict(True, f"Fits: {off}; the size of the noise is estimated from it.")
    chi_square = noise.pooled([group.left for group in measured]).mean_square
    return Verdict(True, f"Fits: {off}; reduced chi-square {chi_square:.3g}.")


def describe_setback(setback: Setback) -> str:
    """Where the fit has made something worse, in words."""
    other = {"animation": "without foot IK", "before": "before the fit"}[setback.other]
    fitted, better = size(setback.kind, setback.fitted), size(setback.kind, setback.distance)
    part = PARTS[setback.part]
    return f"{NAMES[setback.kind]} {fitted} off the capture in {part}, {better} {other}"


def describe_distances(kinds: Mapping[str, float]) -> str:
    """Distances of all kinds of joints, in words."""
    return ", ".join(f"{NAMES[kind]} {size(kind, distance)}" for kind, distance in kinds.items())


def size(kind: str, distance: float) -> str:
    """A distance with its unit, cm or degrees."""
    if kind in ("foot", "body"):
        return f"{math.degrees(distance):.1f}°"
    return f"{100 * distance:.{1 if distance >= 0.01 else 2}f} cm"


def judge_tolerances(groups: Sequence[Group]) -> Verdict:
    """Whether a motion is reproduced within its sigmas, where the reference has no noise."""
    measured = [group for group in groups if group.is_measured and group.left.count]
    beyond = [group for group in measured if group.plain.scale > 1 or _worst_scale(group) > LOCAL]
    if beyond:
        return Verdict(False, f"Not the same motion: {_describe_misfits(beyond, 'tolerance')}.")
    return Verdict(True, "The same motion, within the tolerances.")


def _is_misfit(group: Group, level: float) -> bool:
    structured = group.left.autocorrelation > STRUCTURED and group.left.autocorrelation_p < level
    large = group.plain.scale > TOO_LARGE and group.plain.p < level
    return (structured and large) or _is_local_misfit(group, level)


def _is_local_misfit(group: Group, level: float) -> bool:
    expected = max(1.0, group.plain.scale)
    return (
        group.worst is not None and group.worst.scale > LOCAL * expected and group.worst.p < level
    )


def _worst_scale(group: Group) -> float:
    return group.worst.scale if group.worst is not None else 0.0


def _describe_misfits(misfits: Sequence[Group], limit: str = "sigma") -> str:
    """The worst group with its worst seconds, then the other kinds."""
    several = len({group.clip for group in misfits}) > 1 or misfits[0].clip > 0
    by_size = sorted(misfits, key=lambda group: -_worst_scale(group))
    worst, others = by_size[0], []
    for group in by_size[1:]:
        if group.kind not in (worst.kind, *(other.kind for other in others)):
            others.append(group)
    stretch = worst.worst
    assert stretch is not None  # of a measured group
    clip = f" in clip {worst.clip + 1}" if several else ""
    seconds = f"from {stretch.start:.1f} s to {stretch.end:.1f} s"
    if worst.plain.scale > TOO_LARGE:
        text = f"{NAMES[worst.kind]} {_times(worst.plain.scale)} worse than their {limit}{clip}"
        text += f", most of all {seconds} ({_times(stretch.scale)})"
    else:
        text = f"{NAMES[worst.kind]} {_times(stretch.scale)} worse than their {limit}{clip}"
        text += f" {seconds}"
    rest = [f"{NAMES[group.kind]} {_times(_worst_scale(group))}" for group in others]
    return f"{text}; at their worst also {', '.join(rest)}" if rest else text


def _noise_findings(measured: Sequence[Group], assumed: Assumed, level: float) -> str:
    """What is wrong with the assumed noise, and what that does to intervals; "" if nothing is."""
    left = noise.pooled([group.left for group in measured])
    frames = left.spacing * assumed.weight
    significant = any(group.left.autocorrelation_p < level for group in measured)
    correlated = significant and not SPARSE < frames < CROWDED
    width = left.mean_square * frames
    correlated = correlated and not assumed.counted
    findings, remedies = [], []
    if not (assumed.sigmas_estimated or assumed.counted) and (
        off := _wrong_sigmas(measured, level, correlated=correlated)
    ):
        findings.append(off)
        remedies.append("set the sigmas below")
    if correlated:
        given = measured[0].correlation
        plain = noise.pooled([group.plain for group in measured])
        found = plain.autocorrelation
        # Relative to the frames for each independent error at the correlation that was given.
        width = plain.mean_square * plain.spacing * assumed.weight
        width *= (1 - given) / (1 + given)
        than = f", not by {given:.2f}" if given else ""
        size = f"{found:.2f} from one frame to the next{than}"
        if assumed.whitened:
            findings.append("the residuals are correlated even where the estimate is taken out")
            remedies.append('set `correlation = "counted"` in [noise]')
        else:
            findings.append(f"the residuals are correlated ({size})")
            remedies.append(f"set `correlation = {found:.2f}`")
    text = ""
    if findings:
        text = f"{' and '.join(findings)}: the intervals are {_width(width**0.5)}; "
        text += " and ".join(remedies)
    outliers = [group for group in measured if group.has_outliers]
    if outliers and assumed.loss == "squares":
        names = ", ".join(dict.fromkeys(NAMES[group.kind] for group in outliers))
        count = sum(group.left.count for group in outliers)
        part = sum(group.left.count * group.near for group in outliers) / count
        text += "; " if text else ""
        text += f"{100 * part:.1f} % of the residuals ({names}) are outliers, beyond "
        text += f"{kinds.NEAR:g} standard deviations, where noise has "
        loss = "student" if assumed.sigmas_estimated else "cauchy"  # which has no sigma to estimate
        text += f'{100 * kinds.EXPECTED[kinds.NEAR]:.1f} %: set `loss = "{loss}"`'
    return text


def _wrong_sigmas(measured: Sequence[Group], level: float, *, correlated: bool) -> str:
    """The noise over the sigmas, where these are wrong; "" if none are.

    With a wrong correlation the size of the residuals is not that of the errors.
    """
    ratios, wrong = {}, False
    for kind in dict.fromkeys(group.kind for group in measured):
        of_kind = [group for group in measured if group.kind == kind]
        outliers = any(group.has_outliers for group in of_kind)
        size = noise.pooled([g.plain if correlated or outliers else g.left for g in of_kind])
        ratios[kind] = size.scale
        wrong |= not 1 / TOO_LARGE < size.scale < TOO_LARGE and size.p < level
    if not wrong:
        return ""
    low, high = min(ratios.values()), max(ratios.values())
    if high < ALIKE * low:
        return f"the noise is about {(low * high) ** 0.5:.2g} of the sigmas that were given"
    each = ", ".join(f"{NAMES[kind]} {ratio:.2g}" for kind, ratio in ratios.items())
    return f"the noise is not that of the sigmas that were given, but times these: {each}"


def _width(factor: float) -> str:
    """How far intervals are from those that would be right."""
    if factor > 1 + ABOUT_RIGHT:
        return f"about {_times(factor)} too narrow"
    if factor < 1 - ABOUT_RIGHT:
        return f"about {_times(1 / max(factor, ALMOST_NONE))} too wide"
    return "about right all the same"


def _times(factor: float) -> str:
    return f"{factor:.2g} times"
