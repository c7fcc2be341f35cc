"""Tables of a fit: its parameters, how well the clips determine them, and its motions."""

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from fitting.motion.playback import ClipActivity, Nudge
from fitting.problem.space import FreeParameter
from fitting.report.document import ParameterRow
from fitting.report.formatting import Table, interval, number, percent

from .fit import FittedParameter

NO_CORRECTION = ("bone_length",)  # figures that say nothing of how close two motions are
CLOSE = 0.05  # fraction of its range within which a parameter counts as recovered
Truth: TypeAlias = Mapping[str, float] | None  # known parameter values by name


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
            remarks.append(f"at its {'lower' if row['at_bound'] == 'low' else 'upper'} bound")
        table.append([*cells, ", ".join(remarks)])
    return table


def gain_table(rows: Sequence[FittedParameter]) -> Table:
    """Gains: their half-lives, and the gains per tick that these mean at 30 and 60 Hz."""
    table = [["gain", "half-life", "gain at 30 Hz", "gain at 60 Hz"]]
    for row in rows:
        if "half_life" in row and "gain_at_30_hz" in row and "gain_at_60_hz" in row:
            gains = [number(row["gain_at_30_hz"]), number(row["gain_at_60_hz"])]
            table.append([row["name"], f"{number(row['half_life'])} s", *gains])
    return table


def recovered(rows: Sequence[FittedParameter], truth: Mapping[str, float]) -> str:
    """How many of the determined parameters are close to their true values."""
    known = [row for row in rows if row["determined"] and row["name"] in truth]
    close = sum(error(row, truth[row["name"]]) <= CLOSE for row in known)
    return (
        f"{close} of {len(known)} determined parameters within {100 * CLOSE:.0f} % of their range"
    )


def error(row: FittedParameter, true: float) -> float:
    """Distance of a fitted value from the true one, as a fraction of the parameter's range."""
    return abs(row["value"] - true) / (row["high"] - row["low"])


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
        words += f", at its {'lower' if row['at_bound'] == 'low' else 'upper'} bound"
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
