"""Contact, probe, lean, target, lock and pelvis of the `record` reference.

Everything is in world space unless it says _ms. The other systems share what they share.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from reference import maths
from reference.characters import Frame, Leg, Parameters, carried, named, turned
from reference.maths import Array, Motion, across, clip, cross, length, lerp, rotate, unit
from reference.terrain import Hit

# Of contact by speed.
BY_SPEED = named("contact", ground_height=0.0, planted_height=0.075, raised_height=0.10) | named(
    "contact", planted_speed=0.25, raised_speed=0.50, half_life=0.0
)


@dataclass
class Standing:
    """Contact of one foot: whether it stands, and the smoothed weight of that."""

    standing: bool
    weight: float


@dataclass
class Followed:
    """Height of the ground as a foothold follows it, and the foothold where the ground is."""

    height: Motion
    foothold_ws: Array


@dataclass
class Hold:
    """Memory of one foot's lock."""

    locked: bool
    factor: float
    offset: Array
    turn: float  # rad about up, from the animated heading to the one it keeps
    foothold: Array
    ball: Array
    heading: Array


@dataclass
class State:
    """Memory of the `record` system; lists have one entry per leg."""

    ground: list[Followed]
    slope: list[Motion]  # ahead and to the right
    slide_weight: float
    pelvis_height: float
    pelvis_offset_ws: Array
    holds: list[Hold]
    standing: Sequence[Standing | None]  # where feet stand by speed


@dataclass(frozen=True)
class Foot(Leg):
    """A leg in a frame, with its contact, hits and foothold.

    `swing_lift`, m, is the part of `lift` that is not animated.
    """

    lift: float
    contact: float
    planted: bool
    lifted: bool
    hit: Hit
    toe_hit: Hit
    turns_in_swing: bool = False
    swing_lift: float = 0.0

    @property
    def turned(self) -> float:
        """0..1, how far the foot turns to the ground under it."""
        return float(self.hit.found) if self.turns_in_swing else self.grounded

    @property
    def grounded(self) -> float:
        """Contact weight of a foot with ground under it, else 0."""
        return self.contact * self.hit.found

    @property
    def foothold_ws(self) -> Array:
        """Where the foot would stand: the hit, raised by what a flat sole on a slope needs."""
        cosine = max(float(self.hit.normal @ self.up), math.cos(self["target.max_slope"]))
        on_ground = self.hit.point + self.up * self["target.foot_height"] * (1.0 / cosine - 1.0)
        animated = self.pos_ws("ankle") - self.up * (self.lift - self.swing_lift)
        return animated + self.hit.found * (on_ground - animated)


def sense(leg: Leg) -> Foot:
    """Contact by height, and the hits of one leg."""
    ankle_ws = leg.pos_ws("ankle")
    lift = float(leg.joint("ankle").pos[1] - leg["contact.ground_height"])
    planted, raised = leg["contact.planted_height"], leg["contact.raised_height"]
    contact = float(lift <= planted)
    if raised > planted:
        contact = clip((raised - lift) / (raised - planted), 0.0, 1.0)

    above = leg.up * leg["probe.ray_up"]
    reach = leg["probe.ray_up"] + leg["probe.ray_down"]
    toe_hit = Hit(False, ankle_ws, leg.up)
    if leg["probe.use_toe"]:
        toe_ls = leg["probe.toe_ls"] * np.array([leg.rig.side[leg.index], 1.0, 1.0])
        toe_hit = leg.terrain.cast(ankle_ws + rotate(leg.world_from_foot, toe_ls) + above, reach)
    return Foot(
        **vars(leg),
        lift=lift,
        contact=contact,
        planted=lift <= planted,
        lifted=lift >= raised,
        hit=leg.terrain.cast(ankle_ws + above, reach),
        toe_hit=toe_hit,
    )


def stand(leg: Leg, before: Standing | None) -> Standing:
    """Contact by speed: a foot stands once its toe is low and slow, until it is high or fast."""
    height = leg.joint("toe").pos[1] - leg["contact.ground_height"]
    speed = leg.frame.toe_speed[leg.index]
    lifted = height > leg["contact.raised_height"] or speed > leg["contact.raised_speed"]
    planted = height <= leg["contact.planted_height"] and speed <= leg["contact.planted_speed"]
    if before is None:
        stands = bool(planted and not lifted)
        return Standing(stands, float(stands))
    stands = bool(not lifted and (planted or before.standing))
    fraction = maths.fraction_of_half_life(leg["contact.half_life"], leg.frame.dt)
    return Standing(stands, lerp(before.weight, float(stands), fraction))


