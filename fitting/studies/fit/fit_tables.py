"""Tables and sentences of a fit: its parameters, its goodness, and what the clips determine."""

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from fitting.experiment.experiment import DEFAULT_SIGMAS
from fitting.inference.identifiability import NORMAL
from fitting.motion import goodness
from fitting.motion.evidence import Evidence, describe_missing_motion, find_evidence
from fitting.motion.playback import ClipActivity, Nudge, Playback
from fitting.motion.worst_window import WorstWindow
from fitting.problem.space import FreeParameter
from fitting.report.document import Block, Grid, Heading, ParameterRow, Points, Section, Text
from fitting.report.formatting import RESIDUALS, Table, interval, number, percent
from fitting.runtime import activity
from jaxik.maths import parameter_tree

from .capture_check import CaptureSigns
from .fit import Fit, FittedParameter

RECOVERED = 0.05  # fraction of its range within which a parameter counts as recovered
Truth: TypeAlias = Mapping[str, float] | None  # known parameter values by name

NOISE = (
    "Noise and found correlation are those of the errors themselves; left is the correlation from "
    "one frame to the next once the given one is taken out. Swing over stance compares the sizes "
    "of the residuals in the two phases (of the body: while a foot swings, and while none does). "
    f"Normal noise has {percent(goodness.EXPECTED[goodness.NEAR], 2)} of its residuals beyond 3 "
    f"standard deviations and {percent(goodness.EXPECTED[goodness.FAR], 5)} beyond 5; these are "
    "taken from the median here."
)

TOLERANCES = (
    "The reference has no noise, so the sigmas are tolerances, and the table says how much of the "
    "motion is not reproduced."
)

COUNTED = (
    "For intervals, each residual counts as {:.3g} independent ones of the size of its sigma, as "
    "their size and correlation say. The best point does not depend on that."
)

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


def parameter_table(rows: Sequence[FittedParameter], truth: Truth) -> Table:
    """Free parameters: value, interval, range, remarks; truth and error where they are known."""
    heading = ["parameter", "value", "unit", "95 % interval", "range"]
    table = [heading + (["truth", "error"] if truth else []) + ["remarks"]]
    for row in rows:
        cells = [row["name"], number(row["value"]), row["unit"]]
        cells += [interval(*row["interval"]), interval(row["low"], row["high"])]
        if truth:
            true = truth.get(row["name"])
            cells.append("unknown" if true is None else number(true))
            cells.append("" if true is None else f"{percent(error(row, true))} of range")
        remarks = [] if row["determined"] else [verdict(row)]
        if row["at_bound"]:
            remarks.append(_at_bound(row))
        table.append([*cells, ", ".join(remarks)])
    return table


def recovered(rows: Sequence[FittedParameter], truth: Mapping[str, float]) -> str:
    """How many of the determined parameters are close to their true values."""
    known = [row for row in rows if row["determined"] and row["name"] in truth]
    close = sum(error(row, truth[row["name"]]) <= RECOVERED for row in known)
    near = f"within {percent(RECOVERED, 0)} of their range"
    return f"{close} of {len(known)} determined parameters {near}"


def error(row: FittedParameter, true: float) -> float:
    """Distance of a fitted value from the true one, as a fraction of the parameter's range."""
    return abs(row["value"] - true) / (row["high"] - row["low"])


def _at_bound(row: FittedParameter) -> str:
    return f"at its {'lower' if row['at_bound'] == 'low' else 'upper'} bound"


def verdict(row: FittedParameter) -> str:
    """What the clips say of a parameter, in words."""
    low, high = row["interval"]
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    match row["verdict"]:
        case "at least":
            return f"at least {number(low)}{unit}"
        case "at most":
            return f"at most {number(high)}{unit}"
        case "several valleys":
            return f"{len(row['valleys'])} local minima"
        case _:
            return "determined" if row["determined"] else "undetermined by these clips"


