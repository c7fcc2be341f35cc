"""Visible qualities of a motion on its ground: each measure with unit, definition and bound.

NumPy; lengths in metres, y up. The sole of a foot is known at two points: below the ankle, which
stands for the heel, and below the ball. Each is as far below its joint, along the foot's up axis,
as the joint is above the floor while the animated foot stands flat. Thresholds are lengths for an
adult and scale with the body.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, NamedTuple

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

VISIBLE = 0.02  # m, from which a viewer notices a sole off its ground, a slide and a pop
TICK = 1.0 / 60.0  # s, the time over which a pop is measured
PELVIS = "pelvis"  # whose pops are those of the whole body
STRAIGHT_REACH = 0.999  # hip to ankle over leg length, from which a leg counts as straight
LEVEL = 1e-3  # m, between the heights of ground that counts as a level floor
MISSING = 0.5  # of the points of soles that may be without ground
FLAT_SLIDE = 0.002  # m, the bound of slides on a level floor, where nothing has to move a foot
SKID = 0.025 / 0.05  # m/s, of an adult, from which a foot in contact skates: 2.5 cm at 20 Hz
CONTACT_HEIGHT = 0.05  # m, of an adult, below which a ball can be in contact
SWING_PEAK = 1.875  # speed of a path of minimum jerk at its middle, over its mean speed

CLOSE = 0.1  # relative difference from a factor
CORRELATED = 0.8  # of heights, from which one counts as proportional to the other
CONSTANT = 0.25  # of the mean, deviation below which heights count as equal
HELPED = 0.5  # of the gaps that a remedy leaves at most, on average

SOLES = ("ankle_height", "ball_height", "ankle_from_foot")  # of a rig: where the soles are
DISPLAY_FACTORS = {"%": 100.0, "cm": 100.0, "mm": 1000.0, "°": math.degrees(1.0)}
_SEEN = f"{100 * VISIBLE:.0f} cm or more"


class Extreme(NamedTuple):
    """The largest value of a series, and where it is."""

    value: float
    """m; NaN where there is nothing to measure."""
    frame: int
    leg: str
    """Of a pop, it may be the pelvis."""

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "–"
        return f"{100 * self.value:z.1f} cm, {self.leg}, frame {self.frame}"


@dataclass(frozen=True)
class Measure:
    """The declaration of a measure of motions."""

    heading: str
    unit: str
    """Of its displayed value."""
    digits: int
    """After the decimal point."""
    meaning: str
    """Its definition."""
    bound: float = math.nan
    """Largest value that is good enough, of an adult; NaN where there is none. See `bounds`."""
    reason: str = ""
    """Of the bound."""
    is_least: bool = False
    """Whether the bound is the smallest value."""

    @property
    def factor(self) -> float:
        """Displayed value / value in SI units, radians and fractions of 1."""
        return DISPLAY_FACTORS.get(self.unit.split()[0], 1.0)

    @property
    def title(self) -> str:
        """The heading with the unit."""
        return f"{self.heading}, {self.unit}"

    def format(self, value: float) -> str:
        """The value in its unit; a dash for NaN."""
        return "–" if math.isnan(value) else f"{self.factor * value:z.{self.digits}f}"

    def limit(self, bound: float) -> str:
        """A bound in the unit."""
        return f"{'≥' if self.is_least else '≤'} {self.format(bound)}"

    def excess(self, value: float, bound: float) -> float:
        """The value as a multiple of the allowed one: above 1 it is beyond its bound."""
        return (1.0 - value) / (1.0 - bound) if self.is_least else value / bound


def declared(
    heading: str, unit: str, digits: int, meaning: str, *, formerly: str = "", **bound: Any
) -> Any:
    """A field of `Figures`: the arguments of `Measure`, and its name in earlier files."""
    measure = Measure(heading, unit, digits, meaning, **bound)
    return field(metadata={"measure": measure} | ({"formerly": formerly} if formerly else {}))


@dataclass(frozen=True)
class Figures:
    """Measures of a motion: SI units, radians and fractions of 1; NaN where unknown."""

    @classmethod
    def measures(cls) -> dict[str, Measure]:
        """The declarations, by name."""
        return {f.name: f.metadata["measure"] for f in fields(cls) if "measure" in f.metadata}

    def text(self, name: str) -> str:
        """A figure in its unit."""
        return self.measures()[name].format(getattr(self, name))

    def numbers(self) -> dict[str, Any]:
        """All figures as JSON holds them: null for NaN."""
        return _without_nan(asdict(self))


def _without_nan(value: Any) -> Any:
    if isinstance(value, Extreme):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


@dataclass(frozen=True)
class Measures(Figures):
    """Visible qualities of one motion on its ground."""

    penetration: float = declared(
        "penetration", "% of frames", 1,
        f"Frames in which a sole is {_SEEN} in the ground.",
        bound=0.05,
        reason="deeper soles are seen; in 5 % of the frames that passes",
    )  # fmt: skip
    penetration_stance: float = declared(
        "penetration of standing feet", "% of frames", 1, "The same of each standing foot."
    )
    penetration_swing: float = declared(
        "penetration of moving feet", "% of frames", 1, "The same of each moving foot."
    )
    penetration_depth: float = declared(
        "penetration depth", "cm", 2,
        "Depth of a foot in the ground, 0 above it; mean over all frames and feet. It is the "
        "deeper of two points of the sole, one below the ankle and one below the ball (the toe "
        "joint), each as far below its joint, along the foot's up axis, as the joint is above the "
        "floor while the animated foot stands flat.",
    )  # fmt: skip
    floating: float = declared(
        "floating", "% of frames", 1,
        f"Frames of each standing foot in which its sole is {_SEEN} above the ground.",
    )  # fmt: skip
    floating_height: float = declared(
        "floating height", "cm", 2,
        "Height above the ground of the lower of the same two points of a standing foot, 0 in the "
        "ground; mean over its frames.",
    )  # fmt: skip
    contact: float = declared(
        "contact preservation", "% of frames", 1,
        "Frames of each standing foot with ground under it in which it neither floats nor "
        "penetrates.",
        bound=0.95, is_least=True,
        reason="a foot that the animation has standing should be seen to stand, but for 5 % of "
        "its frames",
    )  # fmt: skip
    groundless: float = declared(
        "without ground", "% of soles", 1,
        "Points of soles that have no ground under them.",
    )  # fmt: skip
    slide: float = declared(
        "slide", "cm a stance", 2,
        "Length of the horizontal path of the ball of the foot in a stance, beyond that of the "
        "animated one; median.",
        bound=VISIBLE,
        reason="further slides are seen; on a level floor, where nothing has to move a foot, "
        f"{1000 * FLAT_SLIDE:.0f} mm",
    )  # fmt: skip
    foot_skating: float = declared(
        "foot skating", "% of frames", 1,
        "Foot-skating ratio (Karunratanakul et al. 2023): frames in which either foot skids by "
        f"more than 2.5 cm in 1/20 s while its ball is in contact, less than "
        f"{100 * CONTACT_HEIGHT:.0f} cm above the ground. Contacts are the animation's stances, as "
        "swings over uneven ground pass it as closely.",
        bound=0.05,
        reason="a foot that skids is seen; in 5 % of the frames that passes",
    )  # fmt: skip
    pop: float = declared(
        "pop", "cm in 1/60 s", 1,
        "Largest change, over 1/60 s, of a correction: of the pelvis's height, or of an ankle's "
        "place relative to the pelvis, each less that of the animated one, whose strides are those "
        "of its speed and direction. Where frames are longer, the change over a frame is scaled to "
        "1/60 s.",
        bound=VISIBLE,
        reason="larger changes are seen, beyond what a smooth swing from one foothold to the next "
        "needs on this ground",
    )  # fmt: skip
    pops: float = declared(
        "pops", "count", 0,
        f"How often a correction changes by more than {100 * VISIBLE:.0f} cm in 1/60 s. "
        "Consecutive frames above that speed count as one pop.",
    )  # fmt: skip
    knee_jerk: float = declared(
        "knee jerk", "rad/s³", 0,
        "Third derivative of the knee angle, by differences of four consecutive frames; root mean "
        "square. It grows with the frame rate of a clip.",
    )  # fmt: skip
    pelvis_jerk: float = declared(
        "pelvis jerk", "m/s³", 0,
        "The same of the height of the pelvis.",
        bound=80.0,
        reason="beyond that of the animation; as much as a walk over a level floor has itself",
    )  # fmt: skip
    reached: float = declared(
        "reached", "% of targets", 1,
        "Targets of standing feet with ground under them that ankles miss by less than 5 mm (of "
        "an adult).",
        bound=0.95, is_least=True,
        reason="feet stand where their targets are",
    )  # fmt: skip
    straight: float = declared(
        "straight legs", "%", 1,
        f"Frames of each leg in which its ankle is {100 * STRAIGHT_REACH:g} % of the leg's length "
        "from its hip, or further.",
    )  # fmt: skip
    lost_clearance: float = declared(
        "lost clearance", "cm", 1,
        "By how much lower over the ground than in the animation over its floor a foot swings: the "
        "lower of its two points, where that is highest in a swing; median of all swings. Feet "
        "that stay on the ground lose all of their clearance.",
    )  # fmt: skip
    worst: Mapping[str, Extreme] = field(default_factory=dict)
    """Where a measure is worst, m, by name."""
    size: float = 1.0
    """Length of the legs relative to an adult's."""

    @property
    def visible(self) -> float:
        """Distance of a sole of this body from the ground that a viewer notices, m."""
        return VISIBLE * self.size

    @property
    def misplaced(self) -> bool:
        """Whether standing feet are visibly off the ground too often, or have none."""
        return self.contact < MEASURES["contact"].bound or self.groundless > MISSING

    def text(self, name: str) -> str:
        """A figure in its unit, with where it is worst."""
        return " · ".join(filter(None, [super().text(name), str(self.worst.get(name, ""))]))

    def against(self, limits: Mapping[str, float]) -> "list[Bounded]":
        """The known measures beside their bounds, as `bounds` gives them; the worst first."""
        known = [self._bounded(name, limit) for name, limit in limits.items()]
        return sorted(
            (entry for entry in known if not math.isnan(entry.excess)), key=lambda e: -e.excess
        )

    def _bounded(self, name: str, limit: float) -> "Bounded":
        measure, value = MEASURES[name], getattr(self, name)
        words = f"{measure.heading} {measure.format(value)} {measure.unit} ({measure.limit(limit)})"
        if name in self.worst:
            words += f", worst {self.worst[name]}"
        return Bounded(name, measure.excess(value, limit), words)


