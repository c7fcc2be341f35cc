"""Contact, probe, lean, target, lock and pelvis of the `record` reference.

`up` is that of the terrain, unit; everything is in world space unless it says _ms.
"""

import math

import numpy as np

from reference import maths
from reference.characters import (
    Followed,
    Foot,
    Frame,
    Ground,
    Hold,
    Parameters,
    Rig,
    State,
    carried,
    turned,
    world_from_foot,
)
from reference.maths import (
    Array,
    Motion,
    across,
    apply,
    clip,
    cross,
    length,
    lerp,
    rotate,
    unit,
)
from reference.terrain import Hit


def forward(rot: Array, up: Array) -> Array:
    """The model's forward at right angles to up; made of its own up where it looks along up."""
    return unit(across(rotate(rot, maths.Z), up), unit(across(rotate(rot, maths.Y), up), up))


def heading(rig: Rig, frame: Frame, leg: int, up: Array) -> Array:
    """The animated foot's forward at right angles to up; the model's where the foot is along up."""
    sole = rotate(world_from_foot(rig, frame, leg), maths.Z)
    return unit(across(sole, up), forward(frame.world_from_model.rot, up))


def sense(parameters: Parameters, rig: Rig, terrain: Ground, frame: Frame, leg: int) -> Foot:
    """Contact, rays and foothold of one leg."""
    up = terrain.up
    ankle_ws = apply(frame.world_from_model, frame.ankle.pos[leg])
    lift = frame.ankle.pos[leg][1] - parameters.of_leg("contact.ground_height", leg)
    planted_height = parameters.of_leg("contact.planted_height", leg)
    raised_height = parameters.of_leg("contact.raised_height", leg)
    if raised_height > planted_height:
        contact = clip((raised_height - lift) / (raised_height - planted_height), 0.0, 1.0)
    else:
        contact = 1.0 if lift <= planted_height else 0.0

    ray_up = parameters.of_leg("probe.ray_up", leg)
    reach = ray_up + parameters.of_leg("probe.ray_down", leg)
    hit = terrain.cast(ankle_ws + up * ray_up, reach)
    if parameters.of_leg("probe.use_toe", leg):
        toe_ls = np.array(parameters.of_leg("probe.toe_ls", leg))
        toe_ls[0] *= rig.side[leg]
        toe_ws = ankle_ws + rotate(world_from_foot(rig, frame, leg), toe_ls)
        toe_hit = terrain.cast(toe_ws + up * ray_up, reach)
    else:
        toe_hit = Hit(False, ankle_ws, up)

    return Foot(
        hip_ws=apply(frame.world_from_model, frame.hip.pos[leg]),
        ankle_ws=ankle_ws,
        ball_ws=apply(frame.world_from_model, frame.toe.pos[leg]),
        heading_ws=heading(rig, frame, leg, up),
        lift=float(lift),
        contact=float(contact),
        planted=bool(lift <= planted_height),
        lifted=bool(lift >= raised_height),
        hit=hit,
        toe_hit=toe_hit,
        foothold_ws=foothold(parameters, leg, hit, ankle_ws, float(lift), up),
    )


def foothold(
    parameters: Parameters, leg: int, hit: Hit, ankle_ws: Array, lift: float, up: Array
) -> Array:
    """Where the foot would stand: the hit, raised by as much as a flat sole on a slope needs."""
    if not hit.found:
        return ankle_ws - up * lift
    steepest = math.cos(parameters.of_leg("target.max_slope", leg))
    cosine = max(float(hit.normal @ up), steepest)
    sole = parameters.of_leg("target.foot_height", leg)
    return hit.point + up * (sole * (1.0 / cosine - 1.0))


def lean(
    parameters: Parameters,
    feet: list[Foot],
    forward: Array,
    up: Array,
    state: State | None,
    frame: Frame,
) -> tuple[float, list[Motion], Array, Array]:
    """Slide weight, smoothed slope (2), body rotation (4) and smoothed normal (3), world."""
    right = cross(forward, up)
    leg_weights = weights_of_legs(parameters, frame)
    weights = [foot.grounded * w for foot, w in zip(feet, leg_weights, strict=True)]
    normal = np.zeros(3)
    for foot, weight in zip(feet, weights, strict=True):
        normal = normal + weight * foot.hit.normal
    if sum(weights) == 0.0:
        normal = up
    goals = [math.atan2(-float(normal @ axis), float(normal @ up)) for axis in (forward, right)]

    hz = parameters["lean.tick_hz"]
    if state is None:
        slide, slope = float(frame.slide), [Motion(goal, 0.0) for goal in goals]
    else:
        rising = frame.slide > state.slide_weight
        slide_gain = parameters["lean.slide_on_gain" if rising else "lean.slide_off_gain"]
        fraction = maths.fraction_of_gain(slide_gain, hz, frame.dt)
        slide = lerp(state.slide_weight, float(frame.slide), fraction)
        gain = lerp(parameters["lean.gain"], parameters["lean.gain_slide"], slide)
        half_life, spring = maths.half_life_of_gain(gain, hz), parameters["lean.spring"]
        slope = [
            maths.follow(before, goal, half_life, frame.dt, spring)
            for before, goal in zip(state.slope, goals, strict=True)
        ]

    angles = [eased.value for eased in slope]
    lean_forward, lean_side = (
        lerp(parameters[f"lean.{name}_rate"], parameters[f"lean.{name}_rate_slide"], slide) * angle
        for name, angle in zip(("forward", "side"), angles, strict=True)
    )
    body_rot = maths.from_rotvec(right * lean_forward - forward * lean_side)
    smooth_normal = unit(up - math.tan(angles[0]) * forward - math.tan(angles[1]) * right, up)
    return slide, slope, body_rot, smooth_normal


