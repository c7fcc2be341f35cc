"""The probe of the `stride` reference: the ground between a foot's last and next position.

Feet slide along themselves to ground that supports more of a sole, and swing over uneven ground as
people lift and pitch theirs. One leg, one frame at a time. World space; heights are above the root
along the up of the leg, m.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from reference import maths
from reference.characters import Leg
from reference.maths import Array, across, clip, cross, length, lerp, rotate, smooth01, unit
from reference.stages.limits import FADE, gentle, low_enough
from reference.terrain import Hit

PATH = (np.arange(8) + 0.5) / 8  # where ground is looked for, parts of the way between footholds
GIVES_WAY = 0.3  # of an arc over an edge, in which the lift gives way to it
STAIRS = 0.75  # rise over run

# Of a sole: tenths from its ball, those that it slides at most, parts from its plane that support.
HEEL, TIP = -8, 2
FURTHEST = 4
SUPPORTS, DOES_NOT = 0.06, 0.14
STICKING, SLIDING = 4.0, 0.15  # cost of all of a sole that sticks in the ground, or slides away

# Of a swing: parts of its time when each bump is highest.
SHARPNESS = 7.0
UNEVEN = 0.05  # m
HIGHEST = 0.3  # m, of the steps that people were captured on
ON_HEEL = 0.08  # rad
HELD, CLEAR, RISE, FALL, OVER = 0.28, 0.55, 0.52, 0.31, 0.455
HIGHEST_OVER = 0.175  # m
TOES_UP, TOES_DOWN = 0.23, 0.75


@dataclass
class Swing:
    """Where a leg is in its stride; positions at the height of the root.

    The animation gives `known` footholds; others are predicted. `lift`, m, and `pitch`, rad, toes
    up, are what its swing adds to the animation.
    """

    last: Array
    next: Array
    fraction: float
    aside: Array = field(default_factory=lambda: np.zeros(3))
    known: bool = False
    last_ahead: Array | None = None
    next_ahead: Array | None = None
    lift: float = 0.0
    pitch: float = 0.0

    def way(self, part: float) -> Array:
        """The point of the way to the next foothold after a part of it."""
        bend = 4.0 * part * (1.0 - part) * self.aside
        return self.last + (self.next - self.last) * part + bend


class Slide(NamedTuple):
    """How a foot slides, m, and the share of its sole that is supported there."""

    way: Array
    support: float


class Landing(NamedTuple):
    """Where a swing ends: how far away, level and up, m, and how sure that is, 0..1."""

    way: Array
    rise: float
    fraction: float
    certain: float


@dataclass
class UnderBall:
    """The ground under the ball of a leg, as its stride leads from one foothold to the other."""

    stride: Swing
    found: float
    height: float = 0.0
    normal: Array = field(default_factory=lambda: np.zeros(3))
    heel_rise: float = 0.0
    heel_found: float = 0.0
    end_height: float = 0.0
    next_height: float = 0.0
    step: float = 0.0
    over: float = 0.0
    edge: float = 0.0
    sure: float = 0.0
    platform: int = -1

    def under_ankle(self, leg: Leg) -> tuple[float, Array]:
        """Height of the ground below the ankle, m, and the normal from there to the ball."""
        arm = across(leg.pos_ws("ankle") - leg.pos_ws("toe"), leg.up)
        plane = climb(leg, self.normal, arm)
        rise = lerp(plane, shared_rise(plane, self.heel_rise), self.heel_found)
        facing, squared = float(self.normal @ leg.up), float(arm @ arm)
        missing = rise + float(arm @ self.normal) / facing
        steeper = missing / squared if squared > 0.0 else 0.0
        return self.height + rise, unit(self.normal - facing * steeper * arm, leg.up)


def height(leg: Leg, point: Array) -> float:
    """Height of a point above the root, m."""
    return float((point - leg.frame.world_from_model.pos) @ leg.up)


def level(leg: Leg, point: Array) -> Array:
    """The point moved to the height of the root."""
    return point - leg.up * height(leg, point)


def look(leg: Leg, level_point: Array) -> Hit:
    """The ground at that position, from `ray_up` above the root's height to `ray_down` below it."""
    above = leg["probe.ray_up"]
    reach, mask = above + leg["probe.ray_down"], int(leg["probe.layers"])
    return leg.terrain.cast(level_point + leg.up * above, reach, mask)