def lean(
    parameters: Parameters,
    feet: list[Foot],
    forward: Array,
    up: Array,
    state: State | None,
    frame: Frame,
) -> tuple[float, list[Motion], Array, Array]:
    """Slide weight, smoothed slope (2), body rotation (4) and smoothed normal (3)."""
    right = cross(forward, up)
    stands, weights = (
        np.array([getattr(x, name) for x in feet]) for name in ("grounded", "weight")
    )
    normal = standing_normal(stands, weights, np.array([foot.hit.normal for foot in feet]), up)
    goals = [math.atan2(-float(normal @ axis), float(normal @ up)) for axis in (forward, right)]

    if state is None:
        slide, slope = float(frame.slide), [Motion(goal, 0.0) for goal in goals]
    else:
        direction = "on" if frame.slide > state.slide_weight else "off"
        fractions = {
            name: maths.fraction_of_half_life(parameters[f"lean.{name}"], frame.dt)
            for name in ("half_life", "half_life_slide", f"slide_{direction}_half_life")
        }
        fraction = fractions[f"slide_{direction}_half_life"]
        slide = lerp(state.slide_weight, float(frame.slide), fraction)
        gain = lerp(fractions["half_life"], fractions["half_life_slide"], slide)
        half_life = maths.half_life_of_gain(gain, 1.0 / frame.dt)
        spring = parameters["lean.spring"]
        slope = [
            maths.follow(before, goal, half_life, frame.dt, spring)
            for before, goal in zip(state.slope, goals, strict=True)
        ]

    ahead, aside = (eased.value for eased in slope)
    lean_forward, lean_side = (
        lerp(parameters[f"lean.{name}_rate"], parameters[f"lean.{name}_rate_slide"], slide) * angle
        for name, angle in (("forward", ahead), ("side", aside))
    )
    body_rot = maths.from_rotvec(right * lean_forward - forward * lean_side)
    smooth_normal = unit(up - math.tan(ahead) * forward - math.tan(aside) * right, up)
    return slide, slope, body_rot, smooth_normal


def smooth_height(foot: Foot, memory: Followed | None) -> Followed:
    """Smoothed height along up of the foothold and of what the swing adds to the lift, m.

    With `follow_slopes` the height first moves as the plane of the ground does under the foothold.
    A sole whose foot is as animated above its foothold is at most `max_penetration` in the ground.
    """
    foothold, before = float(foot.up @ foot.foothold_ws), None
    goal = foothold + foot.swing_lift
    if memory is not None:
        origin = carried(foot.frame, foot.hit, np.zeros(3))
        turn = turned(foot.frame, foot.hit, maths.IDENTITY)
        place_before = rotate(maths.inverse(turn), foot.foothold_ws - origin)
        height = memory.height.value + foothold - float(foot.up @ place_before)
        if foot["target.follow_slopes"]:
            height += slope_rise(
                foot, foot.foothold_ws - carried(foot.frame, foot.hit, memory.foothold_ws)
            )
        before = Motion(height, memory.height.velocity)
    height, velocity = ease(foot, "target", before, goal, foot.frame.dt)
    sole = height + (foot.lift - foot.swing_lift) - foot["target.foot_height"]
    depth = min(foothold - sole, foothold - height)
    height += max(depth - foot["target.max_penetration"], 0.0)
    return Followed(Motion(height, velocity), foot.foothold_ws)


def ease(
    values: Leg | Parameters, stage: str, before: Motion | None, goal: float, dt: float
) -> Motion:
    """A height after a frame, m, that rises and falls with the half-lives of a stage."""
    direction = "rise" if before is None or goal > before.value else "fall"
    half_life = values[f"{stage}.{direction}_half_life"]
    return maths.follow(before, goal, half_life, dt, values[f"{stage}.spring"])


