"""The `ozz` system in plain NumPy float64, after the foot IK sample of ozz-animation.

One character, one leg, one frame at a time, written from the description of the rules and not from
the code that is tested. Metres, radians, seconds; suffixes _ws world, _ms model.
`up` is that of the body; the rays and ankle height of a leg use its own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Parameters, Rig
from reference.maths import Array, Transform, apply, cross, from_axis_angle, length, rotate, unit
from reference.stages import ground, limb, pole, root
from reference.terrain import Hit

DEFAULTS: dict[str, Any] = {
    **root.DEFAULTS,
    "probe.ray_up": 0.5,
    "probe.ray_down": math.inf,
    "target.foot_height": 0.12,
    "target.max_slope": 1.5,
    "pelvis.enabled": True,
    "pelvis.limit": math.inf,
    "pelvis.on_gain": 1.0,
    "pelvis.off_gain": 1.0,
    "pelvis.tick_hz": 30.0,
    "leg.enabled": True,
    "leg.soften": 1.0,
    "leg.twist": 0.0,
    "leg.weight": 1.0,
    "foot.enabled": True,
    "foot.twist": 0.0,
    "foot.weight": 1.0,
    "foot.offset": np.zeros(3),
}


@dataclass
class State:
    """Memory between frames."""

    root: root.Root
    pelvis_height: float


@dataclass
class Foot:
    """One leg in this frame, world space, with the character already put on the ground."""

    ankle_ws: Array
    hit: Hit
    target_ws: Array
    weight: float


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame."""
    up = terrain.up
    legs = range(len(frame.weight))
    placed = root.place(parameters, terrain, frame, None if state is None else state.root)
    lift = placed.lift
    leg_weights = ground.weights_of_legs(parameters, frame)
    feet = [
        sense(parameters, characters.under(terrain, leg), frame, leg, up * lift, leg_weights[leg])
        for leg in legs
    ]
    pelvis = pelvis_height(parameters, feet, up, state, frame)
    pelvis_offset_ws = up * pelvis * frame.grounded
    body_offset_ws = up * lift + pelvis_offset_ws
    body = limb.body(frame, body_offset_ws, maths.IDENTITY)

    solved, reached, foot_reached, weights = [], [], [], []
    for leg, foot in zip(legs, feet, strict=True):
        weight = foot.weight if foot.hit.found else 0.0
        leg_weight = weight if parameters.of_leg("leg.enabled", leg) else 0.0
        hip, knee, ankle, arrived = solve_leg(parameters, rig, leg, frame, body, foot, leg_weight)
        rot, aimed = aim_foot(parameters, rig, leg, frame, foot, ankle, weight)
        ankle = Transform(ankle.pos, rot)
        solved.append((hip, knee, ankle, limb.toe(frame, leg, ankle)))
        reached.append(arrived)
        foot_reached.append(aimed)
        weights.append(leg_weight)

    output = {
        "body_pos": body.pos,
        "body_rot": body.rot,
        "lift": np.array(lift),
        "pelvis_height": np.array(pelvis),
        "pelvis_offset_ws": pelvis_offset_ws,
        "body_offset_ws": body_offset_ws,
        "found": np.array([foot.hit.found for foot in feet]),
        "target_ws": np.array([foot.target_ws for foot in feet]),
        "weight": np.array(weights),
        "reached": np.array(reached),
        "foot_reached": np.array(foot_reached),
    }
    return State(placed, pelvis), output | characters.joints(solved)


def run(
    parameters: Parameters, rig: Rig, terrain: Ground, frames: Sequence[Frame]
) -> dict[str, Array]:
    """All outputs of `step` for a whole clip, stacked over the frames."""
    return characters.run(step, parameters, rig, terrain, frames)


def sense(
    parameters: Parameters, terrain: Ground, frame: Frame, leg: int, lift_ws: Array, weight: float
) -> Foot:
    """Ray and ankle target of one leg."""
    up = terrain.up
    ankle_ws = apply(frame.world_from_model, frame.ankle.pos[leg]) + lift_ws
    ray_up = parameters.of_leg("probe.ray_up", leg)
    reach = ray_up + parameters.of_leg("probe.ray_down", leg)
    hit = terrain.cast(ankle_ws + up * ray_up, reach)
    target = ankle_ws
    if hit.found:
        steepest = math.cos(parameters.of_leg("target.max_slope", leg))
        cosine = max(float(hit.normal @ up), steepest)
        target = hit.point + up * (parameters.of_leg("target.foot_height", leg) / cosine)
    return Foot(ankle_ws=ankle_ws, hit=hit, target_ws=target, weight=weight)


