"""Goodness of fit, and signs of an offset capture, in a fit's report."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from fitting.experiment.experiment import DEFAULT_SIGMAS
from fitting.inference.identifiability import NORMAL
from fitting.motion import goodness
from fitting.motion.goodness import (
    CLOSE,
    MOTIONS,
    NAMES,
    PART_NAMES,
    SMALL,
    Distances,
    Group,
    pooled,
    size,
)
from fitting.report.document import Block, Grid, Heading, Text
from fitting.report.formatting import RESIDUALS, Table, interval, number, percent

from .capture_check import CaptureSigns
from .fit import Fit

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
    """What the table of sizes says, and how it was made."""
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


def size_table(groups: Sequence[Group], *, judged: bool = True) -> Table:
    """How large the residuals are, and with how many they are judged.

    Args:
        groups: the rows.
        judged: False leaves out p, which says nothing where sigmas are not those of the noise.
    """
    heading = ["residuals", "active", "degrees of freedom", "reduced chi-square", "p"]
    table = [[*heading, "sigma", "noise", "noise / sigma"]]
    for group in groups:
        cells = [RESIDUALS[group.kind].name, str(group.left.count), f"{group.left.degrees:.0f}"]
        p = _p(group.left.p, group) if judged else "–"
        cells += [number(group.left.mean_square), p, *_sizes(group)]
        table.append(cells)
    return _with_clips(table, groups)


def distance_table(distances: Distances) -> Table:
    """How far motions are from the captured one, on fitted frames and on those held out."""
    table = [["distance from the capture, rms", "frames", "flat animation", "before", "fitted"]]
    for part, motions in distances.parts.items():
        for kind in CLOSE:
            cells = [size(kind, motions[motion][kind]) for motion in MOTIONS]
            table.append([NAMES[kind], PART_NAMES[part].removesuffix(" frames"), *cells])
    return table


def distances_of_preset(distances: Distances) -> Table:
    """How far a system that nobody has fitted yet leaves the captured motion."""
    table = [["distance from the capture, rms", "flat animation", "preset"]]
    motions = distances.parts.get("fitted", {})
    for kind in CLOSE if motions else ():
        sizes = [size(kind, motions[motion][kind]) for motion in ("animation", "before")]
        table.append([NAMES[kind], *sizes])
    return table


def tolerance_table(groups: Sequence[Group]) -> Table:
    """How large the errors are where there is no noise."""
    table = [["residuals", "active", "tolerance", "error, rms", "error / tolerance"]]
    for group in groups:
        table.append([RESIDUALS[group.kind].name, str(group.plain.count), *_sizes(group)])
    return _with_clips(table, groups)


def noise_table(groups: Sequence[Group]) -> Table:
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


def _sizes(group: Group) -> list[str]:
    """The given sigma, the size of the errors, and their ratio."""
    _, unit, factor = RESIDUALS[group.kind]
    sizes = (group.sigma, group.sigma * group.plain.scale)
    return [*(f"{number(factor * size)} {unit}" for size in sizes), f"{group.plain.scale:.2f}"]


def _with_clips(table: Table, groups: Sequence[Group]) -> Table:
    """The table with a column for the clip, where there are several."""
    if not any(group.clip for group in groups):
        return table
    heading, *rows = table
    numbered = zip(groups, rows, strict=True)
    return [["clip", *heading], *([str(group.clip + 1), *row] for group, row in numbered)]


def _p(value: float, group: Group) -> str:
    if not group.is_measured:
        return "–"
    return f"< {SMALL:.4f}" if value < SMALL else f"{value:.4f}"


def noise_blocks(fitted: Fit) -> list[Block]:
    """What was estimated of the noise; nothing if nothing was."""
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
        degrees = pooled([g.left for g in fitted.groups if g.kind == kind]).degrees
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
    """What one clip shows: the key of [capture] that fits it, and a sentence."""
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
