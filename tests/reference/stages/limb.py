"""What moves the joints, without memory: body, leg, heel, foot and toe."""

import math
from typing import NamedTuple

import numpy as np

from reference import maths
from reference.characters import Frame, Leg
from reference.maths import Array, Transform, across, clip, cross, length, multiply, rotate, unit
from reference.stages.ground import Foot

# Forward distance from ankle hit to toe hit, m, below which their heights give no pitch.
SHORT_FOOT = 0.01
# Sine of a leg's angle ahead of its hip, up to which a heel rises, and from which it stays.
RISES, STAYS, SHORTENS = 0.0, 0.3, 0.3


class Solved(NamedTuple):
    """Joints of a leg, model space, and whether its ankle reaches what it should."""

    hip: Transform
    knee: Transform
    ankle: Transform
    reached: bool
    stretch: float = 1.0
    """Of thigh and shin."""


def body(frame: Frame, offset_ws: Array, rot_ws: Array) -> Transform:
    """Motion of the body in model space: a rotation about the middle of the hips, and an offset."""
    model_from_world = maths.inverse(frame.world_from_model.rot)
    rot = maths.conjugate(rot_ws, model_from_world)
    pivot = np.mean(frame.hip.pos, axis=0)
    return Transform(pivot + rotate(model_from_world, offset_ws) - rotate(rot, pivot), rot)


def carry(body: Transform, leg: Leg) -> tuple[Transform, Transform, Transform]:
    """Hip, knee and ankle, moved rigidly with the body; model space."""
    hip, knee, ankle = (
        Transform(maths.apply(body, pos), multiply(body.rot, rot))
        for pos, rot in map(leg.joint, ("hip", "knee", "ankle"))
    )
    return hip, knee, ankle


def hinge_of(leg: Leg, knee: Transform) -> Array:
    """The axis, unit, about which a positive angle opens a knee."""
    return rotate(knee.rot, leg.rig.knee_axis_ls[leg.index])


# The leg that bends as animated


def solve_leg(leg: Leg, body: Transform, target: Array) -> Solved:
    """The leg whose ankle is brought to `target`, model space."""
    hip, knee, ankle = carry(body, leg)
    axis = hinge_of(leg, knee)
    distance = length(target - hip.pos)
    nearest, soft_from, _ = _wanted_distance(leg, hip.pos, knee.pos, ankle.pos, distance)
    stretch, farthest = stretched(leg, distance, soft_from)
    long_knee, long_ankle = (hip.pos + stretch * (x.pos - hip.pos) for x in (knee, ankle))
    wanted = _wanted_distance(leg, hip.pos, long_knee, long_ankle, distance)[2]
    knee_rot = maths.from_axis_angle(
        axis, _knee_angle(hip.pos - long_knee, long_ankle - long_knee, axis, wanted)
    )
    bent = knee.pos + rotate(knee_rot, ankle.pos - knee.pos)
    hip_rot = _hip_rotation(bent - hip.pos, target - hip.pos, axis, leg["leg.twist"])
    reached = nearest <= distance <= farthest and leg.weight >= 1.0
    return _rotated(Solved(hip, knee, ankle, reached, stretch), hip_rot, knee_rot, leg.weight)


def stretched(leg: Leg, distance: float, soft_from: float) -> tuple[float, float]:
    """By how much thigh and shin are longer than animated, and how far they reach at most, m."""
    if not leg.parameters.values.get("leg.allow_stretch"):
        return 1.0, soft_from
    most = leg["leg.max_stretch"]
    return clip(distance / soft_from, 1.0, most), most * soft_from


def _rotated(leg: Solved, hip_rot: Array, knee_rot: Array, weight: float) -> Solved:
    """A leg after both rotations by a weight, the knee's first, and as far stretched."""
    hip, knee, ankle, reached, stretch = leg
    stretch = 1.0 + weight * (stretch - 1.0)
    knee_rot = maths.nlerp(maths.IDENTITY, knee_rot, weight)
    hip_rot = maths.nlerp(maths.IDENTITY, hip_rot, weight)
    bent = knee.pos + rotate(knee_rot, ankle.pos - knee.pos)
    shin_rot = multiply(hip_rot, knee_rot)
    moved_knee, moved_ankle = (
        hip.pos + stretch * rotate(hip_rot, x - hip.pos) for x in (knee.pos, bent)
    )
    return Solved(
        Transform(hip.pos, multiply(hip_rot, hip.rot)),
        Transform(moved_knee, multiply(shin_rot, knee.rot)),
        Transform(moved_ankle, multiply(shin_rot, ankle.rot)),
        reached,
        stretch,
    )


