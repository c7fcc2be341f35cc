"""What went wrong in the two seconds in which the fit is worst, in sentences."""

from collections.abc import Sequence

import numpy as np

from fitting.analysis.playback import Playback
from fitting.analysis.worst_window import WorstWindow

from .formatting import percent
from .labels import RESIDUALS

DIRECTIONS = (  # of an offset up, forward and left: positive, negative
    ("too high", "too low"),
    ("too far ahead", "too far behind"),
    ("too far to the left", "too far to the right"),
)


def describe(playback: Playback, window: WorstWindow, legs: Sequence[str]) -> list[str]:
    """What went wrong in the worst window, a sentence or two in each line.

    Args:
        playback: of the fitted system.
        window: its worst one.
        legs: their names.
    """
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
