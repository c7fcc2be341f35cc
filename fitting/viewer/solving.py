"""Solves a clip for any values of a system's parameters, by programs that are compiled once."""

import time
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

import jaxik
from fitting.analysis import measures, placement
from fitting.analysis.placement import Placement
from fitting.datasets.clip_frames import clip_from_result
from fitting.datasets.clips import Clip
from fitting.runtime import program_cache
from fitting.runtime.precision import in_float64
from jaxik.world.similarity import similar

from .feet import Sight, seen
from .lines import Colour, Lines, joined, lines
from .overlays import overlays
from .subject import Subject, Take

SKELETONS: dict[str, Colour] = {  # by name; the colours of reports
    "before": (140, 140, 140),
    "after": (0, 114, 178),
    "captured": (213, 94, 0),
}
HEEL, BALL, ANKLE, TOE = range(4)  # corners of a foot as it is drawn
EDGES = ((ANKLE, HEEL), (HEEL, BALL), (BALL, TOE))


@dataclass(frozen=True)
class Drawn:
    """One motion as it is drawn."""

    bones: Lines
    feet: Lines
    """Coloured by what is wrong with them."""
    sight: Sight
    placement: Placement


@dataclass(frozen=True)
class Solved:
    """What a system makes of a clip."""

    motion: Drawn
    overlays: dict[str, Lines]
    cost: float | None
    """None where no captured motion is known."""
    seconds: float
    """That it took."""


class Solver:
    """Solves one clip of a subject again and again.

    Args:
        subject: what is viewed.
        number: index of the clip.
    """

    def __init__(self, subject: Subject, number: int = 0):
        self.subject = subject
        self.take: Take = subject.takes[number]
        self.before = self._drawn(self.take.animated, "before")
        captured = self.take.captured
        self.captured = None if captured is None else self._drawn(captured, "captured")

    @property
    def path_ws(self) -> Float[np.ndarray, "frames 3"]:
        """Where the animated pelvis is, m."""
        return self.take.animated.positions_ws[:, self.take.base.rig.pelvis]

    @in_float64
    def solve(self, ik: jaxik.FootIK) -> Solved:
        """What a system makes of the clip.

        Raises:
            ValueError: the poses are not finite.
        """
        began, take = time.perf_counter(), self.take
        cost = None if self.subject.cost is None else self.subject.cost(ik)  # runs meanwhile
        result = jax.tree.map(np.asarray, result_of(ik, take))
        solved = clip_from_result(take.base, result, floor=take.floor, rise=take.root.rise)
        if not np.isfinite(solved.positions_ws).all():
            raise ValueError("these parameters give poses that are not finite")
        motion = self._drawn(solved, "after")
        shown = overlays(result, solved)
        cost = None if cost is None else float(cost)
        return Solved(motion, shown, cost, time.perf_counter() - began)

    @in_float64
    def _drawn(self, clip: Clip, name: str) -> Drawn:
        take = self.take
        soles = placement.soles(clip, take.own_speed, take.terrain, take.floor)
        placed = placement.assess(soles, clip, take.animated, own_speed=take.own_speed)
        sight = seen(soles, clip, take.own_speed)
        bones = np.array([[parent, j] for j, parent in enumerate(clip.parents) if parent >= 0])
        starts, ends = np.moveaxis(clip.positions_ws[:, bones], 2, 0)
        feet = _feet(clip, sight.colours(SKELETONS[name]))
        return Drawn(lines(starts, ends, SKELETONS[name]), feet, sight, placed)


@in_float64
def result_of(ik: jaxik.FootIK, take: Take) -> jaxik.Result:
    """The result of a system on a clip, by the program that fits and commands use, too."""
    own = ik if take.size is None else similar(ik, take.size)
    rig, tracks = take.base.rig, dict(take.tracks) or None
    return program_cache.run(own, rig, take.terrain, take.frames, tracks=tracks)


def _feet(clip: Clip, colours: np.ndarray) -> Lines:
    """The soles of a motion, in a colour for each foot in each frame."""
    heel_and_ball = measures.soles(clip)
    joints = np.stack([clip.joints_ws(2), clip.joints_ws(3)], axis=2)
    corners = np.concatenate([heel_and_ball, joints], axis=2)
    return joined(
        *(lines(corners[:, :, start], corners[:, :, end], colours) for start, end in EDGES)
    )