def activity_table(clips: Sequence[ClipActivity]) -> Table:
    """Ground, contact, reach and locks of each clip, a column for each clip and foot."""
    feet = [(clip, leg) for clip in range(len(clips)) for leg in range(len(clips[clip].legs))]
    several = len(clips) > 1
    names = [f"{clips[i].legs[leg]}{f', clip {i + 1}' if several else ''}" for i, leg in feet]
    table = [["foot", *names]]
    for heading, fractions in (
        ("ground found", [clip.grounded for clip in clips]),
        ("in contact", [clip.in_contact for clip in clips]),
        ("target reached", [clip.reached for clip in clips]),
        ("locked", [clip.locked for clip in clips]),
    ):
        table.append([heading, *(percent(fractions[i][leg]) for i, leg in feet)])
    table.append(["locks", *(str(clips[i].locks[leg]) for i, leg in feet)])
    table.append(["releases", *(str(clips[i].releases[leg]) for i, leg in feet)])
    return table


def flip_table(nudges: Mapping[str, tuple[Nudge, Nudge]]) -> Table:
    """Decisions that flip, and the rise in cost, when a threshold moves by 10 % of its range."""
    table = [["threshold", "flips, moved down", "cost", "flips, moved up", "cost"]]
    for name, both in nudges.items():
        cells = [name]
        for nudge in both:
            cells += [percent(nudge.flipped, 2), f"{nudge.rise:+.1f}"]
        table.append(cells)
    return table


def parameter_row(
    row: FittedParameter, free: FreeParameter, docs: Mapping[str, str], truth: Truth
) -> ParameterRow:
    """A parameter within its range, which is linear unless its scale is `log`; docs by leaf."""
    low, high = row["low"], row["high"]

    def fraction(value: float) -> float:
        value = min(max(value, low), high)
        if free.scale == "log" and low > 0:
            return math.log(value / low) / math.log(high / low)
        return (value - low) / (high - low)

    true = None if truth is None else truth.get(row["name"])
    unit = "" if row["unit"] == "1" else row["unit"]
    words = verdict(row)
    if row["at_bound"]:
        words += f", {_at_bound(row)}"
    return ParameterRow(
        name=row["name"],
        meaning=docs.get(free.leaf, ""),
        value=number(row["value"]),
        unit=unit,
        interval=interval(*row["interval"]),
        range=interval(low, high),
        verdict=words,
        determined=row["determined"],
        at=fraction(row["value"]),
        low=fraction(row["interval"][0]),
        high=fraction(row["interval"][1]),
        before=fraction(row["before"]) if math.isfinite(row["before"]) else None,
        truth=None if true is None else fraction(true),
        description=(
            f"{row['name']}: {number(row['value'])} {unit}, 95 % interval "
            f"{interval(*row['interval'])}, in the range {interval(low, high)}"
            + ("" if true is None else f", true value {number(true)}")
        ),
    )


def limit_table(clips: Sequence[ClipActivity]) -> tuple[Table, list[str]]:
    """In which fraction of frames limits change the pose, by clip; names of those that never do."""
    names = [f"clip {i + 1}" for i in range(len(clips))] if len(clips) > 1 else ["frames"]
    idle = [name for name in clips[0].limits if not any(clip.limits[name] for clip in clips)]
    active = [name for name in clips[0].limits if name not in idle]
    rows = [[name, *(percent(clip.limits[name]) for clip in clips)] for name in active]
    return [["limit", *names], *rows], idle


def goodness_blocks(fitted: Fit) -> list[Block]:
    """The sizes of the residuals, and whether they look like noise."""
    judged = not (fitted.assumed.sigmas_estimated or fitted.assumed.counted)
    sizes = Grid(size_table(fitted.groups, judged=judged), "Sizes of the residuals")
    if not fitted.has_noise:
        tolerances = Grid(tolerance_table(fitted.groups), "Errors and tolerances", brief=False)
        return [sizes, Text(TOLERANCES), tolerances]
    noise = Grid(noise_table(fitted.groups), "Residuals as noise", brief=False)
    return [Text(_describe_sizes(fitted)), sizes, *noise_blocks(fitted), Text(NOISE), noise]