class Bounded(NamedTuple):
    """A measure beside its bound."""

    name: str
    excess: float
    """The value as a multiple of the allowed one: above 1 it is beyond its bound."""
    words: str

    @property
    def is_beyond(self) -> bool:
        """Whether the measure is beyond its bound."""
        return self.excess > 1.0


MEASURES = Measures.measures()
BOUNDED = {name: measure for name, measure in MEASURES.items() if measure.reason}
NOISY = ("pelvis_jerk",)  # to which a capture's noise adds: bounded in made animations only


@dataclass(frozen=True)
class Soles:
    """Both points of each sole over the ground; see the module."""

    points_ws: Float64[np.ndarray, "frames legs 2 3"]
    """m."""
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
class PlacedMotion:
    """A motion on its ground, and its visible qualities."""

    clip: Clip
    soles: Soles
    measures: Measures

    @property
    def in_ground(self) -> Bool[np.ndarray, "frames legs"]:
        """Where a sole is visibly in the ground."""
        return self.soles.gap < -self.measures.visible

    @property
    def stands_off(self) -> Bool[np.ndarray, "frames legs"]:
        """Where a foot stands visibly off the ground, above or in it."""
        return self.soles.stance & (np.abs(self.soles.gap) > self.measures.visible)


def place(
    solved: Clip,
    animated: Clip,
    flat: Clip,
    terrain: Terrain,
    floor: float = 0.0,
    reached: Float64[np.ndarray, "frames legs"] | None = None,
) -> PlacedMotion:
    """A motion with its soles over the terrain, and its measures.

    Args:
        solved: the motion.
        animated: the animation from which it was made, with its root where the motion has it, and
            strides scaled and turned for that.
        flat: the animation on its own floor, with its root at the speed at which it steps.
        terrain: y up.
        floor: height of that floor, m.
        reached: 1 or 0 for the target of each ankle, NaN where there is none; None if unknown.
    """
    feet = soles(solved, flat, terrain, floor)
    return PlacedMotion(solved, feet, measure(feet, solved, animated, flat, reached))


