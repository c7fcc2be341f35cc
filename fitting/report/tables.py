"""Tables of a fit and of a posterior: rows of words, and two ways to set them."""

from collections.abc import Mapping, Sequence
from typing import Any

from fitting.analysis.limit_activity import Exercise
from fitting.inference.identifiability import Profile
from fitting.inference.sampling.posterior import Posterior

CLOSE = 0.05  # share of its range within which a parameter counts as recovered
Truth = Mapping[str, float] | None
Table = list[list[str]]  # the first row is the head


def fit_table(rows: Sequence[Mapping[str, Any]], truth: Truth) -> Table:
    """FreeParameter parameters: value, interval, range, truth and error where known, remarks.

    Args:
        rows: `parameters` of `store.describe_fit`.
        truth: known values by name.
    """
    head = ["parameter", "value", "unit", "95 % interval", "range"]
    table = [head + (["truth", "error"] if truth else []) + ["remarks"]]
    for row in rows:
        cells = [row["name"], number(row["value"]), row["unit"]]
        cells += [span(*row["interval"]), span(row["low"], row["high"])]
        if truth:
            known = truth.get(row["name"])
            cells.append("unknown" if known is None else number(known))
            cells.append("" if known is None else f"{share(error(row, known))} of range")
        remarks = [] if row["determined"] else ["undetermined by these clips"]
        if row["at_bound"]:
            remarks.append(f"at its {'lower' if row['at_bound'] == 'low' else 'upper'} bound")
        table.append([*cells, ", ".join(remarks)])
    return table


def gain_table(rows: Sequence[Mapping[str, Any]], rates: Sequence[float]) -> Table:
    """Gains: their half-lives, and the gains per tick that these mean at some rates, Hz."""
    table = [["gain", "half-life", *(f"gain at {hz:.0f} Hz" for hz in rates)]]
    for row in rows:
        if "half_life" in row:
            gains = [number(row[f"gain_at_{hz:.0f}_hz"]) for hz in rates]
            table.append([row["name"], f"{number(row['half_life'])} s", *gains])
    return table


def recovered(rows: Sequence[Mapping[str, Any]], truth: Mapping[str, float]) -> str:
    """How many of the determined parameters came out close to the truth."""
    judged = [row for row in rows if row["determined"] and row["name"] in truth]
    close = sum(error(row, truth[row["name"]]) <= CLOSE for row in judged)
    return (
        f"{close} of {len(judged)} determined parameters within {100 * CLOSE:.0f} % of their range"
    )


def contraction_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """FreeParameter parameters by how much the clips say of them, the least first."""
    table = [["parameter", "kind", "contraction", "verdict"]]
    for row in sorted(rows, key=lambda row: row["contraction"]):
        verdict = "determined" if row["determined"] else "undetermined"
        table.append([row["name"], row["kind"], f"{row['contraction']:.3f}", verdict])
    return table


def exercise_table(clips: Sequence[Exercise]) -> Table:
    """What each clip asks of the fitted system, a column a clip and foot."""
    feet = [(i, leg) for i, clip in enumerate(clips) for leg in range(len(clip.legs))]
    several = len(clips) > 1
    names = [f"{clips[i].legs[n]}{f', clip {i + 1}' if several else ''}" for i, n in feet]
    table = [["foot", *names]]
    for words, series in (
        ("ground found", "found"),
        ("in contact", "standing"),
        ("target reached", "reached"),
        ("locked", "locked"),
    ):
        table.append([words, *(share(getattr(clips[i], series)[n]) for i, n in feet)])
    table.append(["locks", *(str(clips[i].locks[n]) for i, n in feet)])
    table.append(["releases", *(str(clips[i].releases[n]) for i, n in feet)])
    return table


def limits_table(clips: Sequence[Exercise]) -> Table:
    """Share of frames in which each limit changes the pose, a column a clip."""
    table = [
        ["limit", *(f"clip {i + 1}" if len(clips) > 1 else "frames" for i in range(len(clips)))]
    ]
    for name in clips[0].limits:
        table.append([name, *(share(clip.limits[name]) for clip in clips)])
    return table


def flips_table(flips: Mapping[str, tuple[float, float]], profiles: Mapping[str, Profile]) -> Table:
    """Thresholds: decisions that flip, and what that costs, when one moves by 10 % of its range."""
    table = [["threshold", "flips, moved down", "cost", "flips, moved up", "cost"]]
    for name, sides in flips.items():
        cells = [name]
        for flipped, rise in zip(sides, profiles[name].nudged, strict=True):
            cells += [share(flipped, 2), f"{rise:+.1f}"]
        table.append(cells)
    return table


def posterior_table(posterior: Posterior, truth: Truth, units: Mapping[str, str]) -> Table:
    """Parameters of a posterior: moments, intervals, how well sampled, and the truth if known."""
    head = ["parameter", *(["unit"] if units else []), "mean", "sd", "median", "68 % interval"]
    head += ["95 % interval", "ESS", "R-hat", "autocorrelation"]
    table = [head + (["truth", "covered"] if truth else [])]
    for row, time in zip(posterior.summary, posterior.autocorrelation_time, strict=True):
        cells = [row["name"], *([units[row["name"]]] if units else [])]
        cells += [number(row[key]) for key in ("mean", "sd", "median")]
        cells += [span(row["low68"], row["high68"]), span(row["low95"], row["high95"])]
        cells += [f"{row['ess']:.0f}", f"{row['r_hat']:.3f}", f"{time:.0f} steps"]
        if truth:
            known = truth.get(row["name"])
            cells.append("unknown" if known is None else number(known))
            cells.append("" if known is None else "yes" if covers(row, known) else "no")
        table.append(cells)
    return table


def covered(posterior: Posterior, truth: Mapping[str, float], names: Sequence[str]) -> str:
    """How many of these parameters have the truth within their 95 % interval."""
    judged = [row for row in posterior.summary if row["name"] in names and row["name"] in truth]
    inside = sum(covers(row, truth[row["name"]]) for row in judged)
    return f"{inside} of {len(judged)}"


def covers(row: Mapping[str, Any], known: float) -> bool:
    """Whether the 95 % interval of a posterior's row holds this value."""
    return row["low95"] <= known <= row["high95"]


def error(row: Mapping[str, Any], known: float) -> float:
    """Distance of a fit's row from the truth as a share of its range."""
    return abs(row["value"] - known) / (row["high"] - row["low"])


def number(value: float) -> str:
    """Four digits."""
    return f"{value:.4g}"


def share(value: float, digits: int = 1) -> str:
    """A share of 1 in per cent."""
    return f"{100 * value:.{digits}f} %"


def span(low: float, high: float) -> str:
    """From one number to another."""
    return f"{low:.4g} to {high:.4g}"


def aligned(table: Table) -> str:
    """A table in columns of one width, for a terminal."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]
    return "\n".join([lines[0], "-" * max(len(line) for line in lines), *lines[1:]])


def markdown(table: Table) -> str:
    """A table as Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in table]
    return "\n".join([lines[0], "|" + " --- |" * len(table[0]), *lines[1:]])
