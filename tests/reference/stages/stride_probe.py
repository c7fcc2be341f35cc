"""The probe of the `stride` reference: the ground between a foot's last and next position.

One leg, one frame at a time. World space; heights are above the root along the up of the leg, m.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from reference import maths
from reference.characters import Frame, Ground, Parameters, Rig, world_from_foot
from reference.maths import Array, across, apply, clip, length, lerp, rotate, smooth01, unit
from reference.stages import ground, support
from reference.stages.limits import FADE, gentle, low_enough
from reference.stages.swing import axis_of_pitch, beyond_animation
from reference.terrain import Hit

PATH_POINTS = 8
EDGE_FRACTION = 0.15  # of the swing's time at either end, over which the path fades out


@dataclass
class Swing:
    """Where a leg is in its stride; positions at the height of the root.

    The animation gives `known` footholds; others are predicted. `lift`, m, and `pitch`, rad, toes
    up, are what its swing adds to the animation.
    """

    last: Array
    next: Array
    fraction: float
    aside: Array | None = None
    known: bool = False
    lift: float = 0.0
    pitch: float = 0.0

    def way(self, part: float) -> Array:
        """The point of the way to the next foothold after a part of it."""
        point = self.last + (self.next - self.last) * part
        return point if self.aside is None else point + 4.0 * part * (1.0 - part) * self.aside


def level(frame: Frame, up: Array, point: Array) -> Array:
    """The point moved to the height of the root."""
    return point - up * height(frame, up, point)


def height(frame: Frame, up: Array, point: Array) -> float:
    """Height of a point above the root, m."""
    return float((point - frame.world_from_model.pos) @ up)


def look(parameters: Parameters, terrain: Ground, leg: int, level_point: Array) -> Hit:
    """The ground at that position, from `ray_up` above the root's height to `ray_down` below it."""
    above = parameters.of_leg("probe.ray_up", leg)
    reach = above + parameters.of_leg("probe.ray_down", leg)
    mask = int(parameters.of_leg("probe.layers", leg))
    return terrain.cast(level_point + terrain.up * above, reach, mask)


def swing(parameters: Parameters, frame: Frame, leg: int, up: Array, planted: bool) -> Swing:
    """The swing from the labels of the animation; without them, from the character's velocity."""
    stride = frame.stride
    if stride.known[leg] > 0.5 and parameters.of_leg("probe.use_strides", leg):
        last_ws = level(frame, up, stride.last_ws[leg])
        next_ws = level(frame, up, stride.next_ws[leg])
        aside = None if stride.aside_ws is None else across(stride.aside_ws[leg], up)
        return Swing(last_ws, next_ws, float(stride.fraction[leg]), aside, known=True)
    stance_time = parameters.of_leg("probe.stance_time", leg)
    swing_time = parameters.of_leg("probe.swing_time", leg)
    velocity = across(frame.travel_ws, up)
    here, hip, ankle = (
        apply(frame.world_from_model, getattr(frame, joint).pos[leg])
        for joint in ("toe", "hip", "ankle")
    )
    here = level(frame, up, here)
    ahead = 0.0  # s by which the foot is ahead of its hip
    if velocity @ velocity > 0.0:
        ahead = float((ankle - hip) @ velocity / (velocity @ velocity))
    ahead = clip(ahead, -stance_time / 2.0, stance_time / 2.0)
    if planted:
        return Swing(here, here + velocity * (stance_time + swing_time), 0.0)
    fraction = 0.5 + ahead / stance_time
    to_come = (stance_time / 2.0 - ahead) + (1.0 - fraction) * swing_time
    gone = (stance_time / 2.0 + ahead) + fraction * swing_time
    return Swing(here - velocity * gone, here + velocity * to_come, fraction)


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


def eased(parameters: Parameters, leg: int, fraction: float) -> float:
    """The part of its way between two footholds that a foot has done at a part of its swing."""
    start = parameters.of_leg("probe.rise_start", leg)
    end = parameters.of_leg("probe.rise_end", leg)
    x = clip((fraction - start) / (end - start), 0.0, 1.0)
    k = parameters.of_leg("probe.steepness", leg)
    return x**k / (x**k + (1.0 - x) ** k)