def soles(solved: Clip, flat: Clip, terrain: Terrain, floor: float = 0.0) -> Soles:
    """The soles of a motion over a terrain; see `place`.

    The ground is sought from `step_height` above the sole or the ground of the path, whichever
    is higher, so that a character inside a hill is in the ground, and a roof is not ground.
    """
    points = sole_points(solved)
    path = ground_path.path_heights(solved, terrain, floor, flat.pieces)
    lowest = points[..., 1] if path is None else np.maximum(points[..., 1], path[:, None, None])
    ground = ground_path.heights_under(terrain, points, lowest + ground_path.step_height(flat))
    height = np.where(flat.observed[:, None, None], points[..., 1] - ground, np.nan)
    return Soles(points, height, ground, flat.observed_stances())


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


def measure(
    feet: Soles,
    solved: Clip,
    animated: Clip,
    flat: Clip,
    reached: Float64[np.ndarray, "frames legs"] | None = None,
) -> Measures:
    """The measures of a motion whose soles are `feet`; other arguments as for `place`.

    Corrections are relative to `animated`, slides to `flat`.
    """
    names, gap, stance = solved.rig.names, feet.gap, feet.stance
    size = body.ratio(solved.rig)
    known, visible = ~np.isnan(gap), VISIBLE * size
    in_ground, above = gap < -visible, gap > visible  # false for NaN
    slides = _of_stances(travelled(solved, flat, stance))
    known_slides, speed = slides[~np.isnan(slides)], _pops(solved, animated)
    hip, knee, ankle = (solved.joints_ws(role) for role in range(3))
    lengths = np.stack([solved.rig.thigh, solved.rig.shin], axis=-1)
    pelvis = solved.positions_ws[:, solved.rig.pelvis, 1]
    standing = np.where(stance, gap, np.nan)
    lost = _lost_clearances(feet, flat)
    known_lost = lost[~np.isnan(lost)]
    return Measures(
        penetration=_mean(np.any(in_ground, axis=1), np.any(known, axis=1)),
        penetration_stance=_mean(in_ground, stance & known),
        penetration_swing=_mean(in_ground, ~stance & known),
        penetration_depth=_mean(np.maximum(-gap, 0.0), known),
        floating=_mean(above, stance & known),
        floating_height=_mean(np.maximum(gap, 0.0), stance & known),
        contact=_mean(~in_ground & ~above, stance & known),
        groundless=float(np.mean(np.isnan(feet.ground))),
        slide=float(np.median(known_slides)) if known_slides.size else math.nan,
        foot_skating=_foot_skating(feet, solved, animated.cuts, size),
        pop=_extreme(speed, (*names, PELVIS)).value,
        pops=float(sum(len(contacts.runs(of_joint > visible)) for of_joint in speed.T)),
        knee_jerk=jerk(knee_angle(hip, knee, ankle), solved.fps, animated.cuts),
        pelvis_jerk=jerk(pelvis, solved.fps, animated.cuts),
        reached=math.nan if reached is None else _mean(reached, stance & ~np.isnan(reached)),
        straight=_mean(straight(hip, ankle, lengths), np.ones(stance.shape, bool)),
        lost_clearance=float(np.median(known_lost)) if known_lost.size else math.nan,
        worst={
            "penetration": _extreme(-gap, names),
            "floating": _extreme(standing, names),
            "contact": _extreme(np.abs(standing), names),
            "slide": _extreme(slides, names),
            "pop": _extreme(speed, (*names, PELVIS)),
            "lost_clearance": _extreme(lost, names),
        },
        size=size,
    )