def swing(leg: Leg, planted: bool) -> Swing:
    """The swing from the labels of the animation; without them, from the character's velocity."""
    stride, i = leg.frame.stride, leg.index
    if stride.known[i] > 0.5 and leg["probe.use_strides"]:
        last_ws, next_ws = level(leg, stride.last_ws[i]), level(leg, stride.next_ws[i])
        aside = np.zeros(3) if stride.aside_ws is None else across(stride.aside_ws[i], leg.up)
        last_ahead, next_ahead = (
            None if ways is None else ways[i]
            for ways in (stride.last_ahead_ws, stride.next_ahead_ws)
        )
        return Swing(
            last_ws, next_ws, float(stride.fraction[i]), aside, True, last_ahead, next_ahead
        )
    stance_time, swing_time = leg["probe.stance_time"], leg["probe.swing_time"]
    velocity = across(leg.frame.travel_ws, leg.up)
    here = level(leg, leg.pos_ws("toe"))
    ahead = 0.0  # s by which the foot is ahead of its hip
    if velocity @ velocity > 0.0:
        way = leg.pos_ws("ankle") - leg.pos_ws("hip")
        ahead = float(way @ velocity / (velocity @ velocity))
    ahead = clip(ahead, -stance_time / 2.0, stance_time / 2.0)
    if planted:
        return Swing(here, here + velocity * (stance_time + swing_time), 0.0)
    fraction = 0.5 + ahead / stance_time
    to_come = (stance_time / 2.0 - ahead) + (1.0 - fraction) * swing_time
    gone = (stance_time / 2.0 + ahead) + fraction * swing_time
    return Swing(here - velocity * gone, here + velocity * to_come, fraction)


def eased(leg: Leg, fraction: float) -> float:
    """The part of its way between two footholds that a foot has done at a part of its swing."""
    start, end, k = leg["probe.rise_start"], leg["probe.rise_end"], leg["probe.steepness"]
    x = clip((fraction - start) / (end - start), 0.0, 1.0)
    return x**k / (x**k + (1.0 - x) ** k)


# Slides to support


def slide_to_support(leg: Leg, stride: Swing) -> tuple[Swing, Slide]:
    """The stride between footholds that support more of the sole, and how far the foot slides."""
    ends = (stride.last, stride.last_ahead), (stride.next, stride.next_ahead)
    slides = [slide(leg, pos, heading(leg, ahead), stride.known) for pos, ahead in ends]
    last, following = (pos + slide.way for (pos, _), slide in zip(ends, slides, strict=True))
    done = eased(leg, stride.fraction)
    start, end = slides
    way = start.way + done * (end.way - start.way)
    moved = Slide(way, lerp(start.support, end.support, done))
    return replace(stride, last=last, next=following), moved


def heading(leg: Leg, ahead: Array | None) -> Array:
    """Where a foot points at a foothold, at right angles to up; without one, where it does now."""
    return leg.heading_ws if ahead is None else unit(across(ahead, leg.up), leg.heading_ws)


