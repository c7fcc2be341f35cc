"""The two-bone leg in the plane of a pole, after ozz's job; `ozz` and `mec` share it.

Positions and directions are in one space, whichever it is; model space for `solve_leg`.
"""

import math

from reference import maths
from reference.characters import Frame, Rig
from reference.maths import Array, Transform, cross, from_axis_angle, length, rotate, unit
from reference.stages import limb


def solve_leg(
    rig: Rig,
    leg: int,
    frame: Frame,
    body: Transform,
    target: Array,
    pole: Array,
    soften: float,
    twist: float,
    weight: float,
) -> tuple[Transform, Transform, Transform, bool]:
    """Hip, knee and ankle that bring the ankle to `target`, and whether they do; model space.

    Args:
        rig: with the hinge of the knee.
        leg: index of the leg.
        frame: the animated pose, which moves with the body first.
        body: motion of the body in model space.
        target: position of the ankle (3), m.
        pole: direction (3, any length) that the bend plane is to contain.
        soften: fraction of the leg's length beyond which the target is softened, 0..1.
        twist: about the direction of the target, rad.
        weight: of both rotations, 0..1.
    """
    hip, knee, ankle = (
        limb.carry(body, joint, leg) for joint in (frame.hip, frame.knee, frame.ankle)
    )
    hinge = rotate(knee.rot, rig.knee_axis_ls[leg])
    hip_rot, knee_rot, in_reach = joint_rotations(
        knee.pos - hip.pos, ankle.pos - hip.pos, hinge, target - hip.pos, pole, soften, twist
    )
    reached = in_reach and weight >= 1.0
    return *limb.rotated(hip, knee, ankle, hip_rot, knee_rot, weight), reached


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
    soft_from = maths.clip(soften, 0.0, 1.0) * (thigh + shin)
    wanted = softened(distance, soft_from, thigh + shin)
    in_reach = abs(thigh - shin) < distance <= soft_from

    # Full lengths count, whether or not the hinge is at right angles to the bones.
    present = maths.interior_angle(thigh, shin, float(ankle @ ankle))
    if hinge @ cross(-knee, ankle - knee) < 0.0:
        present = -present
    knee_rot = from_axis_angle(hinge, maths.interior_angle(thigh, shin, wanted**2) - present)

    bent = knee + rotate(knee_rot, ankle - knee)
    if distance < maths.DIRECTIONLESS:
        return maths.IDENTITY, knee_rot, in_reach
    direction = target / distance
    arc = maths.shortest_arc(unit(bent, direction), direction, hinge)
    level = _to_pole(rotate(arc, hinge), direction, pole)
    return (
        maths.multiply(from_axis_angle(direction, twist), maths.multiply(level, arc)),
        knee_rot,
        in_reach,
    )


def softened(distance: float, soft_from: float, chain: float) -> float:
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
    angle = math.acos(maths.clip(float(wanted @ hinge) / length(wanted), -1.0, 1.0))
    return from_axis_angle(direction, -angle if hinge @ pole < 0.0 else angle)
