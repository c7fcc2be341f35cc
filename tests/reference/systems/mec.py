"""The `mec` system: three rays per foot, planting, hints, fades."""

import functools
import math
from dataclasses import dataclass, field

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Leg, Parameters, Rig, named
from reference.maths import Array, across, cross, from_axis_angle, lerp, multiply, rotate, unit
from reference.stages import ground, limb
from reference.stages.ground import Standing
from reference.terrain import ALL_LAYERS, Hit

AS_IT_COMES = (
    named("probe", ray_up=0.5, foot_length=0.2, half_width=0.05, forward=maths.Z, active=True)
    | named("probe", extra=0.2, by_height=True, by_speed=False, extra_min=0.0, extra_max=0.3)
    | named("probe", stable_height=0.12, stable_speed=0.5, layers=ALL_LAYERS)
    | {"target.foot_height": 0.10, "effector.transition_time": 0.2}
    | named("lock", plant=True, plant_weight=1.0, plant_speed=math.inf)
    | named("lock", release_distance=math.inf, release_angle=math.pi, release_time=0.3)
    | named("pelvis", enabled=True, min_length=0.5, max_length=0.88, damp=True, speed=10.0)
    | named("leg", soften=1.0, twist=0.0, weight=1.0, allow_stretch=True, max_stretch=1.05)
    | {"foot.max_tilt": math.radians(45.0)}
)
DEFAULTS = AS_IT_COMES | {"leg.hint_offset": np.zeros(3)}
"""Of the faithful system."""
STANDS_BY_SPEED = (
    AS_IT_COMES
    | ground.BY_SPEED
    | named("contact", planted_height=0.09, raised_height=0.12, raised_speed=0.35)
    | named("probe", by_speed=True, stable_speed=0.25, stable_height=0.095, extra_min=-0.03)
    | {"target.foot_height": 0.085, "pelvis.max_length": 0.84}
    | named("lock", release_distance=0.15, release_angle=0.5)
)
"""As it comes."""


@dataclass(frozen=True)
class Foot(Leg):
    """A leg in a frame with what its three rays found. Where `found` is false, `hit` means nothing.

    `ahead` is the unit forward of the foot at right angles to up.
    """

    extra: float
    found: bool
    hit: Hit
    ahead: Array
    pitch: float
    roll: float
    toe_point: Array


@dataclass
class Memory:
    """Memory of one leg, world space."""

    plant_weight: float
    planted: bool
    kept_point: Array  # m
    kept_rot: Array  # from the axes of the foot to the world
    standing: Standing | None  # None where all feet always stand
    hold: float = 1.0  # what is left of the planting of a foot that is let go
    fade: float = 0.0
    # From the animated ankle, m, and its rotation to the last goal.
    offset_ws: Array = field(default_factory=lambda: np.zeros(3))
    rot_ws: Array = field(default_factory=maths.IDENTITY.copy)


@dataclass
class State:
    """Memory between frames."""

    pelvis_height: float
    legs: list[Memory]


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    up = terrain.up
    feet, memory, targets, goal_rots = [], [], [], []
    for leg in characters.legs_of(parameters, rig, terrain, frame):
        foot, before = sense(leg), state.legs[leg.index] if state else None
        after, point, rot = plant(foot, before)
        goal = point + leg.up * leg["target.foot_height"]
        target, rot = fade(foot, before, after, goal, rot)
        feet.append(foot)
        memory.append(after)
        targets.append(target)
        goal_rots.append(rot)

    pelvis = pelvis_height(parameters, feet, targets, up, state)
    offset_ws = up * pelvis * frame.grounded
    body = limb.body(frame, offset_ws, maths.IDENTITY)

    solved, weights, hints, stretches = [], [], [], []
    for foot, after, target, rot in zip(feet, memory, targets, goal_rots, strict=True):
        weight = foot.weight * after.fade
        hint_ws = np.zeros(3)
        hip, knee, ankle = limb.carry(body, foot)
        if "leg.hint_offset" in parameters.values:
            calf = foot.joint("knee").pos - foot.joint("ankle").pos + foot["leg.hint_offset"]
            hint_ws = foot.toe_point + rotate(frame.world_from_model.rot, calf)
            towards = maths.unapply(frame.world_from_model, hint_ws) - hip.pos
        else:  # the knee bends as animated
            towards = cross(limb.hinge_of(foot, knee), ankle.pos - knee.pos)
        target_ms = maths.unapply(frame.world_from_model, target)
        leg = limb.solve_leg_to_pole(foot, body, target_ms, towards, weight)
        model_from_foot = multiply(maths.inverse(frame.world_from_model.rot), rot)
        wanted = multiply(model_from_foot, maths.inverse(rig.ankle_from_foot[foot.index]))
        solved.append(limb.with_foot(foot, leg, maths.nlerp(leg.ankle.rot, wanted, weight)))
        weights.append(weight)
        stretches.append(leg.stretch)
        hints.append(hint_ws)

    output = characters.solution(body, solved) | {
        "pelvis_height": np.array(pelvis),
        "pelvis_offset_ws": offset_ws,
        "body_offset_ws": offset_ws,
        "target_ws": np.array(targets),
        "goal_rot": np.array(goal_rots),
        "weight": np.array(weights),
        "hint_ws": np.array(hints),
        "stretch": np.array(stretches),
    }
    for name in ("found", "extra", "pitch", "roll"):
        output[name] = np.array([getattr(foot, name) for foot in feet])
    for name in ("planted", "plant_weight", "fade"):
        output[name] = np.array([getattr(after, name) for after in memory])
    return State(pelvis, memory), output