def slide(leg: Leg, level_point: Array, heading: Array, known: bool) -> Slide:
    """Where the foot that would stand with its ball here, if that is known, stands instead."""
    up, foothold = leg.up, look(leg, level_point)
    # The sole reaches from behind the ankle to beyond the ball.
    drop = leg["target.foot_height"] - leg["probe.ball_height"]
    between = math.sqrt(max(leg.rig.foot**2 - drop**2, 0.0))
    sole = between + leg["probe.heel_length"] + leg["probe.toe_length"]
    highest, deepest = leg["probe.max_step_up"], leg["probe.max_step_down"]
    if foothold.found:
        lowest = height(leg, foothold.point) - deepest
        start = max(height(leg, foothold.point), 0.0) + highest
    else:
        way = length(level_point - leg.frame.world_from_model.pos)
        margin = STAIRS * max(way - highest, 0.0)
        start, lowest = highest + margin, -deepest - margin
    hits = {
        place: leg.terrain.cast(
            level_point + place / 10.0 * sole * heading + start * up,
            start - lowest,
            int(leg["probe.layers"]),
        )
        for place in range(HEEL - FURTHEST, TIP + FURTHEST + 1)
    }

    def fit(ball: int) -> tuple[float, float]:
        """Shares of the sole that are supported and that stick in the ground."""
        if not hits[ball].found:
            return 0.0, 0.0
        on, stuck = [], []
        normal = hits[ball].normal
        slope = -float(across(heading, up) @ normal) / float(normal @ up)
        for place in range(ball + HEEL, ball + TIP + 1):
            over = float((hits[place].point - hits[ball].point) @ up) / sole
            over -= slope * (place - ball) / 10.0
            off = smooth01((abs(over) - SUPPORTS) / (DOES_NOT - SUPPORTS))
            found = hits[place].found
            on.append(1.0 - off if found else 0.0)
            stuck.append(off if found and over > 0.0 else 0.0)
        firm = gentle(leg, normal)
        return firm * float(np.mean(on)), firm * float(np.mean(stuck))

    def cost(place: int) -> float:
        share, stuck = fit(place)
        far = abs(place) / 10.0
        lack = max(leg["probe.min_sole"] - share + STICKING * stuck, 0.0)
        return (
            lack
            + SLIDING * abs(place - 0.1) / 10.0
            + 6.0 * smooth01(5.0 * (far - leg["probe.max_slide"] / sole))
        )

    places = sorted(range(FURTHEST, -FURTHEST - 1, -1), key=abs) if known else [0]
    best = min(places, key=cost)
    return Slide(best / 10.0 * sole * heading, fit(best)[0])


# The ground under a foot


def under_ball(leg: Leg, stride: Swing) -> UnderBall:
    """The ground under the ball of a leg in this stride."""
    last, following = (look(leg, pos) for pos in (stride.last, stride.next))
    if not last.found and not following.found:
        return UnderBall(stride, found=0.0)
    risen = eased(leg, stride.fraction)
    found = lerp(float(last.found), float(following.found), risen)
    arrives = float(following.found)  # a swing to nowhere stays as animated
    last = last if last.found else following
    following = following if following.found else last

    low, high = height(leg, last.point), height(leg, following.point)
    # What the two footholds rise by is a slope, as far as both planes rise so far, and a step.
    across_ws = across(stride.next - stride.last, leg.up)
    slope = shared_rise(high - low, *(climb(leg, x.normal, across_ws) for x in (last, following)))
    step = high - low - slope
    hits = [look(leg, stride.way(part)) for part in PATH]
    path = [height(leg, hit.point) if hit.found else None for hit in hits]
    sure = gentle(leg, following.normal) * climbable(leg, [low, *path, high], slope)
    evened = [
        (part, at - slope * part - low)
        for at, part in zip(path, PATH, strict=True)
        if at is not None
    ]
    chord = sure * arrives * step
    over, edge = (
        highest(leg, heights)
        for heights in (
            [at - max(step, 0.0) for _, at in evened],
            [at - chord * part for part, at in evened],
        )
    )
    stair = easiest(lambda _, step: -abs(step), leg, [low, *path, high], slope)
    next_normal = last.normal + sure * (following.normal - last.normal)

    squared = float(across_ws @ across_ws)
    on_its_way = 0.0
    if squared > 0.0:
        on_its_way = float((leg.pos_ws("toe") - stride.last) @ across_ws) / squared
    ground = low + sure * (slope * clip(on_its_way, 0.0, 1.0) + step * risen)
    normal = unit(last.normal + risen * (next_normal - last.normal), leg.up)
    platform = following.platform if sure * risen > 0.5 else last.platform
    step = clip(step, stair, -stair)
    heel_rise, heel_found = 0.0, 0.0
    arm = leg.pos_ws("ankle") - leg.pos_ws("toe")
    share = sure * arrives * risen
    for start, at, part in ((stride.last, low, 1.0 - share), (stride.next, high, share)):
        heel = look(leg, level(leg, start + arm))
        if heel.found:
            heel_rise += part * (height(leg, heel.point) - at)
            heel_found += part
    if heel_found > 0.0:
        heel_rise /= heel_found
    plane = climb(leg, normal, arm)
    heel = look(leg, level(leg, stride.next + arm))
    end = high + (shared_rise(plane, height(leg, heel.point) - high) if heel.found else plane)
    under = ground, normal, heel_rise, heel_found, end, high - slope
    return UnderBall(stride, found, *under, step, over, edge, sure * arrives, platform)


