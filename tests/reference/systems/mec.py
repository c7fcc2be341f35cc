"""The `mec` system in plain NumPy float64: three rays per foot, planting, hints, fades.

One character, one leg, one frame at a time, written from the description of the rules and not from
the code that is tested. Metres, radians, seconds; suffixes _ws world, _ms model.
Each foot has an up of its own, that of its terrain; the body has another.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Parameters, Rig
from reference.maths import Array, Transform, apply, rotate
from reference.stages import contact_by_speed, ground, limb, pole, three_ray_probe
from reference.stages.contact_by_speed import Standing
from reference.stages.three_ray_probe import Foot
from reference.terrain import ALL_LAYERS

DEFAULTS: dict[str, Any] = {
    "probe.ray_up": 0.5,
    "probe.foot_length": 0.2,
    "probe.half_width": 0.05,
    "probe.forward": np.array([0.0, 0.0, 1.0]),
    "probe.active": True,
    "probe.extra": 0.2,
    "probe.by_height": True,
    "probe.by_speed": False,
    "probe.extra_min": 0.0,
    "probe.extra_max": 0.3,
    "probe.stable_height": 0.12,
    "probe.stable_speed": 0.5,
    "probe.layers": ALL_LAYERS,
    "target.foot_height": 0.10,
    "lock.plant": True,
    "lock.plant_weight": 1.0,
    "lock.plant_speed": math.inf,
    "pelvis.enabled": True,
    "pelvis.min_length": 0.5,
    "pelvis.max_length": 0.88,
    "pelvis.damp": True,
    "pelvis.speed": 10.0,
    "effector.transition_time": 0.2,
    "leg.hint_offset": np.zeros(3),
    "leg.soften": 1.0,
    "leg.twist": 0.0,
    "leg.weight": 1.0,
    "foot.max_tilt": math.radians(45.0),
}

# As it comes; `DEFAULTS` are those of the faithful system.
STANDS_BY_SPEED: dict[str, Any] = {
    **{name: value for name, value in DEFAULTS.items() if name != "leg.hint_offset"},
    **contact_by_speed.DEFAULTS,
    "contact.planted_height": 0.09,
    "contact.raised_height": 0.12,
    "contact.raised_speed": 0.35,
    "probe.by_speed": True,
    "probe.stable_speed": 0.25,
    "probe.stable_height": 0.095,
    "probe.extra_min": -0.03,
    "target.foot_height": 0.085,
}


@dataclass
class Leg:
    """Memory of one leg."""

    plant_weight: float
    planted: bool
    kept_point: Array  # m, world
    kept_rot: Array  # from the axes of the foot to the world
    fade: float
    offset_ws: Array  # m, from the animated ankle to the last goal
    rot_ws: Array  # from the animated rotation to the last goal's
    standing: Standing | None = None  # None where all feet always stand


@dataclass
class State:
    """Memory between frames."""

    pelvis_height: float
    legs: list[Leg]


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    up = terrain.up
    legs = range(len(frame.weight))
    leg_weights = ground.weights_of_legs(parameters, frame)
    feet, memory, goals = [], [], []
    for leg in legs:
        below = characters.under(terrain, leg)
        foot = three_ray_probe.sense(parameters, rig, below, frame, leg, leg_weights[leg])
        before = None if state is None else state.legs[leg]
        standing = None
        if "contact.planted_speed" in parameters.values:
            stood = None if before is None else before.standing
            standing = contact_by_speed.stand(parameters, frame, leg, stood)
        after, point, rot = plant(parameters, below, frame, leg, foot, standing, before)
        height = parameters.of_leg("target.foot_height", leg)
        goals.append(
            fade(parameters, frame, leg, foot, before, after, point + foot.up * height, rot)
        )
        feet.append(foot)
        memory.append(after)

    targets = [target for target, _ in goals]
    pelvis = pelvis_height(parameters, feet, targets, up, state, frame)
    offset_ws = up * pelvis * frame.grounded
    body = limb.body(frame, offset_ws, maths.IDENTITY)

    solved, reached, weights, hints = [], [], [], []
    for leg in legs:
        target_ws, rot_ws = goals[leg]
        weight = leg_weights[leg] * memory[leg].fade
        bends_as_animated = "leg.hint_offset" not in parameters.values
        hint_ws = None if bends_as_animated else knee_hint(parameters, frame, leg, feet[leg])
        hip, knee, ankle, arrived = solve_leg(
            parameters, rig, leg, frame, body, target_ws, hint_ws, weight
        )
        model_from_foot = maths.multiply(maths.inverse(frame.world_from_model.rot), rot_ws)
        wanted = maths.multiply(model_from_foot, maths.inverse(rig.ankle_from_foot[leg]))
        ankle = Transform(ankle.pos, maths.nlerp(ankle.rot, wanted, weight))
        solved.append((hip, knee, ankle, limb.toe(frame, leg, ankle)))
        reached.append(arrived)
        weights.append(weight)
        hints.append(np.zeros(3) if hint_ws is None else hint_ws)

    output = {
        "body_pos": body.pos,
        "body_rot": body.rot,
        "pelvis_height": np.array(pelvis),
        "pelvis_offset_ws": offset_ws,
        "body_offset_ws": offset_ws,
        "found": np.array([foot.found for foot in feet]),
        "extra": np.array([foot.extra for foot in feet]),
        "pitch": np.array([foot.pitch for foot in feet]),
        "roll": np.array([foot.roll for foot in feet]),
        "target_ws": np.array(targets),
        "goal_rot": np.array([rot for _, rot in goals]),
        "planted": np.array([after.planted for after in memory]),
        "plant_weight": np.array([after.plant_weight for after in memory]),
        "fade": np.array([after.fade for after in memory]),
        "weight": np.array(weights),
        "hint_ws": np.array(hints),
        "reached": np.array(reached),
    }
    return State(pelvis, memory), output | characters.joints(solved)


def run(
    parameters: Parameters, rig: Rig, terrain: Ground, frames: Sequence[Frame]
) -> dict[str, Array]:
    """All outputs of `step` for a whole clip, stacked over the frames."""
    return characters.run(step, parameters, rig, terrain, frames)


def plant(
    parameters: Parameters,
    terrain: Ground,
    frame: Frame,
    leg: int,
    foot: Foot,
    standing: Standing | None,
    before: Leg | None,
) -> tuple[Leg, Array, Array]:
    """Memory of the leg without its fade; foothold and rotation of the foot there, world."""
    goal_weight = parameters.of_leg("lock.plant_weight", leg)
    speed = parameters.of_leg("lock.plant_speed", leg)
    if before is None or math.isinf(speed):
        weight = goal_weight
    else:
        weight = maths.move_towards(before.plant_weight, goal_weight, speed * frame.dt)

    point, rot = foot.hit.point, foot.animated_rot
    if foot.found:
        rot = three_ray_probe.flat_foot(parameters, leg, foot)
    stands = standing is None or standing.standing
    takes_part = ground.weights_of_legs(parameters, frame)[leg] > 0.0
    plants = parameters.of_leg("lock.plant", leg) and takes_part
    planted = bool(foot.found and stands and plants)
    kept_point, kept_rot = np.zeros(3), maths.IDENTITY
    if planted:
        if before is not None and before.planted:
            kept_point = characters.carried(frame, foot.hit, before.kept_point)
            kept_rot = characters.turned(frame, foot.hit, before.kept_rot)
        else:
            kept_point, kept_rot = point, rot
        followed_point = followed(parameters, terrain, leg, foot, kept_point)
        point = point + weight * (followed_point - point)
        rot = maths.nlerp(rot, kept_rot, weight)
    after = Leg(weight, planted, kept_point, kept_rot, 0.0, np.zeros(3), maths.IDENTITY, standing)
    return after, point, rot


def followed(parameters: Parameters, terrain: Ground, leg: int, foot: Foot, kept: Array) -> Array:
    """The kept point at the present height of the ground."""
    above = parameters.of_leg("target.foot_height", leg) + parameters.of_leg("probe.ray_up", leg)
    mask = int(parameters.of_leg("probe.layers", leg))
    hit = terrain.cast(kept + foot.up * above, above + foot.extra, mask)
    if not hit.found:
        return kept
    return kept + foot.up * float(foot.up @ (hit.point - kept))


def fade(
    parameters: Parameters,
    frame: Frame,
    leg: int,
    foot: Foot,
    before: Leg | None,
    after: Leg,
    goal_ws: Array,
    goal_rot: Array,
) -> tuple[Array, Array]:
    """Ankle target and foot rotation, world; completes the memory `after`."""
    end = 1.0 if foot.found else 0.0
    time = parameters.of_leg("effector.transition_time", leg)
    if before is None or time <= 0.0:
        after.fade = end
    else:
        after.fade = maths.move_towards(before.fade, end, frame.dt / time)
    if foot.found:
        after.offset_ws = goal_ws - foot.ankle_ws
        after.rot_ws = maths.multiply(goal_rot, maths.inverse(foot.animated_rot))
    elif before is not None:
        after.offset_ws, after.rot_ws = before.offset_ws, before.rot_ws
    return foot.ankle_ws + after.offset_ws, maths.multiply(after.rot_ws, foot.animated_rot)


def pelvis_height(
    parameters: Parameters,
    feet: list[Foot],
    targets: list[Array],
    up: Array,
    state: State | None,
    frame: Frame,
) -> float:
    """Height of the body above its animated position, m, at which every leg is long enough."""
    goal, lows, highs = 0.0, [], []
    for leg, (foot, target) in enumerate(zip(feet, targets, strict=True)):
        if not foot.found or foot.weight <= 0.0:
            continue
        gap = target - apply(frame.world_from_model, frame.hip.pos[leg])
        along = float(gap @ up)
        across_squared = float(gap @ gap) - along**2
        shortest = parameters.of_leg("pelvis.min_length", leg)
        longest = parameters.of_leg("pelvis.max_length", leg)
        lows.append(along + math.sqrt(max(shortest**2 - across_squared, 0.0)))
        highs.append(along + math.sqrt(max(longest**2 - across_squared, 0.0)))
    if lows and parameters["pelvis.enabled"]:
        goal = min(max(0.0, max(lows)), min(highs))
    if state is None or not parameters["pelvis.damp"]:
        return goal
    return maths.move_by_speed(state.pelvis_height, goal, parameters["pelvis.speed"], frame.dt)


def knee_hint(parameters: Parameters, frame: Frame, leg: int, foot: Foot) -> Array:
    """The point that the knee is to look at from the hip, m, world."""
    calf = frame.knee.pos[leg] - frame.ankle.pos[leg]
    moved = calf + np.asarray(parameters.of_leg("leg.hint_offset", leg))
    return foot.toe_point + rotate(frame.world_from_model.rot, moved)


def solve_leg(
    parameters: Parameters,
    rig: Rig,
    leg: int,
    frame: Frame,
    body: Transform,
    target_ws: Array,
    hint_ws: Array | None,
    weight: float,
) -> tuple[Transform, Transform, Transform, bool]:
    """Hip, knee and ankle, model space.

    The pole leads from the carried hip to the hint; without one it is that of the animated knee.
    """
    hip, knee, ankle = (
        limb.carry(body, joint, leg) for joint in (frame.hip, frame.knee, frame.ankle)
    )
    if hint_ws is None:
        hinge = rotate(knee.rot, rig.knee_axis_ls[leg])
        towards = maths.cross(hinge, ankle.pos - knee.pos)
    else:
        towards = maths.unapply(frame.world_from_model, hint_ws) - hip.pos
    return pole.solve_leg(
        rig,
        leg,
        frame,
        body,
        target=maths.unapply(frame.world_from_model, target_ws),
        pole=towards,
        soften=parameters.of_leg("leg.soften", leg),
        twist=parameters.of_leg("leg.twist", leg),
        weight=weight,
    )