def smooth_height(
    parameters: Parameters, leg: int, foot: Foot, up: Array, memory: Followed | None, frame: Frame
) -> Followed:
    """Smoothed height along up of the foothold and of what the swing adds to the lift, m.

    With `follow_slopes` the height first moves as the plane of the ground does under the foothold.
    """
    foothold, before = float(up @ foot.foothold_ws), None
    goal = foothold + foot.swing_lift
    if memory is not None:
        origin = carried(frame, foot.hit, np.zeros(3))
        turn = turned(frame, foot.hit, maths.IDENTITY)
        place_before = rotate(maths.inverse(turn), foot.foothold_ws - origin)
        height = memory.height.value + foothold - float(up @ place_before)
        if parameters.of_leg("target.follow_slopes", leg):
            way = foot.foothold_ws - carried(frame, foot.hit, memory.foothold_ws)
            height += slope_rise(parameters, leg, foot.hit.normal, way, up)
        before = Motion(height, memory.height.velocity)
    rises = before is None or goal > before.value
    half_life = parameters.of_leg(f"target.{'rise' if rises else 'fall'}_half_life", leg)
    spring = parameters.of_leg("target.spring", leg)
    return Followed(maths.follow(before, goal, half_life, frame.dt, spring), foot.foothold_ws)


def slope_rise(parameters: Parameters, leg: int, normal: Array, way: Array, up: Array) -> float:
    """How far a plane with this normal rises along a way, m: as far as it is at most this steep."""
    steepness = math.acos(clip(float(normal @ up), -1.0, 1.0))
    uphill = across(-normal, up)
    if steepness <= parameters.of_leg("target.max_slope", leg):
        return float(way @ unit(uphill, up)) * math.tan(steepness)
    return float(way @ uphill) / math.cos(parameters.of_leg("target.max_slope", leg))


def clamped_target(
    parameters: Parameters, leg: int, foot: Foot, up: Array, height: float, frame: Frame
) -> tuple[Array, Array]:
    """Foothold at the smoothed height and the ankle target above it, both within the limits."""
    foothold = foot.foothold_ws + up * (height - foot.swing_lift - up @ foot.foothold_ws)
    target = foothold + up * foot.lift
    lowest = parameters.of_leg("target.min_ankle_height", leg)
    highest = parameters.of_leg("target.max_ankle_height", leg)
    height_ms = maths.unapply(frame.world_from_model, target)[1]
    shift = up * (clip(height_ms, lowest, highest) - height_ms)
    return foothold + shift, target + shift


