"""Three rays under a foot of the `mec` reference, and the foot laid flat on their hits; world."""

import math
from dataclasses import dataclass

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Parameters, Rig
from reference.maths import Array, across, apply, cross, from_axis_angle, rotate, unit
from reference.stages import ground
from reference.terrain import Hit


@dataclass
class Foot:
    """One leg in this frame, world space. Where `found` is false, `hit` is meaningless."""

    up: Array
    weight: float
    ankle_ws: Array
    animated_rot: Array  # from the axes of the foot to the world
    extra: float
    found: bool
    hit: Hit
    ahead: Array
    pitch: float
    roll: float
    toe_point: Array


def extra_length(
    parameters: Parameters, frame: Frame, leg: int, up: Array, ankle_ws: Array
) -> float:
    """How far the rays reach below the sole, m."""
    by_height = parameters.of_leg("probe.by_height", leg)
    by_speed = parameters.of_leg("probe.by_speed", leg)
    if not by_height and not by_speed:
        return parameters.of_leg("probe.extra", leg)
    height = float(up @ (ankle_ws - frame.world_from_model.pos))
    stable = True
    if by_height and height > parameters.of_leg("probe.stable_height", leg):
        stable = False
    if by_speed and frame.foot_speed[leg] > parameters.of_leg("probe.stable_speed", leg):
        stable = False
    return parameters.of_leg("probe.extra_max" if stable else "probe.extra_min", leg)


def sense(
    parameters: Parameters, rig: Rig, terrain: Ground, frame: Frame, leg: int, weight: float
) -> Foot:
    """The foot's three rays and the tilt of the ground that follows from them."""
    up = terrain.up
    ankle_ws = apply(frame.world_from_model, frame.ankle.pos[leg])
    animated_rot = characters.world_from_foot(rig, frame, leg)
    foot_forward = rotate(animated_rot, np.asarray(parameters.of_leg("probe.forward", leg)))
    ahead = unit(across(foot_forward, up), ground.forward(frame.world_from_model.rot, up))
    right = cross(ahead, up)

    extra = extra_length(parameters, frame, leg, up, ankle_ws)
    sole = parameters.of_leg("target.foot_height", leg)
    above = up * parameters.of_leg("probe.ray_up", leg)
    reach = parameters.of_leg("probe.ray_up", leg) + sole + extra
    mask = int(parameters.of_leg("probe.layers", leg))
    foot_length = parameters.of_leg("probe.foot_length", leg)
    half_width = parameters.of_leg("probe.half_width", leg)

    hit = terrain.cast(ankle_ws + above, reach, mask)
    pitch, roll = 0.0, 0.0
    if not (hit.found and parameters.of_leg("probe.active", leg)):
        found = False
        toe_point = ankle_ws - up * sole + ahead * foot_length
    else:
        found = True
        goal = hit.point + up * sole
        toe_point = hit.point + ahead * foot_length
        toe = terrain.cast(goal + ahead * foot_length + above, reach, mask)
        if toe.found:
            toe_point = toe.point
            pitch = math.atan2(float(up @ (toe.point - hit.point)), foot_length)
        corner = terrain.cast(goal + right * half_width + above, reach, mask)
        if corner.found:
            roll = math.atan2(float(up @ (corner.point - hit.point)), half_width)
    return Foot(
        up=up,
        weight=weight,
        ankle_ws=ankle_ws,
        animated_rot=animated_rot,
        extra=float(extra),
        found=found,
        hit=hit,
        ahead=ahead,
        pitch=pitch,
        roll=roll,
        toe_point=toe_point,
    )


def flat_foot(parameters: Parameters, leg: int, foot: Foot) -> Array:
    """Rotation from the foot's axes to the world that lays it flat with its animated yaw."""
    pitch = from_axis_angle(cross(foot.ahead, foot.up), foot.pitch)
    tilt = limited(
        maths.multiply(pitch, from_axis_angle(foot.ahead, -foot.roll)),
        parameters.of_leg("foot.max_tilt", leg),
    )
    upright = maths.shortest_arc(maths.Y, foot.up, maths.X)
    forward = np.asarray(parameters.of_leg("probe.forward", leg))
    level = unit(across(forward, maths.Y), maths.Z)
    yaw = maths.signed_angle(rotate(upright, level), foot.ahead, foot.up)
    return maths.multiply(tilt, maths.multiply(from_axis_angle(foot.up, yaw), upright))


def limited(rot: Array, limit: float) -> Array:
    """The rotation `rot`, by less than pi, with its angle limited to `limit` rad."""
    sine = maths.length(rot[1:])
    angle = 2.0 * math.atan2(sine, float(rot[0]))
    if angle <= limit:
        return rot
    return from_axis_angle(rot[1:] / sine, limit)