def travelled(
    motion: Clip, flat: Clip, stance: Bool[np.ndarray, "frames legs"]
) -> Float64[np.ndarray, "frames legs"]:
    """How far a ball has gone over the ground since its stance began, beyond the animated one, m.

    NaN in swings.
    """
    steps = horizontal_steps(motion.joints_ws(3), flat.cuts)
    steps = steps - horizontal_steps(flat.joints_ws(3), flat.cuts)
    path = np.full(stance.shape, np.nan)
    for leg in range(stance.shape[1]):
        for first, last in contacts.runs(stance[:, leg]):
            path[first : last + 1, leg] = np.append(0.0, np.cumsum(steps[first:last, leg]))
    return path


def _of_stances(path: Float64[np.ndarray, "frames legs"]) -> Float64[np.ndarray, "frames legs"]:
    """The last value of each stance at its first frame; NaN elsewhere, and for single frames."""
    slides = np.full(path.shape, np.nan)
    for leg in range(path.shape[1]):
        for first, last in contacts.runs(~np.isnan(path[:, leg])):
            if last > first:
                slides[first, leg] = path[last, leg]
    return slides


def _foot_skating(feet: Soles, solved: Clip, cuts: Sequence[int], size: float) -> float:
    """The foot-skating ratio over all steps from one frame to the next; NaN if none is known."""
    height, steps = feet.height[..., 1], horizontal_steps(solved.joints_ws(3), cuts)
    in_contact = feet.stance & (height < CONTACT_HEIGHT * size)  # false for NaN
    known = ~np.isnan(height)
    skids = in_contact[1:] & in_contact[:-1] & (steps * solved.fps > SKID * size)
    return _mean(np.any(skids, axis=1), np.any(known[1:] & known[:-1], axis=1))


