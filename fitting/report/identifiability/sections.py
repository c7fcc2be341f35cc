"""Paragraphs and tables on how well the clips determine the parameters of a fit."""

from collections.abc import Mapping, Sequence

import numpy as np

from fitting.analysis.evidence import Evidence, find_evidence
from fitting.analysis.limit_activity import ClipActivity
from fitting.analysis.missing_motion import describe_missing_motion
from fitting.report.fit_tables import verdict
from fitting.report.formatting import Table, bullets, interval, markdown, number, percent
from fitting.runtime import activity
from fitting.studies.fit import Fit, FittedParameter
from jaxik.maths import parameter_tree

DETERMINED = (
    "A parameter is held at each value of its range while all others follow; the 95 % interval is "
    "where the cost stays low ([curves](profiles.png)). Determined: both ends of the interval are "
    "set by the clips, in one valley, and it is less than 0.7 times as wide as the prior's. "
    "Contraction is 1 where the clips alone decide and 0 where only the prior is known."
)


def sections(fitted: Fit, clips: Sequence[ClipActivity]) -> list[str]:
    """The whole section as Markdown.

    Args:
        fitted: the fit.
        clips: what each clip demands of the fitted system.
    """
    known, rows = fitted.identifiability, fitted.summary["parameters"]
    names = ", ".join(f"`{name}`" for name in known.undetermined)
    parts = [
        "## What these clips determine",
        f"Not determined: {names}." if names else "All free parameters are determined.",
        DETERMINED,
        markdown(verdict_table(rows)),
    ]
    if known.ridges:
        parameters = {p.name: p for p in fitted.problem.space.parameters}
        parts.append("Determined only together, while each alone is not:")
        parts.append(bullets([ridge.describe(parameters) for ridge in known.ridges]))
    if known.correlated:
        parts.append("Pairs of which these clips mostly determine one combination (correlation):")
        pairs = [f"`{a}` and `{b}`: {value:+.3f}" for a, b, value in known.correlated]
        parts.append(bullets(pairs))
    if known.weakest:
        together = ", ".join(f"`{name}`" for name in known.weakest)
        parts.append(f"The least determined direction moves {together}.")
    if names:
        parts.append("What a clip would have to show to determine the rest:")
        parts.append(markdown(missing_table(fitted, clips)))
    evidence = {}
    title = f"Finding what determines {len(known.profiles)} parameters"
    with activity.announced(title, len(known.profiles)) as finding:
        for name, profile in known.profiles.items():
            evidence[name] = find_evidence(fitted.problem, fitted.playbacks, profile)
            finding.advance()
    if any(evidence.values()):
        parts.append(
            "What determines each parameter: when it leaves its interval, the cost rises, most of "
            "all in this second of the clip and by residuals of this kind."
        )
        parts.append(markdown(evidence_table(evidence, len(clips))))
    return parts


def verdict_table(rows: Sequence[FittedParameter]) -> Table:
    """Free parameters by how well the clips determine them, the worst first."""
    table = [["parameter", "kind", "verdict", "95 % interval", "contraction", "valleys"]]
    for row in sorted(rows, key=lambda row: row["contraction"]):
        valleys = [
            f"{interval(*valley['interval'])}, lowest at {number(valley['value'])}"
            f" ({valley['rise']:+.1f})"
            for valley in row["valleys"]
        ]
        cells = [row["name"], row["kind"], verdict(row), interval(*row["interval"])]
        several = "; ".join(valleys) if len(valleys) > 1 else ""
        table.append([*cells, f"{row['contraction']:.3f}", several])
    return table


def missing_table(fitted: Fit, clips: Sequence[ClipActivity]) -> Table:
    """The parameters that are not determined, and the motion that would determine them."""
    known, table = fitted.identifiability, [["parameter", "a clip with"]]
    docs = parameter_tree.docs(fitted.problem.space.system)
    declared = parameter_tree.declarations(fitted.problem.space.system)
    for parameter in fitted.problem.space.parameters:
        if parameter.name in known.undetermined:
            active = [
                clip.limits[parameter.leaf] for clip in clips if parameter.leaf in clip.limits
            ]
            words = describe_missing_motion(
                parameter,
                declared[parameter.leaf].unit,
                docs[parameter.leaf],
                known.profiles[parameter.name],
                float(np.mean(active)) if active else None,
            )
            table.append([parameter.name, words])
    return table


def evidence_table(evidence: Mapping[str, Sequence[Evidence]], clips: int) -> Table:
    """Where the cost rises when parameters leave their intervals, a row for each side."""
    table = [["parameter", "moved to", "rise of the cost", "most in", "residuals"]]
    if clips > 1:
        table[0].insert(3, "clip")
    for name, sides in evidence.items():
        for side in sides:
            part = f"{side.start:.1f} to {side.start + 1:.1f} s ({percent(side.share, 0)})"
            cells = [name, number(side.value), f"{sum(side.rises):+.1f}", part, side.kind]
            if clips > 1:
                of_clips = ", ".join(f"{rise:+.1f}" for rise in side.rises)
                cells.insert(3, f"{side.clip + 1} ({of_clips})")
            table.append(cells)
    return table