def highest(leg: Leg, heights: Sequence[float]) -> float:
    """The highest of these, m, 0 if all are lower; what nobody can step onto does not count."""
    limit = leg["probe.max_step_up"]
    counting = [x * (1.0 - smooth01((x - limit) / FADE)) for x in heights if x > 0.0]
    return max(counting, default=0.0)


def below_others(leg: Leg, legs: list[Leg], balls: list[UnderBall]) -> float:
    """How far the ground of this foot is below the highest of the others, m, without slopes."""
    ball, below = balls[leg.index], 0.0
    for other, beside in zip(legs, balls, strict=True):
        if other is leg or not beside.found or not ball.found:
            continue
        way = other.pos_ws("toe") - leg.pos_ws("toe")
        rise = beside.height - ball.height
        slope = shared_rise(rise, climb(leg, ball.normal, way), climb(other, beside.normal, way))
        below = max(below, rise - slope)
    return below


def above_others(leg: Leg, balls: list[UnderBall]) -> float:
    """How far the next foothold is above the ground of all other feet, m, without its slope."""
    others = [ball.height for ball in balls if ball is not balls[leg.index] and ball.found]
    return max(balls[leg.index].next_height - max(others, default=-math.inf), 0.0)


def ground_of_stride(leg: Leg, ball: UnderBall, below: float, above: float) -> tuple[Hit, Swing]:
    """The ground under the ankle of a leg, and its swing.

    `below` is how far its ground is below that of another foot, m, and `above` how far its next
    foothold is above the ground of all others.
    """
    ankle, ball_ws, stride = leg.pos_ws("ankle"), leg.pos_ws("toe"), ball.stride
    here = level(leg, ankle)
    if not ball.found:
        return Hit(False, here, leg.up), stride
    lift, pitch = beyond_animation(leg, ball, below, above)

    def lift_over_edges() -> float:
        """How far the ground must be raised for the animated sole to clear what is on its path."""
        axes = leg.world_from_foot
        behind = np.array([0.0, -leg["target.foot_height"], -leg["probe.heel_length"]])
        sole = ball_ws - leg.up * leg["probe.ball_height"]
        tip = sole + rotate(axes, maths.Z * leg["probe.toe_length"])
        turn = maths.from_axis_angle(axis_of_pitch(leg), pitch)
        arc = ball.edge * math.sin(math.pi * stride.fraction) ** 2
        lowest = math.inf
        for point in (ankle + rotate(axes, behind), sole, tip):
            # The clearance that the animation has over its own floor counts, not its depth.
            clearance = max(height(leg, point) - leg["probe.clearance"], 0.0)
            moved = ankle + rotate(turn, point - ankle)
            lowest = min(lowest, clearance + lift + float((moved - point) @ leg.up))
        return 0.5 * (arc - lowest + math.hypot(arc - lowest, GIVES_WAY * arc))

    ground, under = ball.under_ankle(leg)
    point = here + leg.up * (ground + lift_over_edges())
    stride = replace(stride, lift=lift * ball.found, pitch=pitch * ball.found)
    normal = unit(leg.up + ball.found * (under - leg.up), leg.up)
    return Hit(ball.found, point, normal, ball.platform), stride


def landing(leg: Leg, ball: UnderBall, hit: Hit) -> Landing:
    """Where the swing of a leg over the ground that was hit below its ankle ends."""
    stride = ball.stride
    way = stride.next - level(leg, leg.pos_ws("toe"))
    rise = ball.end_height - height(leg, hit.point)
    certain = ball.sure * stride.known
    return Landing(across(way, leg.up), rise, stride.fraction, certain)


def climbable(leg: Leg, heights: Sequence[float | None], slope: float) -> float:
    """From 0 to 1, how far the easiest choice of points has steps that are low enough."""
    return easiest(low_enough, leg, heights, slope)


