"""Sentences and tables on how well the clips determine the parameters of a fit."""

from collections.abc import Mapping, Sequence

import numpy as np

from fitting.motion.evidence import Evidence, describe_missing_motion, find_evidence
from fitting.motion.playback import ClipActivity, Playback
from fitting.motion.worst_window import WorstWindow
from fitting.report.document import Block, Grid, Points, Section, Text
from fitting.report.formatting import RESIDUALS, Table, interval, number, percent
from fitting.runtime import activity
from jaxik.maths import parameter_tree

from .fit import Fit, FittedParameter
from .fit_tables import verdict

DETERMINED = (
    "A parameter is held at each value of its range while all others follow; the 95 % interval is "
    "where the cost stays low ([curves](profiles.png)). Determined: both ends of the interval are "
    "set by the clips, at one local minimum, and it is less than 0.7 times as wide as the prior's. "
    "Contraction is 1 where the clips alone decide and 0 where only the prior is known."
)

DIRECTIONS = (  # of an offset up, forward and left: positive, negative
    ("too high", "too low"),
    ("too far ahead", "too far behind"),
    ("too far to the left", "too far to the right"),
)


def determined_blocks(fitted: Fit, clips: int) -> list[Block]:
    """How well the clips determine the parameters, and by what."""
    known, rows = fitted.identifiability, fitted.summary["parameters"]
    names = ", ".join(f"`{name}`" for name in known.undetermined)
    blocks: list[Block] = [
        Text(f"Not determined: {names}." if names else "All free parameters are determined."),
        Text(DETERMINED),
        Grid(verdict_table(rows), "How well parameters are determined", brief=False),
    ]
    if known.ridges:
        parameters = {p.name: p for p in fitted.problem.space.parameters}
        blocks.append(Text("Determined only together, while each alone is not:"))
        blocks.append(Points([ridge.describe(parameters) for ridge in known.ridges]))
    if known.correlated:
        pairs = [f"`{a}` and `{b}`: {value:+.3f}" for a, b, value in known.correlated]
        blocks += [
            Text("Pairs of which these clips mostly determine one combination (correlation):"),
            Points(pairs),
        ]
    if known.weakest:
        together = ", ".join(f"`{name}`" for name in known.weakest)
        blocks.append(Text(f"The least determined direction moves {together}."))
    evidence = {}
    title = f"Finding what determines {len(known.profiles)} parameters"
    with activity.announced(title, len(known.profiles)) as finding:
        for name, profile in known.profiles.items():
            evidence[name] = find_evidence(fitted.problem, fitted.playbacks, profile)
            finding.advance()
    if any(evidence.values()):
        blocks.append(
            Text(
                "What determines each parameter: when it leaves its interval, the cost rises, most "
                "of all in this second of the clip and by residuals of this kind."
            )
        )
        table = evidence_table(evidence, clips)
        blocks.append(Grid(table, "What determines each parameter", brief=False))
    return blocks


def verdict_table(rows: Sequence[FittedParameter]) -> Table:
    """Free parameters by how well the clips determine them, the worst first."""
    table = [["parameter", "kind", "verdict", "95 % interval", "contraction", "local minima"]]
    for row in sorted(rows, key=lambda row: row["contraction"]):
        minima = [
            f"{interval(*minimum['interval'])}, lowest at {number(minimum['value'])}"
            f" ({minimum['rise']:+.1f})"
            for minimum in row["valleys"]
        ]
        cells = [row["name"], row["kind"], verdict(row), interval(*row["interval"])]
        several = "; ".join(minima) if len(minima) > 1 else ""
        table.append([*cells, f"{row['contraction']:.3f}", several])
    return table


def prior_section(rows: Sequence[FittedParameter]) -> Section:
    """What a prior is, and the table of them."""
    explanation = (
        "What was known of the parameters before these clips, beside what the fit leaves of it. A "
        "normal prior is one of `u`, the parameter's range stretched to a coordinate without "
        "bounds; the spread is its standard deviation there. Unless the experiment says otherwise, "
        "it is centred at the system's value, or, where that is in the outer sixth of the range, a "
        "sixth inside. A uniform prior is the range itself."
    )
    grid = Grid(prior_table(rows), "Priors", brief=False)
    return Section("Priors", [Text(explanation), grid], on_page=False)


def prior_table(rows: Sequence[FittedParameter]) -> Table:
    """Free parameters: shape, centre and spread of the prior, its interval and the fit's."""
    table = [["parameter", "unit", "prior", "centre", "spread of u"]]
    table[0] += ["95 % of the prior", "95 % interval of the fit"]
    for row in rows:
        prior = row["prior"]
        cells = [row["name"], row["unit"], prior["shape"], _centre(row)]
        cells.append("" if prior["spread"] is None else number(prior["spread"]))
        table.append([*cells, interval(*prior["interval"]), interval(*row["interval"])])
    return table