def slope_rise(foot: Foot, way: Array) -> float:
    """How far the ground rises along a way, m, as far as it is at most as steep as it may be."""
    steepness = math.acos(clip(float(foot.hit.normal @ foot.up), -1.0, 1.0))
    uphill = across(-foot.hit.normal, foot.up)
    if steepness <= foot["target.max_slope"]:
        return float(way @ unit(uphill, foot.up)) * math.tan(steepness)
    return float(way @ uphill) / math.cos(foot["target.max_slope"])


def clamped_target(foot: Foot, height: float) -> tuple[Array, Array]:
    """Foothold at the smoothed height and the ankle target above it, both within the limits."""
    up = foot.up
    foothold = foot.foothold_ws + up * (height - foot.swing_lift - up @ foot.foothold_ws)
    target = foothold + up * foot.lift
    height_ms = maths.unapply(foot.frame.world_from_model, target)[1]
    allowed = clip(height_ms, foot["target.min_ankle_height"], foot["target.max_ankle_height"])
    shift = up * (allowed - height_ms)
    return foothold + shift, target + shift


def lock(
    foot: Foot, foothold: Array, before: Hold | None, pelvis_offset: Array
) -> tuple[Hold, Array, Array]:
    """Memory of the foot's lock after this frame; offset of the target (3), turn of the foot (4).

    `pelvis_offset` (3) is that of the previous frame.
    """
    up, frame, heading = foot.up, foot.frame, foot.heading_ws
    hip_ws, ankle_ws, ball_ws = (foot.pos_ws(name) for name in ("hip", "ankle", "toe"))
    was_locked, factor, turn, swung = False, 0.0, 0.0, 0.0
    offset = moved = np.zeros(3)
    if before is not None:
        was_locked, factor, turn = before.locked, before.factor, before.turn
        carried_rot = turned(frame, foot.hit, maths.IDENTITY)
        offset = rotate(carried_rot, before.offset)
        moved = foothold - carried(frame, foot.hit, before.foothold)
        if foot["lock.hold_ball"]:
            rolled = ball_ws - carried(frame, foot.hit, before.ball)
            moved = across(rolled, up) + up * float(up @ moved)
        pointed = rotate(carried_rot, before.heading)
        swung = math.atan2(float(cross(pointed, heading) @ up), pointed @ heading)

    def of_ankle(offset: Array, turn: float) -> Array:
        """How far the ankle moves if the ball moves by the offset and the foot turns about it."""
        if not foot["lock.hold_ball"]:
            return offset
        arm = ankle_ws - ball_ws
        return offset + rotate(maths.from_axis_angle(up, turn), arm) - arm

    def is_slow(name: str) -> bool:
        """Whether the move respects the speed limit of that name, which may be infinite."""
        return math.isinf(foot[name]) or length(moved) <= foot[name] * frame.dt

    # Where the ankle would be if the foot stayed, relative to where the hip probably is.
    hip = hip_ws + pelvis_offset
    kept = foothold + of_ankle(offset - moved, turn - swung) + up * foot.lift
    hip_ms, knee_ms, ankle_ms = (foot.joint(name).pos for name in ("hip", "knee", "ankle"))
    thigh, shin = length(hip_ms - knee_ms), length(knee_ms - ankle_ms)
    knee_angle = maths.interior_angle(thigh, shin, float((kept - hip) @ (kept - hip)))
    most_turned = foot["lock.release_heading"]
    must_release = (
        foot.lifted
        or not foot["lock.release_min_angle"] <= knee_angle <= foot["lock.release_max_angle"]
        or maths.angle_between(kept - hip, ankle_ws - hip_ws) > foot["lock.release_cone"]
        or length(offset - moved) > foot["lock.release_distance"]
        or (most_turned < math.pi and abs(turn - swung) > most_turned)
        or not is_slow("lock.release_speed")
        or not foot["lock.enabled"]
        or foot.weight == 0.0
    )
    relockable = factor <= foot["lock.relock_threshold"] and is_slow("lock.max_speed")
    may_lock = was_locked or (foot.planted and relockable and foot.hit.found > 0)
    locked = may_lock and not must_release

    if locked:
        fraction = maths.fraction_of_half_life(foot["lock.lock_half_life"], frame.dt)
        factor += fraction * (1.0 - factor)
        offset, turn = offset - factor * moved, turn - factor * swung
    else:
        fraction = maths.fraction_of_half_life(foot["lock.unlock_half_life"], frame.dt)
        factor *= 1.0 - fraction
        way = length(offset)
        if foot["lock.hold_ball"]:
            way += abs(turn) * length(ankle_ws - ball_ws)
        fastest = foot["lock.return_speed"]
        if fraction * way > fastest * frame.dt:
            fraction = fastest * frame.dt / way
        offset, turn = offset * (1.0 - fraction), turn * (1.0 - fraction)
    after = Hold(locked, factor, offset, turn, foothold, ball_ws, heading)
    rot = maths.from_axis_angle(up, turn) if foot["lock.hold_ball"] else maths.IDENTITY
    return after, of_ankle(offset, turn), rot