def _wanted_distance(
    leg: Leg, hip: Array, knee: Array, ankle: Array, distance: float
) -> tuple[float, float, float]:
    """Nearest hip-ankle distance, where softening starts, and the softened distance, all m.

    A leg as long as animated is neither limited nor softened where that is asked for.
    """
    a, b, animated = length(hip - knee), length(ankle - knee), length(ankle - hip)
    nearest, farthest = (
        math.sqrt(max(a * a + b * b - 2.0 * a * b * math.cos(leg[f"leg.{name}_knee_angle"]), 0.0))
        for name in ("min", "max")
    )
    soft_from = leg["leg.soften"] * farthest
    if leg["leg.as_animated"]:
        nearest, farthest = min(nearest, animated), max(farthest, animated)
        soft_from = max(soft_from, animated)
    room = farthest - soft_from
    wanted = min(distance, soft_from)
    if distance > soft_from and room > 0.0:
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
    level = maths.from_axis_angle(direction, maths.signed_angle(rotate(arc, axis), axis, direction))
    return multiply(maths.from_axis_angle(direction, twist), multiply(level, arc))


# The leg in the plane of a pole, after ozz's job; `ozz` and `mec` share it


def solve_leg_to_pole(
    leg: Leg, body: Transform, target: Array, pole: Array, weight: float
) -> Solved:
    """The leg whose ankle is brought to `target`, model space.

    Args:
        leg: the animated pose, which moves with the body first.
        body: motion of the body.
        target: position of the ankle (3), m.
        pole: direction (3, any length) that the bend plane is to contain.
        weight: of both rotations, 0..1.
    """
    hip, knee, ankle = carry(body, leg)
    bones = length(knee.pos - hip.pos) + length(ankle.pos - knee.pos)
    distance, soften = length(target - hip.pos), leg["leg.soften"]
    stretch, farthest = stretched(leg, distance, soften * bones)
    hip_rot, knee_rot, in_reach = joint_rotations(
        stretch * (knee.pos - hip.pos),
        stretch * (ankle.pos - hip.pos),
        hinge_of(leg, knee),
        target - hip.pos,
        pole,
        soften,
        leg["leg.twist"],
    )
    in_reach |= soften * bones < distance <= farthest
    carried = Solved(hip, knee, ankle, in_reach and weight >= 1.0, stretch)
    return _rotated(carried, hip_rot, knee_rot, weight)


def joint_rotations(
    knee: Array,
    ankle: Array,
    hinge: Array,
    target: Array,
    pole: Array,
    soften: float,
    twist: float,
) -> tuple[Array, Array, bool]:
    """Rotations of the hip and, before it, of the knee; whether the target is within reach.

    Positions (3) are relative to the hip, m; a rotation about the unit `hinge` (3) opens the knee.
    """
    thigh, shin, distance = length(knee), length(ankle - knee), length(target)
    soft_from = clip(soften, 0.0, 1.0) * (thigh + shin)
    wanted = _softened(distance, soft_from, thigh + shin)
    in_reach = abs(thigh - shin) < distance <= soft_from

    # Full lengths count, whether or not the hinge is at right angles to the bones.
    present = maths.interior_angle(thigh, shin, float(ankle @ ankle))
    if hinge @ cross(-knee, ankle - knee) < 0.0:
        present = -present
    knee_rot = maths.from_axis_angle(hinge, maths.interior_angle(thigh, shin, wanted**2) - present)

    bent = knee + rotate(knee_rot, ankle - knee)
    if distance < maths.DIRECTIONLESS:
        return maths.IDENTITY, knee_rot, in_reach
    direction = target / distance
    arc = maths.shortest_arc(unit(bent, direction), direction, hinge)
    level = _to_pole(rotate(arc, hinge), direction, pole)
    hip_rot = multiply(maths.from_axis_angle(direction, twist), multiply(level, arc))
    return hip_rot, knee_rot, in_reach


def _softened(distance: float, soft_from: float, chain: float) -> float:
    """Softened distance, m: beyond `soft_from` it tends to the length of the chain."""
    room = chain - soft_from
    if distance <= soft_from or room <= 0.0:
        return distance
    alpha = (distance - soft_from) / room
    return soft_from + room * (1.0 - (3.0 / (alpha + 3.0)) ** 4)


def _to_pole(hinge: Array, direction: Array, pole: Array) -> Array:
    """Rotation about the unit `direction` that brings `pole` into the plane across `hinge`."""
    wanted = cross(direction, unit(pole, direction))
    if length(wanted) < maths.DIRECTIONLESS:
        return maths.IDENTITY
    angle = math.acos(clip(float(wanted @ hinge) / length(wanted), -1.0, 1.0))
    return maths.from_axis_angle(direction, -angle if hinge @ pole < 0.0 else angle)


# Heel, foot and toe


