"""The heels of the `stride` reference: they rise where a leg would be too long."""

import math

from reference import maths
from reference.characters import Foot, Frame, Parameters
from reference.maths import Array, across, clip, cross, length, rotate, smooth01

RISES, STAYS = 0.2, 0.4  # sine of a leg's angle ahead of its hip


def leg_length(frame: Frame, leg: int) -> float:
    """Thigh and shin together, m."""
    hip, knee, ankle = (joint.pos[leg] for joint in (frame.hip, frame.knee, frame.ankle))
    return length(hip - knee) + length(knee - ankle)


def raised(
    parameters: Parameters,
    frame: Frame,
    leg: int,
    foot: Foot,
    target: Array,
    turn: Array,
    offset_ws: Array,
    up: Array,
) -> tuple[Array, Array, float]:
    """Ankle target, ankle rotation, and the angle by which the heel rises about the ball, rad.

    `turn` is the rotation (4) that the foot's lock gives it, world space.
    """
    rot_ws = maths.multiply(frame.world_from_model.rot, frame.ankle.rot[leg])
    rot_ws = maths.multiply(turn, rot_ws)
    tilt = onto_ground(foot, up)
    from_ball = rotate(tilt, rotate(turn, foot.ankle_ws - foot.ball_ws))
    ball = target - from_ball
    hip = foot.hip_ws + offset_ws
    longest = max(
        parameters.of_leg("effector.extension", leg) * leg_length(frame, leg),
        length(foot.ankle_ws - foot.hip_ws),
    )
    level_axis = cross(foot.heading_ws, up)
    axis = rotate(tilt, level_axis)
    square = across(from_ball, axis)
    to_ball = ball - hip
    fixed = to_ball + (from_ball - square)
    middle = float(fixed @ fixed) + float(square @ square)
    by_cosine = 2.0 * float(fixed @ square)
    by_sine = -2.0 * float(fixed @ cross(axis, square))
    lift = 0.0
    if by_sine < 0.0:
        reach = math.hypot(by_cosine, by_sine)
        angle = math.acos(clip((longest**2 - middle) / reach, -1.0, 1.0))
        angle += math.atan2(by_sine, by_cosine)
        lift = clip(angle, 0.0, parameters.of_leg("effector.max_lift", leg))
    to_ankle = target - hip
    ahead = float(to_ankle @ foot.heading_ws) / length(to_ankle)
    lift *= 1.0 - smooth01((ahead - RISES) / (STAYS - RISES))
    ankle = ball + rotate(maths.from_axis_angle(axis, -lift), from_ball)
    # The foot stage tilts the foot after its heel has risen.
    return ankle, maths.multiply(maths.from_axis_angle(level_axis, -lift), rot_ws), lift


def onto_ground(foot: Foot, up: Array) -> Array:
    """The rotation by which a level sole comes to lie on the ground, as far as the foot turns."""
    whole = maths.shortest_arc(up, foot.hit.normal, foot.heading_ws)
    return maths.nlerp(maths.IDENTITY, whole, foot.turned)