def pelvis_height(
    parameters: Parameters, feet: list[Foot], up: Array, state: State | None, frame: Frame
) -> float:
    """Height of the body above its animated position along up, m.

    A foot with a partial weight counts as partly between the highest foot and itself.
    """
    gaps, weights = [], []
    for foot in feet:
        if foot.weight > 0.0:
            gaps.append(float(up @ (foot.target_ws - foot.ankle_ws)))
            weights.append(foot.weight if foot.hit.found else 0.0)
    contact = max(weights, default=0.0)
    if not parameters["pelvis.enabled"]:
        contact = 0.0
    top = max(gaps, default=0.0)
    low = min((top + w * (gap - top) for w, gap in zip(weights, gaps, strict=True)), default=0.0)
    limit = parameters["pelvis.limit"]
    goal = contact * maths.clip(low, -limit, limit)
    if state is None:
        return goal
    hz = parameters["pelvis.tick_hz"]
    on = maths.fraction_of_gain(parameters["pelvis.on_gain"], hz, frame.dt)
    off = maths.fraction_of_gain(parameters["pelvis.off_gain"], hz, frame.dt)
    return maths.lerp(state.pelvis_height, goal, maths.lerp(off, on, contact))


def solve_leg(
    parameters: Parameters,
    rig: Rig,
    leg: int,
    frame: Frame,
    body: Transform,
    foot: Foot,
    weight: float,
) -> tuple[Transform, Transform, Transform, bool]:
    """Hip, knee and ankle, model space; the pole is the carried knee's y axis."""
    knee = limb.carry(body, frame.knee, leg)
    ankle = limb.carry(body, frame.ankle, leg)
    hinge = rotate(knee.rot, rig.knee_axis_ls[leg])
    along_shin = unit(ankle.pos - knee.pos, np.zeros(3))
    return pole.solve_leg(
        rig,
        leg,
        frame,
        body,
        target=maths.unapply(frame.world_from_model, foot.target_ws),
        pole=cross(hinge, along_shin),
        soften=parameters.of_leg("leg.soften", leg),
        twist=parameters.of_leg("leg.twist", leg),
        weight=weight,
    )


def aim_foot(
    parameters: Parameters,
    rig: Rig,
    leg: int,
    frame: Frame,
    foot: Foot,
    ankle: Transform,
    weight: float,
) -> tuple[Array, bool]:
    """Model-space rotation of the ankle with its sole on the ground, and whether it gets there."""
    weight = weight * parameters.of_leg("foot.weight", leg)
    if not parameters.of_leg("foot.enabled", leg):
        weight = 0.0
    carried_ws = maths.multiply(frame.world_from_model.rot, ankle.rot)
    world_from_foot = maths.multiply(carried_ws, rig.ankle_from_foot[leg])
    toes = rotate(world_from_foot, maths.Z)
    look_at = foot.target_ws + foot.hit.normal
    correction, reached = aim(
        forward=rotate(world_from_foot, maths.Y),
        offset=rotate(world_from_foot, np.asarray(parameters.of_leg("foot.offset", leg))),
        up=toes,
        target=look_at - apply(frame.world_from_model, ankle.pos),
        pole=toes,
        twist=parameters.of_leg("foot.twist", leg),
    )
    correction = maths.nlerp(maths.IDENTITY, correction, weight)
    model_from_world = maths.inverse(frame.world_from_model.rot)
    rot = maths.multiply(model_from_world, maths.multiply(correction, carried_ws))
    return rot, reached and weight >= 1.0


def aim(
    forward: Array, offset: Array, up: Array, target: Array, pole: Array, twist: float
) -> tuple[Array, bool]:
    """Rotation after which the ray from `offset` along `forward` passes through `target`.

    `up` then faces `pole`. All (3) in one space, from the joint. The identity where the ray passes
    the joint farther away than the target is, or where the target is on the joint. Also whether
    the target is reached.
    """
    along = float(offset @ forward)
    root = float(target @ target) - float(offset @ offset) + along**2
    if root < 0.0:
        return maths.IDENTITY, False
    distance = length(target)
    if distance < maths.DIRECTIONLESS:
        return maths.IDENTITY, True
    direction = target / distance
    reach = offset + forward * (math.sqrt(root) - along)
    arc = maths.shortest_arc(unit(reach, direction), direction, up)
    to_pole = from_axis_angle(direction, maths.signed_angle(rotate(arc, up), pole, direction))
    return maths.multiply(from_axis_angle(direction, twist), maths.multiply(to_pole, arc)), True
