"""The `record` system in plain NumPy float64: one character, one leg, one frame at a time.

An oracle for the JAX stages. It is written from the description of the rules, with if/else, loops,
acos and atan2, so that an error would have to be made twice to go unnoticed. Metres, radians,
seconds, wxyz; suffixes _ws world, _ms model, _ls local. Model up is +Y, forward +Z, left +X; `up`
is that of the terrain.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from reference import characters, maths
from reference.characters import DEFAULTS, Frame, Ground, Parameters, Rig, State
from reference.maths import Transform
from reference.stages import contact_by_speed, ground, limb

# What differs as it comes; `DEFAULTS` are those of the faithful system.
STANDS_BY_SPEED = contact_by_speed.DEFAULTS | {
    "contact.planted_height": 0.09,
    "contact.raised_height": 0.12,
    "contact.raised_speed": 0.35,
    "contact.half_life": 0.03,
    "target.max_ankle_height": 1.0,
    "target.rise_half_life": 0.02,
    "target.fall_half_life": 0.02,
    "target.spring": True,
    "target.follow_slopes": True,
    "lock.hold_ball": True,
    "lock.release_max_angle": math.pi,
    "lock.release_heading": 0.5,
    "lock.relock_threshold": 0.5,
    "lock.unlock_half_life": 0.05,
    "lock.return_speed": 0.6,
    "pelvis.wait_to_rise": True,
    "leg.as_animated": True,
    "foot.max_pitch": 0.8,
    "foot.min_pitch": -1.0,
    "foot.max_roll": 0.45,
    "foot.min_roll": -0.6,
}
__all__ = ["DEFAULTS", "Frame", "Ground", "Parameters", "Rig", "State", "Transform", "run", "step"]


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, np.ndarray]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    up = terrain.up
    turned = frame.world_from_model.rot
    forward = ground.forward(turned, up)
    legs = range(len(frame.weight))
    feet = [ground.sense(parameters, rig, terrain, frame, leg) for leg in legs]
    standing = []
    if "contact.planted_speed" in parameters.values:
        for leg in legs:
            before = None if state is None else state.standing[leg]
            standing.append(contact_by_speed.stand(parameters, frame, leg, before))
        feet = [
            dataclasses.replace(
                foot, contact=now.weight, planted=now.standing, lifted=not now.standing
            )
            for foot, now in zip(feet, standing, strict=True)
        ]

    slide, slope, body_rot_ws, smooth_normal = ground.lean(
        parameters, feet, forward, up, state, frame
    )

    followed, footholds, targets = [], [], []
    for leg in legs:
        before = None if state is None else state.ground[leg]
        memory = ground.smooth_height(parameters, leg, feet[leg], up, before, frame)
        foothold, target = ground.clamped_target(
            parameters, leg, feet[leg], up, memory.height.value, frame
        )
        followed.append(memory)
        footholds.append(foothold)
        targets.append(target)

    holds, offsets, turns = [], [], []
    pelvis_before = np.zeros(3) if state is None else state.pelvis_offset_ws
    for leg in legs:
        before = None if state is None else state.holds[leg]
        hold, offset, turn = ground.lock(
            parameters, leg, feet[leg], footholds[leg], up, before, pelvis_before, frame
        )
        holds.append(hold)
        offsets.append(offset)
        turns.append(turn)
    targets = [target + offset for target, offset in zip(targets, offsets, strict=True)]

    pelvis = ground.pelvis_height(parameters, feet, targets, up, state, frame)
    direction = up if parameters["pelvis.vertical_only"] else smooth_normal
    pelvis_offset_ws = frame.grounded * pelvis * direction
    body_rot_ws = maths.nlerp(maths.IDENTITY, body_rot_ws, frame.grounded)
    body = limb.body(frame, pelvis_offset_ws, body_rot_ws)

    solved = []
    for leg in legs:
        target_ms = maths.unapply(frame.world_from_model, targets[leg])
        hip, knee, ankle, reached = limb.solve_leg(parameters, rig, leg, frame, body, target_ms)
        rot_ws = maths.multiply(turns[leg], maths.multiply(turned, frame.ankle.rot[leg]))
        rot = limb.foot(parameters, rig, leg, feet[leg], frame, knee, ankle, rot_ws, forward, up)
        ankle = Transform(ankle.pos, rot)
        solved.append((hip, knee, ankle, limb.toe(frame, leg, ankle), reached))

    state = State(
        ground=followed,
        slope=slope,
        slide_weight=slide,
        pelvis_height=pelvis,
        pelvis_offset_ws=pelvis_offset_ws,
        holds=holds,
        standing=standing,
    )
    output = {
        "body_pos": body.pos,
        "body_rot": body.rot,
        "reached": np.array([reached for *_, reached in solved]),
        "contact": np.array([foot.contact for foot in feet]),
        "locked": np.array([hold.locked for hold in holds]),
        "factor": np.array([hold.factor for hold in holds]),
        "offset_ws": np.array(offsets),
        "target_ws": np.array(targets),
        "slope": np.array([eased.value for eased in slope]),
        "slide_weight": np.array(slide),
        "ground_height": np.array([memory.height.value for memory in followed]),
        "pelvis_height": np.array(pelvis),
        "pelvis_offset_ws": pelvis_offset_ws,
    }
    output |= characters.joints([row[:4] for row in solved])
    return state, output


def run(
    parameters: Parameters, rig: Rig, terrain: Ground, frames: Sequence[Frame]
) -> dict[str, np.ndarray]:
    """All outputs of `step` for a whole clip, stacked over the frames."""
    return characters.run(step, parameters, rig, terrain, frames)