def slide_to_support(
    parameters: Parameters, rig: Rig, terrain: Ground, frame: Frame, leg: int, stride: Swing
) -> tuple[Swing, support.Slide]:
    """The stride between footholds that support more of the sole, and how far the foot slides."""
    slides = [
        support.slide(parameters, rig, terrain, frame, leg, foothold, stride.known)
        for foothold in (look(parameters, terrain, leg, pos) for pos in (stride.last, stride.next))
    ]
    heading = ground.heading(rig, frame, leg, terrain.up)
    last, following = (
        pos + slide.forward * heading
        for pos, slide in zip((stride.last, stride.next), slides, strict=True)
    )
    done = eased(parameters, leg, stride.fraction)
    forward, share = (lerp(start, end, done) for start, end in zip(*slides, strict=True))
    return replace(stride, last=last, next=following), support.Slide(forward, share)


def under_ball(
    parameters: Parameters, terrain: Ground, frame: Frame, leg: int, stride: Swing
) -> UnderBall:
    """The ground under the ball of a leg in this stride."""
    up = terrain.up
    last, following = (look(parameters, terrain, leg, pos) for pos in (stride.last, stride.next))
    if not last.found and not following.found:
        return UnderBall(stride, found=False)
    arrives = float(following.found)  # a swing to nowhere stays as animated
    last = last if last.found else following
    following = following if following.found else last

    low, high = height(frame, up, last.point), height(frame, up, following.point)
    # What the two footholds rise by is a slope, as far as both planes rise so far, and a step.
    across_ws = across(stride.next - stride.last, up)
    climbs = [climb(parameters, leg, up, hit.normal, across_ws) for hit in (last, following)]
    slope = shared_rise(high - low, *climbs)
    step = high - low - slope
    sure = gentle(parameters, leg, up, following.normal)
    on_way = between(parameters, terrain, frame, leg, stride)
    sure *= climbable(parameters, leg, [low, *on_way, high], slope)
    parts = [(index + 0.5) / PATH_POINTS for index in range(PATH_POINTS)]
    evened = [at - slope * part for at, part in zip(on_way, parts, strict=True) if at is not None]
    over = max(0.0, max(evened, default=0.0) - low - max(step, 0.0)) if evened else 0.0
    over *= 1.0 - smooth01((over - parameters.of_leg("probe.max_step_up", leg)) / FADE)
    high = lerp(low, high, sure)
    next_normal = last.normal + sure * (following.normal - last.normal)

    risen = eased(parameters, leg, stride.fraction)
    ball = apply(frame.world_from_model, frame.toe.pos[leg])
    squared = float(across_ws @ across_ws)
    on_its_way = float((ball - stride.last) @ across_ws) / squared if squared > 0.0 else 0.0
    ground = low + sure * (slope * clip(on_its_way, 0.0, 1.0) + step * risen)
    normal = unit(last.normal + risen * (next_normal - last.normal), up)
    platform = following.platform if sure * risen > 0.5 else last.platform
    return UnderBall(
        stride, True, ground, normal, step, over, sure * arrives, max(low, high), platform
    )


def below_others(
    parameters: Parameters, frame: Frame, leg: int, ups: list[Array], balls: list[UnderBall]
) -> float:
    """How far the ground of this foot is below the highest of the others, m, without slopes."""
    here = apply(frame.world_from_model, frame.toe.pos[leg])
    below = 0.0
    for other, beside in enumerate(balls):
        if other == leg or not beside.found or not balls[leg].found:
            continue
        way = apply(frame.world_from_model, frame.toe.pos[other]) - here
        rise = beside.height - balls[leg].height
        climbs = [climb(parameters, end, ups[end], balls[end].normal, way) for end in (leg, other)]
        below = max(below, rise - shared_rise(rise, *climbs))
    return below


def ground_of_stride(
    parameters: Parameters,
    rig: Rig,
    terrain: Ground,
    frame: Frame,
    leg: int,
    ball: UnderBall,
    below: float,
) -> tuple[Hit, Swing]:
    """The ground under the ankle of a leg, and its swing.

    `below` is how far its ground is below that of another foot, m.
    """
    up, stride = terrain.up, ball.stride
    here = level(frame, up, apply(frame.world_from_model, frame.ankle.pos[leg]))
    if not ball.found:
        return Hit(False, here, up), stride
    stride.lift, stride.pitch = beyond_animation(
        parameters, rig, frame, leg, up, stride.fraction, ball.step, ball.over, ball.sure, below
    )
    ball_ws = apply(frame.world_from_model, frame.toe.pos[leg])

    def beside_ball(point: Array) -> float:
        """Height of the ground under a point of the foot, on the plane under its ball, m."""
        return ball.height + climb(parameters, leg, up, ball.normal, point - ball_ws)

    need = lift_over_edges(parameters, rig, terrain, frame, leg, stride, beside_ball, ball.top)
    passed, left = stride.fraction, 1.0 - stride.fraction
    window = smooth01(passed / EDGE_FRACTION) * smooth01(left / EDGE_FRACTION)
    ankle = apply(frame.world_from_model, frame.ankle.pos[leg])
    point = here + up * (beside_ball(ankle) + window * need)
    return Hit(True, point, ball.normal, ball.platform), stride