def _describe_sizes(fitted: Fit) -> str:
    """How the table of sizes is made and read."""
    squares = "mean of the squared residuals"
    if (loss := fitted.assumed.loss) != "squares":
        squares = f"square of the residuals' median size, before the loss `{loss}`,"
    every = fitted.experiment.independent_every
    thinning = f" One in {every:g} s counts as independent in the fit." if every else ""
    if fitted.assumed.counted:
        return (
            f"Sigmas say what a difference weighs. Reduced chi-square is the {squares} in units of "
            "what noise of this size would have; intervals do not rest on it, but on size and "
            f"correlation of the residuals.{thinning}"
        )
    return (
        f"Reduced chi-square is the {squares} in units of what is expected: 1 if sigmas and system "
        "are right. p is the probability of one at least as far from 1; its degrees of freedom are "
        "the active residuals (observed, of present legs, with a finite sigma), less what their "
        f"correlation and the fitted parameters take.{thinning} Contact labels and accelerations "
        "(`smooth`) have no normal noise, so they are not tested."
    )


def size_table(groups: Sequence[goodness.Group], *, judged: bool = True) -> Table:
    """The sizes of the residuals, their count and degrees of freedom.

    Args:
        groups: the rows.
        judged: whether to show p, which means nothing where sigmas are not those of the noise.
    """
    heading = ["residuals", "active", "degrees of freedom", "reduced chi-square", "p"]
    table = [[*heading, "sigma", "noise", "noise / sigma"]]
    for group in groups:
        cells = [RESIDUALS[group.kind].name, str(group.left.count), f"{group.left.degrees:.0f}"]
        p = _p(group.left.p, group) if judged else "–"
        cells += [number(group.left.mean_square), p, *_sizes(group)]
        table.append(cells)
    return _with_clips(table, groups)


def distance_table(distances: goodness.Distances) -> Table:
    """How far motions are from the captured one, on fitted frames and on those held out."""
    table = [["distance from the capture, rms", "frames", "flat animation", "before", "fitted"]]
    for part, motions in distances.parts.items():
        for kind in goodness.CLOSE:
            cells = [goodness.size(kind, motions[motion][kind]) for motion in goodness.MOTIONS]
            table.append(
                [goodness.NAMES[kind], goodness.PART_NAMES[part].removesuffix(" frames"), *cells]
            )
    return table


def distances_of_preset(distances: goodness.Distances) -> Table:
    """How far a system before any fit is from the captured motion."""
    table = [["distance from the capture, rms", "flat animation", "preset"]]
    motions = distances.parts.get("fitted", {})
    for kind in goodness.CLOSE if motions else ():
        sizes = [goodness.size(kind, motions[motion][kind]) for motion in ("animation", "before")]
        table.append([goodness.NAMES[kind], *sizes])
    return table


def tolerance_table(groups: Sequence[goodness.Group]) -> Table:
    """The sizes of the errors where there is no noise."""
    table = [["residuals", "active", "tolerance", "error, rms", "error / tolerance"]]
    for group in groups:
        table.append([RESIDUALS[group.kind].name, str(group.plain.count), *_sizes(group)])
    return _with_clips(table, groups)


