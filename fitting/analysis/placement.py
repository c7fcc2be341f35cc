"""How the feet of a motion are placed on its ground: what a viewer sees of it, frame by frame.

NumPy; lengths in metres, y up. The sole of a foot is known at two points: below the ankle, which
stands for the heel, and below the ball. Each is as far below its joint, along the foot's up axis,
as the joint is above the floor while the animated foot stands flat. What is visible is as large as
the body: limits are for an adult.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from fitting.datasets import ground_path
from fitting.datasets.clips import contacts
from fitting.datasets.clips.clip import Clip
from jaxik.world import body
from jaxik.world.terrain import Terrain

from . import measures

VISIBLE = 0.02  # m: what a viewer notices of a sole in the ground or above it
SHARE_LIMIT = 0.05  # of the frames of standing feet that may be visibly off the ground
MISSING_LIMIT = 0.5  # of the points of soles that may be without ground
SLIDE_LIMIT = 0.02  # m per stance, median
POP_LIMIT = 0.05  # m in 1/60 s


@dataclass(frozen=True)
class Soles:
    """Both points of each sole over the ground; see the module."""

    height: Float64[np.ndarray, "frames legs 2"]
    """m above the ground, negative in it; NaN where there is no ground, and in masked frames."""
    ground: Float64[np.ndarray, "frames legs 2"]
    """m, height of the ground below the point; NaN where there is none."""
    stance: Bool[np.ndarray, "frames legs"]
    """Where the animation says that the foot stands."""

    @property
    def gap(self) -> Float64[np.ndarray, "frames legs"]:
        """Height of the foot's lower point above the ground, m; NaN without ground."""
        return np.fmin.reduce(self.height, axis=-1)


@dataclass(frozen=True)
class Extreme:
    """The largest value of a series, and where it is."""

    value: float
    """NaN where there is nothing to measure."""
    frame: int
    leg: str


@dataclass(frozen=True)
class Placement:
    """How the feet of one motion are placed; NaN where there is nothing to measure."""

    sunk: float
    """Fraction of the frames of standing feet in which one is `visible` or more in the ground."""
    floating: float
    """Fraction of those in which it is `visible` or more above it."""
    sunk_swing: float
    """Fraction of the frames of moving feet in which one is `visible` or more in the ground."""
    sunk_frames: float
    """Fraction of all frames in which any foot is."""
    groundless: float
    """Fraction of the soles' points, over all frames, that have no ground under them."""
    deepest: Extreme
    """m in the ground, of any foot."""
    highest: Extreme
    """m above it, of a standing foot."""
    slide: float
    """m per stance, horizontal path of the ball beyond the animated one; median."""
    largest_slide: Extreme
    """m; its frame is the first of the stance."""
    pop: Extreme
    """m in 1/60 s, change of the ankle's place relative to the body, beyond the animated one."""
    size: float = 1.0
    """Length of the legs relative to an adult's: limits are as many times as large."""

    @property
    def visible(self) -> float:
        """What a viewer notices of a sole in the ground of this body or above it, m."""
        return VISIBLE * self.size

    @property
    def misplaced(self) -> bool:
        """Whether standing feet are visibly off the ground too often, or have none."""
        return self.sunk + self.floating > SHARE_LIMIT or self.groundless > MISSING_LIMIT


def soles(solved: Clip, animated: Clip, terrain: Terrain, floor: float = 0.0) -> Soles:
    """The soles of a motion over a terrain.

    The ground is looked for from `step_height` above the sole or the ground of the path, whichever
    is higher: a character inside a hill is found to be in it, and a roof is no ground.

    Args:
        solved: the motion.
        animated: the flat animation from which it was made, on its own floor.
        terrain: y up.
        floor: height of that floor, m.
    """
    points = measures.soles(solved)
    path = ground_path.path_heights(solved, terrain, floor)
    lowest = points[..., 1] if path is None else np.maximum(points[..., 1], path[:, None, None])
    ground = ground_path.heights_under(terrain, points, lowest + ground_path.step_height(animated))
    height = np.where(animated.observed[:, None, None], points[..., 1] - ground, np.nan)
    return Soles(height, ground, animated.observed_stances())


def assess(feet: Soles, solved: Clip, animated: Clip, own_speed: Clip | None = None) -> Placement:
    """What a viewer sees of the feet of a motion.

    Args:
        feet: of the motion.
        solved: the motion.
        animated: the animation from which it was made, with its root where the motion has it.
        own_speed: the animation with its root at the speed at which it steps, whose slides are not
            counted; None if it has that speed.
    """
    names, gap, stance = solved.rig.names, feet.gap, feet.stance
    size = body.ratio(solved.rig)
    in_ground, above = gap < -VISIBLE * size, gap > VISIBLE * size  # false for NaN
    known = ~np.isnan(gap)
    slides = _slides(solved, stance) - _slides(own_speed or animated, stance)
    stances = slides[~np.isnan(slides)]
    return Placement(
        sunk=_fraction(in_ground, stance & known),
        floating=_fraction(above, stance & known),
        sunk_swing=_fraction(in_ground, ~stance & known),
        sunk_frames=_fraction(np.any(in_ground, axis=1), np.any(known, axis=1)),
        groundless=float(np.mean(np.isnan(feet.ground))),
        deepest=_extreme(-gap, names),
        highest=_extreme(np.where(stance, gap, np.nan), names),
        slide=float(np.median(stances)) if stances.size else float("nan"),
        largest_slide=_extreme(slides, names),
        pop=_extreme(_pops(solved, animated), names),
        size=size,
    )


def _slides(
    clip: Clip, stance: Bool[np.ndarray, "frames legs"]
) -> Float64[np.ndarray, "frames legs"]:
    """Length of the ball's horizontal path in each stance, m, at its first frame; NaN elsewhere."""
    steps = measures.horizontal_steps(clip.joints_ws(3), clip.cuts)
    slides = np.full(stance.shape, np.nan)
    for leg in range(stance.shape[1]):
        for first, last in contacts.runs(stance[:, leg]):
            if last > first:
                slides[first, leg] = steps[first:last, leg].sum()
    return slides


def _pops(solved: Clip, animated: Clip) -> Float64[np.ndarray, "frames legs"]:
    """Change of the ankles' corrections relative to the pelvis, m in 1/60 s, at its last frame."""
    before, after = (
        clip.joints_ws(2) - clip.positions_ws[:, clip.rig.pelvis][:, None]
        for clip in (animated, solved)
    )
    speeds = measures.correction_speed(after - before, solved.fps, solved.cuts)
    pops = np.full(before.shape[:2], np.nan)
    pops[len(pops) - len(speeds) :] = speeds
    return pops


def _fraction(chosen: np.ndarray, among: np.ndarray) -> float:
    return float(np.mean(chosen[among])) if among.any() else float("nan")


def _extreme(series: Float64[np.ndarray, "frames legs"], names: tuple[str, ...]) -> Extreme:
    if np.isnan(series).all():
        return Extreme(float("nan"), 0, names[0])
    frame, leg = np.unravel_index(np.nanargmax(series), series.shape)
    return Extreme(float(series[frame, leg]), int(frame), names[leg])