def between(
    parameters: Parameters, terrain: Ground, frame: Frame, leg: int, stride: Swing
) -> list[float | None]:
    """Heights of the ground along the way from one foothold to the other; None without ground."""
    heights: list[float | None] = []
    for index in range(PATH_POINTS):
        pos = stride.way((index + 0.5) / PATH_POINTS)
        hit = look(parameters, terrain, leg, pos)
        heights.append(height(frame, terrain.up, hit.point) if hit.found else None)
    return heights


def climbable(
    parameters: Parameters, leg: int, heights: Sequence[float | None], slope: float
) -> float:
    """From 0 to 1, how far the easiest choice of points to step on has steps that are low enough.

    All choices are tried: any points of the way, in their order, between the two footholds.
    """
    places = [0.0, *((np.arange(PATH_POINTS) + 0.5) / PATH_POINTS), 1.0]
    pairs = zip(heights, places, strict=True)
    start, *middle, end = [at - slope * place for at, place in pairs if at is not None]
    best = 0.0
    for count in range(len(middle) + 1):
        for chosen in itertools.combinations(middle, count):
            steps = np.diff([start, *chosen, end])
            best = max(best, min(low_enough(parameters, leg, float(step)) for step in steps))
            if best == 1.0:
                return best
    return best


def climb(parameters: Parameters, leg: int, up: Array, normal: Array, moved: Array) -> float:
    """What a plane with this normal rises by along the horizontal part of a move, m."""
    facing = float(normal @ up)
    if facing <= 0.0:
        return 0.0
    rise = -float(across(moved, up) @ normal) / facing
    return rise * gentle(parameters, leg, up, normal)


def shared_rise(*rises: float) -> float:
    """The smallest of rises that are all up or all down, m; else 0."""
    if all(rise > 0.0 for rise in rises):
        return min(rises)
    if all(rise < 0.0 for rise in rises):
        return max(rises)
    return 0.0


def lift_over_edges(
    parameters: Parameters,
    rig: Rig,
    terrain: Ground,
    frame: Frame,
    leg: int,
    stride: Swing,
    ground_under: Callable[[Array], float],
    top: float,
) -> float:
    """How far the ground must be raised for the animated sole to clear obstacles on its path, m."""
    up = terrain.up
    axes = world_from_foot(rig, frame, leg)
    behind = np.array(
        [
            0.0,
            -parameters.of_leg("target.foot_height", leg),
            -parameters.of_leg("probe.heel_length", leg),
        ]
    )
    heel = apply(frame.world_from_model, frame.ankle.pos[leg]) + rotate(axes, behind)
    toe = apply(frame.world_from_model, frame.toe.pos[leg])
    ball = toe - up * parameters.of_leg("probe.ball_height", leg)

    tip = ball + rotate(axes, np.array([0.0, 0.0, parameters.of_leg("probe.toe_length", leg)]))
    ankle = apply(frame.world_from_model, frame.ankle.pos[leg])
    turn = maths.from_axis_angle(axis_of_pitch(rig, frame, leg, up), stride.pitch)

    need = 0.0
    for index in range(PATH_POINTS):
        pos = stride.way((index + 0.5) / PATH_POINTS)
        hit = look(parameters, terrain, leg, pos)
        if not hit.found:
            continue
        edge = height(frame, up, hit.point)
        beyond = edge - top - parameters.of_leg("probe.max_step_up", leg)
        counts = 1.0 - smooth01(beyond / FADE)
        for point in (heel, ball, tip):
            moved = ankle + rotate(turn, point - ankle)
            away = length(across(moved - pos, up))
            over = edge - parameters.of_leg("probe.way_slope", leg) * away - ground_under(point)
            # The clearance that the animation has over its own floor is subtracted.
            lift = height(frame, up, point) - parameters.of_leg("probe.clearance", leg)
            added = stride.lift + float((moved - point) @ up)
            need = max(need, counts * over - max(lift, 0.0) - added)
    return need
