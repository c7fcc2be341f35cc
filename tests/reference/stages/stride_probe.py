"""The probe of the `stride` reference: the ground between a foot's last and next position.

Feet slide along themselves to ground that supports more of a sole, and swing over uneven ground as
people lift and pitch theirs. One leg, one frame at a time. World space; heights are above the root
along the up of the leg, m.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from reference import maths
from reference.characters import Leg
from reference.maths import Array, across, clip, cross, length, lerp, rotate, smooth01, unit
from reference.stages.limits import FADE, gentle, low_enough
from reference.terrain import Hit

PATH = (np.arange(8) + 0.5) / 8  # where ground is looked for, parts of the way between footholds
EDGE_FRACTION = 0.15  # of the swing's time at either end, over which the path fades out

# Of a sole: fifths from its ball, those that it slides at most, those from its plane that support.
HEEL, TIP = -4, 1
FURTHEST = 2
SUPPORTS, DOES_NOT = 0.3, 0.7
SUPPORT_FADE, INDIFFERENCE = 0.10, 0.01  # of the sole
ASIDE_COSTS, HEIGHT_COSTS = 0.03, 0.1  # of the sole, for each fifth of it

# Of a swing: parts of its time when each bump is highest.
SHARPNESS = 7.0
UNEVEN = 0.05  # m
HIGHEST = 0.3  # m, of the steps that people were captured on
ON_HEEL = 0.08  # rad
HELD, CLEAR, RISE, FALL, OVER, TOES_UP, TOES_DOWN = 0.28, 0.55, 0.52, 0.31, 0.455, 0.23, 0.75


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
    lift: float = 0.0
    pitch: float = 0.0

    def way(self, part: float) -> Array:
        """The point of the way to the next foothold after a part of it."""
        bend = 4.0 * part * (1.0 - part) * self.aside
        return self.last + (self.next - self.last) * part + bend


class Slide(NamedTuple):
    """How far forward a foot slides, m, and the share of its sole that is supported there."""

    forward: float
    support: float


@dataclass
class UnderBall:
    """The ground under the ball of a leg, as its stride leads from one foothold to the other."""

    stride: Swing
    found: bool
    height: float = 0.0
    normal: Array = field(default_factory=lambda: np.zeros(3))
    step: float = 0.0
    over: float = 0.0
    sure: float = 0.0
    top: float = 0.0
    platform: int = -1
    path: Sequence[float | None] = ()  # heights along the way; None without ground


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
        return Swing(last_ws, next_ws, float(stride.fraction[i]), aside, known=True)
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
    slides = [slide(leg, look(leg, pos), stride.known) for pos in (stride.last, stride.next)]
    last, following = (
        pos + slide.forward * leg.heading_ws
        for pos, slide in zip((stride.last, stride.next), slides, strict=True)
    )
    done = eased(leg, stride.fraction)
    forward, share = (lerp(start, end, done) for start, end in zip(*slides, strict=True))
    return replace(stride, last=last, next=following), Slide(forward, share)


def slide(leg: Leg, foothold: Hit, known: bool) -> Slide:
    """Where the foot that would stand with its ball on this foothold, if known, stands instead."""
    if not foothold.found:
        return Slide(0.0, 0.0)
    up, heading = leg.up, leg.heading_ws
    # The sole reaches from behind the ankle to beyond the ball.
    drop = leg["target.foot_height"] - leg["probe.ball_height"]
    between = math.sqrt(max(leg.rig.foot**2 - drop**2, 0.0))
    fifth = (between + leg["probe.heel_length"] + leg["probe.toe_length"]) / 5.0
    highest, deepest = leg["probe.max_step_up"], leg["probe.max_step_down"]
    hits = {
        place: leg.terrain.cast(
            foothold.point + place * fifth * heading + highest * up,
            highest + deepest,
            int(leg["probe.layers"]),
        )
        for place in range(HEEL - FURTHEST, TIP + FURTHEST + 1)
    }

    def fit(ball: int) -> tuple[float, float]:
        """Shares of the sole that are supported and that stick in the ground."""
        on, stuck = [], []
        normal = hits[ball].normal
        slope = -float(across(heading, up) @ normal) / float(normal @ up)
        for place in range(ball + HEEL, ball + TIP + 1):
            over = float((hits[place].point - hits[ball].point) @ up)
            over -= slope * fifth * (place - ball)
            off = smooth01((abs(over) / fifth - SUPPORTS) / (DOES_NOT - SUPPORTS))
            found = hits[place].found
            on.append(1.0 - off if found else 0.0)
            stuck.append(off if found and over > 0.0 else 0.0)
        return float(np.mean(on)), float(np.mean(stuck))

    enough, furthest = leg["probe.min_sole"], leg["probe.max_slide"]
    places = range(-FURTHEST, FURTHEST + 1)
    supported = {place: fit(place) for place in places}
    here, stuck_here = supported[0]
    if not known:
        return Slide(0.0, here)
    gains = []
    for place, (share, stuck) in supported.items():
        climbed = abs(float((hits[place].point - hits[0].point) @ up))
        gain = min(share - stuck, enough) - ASIDE_COSTS * abs(place)
        gain -= HEIGHT_COSTS * climbed / fifth
        gains.append(gain - 2.0 * smooth01((abs(place) * fifth - furthest) / fifth))
    chance = np.exp((np.array(gains) - max(gains)) / INDIFFERENCE)
    chance /= chance.sum()
    need = smooth01((enough - (here - stuck_here)) / SUPPORT_FADE)
    there = float(chance @ [share for share, _ in supported.values()])
    return Slide(need * fifth * float(chance @ places), lerp(here, there, need))


# The ground under a foot


def under_ball(leg: Leg, stride: Swing) -> UnderBall:
    """The ground under the ball of a leg in this stride."""
    last, following = (look(leg, pos) for pos in (stride.last, stride.next))
    if not last.found and not following.found:
        return UnderBall(stride, found=False)
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
    evened = [at - slope * part for at, part in zip(path, PATH, strict=True) if at is not None]
    over = max(0.0, max(evened) - low - max(step, 0.0)) if evened else 0.0
    over *= 1.0 - smooth01((over - leg["probe.max_step_up"]) / FADE)
    high = lerp(low, high, sure)
    next_normal = last.normal + sure * (following.normal - last.normal)

    risen = eased(leg, stride.fraction)
    squared = float(across_ws @ across_ws)
    on_its_way = 0.0
    if squared > 0.0:
        on_its_way = float((leg.pos_ws("toe") - stride.last) @ across_ws) / squared
    ground = low + sure * (slope * clip(on_its_way, 0.0, 1.0) + step * risen)
    normal = unit(last.normal + risen * (next_normal - last.normal), leg.up)
    platform = following.platform if sure * risen > 0.5 else last.platform
    return UnderBall(
        stride, True, ground, normal, step, over, sure * arrives, max(low, high), platform, path
    )


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


def ground_of_stride(leg: Leg, ball: UnderBall, below: float) -> tuple[Hit, Swing]:
    """The ground under the ankle of a leg, and its swing.

    `below` is how far its ground is below that of another foot, m.
    """
    ankle, ball_ws, stride = leg.pos_ws("ankle"), leg.pos_ws("toe"), ball.stride
    here = level(leg, ankle)
    if not ball.found:
        return Hit(False, here, leg.up), stride
    lift, pitch = beyond_animation(leg, ball, below)
    stride = replace(stride, lift=lift, pitch=pitch)

    def beside_ball(point: Array) -> float:
        """Height of the ground under a point of the foot, on the plane under its ball, m."""
        return ball.height + climb(leg, ball.normal, point - ball_ws)

    def lift_over_edges() -> float:
        """How far the ground must be raised for the animated sole to clear what is on its path."""
        axes, need = leg.world_from_foot, 0.0
        behind = np.array([0.0, -leg["target.foot_height"], -leg["probe.heel_length"]])
        sole = ball_ws - leg.up * leg["probe.ball_height"]
        tip = sole + rotate(axes, maths.Z * leg["probe.toe_length"])
        turn = maths.from_axis_angle(axis_of_pitch(leg), pitch)
        for part, edge in zip(PATH, ball.path, strict=True):
            if edge is None:
                continue
            counts = 1.0 - smooth01((edge - ball.top - leg["probe.max_step_up"]) / FADE)
            for point in (ankle + rotate(axes, behind), sole, tip):
                moved = ankle + rotate(turn, point - ankle)
                away = length(across(moved - stride.way(part), leg.up))
                over = edge - leg["probe.way_slope"] * away - beside_ball(point)
                # The clearance that the animation has over its own floor is subtracted.
                clearance = max(height(leg, point) - leg["probe.clearance"], 0.0)
                added = lift + float((moved - point) @ leg.up)
                need = max(need, counts * over - clearance - added)
        return need

    passed, left = stride.fraction, 1.0 - stride.fraction
    window = smooth01(passed / EDGE_FRACTION) * smooth01(left / EDGE_FRACTION)
    point = here + leg.up * (beside_ball(ankle) + window * lift_over_edges())
    return Hit(True, point, ball.normal, ball.platform), stride


def climbable(leg: Leg, heights: Sequence[float | None], slope: float) -> float:
    """From 0 to 1, how far the easiest choice of points to step on has steps that are low enough.

    All choices are tried: any points of the way, in their order, between the two footholds.
    """
    pairs = zip(heights, (0.0, *PATH, 1.0), strict=True)
    start, *middle, end = [at - slope * place for at, place in pairs if at is not None]
    best = 0.0
    for count in range(len(middle) + 1):
        for chosen in itertools.combinations(middle, count):
            steps = np.diff([start, *chosen, end])
            best = max(best, min(low_enough(leg, float(step)) for step in steps))
            if best == 1.0:
                return best
    return best


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


def beyond_animation(leg: Leg, ball: UnderBall, below: float) -> tuple[float, float]:
    """How much higher the ankle is, m, and how much further the toes are up, rad.

    `below` is how far the ground of this foot is below that of another, m.
    """
    if leg["probe.swing_as_animated"]:
        return 0.0, 0.0
    fraction, ball_ws = ball.stride.fraction, leg.pos_ws("toe")
    animated = max(height(leg, ball_ws) - leg["probe.ball_height"], 0.0)
    step = clip(ball.step, -HIGHEST, HIGHEST)
    effort = abs(step) + ball.over
    uneven = smooth01(effort / UNEVEN)
    lift = uneven * leg["probe.toe_clearance"] * bump(fraction, CLEAR)
    lift -= uneven * leg["probe.held_lift"] * animated * bump(fraction, HELD)
    lift += leg["probe.lift_per_rise"] * max(step, 0.0) * bump(fraction, RISE)
    lift += leg["probe.lift_per_fall"] * max(-step, 0.0) * bump(fraction, FALL)
    lift += leg["probe.lift_over"] * ball.over * bump(fraction, OVER)
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