def raise_heel(
    foot: Foot, target: Array, turn: Array, offset_ws: Array
) -> tuple[Array, Array, float]:
    """Ankle target, ankle rotation, and the angle by which the heel rises about the ball, rad.

    A heel rises where the leg would be too long. `turn` is the rotation (4) that the foot's lock
    gives it, `offset_ws` the way of the body; world space.
    """
    hip_ws, ankle_ws, heading = foot.pos_ws("hip"), foot.pos_ws("ankle"), foot.heading_ws
    # A level sole comes to lie on the ground, as far as the foot turns.
    whole = maths.shortest_arc(foot.up, foot.hit.normal, heading)
    tilt = maths.nlerp(maths.IDENTITY, whole, foot.turned)
    from_ball = rotate(tilt, rotate(turn, ankle_ws - foot.pos_ws("toe")))
    ball = target - from_ball
    hip = hip_ws + offset_ws
    longest = max(foot["effector.extension"] * foot.length, length(ankle_ws - hip_ws))
    level_axis = cross(heading, foot.up)
    axis = rotate(tilt, level_axis)
    square = across(from_ball, axis)
    fixed = ball - hip + (from_ball - square)
    middle = float(fixed @ fixed) + float(square @ square)
    by_cosine = 2.0 * float(fixed @ square)
    by_sine = -2.0 * float(fixed @ cross(axis, square))
    lift = 0.0
    if by_sine < 0.0:
        reach = math.hypot(by_cosine, by_sine)
        angle = math.acos(clip((longest**2 - middle) / reach, -1.0, 1.0))
        angle += math.atan2(by_sine, by_cosine)
        angle *= maths.smooth01(-by_sine / reach / SHORTENS)
        lift = clip(angle, 0.0, foot["effector.max_lift"])
    to_ankle = target - hip
    ahead = float(to_ankle @ heading) / length(to_ankle)
    lift *= 1.0 - maths.smooth01((ahead - RISES) / (STAYS - RISES))
    ankle = ball + rotate(maths.from_axis_angle(axis, -lift), from_ball)
    # The foot stage tilts the foot after its heel has risen.
    rot_ws = multiply(maths.from_axis_angle(level_axis, -lift), multiply(turn, foot.ankle_rot_ws))
    return ankle, rot_ws, lift


def turn_foot(foot: Foot, leg: Solved, rot_ws: Array, forward: Array) -> Array:
    """Model-space rotation of the ankle: `rot_ws`, tilted onto the ground within limits."""
    world_from_model, up = foot.frame.world_from_model.rot, foot.up
    foot_rot = multiply(rot_ws, foot.rig.ankle_from_foot[foot.index])
    foot_forward = rotate(foot_rot, maths.Z)
    heading = unit(across(foot_forward, up), forward)
    right = cross(heading, up)
    side = float(foot.rig.side[foot.index]) or 1.0
    lateral = -side * right
    shin = unit(rotate(world_from_model, leg.ankle.pos - leg.knee.pos), -up)

    def limited(name: str, axis: Array, angle: float) -> float:
        """By how much of an angle the axis of the foot may rise from where it is, rad."""
        now = math.atan2(-float(axis @ shin), length(across(axis, shin)))
        low, high = foot[f"foot.min_{name}"], foot[f"foot.max_{name}"]
        return clip(now + angle * foot.turned, min(now, low), max(now, high)) - now

    pitch, roll = _ground_angles(foot, heading, right, lateral)
    tilt = maths.from_axis_angle(right, limited("pitch", foot_forward, pitch))
    roll_axis = rotate(tilt, unit(cross(lateral, up), heading))
    angle = limited("roll", side * rotate(foot_rot, maths.X), roll)
    tilt = multiply(maths.from_axis_angle(roll_axis, angle), tilt)
    wanted = multiply(maths.inverse(world_from_model), multiply(tilt, rot_ws))
    return maths.nlerp(leg.ankle.rot, wanted, foot.weight)


def _ground_angles(foot: Foot, heading: Array, right: Array, lateral: Array) -> tuple[float, float]:
    """Pitch (+ toes up) and then roll (+ outer edge up) of the ground under the foot."""
    if not foot.hit.found:
        return 0.0, 0.0
    normal, up = foot.hit.normal, foot.up
    pitch = math.atan2(-float(normal @ heading), float(normal @ up))
    if foot.toe_hit.found:
        sole = foot.toe_hit.point - foot.hit.point
        if sole @ heading > SHORT_FOOT:
            pitch = math.atan2(float(sole @ up), float(sole @ heading))
    pitched_up = rotate(maths.from_axis_angle(right, pitch), up)
    return pitch, math.atan2(-float(normal @ lateral), float(normal @ pitched_up))


def with_foot(
    leg: Leg, solved: Solved, rot: Array
) -> tuple[Transform, Transform, Transform, Transform, bool]:
    """Hip, knee, ankle with this rotation, the toe carried rigidly with it, and `reached`."""
    hip, knee, (ankle, _), reached, _ = solved
    change = multiply(rot, maths.inverse(leg.joint("ankle").rot))
    reach = leg.joint("toe").pos - leg.joint("ankle").pos
    toe = Transform(ankle + rotate(change, reach), multiply(change, leg.joint("toe").rot))
    return hip, knee, Transform(ankle, rot), toe, reached
