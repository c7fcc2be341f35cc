"""The `record` system: a lock, a lean and two rays per foot."""

import functools
import math
from dataclasses import replace

import numpy as np

from reference import characters, maths
from reference.characters import DEFAULTS, Frame, Ground, Parameters, Rig, named
from reference.maths import Array, Transform
from reference.stages import ground, limb
from reference.stages.ground import State

# What differs as it comes; `DEFAULTS` are those of the faithful system.
STANDS_BY_SPEED = (
    ground.BY_SPEED
    | named("contact", planted_height=0.09, raised_height=0.12, raised_speed=0.35, half_life=0.03)
    | named("target", max_ankle_height=1.0, rise_half_life=0.02, fall_half_life=0.02)
    | named("target", spring=True, follow_slopes=True)
    | named("lock", hold_ball=True, release_max_angle=math.pi, release_heading=0.5)
    | named("lock", relock_threshold=0.5, unlock_half_life=0.05, return_speed=0.6)
    | {"pelvis.wait_to_rise": True, "pelvis.min_extension": 0.36}
    | {"leg.as_animated": True, "leg.soften": 0.98}
    | named("foot", max_pitch=1.0, min_pitch=-1.0, max_roll=0.45, min_roll=-0.6)
)
__all__ = ["DEFAULTS", "Frame", "Ground", "Parameters", "Rig", "State", "Transform", "run", "step"]


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    up = terrain.up
    forward = characters.forward(frame.world_from_model.rot, up)
    feet = [ground.sense(leg) for leg in characters.legs_of(parameters, rig, terrain, frame)]
    standing = [None] * len(feet)
    if "contact.planted_speed" in parameters.values:
        before = state.standing if state else standing
        standing = [ground.stand(foot, x) for foot, x in zip(feet, before, strict=True)]
        feet = [
            replace(foot, contact=now.weight, planted=now.standing, lifted=not now.standing)
            for foot, now in zip(feet, standing, strict=True)
        ]
    slide, slope, lean_ws, normal = ground.lean(parameters, feet, forward, up, state, frame)

    followed, holds, offsets, turns, targets = [], [], [], [], []
    pelvis_before = state.pelvis_offset_ws if state else np.zeros(3)
    for foot in feet:
        memory = ground.smooth_height(foot, state.ground[foot.index] if state else None)
        foothold, target = ground.clamped_target(foot, memory.height.value)
        hold, offset, turn = ground.lock(
            foot, foothold, state.holds[foot.index] if state else None, pelvis_before
        )
        followed.append(memory)
        holds.append(hold)
        offsets.append(offset)
        turns.append(turn)
        targets.append(target + offset)

    before = state.pelvis_height if state else None
    pelvis = ground.pelvis_height(parameters, feet, targets, up, before)
    direction = up if parameters["pelvis.vertical_only"] else normal
    offset_ws = frame.grounded * pelvis * direction
    body = limb.body(frame, offset_ws, maths.nlerp(maths.IDENTITY, lean_ws, frame.grounded))

    solved = []
    for foot, target, turn in zip(feet, targets, turns, strict=True):
        target_ms = maths.unapply(frame.world_from_model, target)
        leg = limb.solve_leg(foot, body, target_ms)
        rot = limb.turn_foot(foot, leg, maths.multiply(turn, foot.ankle_rot_ws), forward)
        solved.append(limb.with_foot(foot, leg, rot))

    output = characters.solution(body, solved) | {
        "contact": np.array([foot.contact for foot in feet]),
        "locked": np.array([hold.locked for hold in holds]),
        "factor": np.array([hold.factor for hold in holds]),
        "offset_ws": np.array(offsets),
        "target_ws": np.array(targets),
        "slope": np.array([eased.value for eased in slope]),
        "slide_weight": np.array(slide),
        "ground_height": np.array([memory.height.value for memory in followed]),
        "pelvis_height": np.array(pelvis),
        "pelvis_offset_ws": offset_ws,
    }
    return State(followed, slope, slide, pelvis, offset_ws, holds, standing), output


run = functools.partial(characters.run, step)