def noise_table(groups: Sequence[goodness.Group]) -> Table:
    """Whether the residuals look like noise."""
    measured = [group for group in groups if group.is_measured]
    heading = ["residuals", "correlation given", "found", "left", "p", "independent every"]
    table = [[*heading, "swing / stance", "p", "beyond 3", "beyond 5"]]
    for group in measured:
        left, ratio = group.left, group.swing_ratio
        cells = [RESIDUALS[group.kind].name, f"{group.correlation:.2f}"]
        cells += [f"{group.plain.autocorrelation:.3f}", f"{left.autocorrelation:.3f}"]
        cells += [_p(left.autocorrelation_p, group), f"{left.spacing * group.dt:.3g} s"]
        cells += ["–", "–"] if ratio is None else [f"{ratio:.2f}", _p(group.swing_p, group)]
        cells += [percent(group.near, 2), percent(group.far, 2)]
        table.append(cells)
    return _with_clips(table, measured)


def _sizes(group: goodness.Group) -> list[str]:
    """The given sigma, the size of the errors, and their ratio."""
    _, unit, factor = RESIDUALS[group.kind]
    sizes = (group.sigma, group.sigma * group.plain.scale)
    return [*(f"{number(factor * size)} {unit}" for size in sizes), f"{group.plain.scale:.2f}"]


def _with_clips(table: Table, groups: Sequence[goodness.Group]) -> Table:
    """The table with a column for the clip, where there are several."""
    if not any(group.clip for group in groups):
        return table
    heading, *rows = table
    numbered = zip(groups, rows, strict=True)
    return [["clip", *heading], *([str(group.clip + 1), *row] for group, row in numbered)]


def _p(value: float, group: goodness.Group) -> str:
    if not group.is_measured:
        return "–"
    return f"< {goodness.SMALL:.4f}" if value < goodness.SMALL else f"{value:.4f}"


def noise_blocks(fitted: Fit) -> list[Block]:
    """The noise that was estimated; nothing if none was."""
    options = fitted.experiment.noise
    if not options.estimates_any:
        return []
    blocks: list[Block] = [Heading("Noise")]
    if options.sigmas == "estimated":
        blocks.append(Grid(_estimated_sigmas(fitted), "Estimated sigmas", brief=False))
    if options.correlation == "whitened":
        correlations = _estimated_correlations(fitted)
        blocks.append(Grid(correlations, "Estimated correlations", brief=False))
    if options.correlation == "counted":
        blocks.append(Text(COUNTED.format(fitted.noise.weight)))
    if fitted.problem.loss == "student" and options.sigmas == "estimated":
        blocks.append(Text(f"Student's t has {fitted.noise.tails:.3g} degrees of freedom."))
    return blocks


def sigma_table(draws: Mapping[str, np.ndarray]) -> Table:
    """Sampled sigmas: median and 95 % interval of each."""
    table = [["sigma", "unit", "median", "95 % interval"]]
    for kind, values in draws.items():
        name, unit, factor = RESIDUALS[kind]
        low, middle, high = np.percentile(factor * values, [2.5, 50, 97.5])
        table.append([name, unit, number(middle), interval(low, high)])
    return table


def _estimated_sigmas(fitted: Fit) -> Table:
    """Sigmas with the 95 % interval that their degrees of freedom give them."""
    table = [["sigma", "unit", "given", "estimated", "95 % interval"]]
    for kind, sigma in fitted.noise.sigmas.items():
        name, unit, factor = RESIDUALS[kind]
        assumed = fitted.experiment.sigmas.get(kind, DEFAULT_SIGMAS[kind])
        degrees = goodness.pooled([g.left for g in fitted.groups if g.kind == kind]).degrees
        spread = math.exp(NORMAL / math.sqrt(2 * max(degrees, 1)))
        ends = interval(factor * sigma / spread, factor * sigma * spread)
        table.append([name, unit, number(factor * assumed), number(factor * sigma), ends])
    return table


def _estimated_correlations(fitted: Fit) -> Table:
    """Correlations with the 95 % interval of an autoregression's coefficient."""
    table = [["correlation from one frame to the next", "estimated", "95 % interval"]]
    for kind, rho in fitted.noise.correlations.items():
        count = sum(group.left.count for group in fitted.groups if group.kind == kind)
        half = NORMAL * math.sqrt((1 - rho**2) / max(count, 1))
        ends = interval(rho - half, min(rho + half, 1.0))
        table.append([RESIDUALS[kind].name, f"{rho:.3f}", ends])
    return table


