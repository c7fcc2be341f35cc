"""How far motions are from the captured one, in m and rad, and what follows for a fit.

Three motions are compared on the same frames: the flat animation without foot IK, the system as it
was before the fit, and the fitted one. Distances are root mean squares over frames and legs. Frames
that were held out say what the parameters are worth on motion that they were not fitted to.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from fitting.analysis.playback import Playback
from fitting.analysis.worst_window import PER_LEG

Part: TypeAlias = Literal["fitted", "held_out"]
Motion: TypeAlias = Literal["animation", "before", "fitted"]
Kinds: TypeAlias = Mapping[str, float]
MOTIONS: tuple[Motion, ...] = get_args(Motion)
PARTS: tuple[Part, ...] = get_args(Part)

# Distances up to which two motions look the same, m and rad: what a good fit of a capture leaves.
CLOSE = {"ankle": 0.02, "knee": 0.03, "pelvis": 0.02, "foot": 0.1}
# Differences between two distances that nobody sees, m and rad: 2 mm, of a foot at heel and tip.
UNSEEN = {"ankle": 0.002, "knee": 0.002, "pelvis": 0.002, "foot": math.radians(1.0)}


class Setback(NamedTuple):
    """A distance that is larger for the fitted motion than for another one."""

    part: Part
    kind: str
    fitted: float
    """m or rad."""
    other: Motion
    """Which is closer."""
    distance: float
    """Of the other motion; m or rad."""


@dataclass(frozen=True)
class Distances:
    """How far the animation, the system before the fit, and the fitted one are from the capture."""

    parts: Mapping[Part, Mapping[Motion, Kinds]]
    """m and rad, of `CLOSE`'s kinds; no part of which no frame was observed."""

    @property
    def setbacks(self) -> list[Setback]:
        """Where the fitted motion is visibly worse than another, the largest ones first."""
        worse = [
            Setback(part, kind, motions["fitted"][kind], other, distance)
            for part, motions in self.parts.items()
            for other in ("animation", "before")
            for kind, distance in motions[other].items()
            if motions["fitted"][kind] > distance + UNSEEN[kind]
        ]
        return sorted(worse, key=lambda s: (s.distance - s.fitted) / CLOSE[s.kind])

    @property
    def far(self) -> list[tuple[Part, str, float]]:
        """Where the fitted motion does not look like the captured one: part, kind and distance."""
        return [
            (part, kind, distance)
            for part, motions in self.parts.items()
            for kind, distance in motions["fitted"].items()
            if distance > CLOSE[kind]
        ]

    @property
    def better(self) -> Motion:
        """Whose parameters are worth keeping: the fitted ones, or those from before the fit."""
        worse = any(setback.other == "before" for setback in self.setbacks)
        return "before" if worse and self._score("before") < self._score("fitted") else "fitted"

    @property
    def best(self) -> Motion:
        """Which motion is nearest as a whole; of equal ones the fitted one."""
        return min(reversed(MOTIONS), key=self._score)

    def _score(self, motion: Motion) -> float:
        """All distances as one number: squares, in units of what looks the same."""
        return sum(
            (distance / CLOSE[kind]) ** 2
            for motions in self.parts.values()
            for kind, distance in motions[motion].items()
        )


def measure(before: Sequence[Playback], fitted: Sequence[Playback]) -> Distances:
    """The distances of three motions from the captured one, over all clips.

    Args:
        before: the clips with the system as it was before the fit.
        fitted: the same clips with the fitted system.
    """
    parts: dict[Part, dict[Motion, Kinds]] = {}
    frames: dict[Part, list] = {
        "fitted": [clip.seen for clip in fitted],
        "held_out": [clip.held_out for clip in fitted],
    }
    for part in PARTS:
        if any(np.any(chosen) for chosen in frames[part]):
            motions: dict[Motion, list] = {
                "animation": [clip.animated_errors for clip in fitted],
                "before": [clip.errors for clip in before],
                "fitted": [clip.errors for clip in fitted],
            }
            parts[part] = {
                motion: {
                    kind: _rms([clip[kind] for clip in errors], kind, fitted, frames[part])
                    for kind in CLOSE
                }
                for motion, errors in motions.items()
            }
    return Distances(parts)


def _rms(
    errors: Sequence[np.ndarray], kind: str, clips: Sequence[Playback], frames: Sequence[np.ndarray]
) -> float:
    """Root mean square of the lengths of errors, over frames and present legs of all clips."""
    squares = []
    for values, clip, chosen in zip(errors, clips, frames, strict=True):
        lengths = np.sum(np.asarray(values)[np.asarray(chosen)] ** 2, axis=-1)
        squares.append(lengths[:, np.asarray(clip.present) > 0] if kind in PER_LEG else lengths)
    return float(np.sqrt(np.mean(np.concatenate([square.ravel() for square in squares]))))