run = functools.partial(characters.run, step)


def sense(leg: Leg) -> Foot:
    """The foot's three rays and the tilt of the ground that follows from them."""
    up, ankle_ws, ground_under = leg.up, leg.pos_ws("ankle"), leg.terrain
    foot_forward = rotate(leg.world_from_foot, np.asarray(leg["probe.forward"]))
    ahead = unit(across(foot_forward, up), leg.forward_ws)
    right = cross(ahead, up)

    sole, extra = leg["target.foot_height"], extra_length(leg)
    above = up * leg["probe.ray_up"]
    reach, mask = leg["probe.ray_up"] + sole + extra, int(leg["probe.layers"])
    foot_length, half_width = leg["probe.foot_length"], leg["probe.half_width"]

    hit = ground_under.cast(ankle_ws + above, reach, mask)
    found = bool(hit.found and leg["probe.active"])
    pitch, roll = 0.0, 0.0
    toe_point = (hit.point if found else ankle_ws - up * sole) + ahead * foot_length
    if found:
        goal = hit.point + up * sole
        toe = ground_under.cast(goal + ahead * foot_length + above, reach, mask)
        if toe.found:
            toe_point = toe.point
            pitch = math.atan2(float(up @ (toe.point - hit.point)), foot_length)
        corner = ground_under.cast(goal + right * half_width + above, reach, mask)
        if corner.found:
            roll = math.atan2(float(up @ (corner.point - hit.point)), half_width)
    return Foot(
        **vars(leg),
        extra=extra,
        found=found,
        hit=hit,
        ahead=ahead,
        pitch=pitch,
        roll=roll,
        toe_point=toe_point,
    )


def extra_length(leg: Leg) -> float:
    """How far the rays reach below the sole, m."""
    if not leg["probe.by_height"] and not leg["probe.by_speed"]:
        return float(leg["probe.extra"])
    height = float(leg.up @ (leg.pos_ws("ankle") - leg.frame.world_from_model.pos))
    too_high = leg["probe.by_height"] and height > leg["probe.stable_height"]
    speed = leg.frame.foot_speed[leg.index]
    too_fast = leg["probe.by_speed"] and speed > leg["probe.stable_speed"]
    return float(leg["probe.extra_min" if too_high or too_fast else "probe.extra_max"])


def flat_foot(foot: Foot) -> Array:
    """Rotation from the foot's axes to the world that lays it flat with its animated yaw."""
    pitch = from_axis_angle(cross(foot.ahead, foot.up), foot.pitch)
    tilt = multiply(pitch, from_axis_angle(foot.ahead, -foot.roll))
    sine = maths.length(tilt[1:])
    if 2.0 * math.atan2(sine, float(tilt[0])) > foot["foot.max_tilt"]:
        tilt = from_axis_angle(tilt[1:] / sine, foot["foot.max_tilt"])
    upright = maths.shortest_arc(maths.Y, foot.up, maths.X)
    level = unit(across(np.asarray(foot["probe.forward"]), maths.Y), maths.Z)
    yaw = maths.signed_angle(rotate(upright, level), foot.ahead, foot.up)
    return multiply(tilt, multiply(from_axis_angle(foot.up, yaw), upright))


