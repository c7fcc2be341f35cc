"""The `unreal` system in plain NumPy float64: feet find the ground while the character is idle.

One character, one leg, one frame at a time, written from the description of the rules and not from
the code that is tested. Metres, radians, seconds; suffixes _ws world, _ms model.
`up` is that of the body; the ray and effector of a leg use its own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Parameters, Rig
from reference.maths import Array, Transform, apply
from reference.stages import ground, limb

DEFAULTS: dict[str, Any] = {
    "probe.ray_up": 0.9,
    "probe.ray_down": 0.5,
    "contact.idle_speed": 0.0,
    "target.adjust": 0.0,
    "pelvis.enabled": True,
    "pelvis.speed": 15.0,
    "pelvis.half_height": 0.9,
    "effector.speed": 15.0,
    "effector.latch": True,
    "effector.latch_distance": 0.01,
    "leg.min_knee_angle": 0.0,
    "leg.max_knee_angle": math.pi,
    "leg.soften": 1.0,
    "leg.twist": 0.0,
    "leg.as_animated": False,
    "leg.weight": 1.0,
}


@dataclass
class State:
    """Memory between frames; lists have one entry per leg. Heights in m along up."""

    hip: float
    half_height: float
    effector: list[float]
    asleep: bool


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    legs = range(len(frame.weight))
    leg_weights = ground.weights_of_legs(parameters, frame)
    idle = frame.speed <= parameters["contact.idle_speed"]
    found, offsets = [], []
    for leg in legs:
        hit, offset = ground_offset(parameters, characters.under(terrain, leg), frame, leg)
        found.append(hit)
        offsets.append(offset if idle else 0.0)

    hip_goal = 0.0
    if parameters["pelvis.enabled"]:
        for offset, weight in zip(offsets, leg_weights, strict=True):
            if weight > 0.0:
                hip_goal = min(hip_goal, offset)
    goals = [offset - hip_goal for offset in offsets]
    state = advance(parameters, state, idle, hip_goal, goals, leg_weights, frame.dt)

    offset_ws = terrain.up * state.hip * frame.grounded
    body = limb.body(frame, offset_ws, maths.IDENTITY)
    solved, reached, targets = [], [], []
    for leg in legs:
        raised = characters.under(terrain, leg).up * state.effector[leg]
        target_ws = apply(frame.world_from_model, frame.ankle.pos[leg])
        target_ws = target_ws + offset_ws + raised
        target_ms = maths.unapply(frame.world_from_model, target_ws)
        hip, knee, ankle, arrived = limb.solve_leg(parameters, rig, leg, frame, body, target_ms)
        # The body does not rotate, so the animated model-space rotation is the world's as well.
        ankle = Transform(ankle.pos, maths.nlerp(ankle.rot, frame.ankle.rot[leg], leg_weights[leg]))
        solved.append((hip, knee, ankle, limb.toe(frame, leg, ankle)))
        reached.append(arrived)
        targets.append(target_ws)

    output = {
        "body_pos": body.pos,
        "body_rot": body.rot,
        "hip": np.array(state.hip),
        "pelvis_height": np.array(state.hip),
        "pelvis_offset_ws": offset_ws,
        "body_offset_ws": offset_ws,
        "half_height": np.array(state.half_height),
        "effector": np.array(state.effector),
        "asleep": np.array(state.asleep),
        "idle": np.array(idle),
        "found": np.array(found),
        "target_ws": np.array(targets),
        "weight": np.array(leg_weights),
        "reached": np.array(reached),
    }
    return state, output | characters.joints(solved)


def run(
    parameters: Parameters, rig: Rig, terrain: Ground, frames: Sequence[Frame]
) -> dict[str, Array]:
    """All outputs of `step` for a whole clip, stacked over the frames."""
    return characters.run(step, parameters, rig, terrain, frames)


def ground_offset(
    parameters: Parameters, terrain: Ground, frame: Frame, leg: int
) -> tuple[bool, float]:
    """Whether the ray at the foot's horizontal position hits ground; the foot's offset, m."""
    up = terrain.up
    origin_height = float(up @ frame.world_from_model.pos)
    ankle_ws = apply(frame.world_from_model, frame.ankle.pos[leg])
    top = origin_height + parameters.of_leg("probe.ray_up", leg)
    bottom = origin_height - parameters.of_leg("probe.ray_down", leg)
    hit = terrain.cast(ankle_ws + up * (top - float(up @ ankle_ws)), top - bottom)
    if not hit.found:
        return False, 0.0
    return True, float(up @ hit.point) - origin_height + parameters.of_leg("target.adjust", leg)


def advance(
    parameters: Parameters,
    state: State | None,
    idle: bool,
    hip_goal: float,
    goals: list[float],
    leg_weights: list[float],
    dt: float,
) -> State:
    """Hip, capsule and effectors after one frame, and whether the feet have come to rest."""
    half_height_goal = parameters["pelvis.half_height"] - abs(hip_goal) / 2.0
    if state is None:
        hip, half_height, effector = hip_goal, half_height_goal, list(goals)
    elif state.asleep and idle and parameters["effector.latch"]:
        return state
    else:
        speed = parameters["pelvis.speed"]
        hip = maths.move_by_speed(state.hip, hip_goal, speed, dt)
        half_height = maths.move_by_speed(state.half_height, half_height_goal, speed, dt)
        effector = [
            maths.move_by_speed(before, goal, parameters.of_leg("effector.speed", leg), dt)
            for leg, (before, goal) in enumerate(zip(state.effector, goals, strict=True))
        ]
    asleep = bool(idle and parameters["effector.latch"])
    for leg, weight in enumerate(leg_weights):
        near = abs(goals[leg] - effector[leg]) <= parameters.of_leg("effector.latch_distance", leg)
        if weight > 0.0 and not near:
            asleep = False
    return State(hip, half_height, effector, asleep)