def _lost_clearances(feet: Soles, flat: Clip) -> Float64[np.ndarray, "frames legs"]:
    """By how much lower each swing is than animated, m, at its first frame; NaN elsewhere."""
    sole = sole_points(flat)[..., 1].min(axis=-1)
    lost = np.full(sole.shape, np.nan)
    for leg, stance in enumerate(feet.stance.T):
        if stance.any():
            over_floor = sole[:, leg] - np.median(sole[stance, leg])
            for first, last in contacts.runs(~stance):
                swing = slice(first, last + 1)
                highest = np.fmax.reduce(feet.gap[swing, leg])
                lost[first, leg] = over_floor[swing].max() - highest
    return lost


def horizontal_steps(
    points_ws: Float[np.ndarray, "frames legs 3"], cuts: Sequence[int] = ()
) -> Float[np.ndarray, "steps legs"]:
    """How far points move from frame to frame over the ground, m; not at all where a cut is."""
    steps = np.linalg.norm(np.diff(points_ws[..., [0, 2]], axis=0), axis=-1)
    steps[[cut - 1 for cut in cuts]] = 0.0
    return steps


def _pops(solved: Clip, animated: Clip) -> Float64[np.ndarray, "frames legs+1"]:
    """How fast corrections change, m in a `TICK`: of ankles relative to the pelvis, and its height.

    The change is taken over a tick, or over a frame where frames are longer. A steady change gives
    the same number at every frame rate. A jump gives its size at 60 Hz and its multiples, and half
    of it at 30 Hz, where it cannot be distinguished from a steady change within the frame. It
    stands at its last frame; NaN before it, and where a cut lies between.
    """
    (ankles, pelvis), (our_ankles, our_pelvis) = (
        (clip.joints_ws(2), clip.positions_ws[:, [clip.rig.pelvis]]) for clip in (animated, solved)
    )
    moved = our_pelvis - pelvis
    correction = np.concatenate([our_ankles - ankles - moved, moved * [0.0, 1.0, 0.0]], axis=1)
    frames = max(1, round(solved.fps * TICK))
    speed = np.full(correction.shape[:2], np.nan)
    change = np.linalg.norm(correction[frames:] - correction[:-frames], axis=-1)
    speed[frames:] = change * (solved.fps * TICK / frames)
    for cut in animated.cuts:  # if the solved body jumps anywhere else, it pops
        speed[cut : cut + frames] = np.nan
    return speed


