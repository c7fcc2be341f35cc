"""Interval plots of a fit's parameters, and a table of what limits do."""

import math
from collections.abc import Mapping, Sequence

from fitting.motion.playback import ClipActivity
from fitting.report.document import ParameterRow
from fitting.report.formatting import Table, interval, number, percent

from .fit import FittedParameter
from .fit_tables import Truth, verdict


def parameter_rows(
    rows: Sequence[FittedParameter],
    scales: Mapping[str, str],
    docs: Mapping[str, str],
    truth: Truth,
) -> list[ParameterRow]:
    """The free parameters.

    Args:
        rows: their numbers.
        scales: by name, on which the range is drawn; all but `log` are linear.
        docs: by name, what they mean.
        truth: known values, by name.
    """
    return [_parameter_row(row, scales[row["name"]], docs[row["name"]], truth) for row in rows]


def _parameter_row(row: FittedParameter, scale: str, doc: str, truth: Truth) -> ParameterRow:
    low, high = row["low"], row["high"]

    def fraction(value: float) -> float:
        value = min(max(value, low), high)
        if scale == "log" and low > 0:
            return math.log(value / low) / math.log(high / low)
        return (value - low) / (high - low)

    true = None if truth is None else truth.get(row["name"])
    unit = "" if row["unit"] == "1" else row["unit"]
    words = verdict(row)
    if row["at_bound"]:
        words += f", at its {'lower' if row['at_bound'] == 'low' else 'upper'} bound"
    return ParameterRow(
        name=row["name"],
        meaning=doc,
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