def easiest(
    ease: Callable[[Leg, float], float], leg: Leg, heights: Sequence[float | None], slope: float
) -> float:
    """The ease of the hardest step of the easiest choice of points to step on.

    All choices are tried: any points of the way, in their order, between the two footholds.
    """
    pairs = zip(heights, (0.0, *PATH, 1.0), strict=True)
    start, *middle, end = [at - slope * place for at, place in pairs if at is not None]
    steps = itertools.combinations([start, *middle, end], 2)
    eases = {(before, after): ease(leg, float(after - before)) for before, after in steps}
    choices = (
        chosen
        for count in range(len(middle) + 1)
        for chosen in itertools.combinations(middle, count)
    )
    return max(
        min(eases[step] for step in itertools.pairwise([start, *chosen, end])) for chosen in choices
    )


def climb(leg: Leg, normal: Array, moved: Array) -> float:
    """What a plane with this normal rises by along the horizontal part of a move, m."""
    facing = float(normal @ leg.up)
    if facing <= 0.0:
        return 0.0
    return -float(across(moved, leg.up) @ normal) / facing * gentle(leg, normal)


def shared_rise(*rises: float) -> float:
    """The smallest of rises that are all up or all down, m; else 0."""
    if all(rise > 0.0 for rise in rises):
        return min(rises)
    return max(rises) if all(rise < 0.0 for rise in rises) else 0.0


# Swings over uneven ground


def bump(x: float, peak: float) -> float:
    """1 at the peak, 0 at both ends of the swing."""
    if x <= 0.0 or x >= 1.0:
        return 0.0
    return ((x / peak) ** peak * ((1.0 - x) / (1.0 - peak)) ** (1.0 - peak)) ** SHARPNESS


def axis_of_pitch(leg: Leg) -> Array:
    """The level axis, unit, about which a positive angle lifts the toes."""
    return cross(leg.heading_ws, leg.up)


def beyond_animation(leg: Leg, ball: UnderBall, below: float, above: float) -> tuple[float, float]:
    """How much higher the ankle is, m, and how much further the toes are up, rad.

    `below` is how far the ground of this foot is below that of another, m, and `above` how far its
    next foothold is above the ground of all others.
    """
    if leg["probe.swing_as_animated"]:
        return 0.0, 0.0
    fraction, ball_ws = ball.stride.fraction, leg.pos_ws("toe")
    animated = max(height(leg, ball_ws) - leg["probe.ball_height"], 0.0)
    step = clip(ball.step, -HIGHEST, HIGHEST)
    over = min(ball.over, HIGHEST_OVER)
    effort = abs(step) + over
    uneven = smooth01(effort / UNEVEN)
    lift = uneven * leg["probe.toe_clearance"] * bump(fraction, CLEAR)
    lift -= uneven * leg["probe.held_lift"] * animated * bump(fraction, HELD)
    ahead = min(above, max(step, 0.0))
    lift += leg["probe.lift_per_rise"] * (max(step, 0.0) - ahead) * bump(fraction, RISE)
    lift += leg["probe.lift_ahead"] * ahead * (1.0 - ahead / HIGHEST) * bump(fraction, RISE)
    lift += leg["probe.lift_per_fall"] * max(-step, 0.0) * bump(fraction, FALL)
    lift += leg["probe.lift_over"] * over * bump(fraction, OVER)
    lift += (ball.over - over) * math.sin(math.pi * fraction) ** 2
    down = uneven * leg["probe.toes_down"] + effort * leg["probe.toes_down_per_height"]
    pitch = uneven * leg["probe.toes_up"] * bump(fraction, TOES_UP)
    pitch -= down * bump(fraction, TOES_DOWN)
    pointing = rotate(leg.world_from_foot, maths.Z)
    animated_pitch = math.asin(clip(float(pointing @ leg.up), -1.0, 1.0))
    pitch *= ball.sure
    pitch -= leg["probe.toes_first"] * below * smooth01(animated_pitch / ON_HEEL)
    arm = leg.pos_ws("ankle") - ball_ws
    turned = rotate(maths.from_axis_angle(axis_of_pitch(leg), pitch), arm)
    return ball.sure * lift + float((turned - arm) @ leg.up), pitch