def jerk(series: Float[np.ndarray, "*b"], fps: float, cuts: Sequence[int] = ()) -> float:
    """Root mean square of the third derivative, per s³, of a series with frames on its first axis.

    Taken by differences of four consecutive frames, none of which starts anew (`cuts`); NaN for
    shorter series.
    """
    third = np.diff(series, n=3, axis=0) * fps**3
    across = [first for cut in cuts for first in range(max(cut - 3, 0), min(cut, len(third)))]
    third = np.delete(third, across, axis=0)
    return float(np.sqrt(np.mean(third**2))) if third.size else float("nan")


def knee_angle(
    hip: Float[np.ndarray, "*b 3"],
    knee: Float[np.ndarray, "*b 3"],
    ankle: Float[np.ndarray, "*b 3"],
) -> Float[np.ndarray, "*b"]:
    """Angle between thigh and shin, rad; pi for a straight leg."""
    thigh, shin = hip - knee, ankle - knee
    across = np.linalg.norm(np.cross(thigh, shin), axis=-1)
    return np.arctan2(across, np.sum(thigh * shin, axis=-1))


def straight(
    hip: Float[np.ndarray, "frames legs 3"],
    ankle: Float[np.ndarray, "frames legs 3"],
    lengths: Float[np.ndarray, "legs 2"],
) -> Bool[np.ndarray, "frames legs"]:
    """Which legs are straight; lengths are those of thigh and shin, m."""
    reach = np.linalg.norm(ankle - hip, axis=-1)
    return reach / np.sum(lengths, axis=-1) >= STRAIGHT_REACH


def _mean(values: np.ndarray, among: Bool[np.ndarray, "*b"]) -> float:
    return float(np.mean(values[among])) if among.any() else math.nan


def _extreme(series: Float64[np.ndarray, "frames legs"], names: tuple[str, ...]) -> Extreme:
    if np.isnan(series).all():
        return Extreme(math.nan, 0, names[0])
    frame, leg = np.unravel_index(np.nanargmax(series), series.shape)
    return Extreme(float(series[frame, leg]), int(frame), names[leg])


def bounds(animated: Clip, feet: Soles) -> dict[str, float]:
    """The bounds of motions made from an animation, by measure, in SI units and fractions of 1.

    They depend on the animation, with its root where foot IK gets it, and on the ground below its
    feet alone, so that every system has the same.
    """
    size, ground = body.ratio(animated.rig), feet.ground[feet.stance]
    level = ground.size > 0 and float(np.ptp(ground)) < LEVEL  # false where some are NaN
    pelvis = animated.positions_ws[:, animated.rig.pelvis, 1]
    return {name: measure.bound for name, measure in BOUNDED.items()} | {
        "slide": size * (FLAT_SLIDE if level else VISIBLE),
        "pop": size * VISIBLE + swing_speed(feet, animated.fps) * TICK,
        "pelvis_jerk": MEASURES["pelvis_jerk"].bound + jerk(pelvis, animated.fps, animated.cuts),
    }


def swing_speed(feet: Soles, fps: float) -> float:
    """How fast corrections must change, m/s, for swings between footholds on the ground.

    A standing ball needs a correction of as much as it is in the ground. Between two stances that
    changes along a path of minimum jerk, whose fastest moment counts; of all swings, the largest.
    """
    fastest = 0.0
    for leg in range(feet.stance.shape[1]):
        height, runs = feet.height[:, leg, 1], contacts.runs(feet.stance[:, leg])
        for (_, last), (first, _) in zip(runs, runs[1:], strict=False):
            change = abs(height[first] - height[last])
            if not np.isnan(change):
                fastest = max(fastest, float(SWING_PEAK * change * fps / (first - last)))
    return fastest


