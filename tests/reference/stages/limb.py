"""Body, leg and foot of the `record` reference: what moves the joints, without memory."""

import math

import numpy as np

from reference import maths
from reference.characters import Foot, Frame, Parameters, Rig
from reference.maths import (
    Array,
    Transform,
    across,
    apply,
    clip,
    cross,
    from_axis_angle,
    length,
    rotate,
    unit,
)
from reference.stages import ground

# Forward distance from ankle hit to toe hit, m, below which their heights give no pitch.
SHORT_FOOT = 0.01


def body(frame: Frame, offset_ws: Array, rot_ws: Array) -> Transform:
    """Motion of the body in model space: a rotation about the middle of the hips, and an offset."""
    model_from_world = maths.inverse(frame.world_from_model.rot)
    rot = maths.conjugate(rot_ws, model_from_world)
    pivot = np.mean(frame.hip.pos, axis=0)
    return Transform(pivot + rotate(model_from_world, offset_ws) - rotate(rot, pivot), rot)


def carry(transform: Transform, joint: Transform, leg: int) -> Transform:
    """One leg's joint, moved rigidly with the body."""
    return Transform(
        apply(transform, joint.pos[leg]), maths.multiply(transform.rot, joint.rot[leg])
    )


def solve_leg(
    parameters: Parameters, rig: Rig, leg: int, frame: Frame, body: Transform, target: Array
) -> tuple[Transform, Transform, Transform, bool]:
    """Hip, knee and ankle that bring the ankle to `target`, and whether they do; model space."""
    hip, knee, ankle = (carry(body, joint, leg) for joint in (frame.hip, frame.knee, frame.ankle))
    weight = ground.weights_of_legs(parameters, frame)[leg]
    axis = rotate(knee.rot, rig.knee_axis_ls[leg])
    distance = length(target - hip.pos)

    as_animated = parameters.of_leg("leg.as_animated", leg)
    nearest, soft_from, wanted = _wanted_distance(
        length(hip.pos - knee.pos),
        length(ankle.pos - knee.pos),
        distance,
        parameters.of_leg("leg.min_knee_angle", leg),
        parameters.of_leg("leg.max_knee_angle", leg),
        parameters.of_leg("leg.soften", leg),
        length(ankle.pos - hip.pos) if as_animated else None,
    )
    reached = nearest <= distance <= soft_from and weight >= 1.0

    knee_rot = from_axis_angle(
        axis, _knee_angle(hip.pos - knee.pos, ankle.pos - knee.pos, axis, wanted)
    )
    bent = knee.pos + rotate(knee_rot, ankle.pos - knee.pos)
    hip_rot = _hip_rotation(
        bent - hip.pos, target - hip.pos, axis, parameters.of_leg("leg.twist", leg)
    )

    return *rotated(hip, knee, ankle, hip_rot, knee_rot, weight), reached


def rotated(
    hip: Transform,
    knee: Transform,
    ankle: Transform,
    hip_rot: Array,
    knee_rot: Array,
    weight: float,
) -> tuple[Transform, Transform, Transform]:
    """Hip, knee and ankle after both rotations by a weight, the knee's first."""
    knee_rot = maths.nlerp(maths.IDENTITY, knee_rot, weight)
    hip_rot = maths.nlerp(maths.IDENTITY, hip_rot, weight)
    bent = knee.pos + rotate(knee_rot, ankle.pos - knee.pos)
    shin_rot = maths.multiply(hip_rot, knee_rot)
    return (
        Transform(hip.pos, maths.multiply(hip_rot, hip.rot)),
        Transform(
            hip.pos + rotate(hip_rot, knee.pos - hip.pos), maths.multiply(shin_rot, knee.rot)
        ),
        Transform(hip.pos + rotate(hip_rot, bent - hip.pos), maths.multiply(shin_rot, ankle.rot)),
    )


def _wanted_distance(
    a: float,
    b: float,
    distance: float,
    min_angle: float,
    max_angle: float,
    soften: float,
    animated: float | None,
) -> tuple[float, float, float]:
    """Nearest hip-ankle distance, where softening starts, and the softened distance, all m.

    The animated distance, if not None, is neither limited nor softened.
    """
    nearest = math.sqrt(max(a * a + b * b - 2.0 * a * b * math.cos(min_angle), 0.0))
    farthest = math.sqrt(max(a * a + b * b - 2.0 * a * b * math.cos(max_angle), 0.0))
    soft_from = soften * farthest
    if animated is not None:
        nearest, farthest = min(nearest, animated), max(farthest, animated)
        soft_from = max(soft_from, animated)
    room = farthest - soft_from
    wanted = distance
    if distance > soft_from:
        wanted = soft_from
        if room > 0.0:
            wanted += room * (1.0 - math.exp(-(distance - soft_from) / room))
    return nearest, soft_from, max(wanted, nearest)