def lock(
    parameters: Parameters,
    leg: int,
    foot: Foot,
    foothold: Array,
    up: Array,
    before: Hold | None,
    pelvis_offset: Array,
    frame: Frame,
) -> tuple[Hold, Array, Array]:
    """Memory of the foot's lock after this frame; offset of the target (3), turn of the foot (4).

    `pelvis_offset` (3) is that of the previous frame. All of this is in world space.
    """
    holds_ball = parameters.of_leg("lock.hold_ball", leg)
    if before is None:
        was_locked, factor, turn, swung = False, 0.0, 0.0, 0.0
        offset = moved = np.zeros(3)
    else:
        was_locked, factor, turn = before.locked, before.factor, before.turn
        carried_rot = turned(frame, foot.hit, maths.IDENTITY)
        offset = rotate(carried_rot, before.offset)
        moved = foothold - carried(frame, foot.hit, before.foothold)
        if holds_ball:
            rolled = foot.ball_ws - carried(frame, foot.hit, before.ball)
            moved = across(rolled, up) + up * float(up @ moved)
        pointed = rotate(carried_rot, before.heading)
        swung = math.atan2(float(cross(pointed, foot.heading_ws) @ up), pointed @ foot.heading_ws)

    def of_ankle(offset: Array, turn: float) -> Array:
        """How far the ankle moves if the ball moves by the offset and the foot turns about it."""
        if not holds_ball:
            return offset
        arm = foot.ankle_ws - foot.ball_ws
        return offset + rotate(maths.from_axis_angle(up, turn), arm) - arm

    # Where the ankle would be if the foot stayed, relative to where the hip probably is.
    hip = foot.hip_ws + pelvis_offset
    kept = foothold + of_ankle(offset - moved, turn - swung) + up * foot.lift
    thigh = length(frame.hip.pos[leg] - frame.knee.pos[leg])
    shin = length(frame.knee.pos[leg] - frame.ankle.pos[leg])
    knee_angle = maths.interior_angle(thigh, shin, float((kept - hip) @ (kept - hip)))
    deviation = maths.angle_between(kept - hip, foot.ankle_ws - foot.hip_ws)
    takes_part = weights_of_legs(parameters, frame)[leg] > 0.0
    most_turned = parameters.of_leg("lock.release_heading", leg)
    must_release = (
        foot.lifted
        or knee_angle < parameters.of_leg("lock.release_min_angle", leg)
        or knee_angle > parameters.of_leg("lock.release_max_angle", leg)
        or deviation > parameters.of_leg("lock.release_cone", leg)
        or length(offset - moved) > parameters.of_leg("lock.release_distance", leg)
        or (most_turned < math.pi and abs(turn - swung) > most_turned)
        or not is_slow(parameters, "lock.release_speed", leg, moved, frame.dt)
        or not parameters.of_leg("lock.enabled", leg)
        or not takes_part
    )
    if was_locked:
        locked = not must_release
    else:
        slow = is_slow(parameters, "lock.max_speed", leg, moved, frame.dt)
        relockable = factor <= parameters.of_leg("lock.relock_threshold", leg)
        locked = foot.planted and relockable and slow and foot.hit.found and not must_release

    if locked:
        half_life = parameters.of_leg("lock.lock_half_life", leg)
        factor += maths.fraction_of_half_life(half_life, frame.dt) * (1.0 - factor)
        offset, turn = offset - factor * moved, turn - factor * swung
    else:
        half_life = parameters.of_leg("lock.unlock_half_life", leg)
        fraction = maths.fraction_of_half_life(half_life, frame.dt)
        factor *= 1.0 - fraction
        way = length(offset)
        if holds_ball:
            way += abs(turn) * length(foot.ankle_ws - foot.ball_ws)
        fastest = parameters.of_leg("lock.return_speed", leg)
        if fraction * way > fastest * frame.dt:
            fraction = fastest * frame.dt / way
        offset, turn = offset * (1.0 - fraction), turn * (1.0 - fraction)
    after = Hold(locked, factor, offset, turn, foothold, foot.ball_ws, foot.heading_ws)
    rot = maths.from_axis_angle(up, turn) if holds_ball else maths.IDENTITY
    return after, of_ankle(offset, turn), rot


def is_slow(parameters: Parameters, name: str, leg: int, moved: Array, dt: float) -> bool:
    """Whether a move, m, in `dt` s respects the speed limit of that name, which may be infinite."""
    limit = parameters.of_leg(name, leg)
    return math.isinf(limit) or length(moved) <= limit * dt


def weights_of_legs(parameters: Parameters, frame: Frame) -> list[float]:
    """How much foot IK each leg gets, 0..1."""
    return [
        float(frame.grounded * weight * parameters.of_leg("leg.weight", leg))
        for leg, weight in enumerate(frame.weight)
    ]


def pelvis_height(
    parameters: Parameters,
    feet: list[Foot],
    targets: list[Array],
    up: Array,
    state: State | None,
    frame: Frame,
) -> float:
    """Smoothed height of the body above its animated position, m along up or the normal."""
    leg_weights = weights_of_legs(parameters, frame)
    weights = [foot.grounded * w for foot, w in zip(feet, leg_weights, strict=True)]
    gaps = [float(up @ (t - foot.ankle_ws)) for t, foot in zip(targets, feet, strict=True)]
    taking_part = [
        (w, gap) for w, gap, total in zip(weights, gaps, leg_weights, strict=True) if total > 0.0
    ]
    top = max((gap for _, gap in taking_part), default=0.0)
    low = min((top + w * (gap - top) for w, gap in taking_part), default=0.0)
    if parameters["pelvis.wait_to_rise"]:
        low = min(low, max(0.0, min((gap for _, gap in taking_part), default=0.0)))
    contact = max(weights)
    limit = parameters["pelvis.limit"]
    goal = contact * clip(low, -limit, limit)
    if state is None:
        return goal
    hz = parameters["pelvis.tick_hz"]
    on = maths.fraction_of_gain(parameters["pelvis.on_gain"], hz, frame.dt)
    off = maths.fraction_of_gain(parameters["pelvis.off_gain"], hz, frame.dt)
    return lerp(state.pelvis_height, goal, lerp(off, on, contact))
