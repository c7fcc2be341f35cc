"""What remains of another system's correction, as numbers for JSON, tables and sentences."""

from collections.abc import Mapping, Sequence

import numpy as np

from fitting.analysis.difference import NEGLIGIBLE, Difference, Remainder, summarise

from .formatting import Table, number, percent
from .labels import DIFFERENCES

FAITHFUL = 0.95  # fraction of a correction from which on it counts as reproduced


def numbers(clips: Sequence[Difference]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Figures of each phase and quantity as JSON holds them, in the units of `DIFFERENCES`.

    `correction` (rms); `rms`, `p95` and `max` of what remains; and `reproduced`, which is
    1 - rms / correction, or None where the reference corrects nothing.
    """
    return {
        phase: {name: _numbers(name, remainder) for name, remainder in remainders.items()}
        for phase, remainders in summarise(clips).items()
    }


def _numbers(quantity: str, remainder: Remainder) -> dict[str, float | None]:
    factor = DIFFERENCES[quantity].factor
    return {
        "correction": factor * remainder.correction,
        "rms": factor * remainder.rms,
        "p95": factor * remainder.p95,
        "max": factor * remainder.max,
        "reproduced": remainder.reproduced,
    }


def table(remainders: Mapping[str, Remainder], source: str) -> Table:
    """A row for each quantity of one phase.

    Args:
        remainders: by quantity.
        source: name of the system that made the reference.
    """
    rows = [["", f"correction by {source}, rms", "remaining, rms", "95 %", "max", "reproduced"]]
    for quantity, remainder in remainders.items():
        name, unit, factor = DIFFERENCES[quantity]
        values = remainder.correction, remainder.rms, remainder.p95, remainder.max
        reproduced = "–" if remainder.reproduced is None else percent(remainder.reproduced)
        rows.append([name, *(f"{factor * value:.2f} {unit}" for value in values), reproduced])
    return rows


def headline(remainders: Mapping[str, Remainder], source: str, target: str) -> str:
    """How much of the source's correction the target reproduces, in one sentence."""
    parts = [
        f"{percent(remainder.reproduced)} of that of the {DIFFERENCES[quantity].name}"
        for quantity, remainder in remainders.items()
        if remainder.reproduced is not None
    ]
    return f"Of the correction that {source} makes, {target} reproduces {', '.join(parts)}."


def shortcomings(clips: Sequence[Difference], source: str, target: str) -> list[str]:
    """What the target does not do as the source does: a sentence each, with the worst place."""
    sentences = []
    for quantity, remainder in summarise(clips)["all frames"].items():
        name, unit, factor = DIFFERENCES[quantity]
        remaining = f"{number(factor * remainder.rms)} {unit}"
        worst = _worst(clips, quantity)
        if remainder.reproduced is None:
            if remainder.rms > NEGLIGIBLE:
                sentences.append(
                    f"{source} leaves the {name} as animated; {target} is {remaining} (rms) off, "
                    f"{worst}."
                )
        elif remainder.reproduced < FAITHFUL:
            correction = f"{number(factor * remainder.correction)} {unit}"
            sentences.append(
                f"{name.capitalize()}: {remaining} (rms) remain of {correction}, {worst}."
            )
    return sentences


def _worst(clips: Sequence[Difference], quantity: str) -> str:
    """Where what remains of a quantity is largest."""
    _, unit, factor = DIFFERENCES[quantity]
    index = int(np.argmax([clip.remaining[quantity].max() for clip in clips]))
    clip, remaining = clips[index], clips[index].remaining[quantity]
    frame, column = np.unravel_index(np.argmax(remaining), remaining.shape)
    of_clip = f" of clip {index + 1}" if len(clips) > 1 else ""
    of_leg = f" ({clip.legs[column]})" if remaining.shape[1] > 1 else ""
    largest = number(factor * float(remaining[frame, column]))
    return f"at most {largest} {unit} at {clip.time[frame]:.2f} s{of_clip}{of_leg}"