def _knee_angle(to_hip: Array, to_ankle: Array, axis: Array, wanted: float) -> float:
    """Angle about the hinge `axis` that puts hip and ankle `wanted` m apart."""
    a, b = length(across(to_hip, axis)), length(across(to_ankle, axis))
    if min(a, b) < maths.DIRECTIONLESS:
        return 0.0
    along = float(axis @ to_hip) - float(axis @ to_ankle)
    in_plane = clip(wanted**2 - along**2, (a - b) ** 2, (a + b) ** 2)
    present = maths.signed_angle(to_hip, to_ankle, axis)
    if present < 0.0:
        present += 2.0 * math.pi
    return maths.interior_angle(a, b, in_plane) - present


def _hip_rotation(bent: Array, target: Array, axis: Array, twist: float) -> Array:
    """Rotation of the hip that points `bent` at `target`, keeps the bend plane, and twists."""
    along_leg = unit(bent, unit(target, -maths.Y))
    direction = unit(target, along_leg)
    arc = maths.shortest_arc(along_leg, direction, axis)
    level = from_axis_angle(direction, maths.signed_angle(rotate(arc, axis), axis, direction))
    return maths.multiply(from_axis_angle(direction, twist), maths.multiply(level, arc))


def foot(
    parameters: Parameters,
    rig: Rig,
    leg: int,
    foot: Foot,
    frame: Frame,
    knee: Transform,
    ankle: Transform,
    rot_ws: Array,
    forward: Array,
    up: Array,
) -> Array:
    """Model-space rotation of the ankle: `rot_ws`, tilted onto the ground within limits."""
    world_from_model = frame.world_from_model.rot
    foot_rot = maths.multiply(rot_ws, rig.ankle_from_foot[leg])
    foot_forward = rotate(foot_rot, maths.Z)
    heading = unit(across(foot_forward, up), forward)
    right = cross(heading, up)
    side = float(rig.side[leg])
    lateral = -side * right

    pitch, roll = _ground_angles(foot, heading, right, lateral, up)
    pitch, roll = pitch * foot.turned, roll * foot.turned

    shin = unit(rotate(world_from_model, ankle.pos - knee.pos), -up)
    joint_pitch = _joint_angle(foot_forward, shin)
    pitch = clip(
        joint_pitch + pitch,
        min(joint_pitch, parameters.of_leg("foot.min_pitch", leg)),
        max(joint_pitch, parameters.of_leg("foot.max_pitch", leg)),
    )
    tilt = from_axis_angle(right, pitch - joint_pitch)
    if side != 0.0:
        joint_roll = _joint_angle(side * rotate(foot_rot, maths.X), shin)
        roll = clip(
            joint_roll + roll,
            min(joint_roll, parameters.of_leg("foot.min_roll", leg)),
            max(joint_roll, parameters.of_leg("foot.max_roll", leg)),
        )
        roll_axis = rotate(tilt, unit(cross(lateral, up), heading))
        tilt = maths.multiply(from_axis_angle(roll_axis, roll - joint_roll), tilt)

    wanted = maths.multiply(maths.inverse(world_from_model), maths.multiply(tilt, rot_ws))
    weight = ground.weights_of_legs(parameters, frame)[leg]
    return maths.nlerp(ankle.rot, wanted, weight)


def _ground_angles(
    foot: Foot, heading: Array, right: Array, lateral: Array, up: Array
) -> tuple[float, float]:
    """Pitch (+ toes up) and then roll (+ outer edge up) of the ground under the foot."""
    if not foot.hit.found:
        return 0.0, 0.0
    normal = foot.hit.normal
    pitch = math.atan2(-float(normal @ heading), float(normal @ up))
    if foot.toe_hit.found:
        sole = foot.toe_hit.point - foot.hit.point
        if sole @ heading > SHORT_FOOT:
            pitch = math.atan2(float(sole @ up), float(sole @ heading))
    pitched_up = rotate(from_axis_angle(right, pitch), up)
    return pitch, math.atan2(-float(normal @ lateral), float(normal @ pitched_up))


def _joint_angle(foot_axis: Array, shin: Array) -> float:
    """Angle by which a foot's axis rises from the plane at right angles to the shin."""
    return math.atan2(-float(foot_axis @ shin), length(across(foot_axis, shin)))


def toe(frame: Frame, leg: int, ankle: Transform) -> Transform:
    """The toe, carried rigidly with the solved ankle."""
    change = maths.multiply(ankle.rot, maths.inverse(frame.ankle.rot[leg]))
    reach = frame.toe.pos[leg] - frame.ankle.pos[leg]
    return Transform(ankle.pos + rotate(change, reach), maths.multiply(change, frame.toe.rot[leg]))
