"""How good is good enough: one bound for each measure, with its reason.

None of them was chosen by what a system reaches. They say what a viewer notices, and what the
animation and the ground ask of any motion that puts the feet on the ground.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fitting.analysis import measures, placement
from fitting.analysis.placement import SHARE_LIMIT, SLIDE_LIMIT, VISIBLE, Extreme, Placement
from fitting.datasets.clips import contacts
from fitting.datasets.clips.clip import Clip
from fitting.studies.animations import Animation

FLAT_SLIDE = 0.002  # m
POP = 0.01  # m in 1/60 s
SWING_PEAK = 1.875  # speed of a path of minimum jerk at its middle, over its mean speed
WALK_JERK = 80.0  # m/s³, of the pelvis in our walk over a flat floor
MISSED = 0.05  # of the targets of standing feet

REASONS = {
    "penetration": f"in at most {SHARE_LIMIT:.0%} of the frames may a sole be {100 * VISIBLE:.0f} "
    "cm or more in the ground, which a viewer notices",
    "float": f"in at most {SHARE_LIMIT:.0%} of its frames may a standing sole be "
    f"{100 * VISIBLE:.0f} cm or more above the ground",
    "slide": f"in a stance a foot may slide {1000 * FLAT_SLIDE:.0f} mm further than animated on a "
    f"level floor, where nothing has to move it, and {100 * SLIDE_LIMIT:.0f} cm elsewhere",
    "pop": f"in 1/60 s a foot's correction may change by {100 * POP:.0f} cm, beyond what a smooth "
    "swing from one foothold to the next needs on this ground",
    "jerk": f"the pelvis may have the animation's jerk and {WALK_JERK:.0f} m/s³ more, as much as a "
    "walk over a level floor has itself",
    "reach": f"at most {MISSED:.0%} of the targets of standing feet may be missed, by 5 mm or more",
}
"""What each bound is and why, by measure."""


@dataclass(frozen=True)
class Cell:
    """One measure of one motion, and its bound."""

    value: float
    """In SI units or fractions of 1; NaN where there is nothing to measure."""
    bound: float
    """Largest value that is good enough; of `reach`, the smallest."""
    worst: Extreme | None = None
    """Where the motion is worst, for measures that know."""
    is_least: bool = False
    """Whether the bound is the smallest value."""

    @property
    def is_within(self) -> bool:
        """Whether the value is good enough; true where there is nothing to measure."""
        if math.isnan(self.value):
            return True
        return self.value >= self.bound if self.is_least else self.value <= self.bound


def cells(
    placed: Placement, jerk: float, reached: float, bounds: Mapping[str, float]
) -> dict[str, Cell]:
    """The cells of a motion, by measure.

    Args:
        placed: how its feet are placed.
        jerk: of the height of its pelvis, m/s³.
        reached: fraction of the targets of its standing feet.
        bounds: of its situation; see `bounds_of`.
    """
    return {
        "penetration": Cell(placed.sunk_frames, bounds["penetration"], placed.deepest),
        "float": Cell(placed.floating, bounds["float"], placed.highest),
        "slide": Cell(placed.slide, bounds["slide"], placed.largest_slide),
        "pop": Cell(placed.pop.value, bounds["pop"], placed.pop),
        "jerk": Cell(jerk, bounds["jerk"]),
        "reach": Cell(reached, bounds["reach"], is_least=True),
    }


def bounds_of(animation: Animation, *, is_flat: bool) -> dict[str, float]:
    """The bounds of a situation, by measure, in SI units and fractions of 1.

    They depend on the animation and the ground alone, so that every system has the same.
    """
    return {
        "penetration": SHARE_LIMIT,
        "float": SHARE_LIMIT,
        "slide": FLAT_SLIDE if is_flat else SLIDE_LIMIT,
        "pop": POP + swing_speed(animation) * measures.TICK,
        "jerk": pelvis_jerk(animation.placed_clip) + WALK_JERK,
        "reach": 1.0 - MISSED,
    }


def pelvis_jerk(clip: Clip) -> float:
    """Jerk of the height of a clip's pelvis, m/s³."""
    return measures.jerk(clip.positions_ws[:, clip.rig.pelvis, 1], clip.fps, clip.cuts)


def swing_speed(animation: Animation) -> float:
    """How fast corrections must change, m/s, for swings between footholds on the ground.

    A standing ball needs a correction of as much as it is in the ground. Between two stances that
    changes along a path of minimum jerk, whose fastest moment counts; of all swings, the largest.
    """
    clip = animation.placed_clip
    needed = -placement.soles(clip, animation.clip, animation.terrain, animation.floor).height
    stance, fastest = clip.stance_labels(), 0.0
    for leg in range(stance.shape[1]):
        runs = contacts.runs(stance[:, leg])
        for (_, last), (first, _) in zip(runs, runs[1:], strict=False):
            change = abs(needed[first, leg, 1] - needed[last, leg, 1])
            if not np.isnan(change):
                fastest = max(fastest, float(SWING_PEAK * change * clip.fps / (first - last)))
    return fastest