def sentences(fitted: Fit) -> list[str]:
    """Offsets that the clips show and that were not fitted, one each, with the remedy."""
    signs = fitted.capture_signs
    return [
        f"Clip {number}: {text}" if len(signs) > 1 else f"{text[0].upper()}{text[1:]}"
        for number, of_clip in enumerate(signs, 1)
        for name, text in _of_clip(of_clip)
        if name not in fitted.experiment.capture
    ]


def _of_clip(signs: CaptureSigns) -> list[tuple[str, str]]:
    """The signs of one clip: the key of [capture] that fits each, and a sentence."""
    ground, rows = signs.ground, []
    if ground.height:
        side = "over" if ground.height > 0 else "in"
        text = (
            f"standing feet are {_cm(ground.height)} {side} the ground in the median of "
            f"{ground.stances} stances, which scatter by {_cm(ground.scatter)}: a floor offset?"
        )
        rows.append(("ground_height", text))
    for axis, tilt in (("x", ground.tilt_x), ("z", ground.tilt_z)):
        if abs(tilt) >= math.radians(0.1):
            text = (
                f"standing feet {'rise over' if tilt > 0 else 'sink into'} the ground by "
                f"{math.degrees(abs(tilt)):.1f}° along {axis}: a tilted floor?"
            )
            rows.append((f"ground_tilt_{axis}", text))
    if signs.lag:
        order = "after" if signs.lag > 0 else "before"
        text = (
            f"the captured ankles move {1000 * abs(signs.lag):.0f} ms {order} the fitted ones: a "
            "time shift?"
        )
        rows.append(("time_shift", text))
    return [(name, f"{text} `[capture] {name} = {{}}` fits it along.") for name, text in rows]


def _cm(metres: float) -> str:
    return f"{100 * abs(metres):.1f} cm"


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
        cells = [row["name"], row["unit"], prior["shape"], _prior_centre(row)]
        cells.append("" if prior["spread"] is None else number(prior["spread"]))
        table.append([*cells, interval(*prior["interval"]), interval(*row["interval"])])
    return table


def _prior_centre(row: FittedParameter) -> str:
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


def describe_window(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> list[str]:
    """What went wrong in the worst window, a sentence or two in each line."""
    start, end = playback.time[window.start], playback.time[window.end]
    fractions = [f"{_noun(kind)} {percent(part, 0)}" for kind, part in window.fractions.items()]
    others = "; " + ", ".join(fractions[1:]) if fractions[1:] else ""
    lines = [
        f"From {start:.2f} s to {end:.2f} s the residuals are {window.rms:.2f} sigmas (rms), "
        f"{window.clip_rms:.2f} over the whole clip.",
        f"{_noun(window.kind).capitalize()} makes up {percent(window.fractions[window.kind], 0)} "
        f"of their squares{others}.",
        f"{_largest_error(playback, window, legs)} {_standing_feet(playback, window, legs)}",
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


def _noun(kind: str) -> str:
    return RESIDUALS[kind].name.lower()


def _largest_error(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> str:
    """When and by how much the largest kind is worst."""
    _, unit, factor = RESIDUALS[window.kind]
    of_leg = "" if window.leg is None else f"of the {legs[window.leg]} leg "
    text = (
        f"The {_noun(window.kind)} {of_leg}is worst at {playback.time[window.frame]:.2f} s: "
        f"{factor * window.size:.1f} {unit} off"
    )
    if window.offset is not None:
        axis = int(np.argmax(np.abs(window.offset)))
        text += f", mostly {DIRECTIONS[axis][int(window.offset[axis] < 0)]}"
        text += f" ({100 * abs(window.offset[axis]):.1f} cm)"
    return text + "."


def _standing_feet(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> str:
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