CAUSES = {
    "missing": "the terrain does not lie below the whole path",
    "units": "the terrain is in another unit of length: one of its units is {0:.4g} m "
    "(--terrain-scale {0:.4g})",
    "offset": "all feet are {1:.0f} cm too {2}: check the clip's floor (--floor) and the height of "
    "the terrain (--terrain-offset)",
    "root": "the root stays on the animation's floor where the ground rises (use --root ground)",
    "clip": "the clip's own soles are up to {1:.0f} cm off its floor while they stand",
    "limit": "the system refuses the ground: {3} is {4}, and feet stand on it with {5}",
    "off": "the system leaves {1:.0f} % of these feet as animated, as `unreal` does while the "
    "character moves",
    "late": "rays met the step only once the foot was in it, {1:.0f} cm deep; `stride` looks ahead",
    "unknown": "none of missing ground, units, root, floor and offset; look at these frames",
}


class Cause(NamedTuple):
    """Why feet are off their ground, or pop; `likely_cause` explains the kinds."""

    kind: str
    amount: float = 0.0
    """`offset`, `clip`, `late`: m. `units`: metres for each unit of the terrain. `off`: 0..1.
    """
    limit: tuple[str, str, str] = ("", "", "")
    """`limit`: the parameter, its value, and one with which feet stand."""

    @property
    def words(self) -> str:
        """The cause, and its remedy."""
        side = "high" if self.amount > 0 else "low"
        return CAUSES[self.kind].format(self.amount, abs(100 * self.amount), side, *self.limit)

    @property
    def sentence(self) -> str:
        """What it causes, the cause, and its remedy."""
        effect = "the pop" if self.kind == "late" else "feet off the ground"
        return f"likely cause of {effect}: {self.words}"


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
    - `unknown`: none of these; `clip`, a cause in the clip on its floor, and `limit`, `off` and
      `late`, causes in the system, are for those who know these to find.

    Args:
        feet: the soles of the animation.
        animated: the animation, with its root where the motion has it.
        unit: of the terrain, as it was read, m.
        trial: tries their remedies; None assumes that they help.
    """
    visible = VISIBLE * body.ratio(animated.rig)
    standing = feet.stance & ~np.isnan(feet.gap)
    if not has_ground(feet):
        return Cause("missing")
    gap, ground = feet.gap[standing], np.fmax.reduce(feet.ground, axis=-1)[standing]

    def helps(cause: Cause) -> bool:
        if trial is None:
            return True
        remedied = trial(cause)
        return remedied is not None and is_much_closer(remedied, feet)

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


def has_ground(feet: Soles) -> bool:
    """Whether there is ground under enough standing feet."""
    known = feet.stance & ~np.isnan(feet.gap)
    return bool(known.sum() >= ENOUGH * feet.stance.sum())


def is_much_closer(feet: Soles, before: Soles) -> bool:
    """Whether standing feet have ground, and half of the gaps to it that they had, or less."""

    def mean_gap(soles: Soles) -> float:
        return _mean(np.abs(soles.gap), soles.stance & ~np.isnan(soles.gap))

    return has_ground(feet) and mean_gap(feet) <= HELPED * mean_gap(before)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if np.std(a) > 0 and np.std(b) > 0 else 0.0


def with_soles_of(captured: Clip, flat: Clip) -> Clip:
    """The captured clip with the soles of its flat animation.

    Its own are measured as if it stood on a floor, which is wrong on uneven ground.
    """
    rig, flat_rig = captured.measured_rig, flat.measured_rig
    if rig is None or flat_rig is None:
        return captured
    soles = {name: getattr(flat_rig, name) for name in SOLES}
    return replace(captured, measured_rig=replace(rig, **soles))