def standing_normal(stands: Array, weights: Array, normals: Array, up: Array) -> Array:
    """Mean normal of the ground under standing feet, the nearer to up the less weight they have."""
    loads = stands * weights
    if loads.sum() == 0.0:
        return up
    mean = loads @ normals / loads.sum()
    return up + min(loads.sum() / stands.max(), 1.0) * (mean - up)


def over_choices(
    pick: Callable[[list[float]], float], heights: Sequence[float], loads: Sequence[float]
) -> float:
    """The mean of what is picked of some heights, m, each of them there with its load; or 0."""
    mean = some = 0.0
    for there in itertools.product((False, True), repeat=len(heights)):
        if any(there):
            chances = (x if is_there else 1.0 - x for x, is_there in zip(loads, there, strict=True))
            chance = math.prod(chances)
            mean += chance * pick(list(itertools.compress(heights, there)))
            some += chance
    return mean / some if some else 0.0


def lowest_of(gaps: Sequence[float], weights: Sequence[float], loads: Sequence[float]) -> float:
    """The lowest of heights, m, of which one with a partial weight is partly the highest."""
    top = over_choices(max, gaps, loads)
    return min(top + w * (gap - top) for w, gap in zip(weights, gaps, strict=True))


def follow_standing(
    parameters: Parameters,
    low: float,
    contact: float,
    before: float | None,
    dt: float,
    resting: float = 0.0,
) -> float:
    """Height of the body after a frame, m, of which feet with a contact want `low`, else rest."""
    low = clip(low, -parameters["pelvis.limit"], parameters["pelvis.limit"])
    goal = lerp(resting, low, contact)
    if before is None:
        return goal
    airborne, standing = (
        maths.fraction_of_half_life(parameters[f"pelvis.{name}"], dt)
        for name in ("airborne_half_life", "half_life")
    )
    return lerp(before, goal, lerp(airborne, standing, contact))


def pelvis_height(
    parameters: Parameters, feet: list[Foot], targets: list[Array], up: Array, before: float | None
) -> float:
    """Smoothed height of the body above its animated position, m along up or the normal."""
    pairs = zip(feet, targets, strict=True)
    gaps = [float(up @ (target - foot.pos_ws("ankle"))) for foot, target in pairs]
    loads = [foot.weight for foot in feet]
    weights = [foot.grounded * foot.weight for foot in feet]
    low = lowest_of(gaps, weights, loads)
    if parameters["pelvis.wait_to_rise"]:
        low = min(low, max(0.0, over_choices(min, gaps, loads)))
    low = max([low, *unfolded_heights(parameters, low, feet, targets, up)])
    contact = max(weights)
    resting = before if before and parameters["pelvis.wait_to_rise"] else 0.0
    return follow_standing(parameters, low, contact, before, feet[0].frame.dt, resting)


def unfolded_heights(
    parameters: Parameters, low: float, feet: list[Foot], targets: list[Array], up: Array
) -> list[float]:
    """Heights of the body, m, that standing feet ask for whose legs would be folded too far."""
    heights = []
    for foot, target in zip(feet, targets, strict=True):
        part, weight = foot["pelvis.min_extension"], foot.grounded * foot.weight
        if part > 0.0 and weight > 0.0:
            hip, ankle, knee = (foot.pos_ws(joint) for joint in ("hip", "ankle", "knee"))
            leg = length(knee - hip) + length(ankle - knee)
            shortest = min(part * leg, length(ankle - hip))
            way = target - hip
            height = float(way @ up)
            aside_squared = float(way @ way) - height**2
            least = height + math.sqrt(max(shortest**2 - aside_squared, 0.0))
            heights.append(lerp(low, max(least, low), weight))
    return heights
