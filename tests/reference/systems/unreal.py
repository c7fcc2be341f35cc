"""The `unreal` system: feet find the ground while the character is idle."""

import functools
import math
from dataclasses import dataclass

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Leg, Parameters, Rig, named
from reference.maths import Array, move_by_speed
from reference.stages import limb

DEFAULTS = (
    named("probe", ray_up=0.9, ray_down=0.5)
    | {"contact.idle_speed": 0.0, "target.adjust": 0.0}
    | named("pelvis", enabled=True, speed=15.0, half_height=0.9)
    | named("effector", speed=15.0, latch=True, latch_distance=0.01)
    | named("leg", min_knee_angle=0.0, max_knee_angle=math.pi, soften=1.0, twist=0.0)
    | named("leg", as_animated=False, weight=1.0)
)


@dataclass
class State:
    """Memory between frames; `effector` has one entry per leg. Heights in m along up."""

    hip: float
    half_height: float
    effector: list[float]
    asleep: bool


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    legs = characters.legs_of(parameters, rig, terrain, frame)
    idle = frame.speed <= parameters["contact.idle_speed"]
    found, offsets = zip(*(ground_offset(leg) for leg in legs), strict=True)
    offsets = [offset if idle else 0.0 for offset in offsets]

    hip_goal = 0.0
    if parameters["pelvis.enabled"]:
        hip_goal = min(0.0, *(leg.weight * x for x, leg in zip(offsets, legs, strict=True)))
    goals = [offset - hip_goal for offset in offsets]
    state = advance(parameters, state, idle, hip_goal, goals, legs)

    offset_ws = terrain.up * state.hip * frame.grounded
    body = limb.body(frame, offset_ws, maths.IDENTITY)
    solved, targets = [], []
    for leg, effector in zip(legs, state.effector, strict=True):
        target_ws = leg.pos_ws("ankle") + offset_ws + leg.up * effector
        target_ms = maths.unapply(frame.world_from_model, target_ws)
        bent = limb.solve_leg(leg, body, target_ms)
        # The body does not rotate, so the animated model-space rotation is the world's as well.
        rot = maths.nlerp(bent.ankle.rot, leg.joint("ankle").rot, leg.weight)
        solved.append(limb.with_foot(leg, bent, rot))
        targets.append(target_ws)

    output = characters.solution(body, solved) | {
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
        "weight": np.array([leg.weight for leg in legs]),
    }
    return state, output


run = functools.partial(characters.run, step)


def ground_offset(leg: Leg) -> tuple[bool, float]:
    """Whether the ray at the foot's horizontal position hits ground; the foot's offset, m."""
    up, ankle_ws = leg.up, leg.pos_ws("ankle")
    origin_height = float(up @ leg.frame.world_from_model.pos)
    top = origin_height + leg["probe.ray_up"]
    bottom = origin_height - leg["probe.ray_down"]
    hit = leg.terrain.cast(ankle_ws + up * (top - float(up @ ankle_ws)), top - bottom)
    if not hit.found:
        return False, 0.0
    return True, float(up @ hit.point) - origin_height + leg["target.adjust"]


def advance(
    parameters: Parameters,
    state: State | None,
    idle: bool,
    hip_goal: float,
    goals: list[float],
    legs: list[Leg],
) -> State:
    """Hip, capsule and effectors after one frame, and whether the feet have come to rest."""
    latches = bool(idle and parameters["effector.latch"])
    half_height_goal = parameters["pelvis.half_height"] - abs(hip_goal) / 2.0
    if state is None:
        hip, half_height, effector = hip_goal, half_height_goal, goals
    elif state.asleep and latches:
        return state
    else:
        speed, dt = parameters["pelvis.speed"], legs[0].frame.dt
        hip = move_by_speed(state.hip, hip_goal, speed, dt)
        half_height = move_by_speed(state.half_height, half_height_goal, speed, dt)
        effector = [
            move_by_speed(before, goal, leg["effector.speed"], dt)
            for before, goal, leg in zip(state.effector, goals, legs, strict=True)
        ]
    near = [
        abs(goal - now) <= leg["effector.latch_distance"] or leg.weight == 0.0
        for goal, now, leg in zip(goals, effector, legs, strict=True)
    ]
    return State(hip, half_height, effector, latches and all(near))
