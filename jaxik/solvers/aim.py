"""Rotating a joint until it looks at a target, as ozz-animation's aim job does."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate

from .pole import PoleTarget
from .reach import LENGTH_BAND
from .rotations import rotation_about, safe_arc


def aim_rotation(
    target: PoleTarget,
    forward: Float[Array, "*f 3"],
    offset: Float[Array, "*o 3"],
    up: Float[Array, "*u 3"],
    gate: AbstractGate,
) -> tuple[Float[Array, "*b 4"], Float[Array, "*r"]]:
    """Rotation of a joint that makes a ray fixed in it pass through the target.

    Consider the point where the ray is as far from the joint as the target is. The shortest arc
    takes that point to the target; then a rotation about the target's direction brings `up` as
    near to the pole as it can; then comes the twist. All vectors are in the joint's space and
    broadcast against each other.

    The joint does not rotate where the target is on the joint. Nor does it where the line of the
    ray passes the joint farther away than the target is; the target is then not reached. There is
    no rotation towards a pole where the pole or the rotated `up` is zero or along the target.

    To apply only a part of the rotation, blend from the identity with `quat.nlerp`. That always
    goes the shorter way; ozz goes the longer way in some cases, which is not reproduced here.

    Args:
        target: from the joint; `up` is turned towards its pole.
        forward: unit direction of the ray.
        offset: start of the ray, from the joint, m.
        up: direction, of any length.
        gate: decides what is reached.

    Returns:
        The rotation, and 1 where the ray passes through the target, else 0.
    """
    to_target = target.to_target
    along = vec.dot(forward, offset)
    beside = vec.reject(offset, forward)
    distance = vec.length(to_target)
    reached = gate.above(distance, vec.length(beside), band=LENGTH_BAND)
    rest = vec.safe_sqrt(vec.dot(to_target, to_target) - vec.dot(beside, beside))
    meeting = offset + vec.scale(forward, rest - along)

    zero = vec.constant((0.0, 0.0, 0.0), to_target)
    away = distance > jnp.finfo(distance.dtype).eps
    direction = vec.normalize(to_target, forward)
    up = vec.normalize(up, zero)
    arc = safe_arc(vec.normalize(meeting, direction), direction, up)
    facing = rotation_about(direction, quat.rotate(arc, up), vec.normalize(target.pole, zero))
    rot = quat.multiply(facing, arc)
    rot = quat.multiply(quat.from_axis_angle(direction, target.twist), rot)
    weight = jnp.where(away, reached, 0.0)
    return quat.nlerp(quat.identity(rot.dtype), rot, weight), reached