def _centre(row: FittedParameter) -> str:
    """The centre of a prior, and the system's value where it is another one."""
    centre = row["prior"]["centre"]
    if centre is None:
        return ""
    other = number(row["before"]) != number(centre)
    return number(centre) + (f" (system: {number(row['before'])})" if other else "")


def missing_motion(fitted: Fit, clips: Sequence[ClipActivity]) -> list[list[str]]:
    """The parameters that are not determined, each with the motion that would determine it."""
    known, missing = fitted.identifiability, []
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
            missing.append([f"`{parameter.name}`", words])
    return missing


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


def describe(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> list[str]:
    """What went wrong in the worst window, a sentence or two in each line."""
    start, end = playback.time[window.start], playback.time[window.end]
    fractions = [f"{_name(kind)} {percent(part, 0)}" for kind, part in window.fractions.items()]
    others = "; " + ", ".join(fractions[1:]) if fractions[1:] else ""
    lines = [
        f"From {start:.2f} s to {end:.2f} s the residuals are {window.rms:.2f} sigmas (rms), "
        f"{window.clip_rms:.2f} over the whole clip.",
        f"{_name(window.kind).capitalize()} makes up {percent(window.fractions[window.kind], 0)} "
        f"of their squares{others}.",
        f"{_largest_error(playback, window, legs)} {_stance(playback, window, legs)}",
    ]
    if window.leg_fractions.sum() > 0:
        worst = int(np.argmax(window.leg_fractions))
        part = percent(window.leg_fractions[worst], 0)
        lines.append(f"The {legs[worst]} leg makes up {part} of the squares of the legs.")
    lines.append(_reach(playback, window))
    if np.isfinite(window.pelvis):
        direction = "high" if window.pelvis > 0 else "low"
        lines.append(f"The pelvis is {100 * abs(window.pelvis):.1f} cm too {direction} on average.")
    lines.append(_soles(playback, window, legs))
    return lines


def _name(kind: str) -> str:
    return RESIDUALS[kind].name.lower()


def _largest_error(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> str:
    """When and by how much the largest kind is worst."""
    _, unit, factor = RESIDUALS[window.kind]
    of_leg = "" if window.leg is None else f"of the {legs[window.leg]} leg "
    text = (
        f"The {_name(window.kind)} {of_leg}is worst at {playback.time[window.frame]:.2f} s: "
        f"{factor * window.size:.1f} {unit} off"
    )
    if window.offset is not None:
        axis = int(np.argmax(np.abs(window.offset)))
        text += f", mostly {DIRECTIONS[axis][int(window.offset[axis] < 0)]}"
        text += f" ({100 * abs(window.offset[axis]):.1f} cm)"
    return text + "."


def _stance(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> str:
    """Which feet stand then, by the captured labels or else by the system's contact weights."""
    labelled = bool(np.any(playback.stance))
    weights = np.asarray(playback.stance if labelled else playback.contact)[window.frame]
    source = "the captured contact labels" if labelled else "the system's contact weights"
    if window.leg is not None:
        state = "stands" if weights[window.leg] > 0.5 else "swings"
        return f"The foot {state} at that time, according to {source}."
    standing = [name for name, weight in zip(legs, weights, strict=True) if weight > 0.5]
    feet = ", ".join(standing) or "none"
    return f"Feet that stand at that time, according to {source}: {feet}."


def _reach(playback: Playback, window: WorstWindow) -> str:
    """Whether the targets could be reached."""
    part = f"{percent(window.out_of_reach, 0)} of these frames and feet"
    if window.leg is None:
        return f"The ankle's target is out of reach in {part}."
    missed = np.asarray(playback.reached)[window.frame, window.leg] < 0.5
    state = "out of reach" if missed else "within reach"
    return f"The target of its ankle is {state} then; targets are out of reach in {part}."


def _soles(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> str:
    """How well the ground and the captured soles agree."""
    gap = window.sole_gap
    if gap is None:
        return "No captured foot stands above known ground, so the terrain is not checked."
    return (
        f"Captured soles that stand are {_above(gap.mean)} the ground on average "
        f"({100 * gap.rms:.1f} cm rms; the {legs[gap.leg]} one {_above(gap.largest)} it at "
        f"{playback.time[gap.frame]:.2f} s). This is an error of the terrain or of the "
        "calibration, which no parameter can remove."
    )


def _above(gap: float) -> str:
    return f"{100 * abs(gap):.1f} cm {'above' if gap > 0 else 'in'}"