def plant(foot: Foot, before: Memory | None) -> tuple[Memory, Array, Array]:
    """Memory of the leg without its fade; foothold and rotation of the foot there, world."""
    standing = None
    if "contact.planted_speed" in foot.parameters.values:
        standing = ground.stand(foot, before.standing if before else None)
    weight, speed = foot["lock.plant_weight"], foot["lock.plant_speed"]
    if before is not None and math.isfinite(speed):
        weight = maths.move_towards(before.plant_weight, weight, speed * foot.frame.dt)

    point = foot.hit.point
    rot = flat_foot(foot) if foot.found else foot.world_from_foot
    stands = standing is None or standing.standing
    planted = bool(foot.found and stands and foot["lock.plant"] and foot.weight > 0.0)
    kept_point, kept_rot, hold = np.zeros(3), maths.IDENTITY, 1.0
    if planted:
        kept_point, kept_rot = point, rot
        if before is not None and before.planted:
            kept_point = characters.carried(foot.frame, foot.hit, before.kept_point)
            kept_rot = characters.turned(foot.frame, foot.hit, before.kept_rot)
        stays = followed(foot, kept_point)
        hold = before.hold if before is not None else 1.0
        leaves = maths.length(stays - point) > foot["lock.release_distance"]
        if leaves or hold < 1.0 or turn_between(rot, kept_rot) > foot["lock.release_angle"]:
            hold = maths.move_towards(hold, 0.0, foot.frame.dt / foot["lock.release_time"])
        if hold <= 0.0:
            planted, hold = False, 1.0
        else:
            point = point + weight * hold * (stays - point)
            rot = maths.nlerp(rot, kept_rot, weight * hold)
    return Memory(weight, planted, kept_point, kept_rot, standing, hold), point, rot


def turn_between(a: Array, b: Array) -> float:
    """Angle from one rotation to another, rad."""
    between = multiply(maths.inverse(a), b)
    return 2.0 * math.atan2(maths.length(between[1:]), abs(float(between[0])))


def followed(foot: Foot, kept: Array) -> Array:
    """The kept point at the present height of the ground."""
    above = foot["target.foot_height"] + foot["probe.ray_up"]
    mask = int(foot["probe.layers"])
    hit = foot.terrain.cast(kept + foot.up * above, above + foot.extra, mask)
    return kept + foot.up * float(foot.up @ (hit.point - kept)) if hit.found else kept


def fade(
    foot: Foot, before: Memory | None, after: Memory, goal_ws: Array, goal_rot: Array
) -> tuple[Array, Array]:
    """Ankle target and foot rotation, world; completes the memory `after`."""
    after.fade = float(foot.found)
    time = foot["effector.transition_time"]
    if before is not None and time > 0.0:
        after.fade = maths.move_towards(before.fade, after.fade, foot.frame.dt / time)
    if foot.found:
        after.offset_ws = goal_ws - foot.pos_ws("ankle")
        after.rot_ws = multiply(goal_rot, maths.inverse(foot.world_from_foot))
    elif before is not None:
        after.offset_ws, after.rot_ws = before.offset_ws, before.rot_ws
    return foot.pos_ws("ankle") + after.offset_ws, multiply(after.rot_ws, foot.world_from_foot)


def pelvis_height(
    parameters: Parameters,
    feet: list[Foot],
    targets: list[Array],
    up: Array,
    state: State | None,
) -> float:
    """Height of the body above its animated position, m, at which every leg is long enough."""
    goal, lows, highs, loads = 0.0, [], [], []
    for foot, target in zip(feet, targets, strict=True):
        if foot.found:
            loads.append(foot.weight)
            gap = target - foot.pos_ws("hip")
            along = float(gap @ up)
            across_squared = float(gap @ gap) - along**2
            for ends, name in ((lows, "pelvis.min_length"), (highs, "pelvis.max_length")):
                ends.append(along + math.sqrt(max(foot[name] ** 2 - across_squared, 0.0)))
    if lows and parameters["pelvis.enabled"]:
        goal = max(0.0, *(load * low for load, low in zip(loads, lows, strict=True)))
        sunk = [lerp(goal, high, load) for load, high in zip(loads, highs, strict=True)]
        goal = min(goal, *sunk)
    if state is None or not parameters["pelvis.damp"]:
        return goal
    dt = feet[0].frame.dt
    return maths.move_by_speed(state.pelvis_height, goal, parameters["pelvis.speed"], dt)
