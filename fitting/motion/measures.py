"""How the feet of a motion are placed on its ground: what a viewer sees of it, frame by frame.

NumPy; lengths in metres, y up. The sole of a foot is known at two points: below the ankle, which
stands for the heel, and below the ball. Each is as far below its joint, along the foot's up axis,
as the joint is above the floor while the animated foot stands flat. What is visible is as large as
the body: limits are for an adult.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from fitting.clips import contacts
from fitting.clips.clip import Clip
from fitting.ground import ground_path
from fitting.ground.coverage import ENOUGH, FACTORS
from jaxik.maths import quat, vec
from jaxik.world import body
from jaxik.world.frame import UP
from jaxik.world.terrain import Terrain

from .playback import Motion

VISIBLE = 0.02  # m: what a viewer notices of a sole in the ground or above it
SHARE_LIMIT = 0.05  # of the frames of standing feet that may be visibly off the ground
MISSING_LIMIT = 0.5  # of the points of soles that may be without ground
SLIDE_LIMIT = 0.02  # m per stance, median
POP_LIMIT = 0.05  # m in 1/60 s

STRAIGHT_KNEE = np.radians(175.0)  # rad; a larger knee angle counts as straight
TICK = 1.0 / 60.0  # s, the time over which a pop is measured
POP = 0.02  # m in a tick; a correction that changes faster is a pop


CLOSE = 0.1  # relative difference from a factor
CORRELATED = 0.8  # of heights, from which one counts as proportional to the other
CONSTANT = 0.25  # of the mean, deviation below which heights count as equal
HELPED = 0.5  # of the gaps that a remedy leaves at most, on average

SOLES = ("ankle_height", "ball_height", "ankle_from_foot")  # of a rig: where the soles are


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
    points = sole_points(solved)
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
    steps = horizontal_steps(clip.joints_ws(3), clip.cuts)
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
    speeds = correction_speed(after - before, solved.fps, solved.cuts)
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


@dataclass(frozen=True)
class Measures:
    """Measures of one motion; NaN where there is nothing to measure.

    `fitting.report.formatting.MEASURES` defines each of them.
    """

    penetration_mean: float
    """Metres."""
    penetration_max: float
    """Metres."""
    clearance: float
    """Metres."""
    slide: float
    """m per stance."""
    pop_max: float
    """m in a 60th of a second."""
    pops: float
    """Count."""
    knee_jerk: float
    """Rad/s³."""
    pelvis_jerk: float
    """m/s³."""
    reached: float
    """Fraction of targets."""
    straight: float
    """Fraction of frames and legs."""


@dataclass(frozen=True)
class FootStates:
    """What is known of each foot in each frame, beside its joints."""

    gap: Float64[np.ndarray, "frames legs"]
    """m, see `gaps`; NaN where there is no ground."""
    stance: Bool[np.ndarray, "frames legs"]
    """Where the animation says that the foot stands."""
    reached: Float64[np.ndarray, "frames legs"]
    """1 or 0; NaN where there is no target."""


def measure(
    motion: Motion, animated: Motion, feet: FootStates, fps: float, cuts: Sequence[int] = ()
) -> Measures:
    """All measures of a motion.

    Args:
        motion: after foot IK.
        animated: before it.
        feet: of the motion.
        fps: frames per second.
        cuts: frames at which the motion starts anew, as in a teleport; see `Clip.cuts`.
    """
    depth = np.maximum(-feet.gap, 0.0)
    correction = np.asarray(motion.ankle) - np.asarray(animated.ankle)
    speed = correction_speed(correction, fps, cuts)
    return Measures(
        penetration_mean=_mean(depth),
        penetration_max=_largest(depth),
        clearance=_mean(np.maximum(feet.gap, 0.0)[feet.stance]),
        slide=slide_per_stance(np.asarray(motion.toe), feet.stance, cuts),
        pop_max=_largest(speed),
        pops=float(sum(len(contacts.runs(leg_speed > POP)) for leg_speed in speed.T)),
        knee_jerk=jerk(motion.knee_angle, fps, cuts),
        pelvis_jerk=jerk(np.asarray(motion.pelvis)[:, 1], fps, cuts),
        reached=_mean(feet.reached),
        straight=_mean((motion.knee_angle > STRAIGHT_KNEE).astype(float)),
    )


def sole_points(clip: Clip) -> Float64[np.ndarray, "frames legs 2 3"]:
    """Points of the soles below ankles and balls, along each foot's up axis, m, world space.

    They are as far below as the clip's rig says.
    """
    rig = clip.rig
    depths = np.stack([rig.ankle_height, rig.ball_height], axis=-1)
    feet = quat.multiply(clip.leg_pose_ws().ankle.rot, rig.ankle_from_foot)
    up = np.asarray(quat.rotate(feet, vec.constant(UP, feet)))
    joints = np.stack([clip.joints_ws(2), clip.joints_ws(3)], axis=2)
    return joints - depths[..., None] * up[:, :, None]


def gaps(
    soles_ws: Float64[np.ndarray, "*b 2 3"], ground: Float64[np.ndarray, "*b 2"]
) -> Float64[np.ndarray, "*b"]:
    """Height of a foot's lowest point above the ground under it, m; negative in the ground.

    A foot with ground under one of its points is measured there; a foot without ground is NaN.

    Args:
        soles_ws: the points of each foot's sole, world space, m.
        ground: height of the ground under each point, m; NaN where there is none.
    """
    return np.fmin.reduce(soles_ws[..., 1] - ground, axis=-1)


def slide_per_stance(
    ball_ws: Float[np.ndarray, "frames legs 3"],
    stance: Bool[np.ndarray, "frames legs"],
    cuts: Sequence[int] = (),
) -> float:
    """Length of the ball's horizontal path in a stance, m; median over the stances of all feet.

    Stances of a single frame are left out; NaN where there are no others.
    """
    steps = horizontal_steps(ball_ws, cuts)
    travelled = np.concatenate([np.zeros((1, ball_ws.shape[1])), np.cumsum(steps, axis=0)])
    slides = [
        travelled[last, leg] - travelled[first, leg]
        for leg in range(ball_ws.shape[1])
        for first, last in contacts.runs(stance[:, leg])
        if last > first
    ]
    return float(np.median(slides)) if slides else float("nan")


def horizontal_steps(
    points_ws: Float[np.ndarray, "frames legs 3"], cuts: Sequence[int] = ()
) -> Float[np.ndarray, "steps legs"]:
    """How far points move from frame to frame over the ground, m; not at all where a cut is."""
    steps = np.linalg.norm(np.diff(points_ws[..., [0, 2]], axis=0), axis=-1)
    steps[[cut - 1 for cut in cuts]] = 0.0
    return steps


def correction_speed(
    correction_ws: Float[np.ndarray, "frames legs 3"], fps: float, cuts: Sequence[int] = ()
) -> Float[np.ndarray, "changes legs"]:
    """How fast corrections change, m in a `TICK`; NaN where a cut lies between.

    The change is taken over a tick, or over a frame where frames are longer. A steady change gives
    the same number at every frame rate. A jump gives its size at 60 Hz and its multiples, and half
    of it at 30 Hz, where it cannot be distinguished from a steady change within the frame.
    """
    frames = max(1, round(fps * TICK))
    change = np.linalg.norm(correction_ws[frames:] - correction_ws[:-frames], axis=-1)
    for cut in cuts:
        change[max(cut - frames, 0) : cut] = np.nan
    return change * (fps * TICK / frames)


def jerk(series: Float[np.ndarray, "*b"], fps: float, cuts: Sequence[int] = ()) -> float:
    """Root mean square of the third derivative, per s³, of a series with frames on its first axis.

    Taken by differences of four consecutive frames, none of which starts anew (`cuts`); NaN for
    shorter series.
    """
    third = np.diff(series, n=3, axis=0) * fps**3
    across = [first for cut in cuts for first in range(max(cut - 3, 0), min(cut, len(third)))]
    third = np.delete(third, across, axis=0)
    return float(np.sqrt(np.mean(third**2))) if third.size else float("nan")


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _largest(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else float("nan")


class Cause(NamedTuple):
    """Why feet are off their ground; `likely_cause` explains the kinds."""

    kind: str
    amount: float = 0.0
    """`offset`: m. `units`: metres for each unit of the terrain."""


Trial = Callable[[Cause], Soles | None]
"""Where the soles are after the remedy for a cause; None where there is no remedy to try."""


def likely_cause(
    feet: Soles, animated: Clip, *, unit: float = 1.0, trial: Trial | None = None
) -> Cause:
    """The simplest cause that explains where the soles of standing feet are without foot IK.

    Of `units` and `root` the remedy must help, too: it leaves half of the gaps at most.

    - `missing`: there is no ground under many of them; `ground.coverage` finds out why.
    - `units`: the feet follow the ground by the factor of a unit of length.
    - `offset`: all feet are too high or too low by the same amount.
    - `root`: the higher the ground, the deeper they are in it.
    - `unknown`: none of these.

    Args:
        feet: the soles of the animation.
        animated: the animation, with its root where the motion has it.
        unit: of the terrain, as it was read, m.
        trial: tries their remedies; None takes them to help.
    """
    visible = VISIBLE * body.ratio(animated.rig)
    standing = feet.stance & ~np.isnan(feet.gap)
    if standing.sum() < ENOUGH * feet.stance.sum():
        return Cause("missing")
    gap, ground = feet.gap[standing], np.fmax.reduce(feet.ground, axis=-1)[standing]

    def helps(cause: Cause) -> bool:
        if trial is None:
            return True
        if (tried := trial(cause)) is None:
            return False
        left = np.abs(tried.gap[feet.stance & ~np.isnan(tried.gap)])
        covered = len(left) >= ENOUGH * feet.stance.sum()
        return covered and bool(left.mean() <= HELPED * np.abs(gap).mean())

    if np.std(gap) <= CONSTANT * abs(np.mean(gap)) and abs(np.mean(gap)) > visible:
        return Cause("offset", float(np.mean(gap)))
    if np.std(ground) > visible:
        if np.std(gap + ground) > visible and _correlation(gap + ground, ground) > CORRELATED:
            followed = np.polyfit(ground, gap + ground, 1)[0]  # m for each metre of the ground
            for factor in FACTORS:
                units = Cause("units", unit * factor)
                if abs(followed / factor - 1.0) < CLOSE and helps(units):
                    return units
        if _correlation(gap, ground) < -CORRELATED and helps(Cause("root")):
            return Cause("root")
    return Cause("unknown")


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if np.std(a) > 0 and np.std(b) > 0 else 0.0


@dataclass(frozen=True)
class PlacedMotion:
    """A motion, and how its feet are placed on the ground."""

    clip: Clip
    soles_ws: Float64[np.ndarray, "frames legs 2 3"]
    """m, below ankles and balls."""
    in_ground: Bool[np.ndarray, "frames legs"]
    """Where a sole is visibly in the ground, as `placement` counts it."""
    placement: Placement


def place(clip: Clip, feet: Soles, placement: Placement) -> PlacedMotion:
    """A motion with what was measured of its soles."""
    return PlacedMotion(clip, sole_points(clip), feet.gap < -placement.visible, placement)


def with_soles_of(captured: Clip, flat: Clip) -> Clip:
    """The captured clip with the soles of its flat animation.

    Its own are measured as if it stood on a floor; on uneven ground they are not where they seem.
    """
    rig, flat_rig = captured.measured_rig, flat.measured_rig
    if rig is None or flat_rig is None:
        return captured
    soles = {name: getattr(flat_rig, name) for name in SOLES}
    return replace(captured, measured_rig=replace(rig, **soles))
