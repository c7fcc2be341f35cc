"""Rotations of a joint: those that line directions up, and ozz-animation's aim job."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.struct import struct

DOWN = (0.0, -1.0, 0.0)
LEFT = (1.0, 0.0, 0.0)
LENGTH_BAND = 0.005  # m over which a blurred decision about lengths changes


@struct
class PoleTarget:
    """Where a joint is to point, and which way up; all in one space."""

    to_target: Float[Array, "*t 3"]
    """m, from the joint."""
    pole: Float[Array, "*p 3"]
    """Direction, of any length."""
    twist: Float[Array, "*w"]
    """rad, about the target's direction, applied last."""


def local_correction(rot: Array, correction: Array) -> Array:
    """The correction on the right of `rot` equivalent to `correction` on its left."""
    w, x, y, z = quat.components(correction)
    return quat.stack(w, *vec.components(quat.unrotate(rot, vec.stack(x, y, z))))


def safe_arc(start: Array, aim: Array, side: Array) -> Array:
    """Shortest rotation between two unit vectors; where they are opposed, by pi about `side`.

    Of `side` only the part at right angles to `start` counts; where it has none, down is used.
    """
    down, left = vec.constant(DOWN, start), vec.constant(LEFT, start)
    axis = vec.reject(side, start)
    axis = jnp.where(vec.has_direction(axis)[..., None], axis, vec.reject(down, start))
    return quat.shortest_arc(start, aim, vec.normalize(axis, left))


def rotation_about(axis: Array, start: Array, aim: Array) -> Array:
    """Rotation about the unit `axis` that lines `start` up with `aim`, seen along the axis.

    `start` and `aim` are unit vectors; the answer is the identity where one of them is zero or lies
    along the axis.
    """
    cos, sin, _ = angle_about(axis, start, aim)
    return quat.normalize(quat.from_cos_sin(axis, cos, sin))


def angle_about(axis: Array, start: Array, aim: Array) -> tuple[Array, Array, Array]:
    """Cosine and sine of the angle from `start` to `aim` about the unit `axis`; whether defined."""
    start, aim = vec.reject(start, axis), vec.reject(aim, axis)
    spans = vec.safe_sqrt(vec.dot(start, start) * vec.dot(aim, aim))
    known = spans > jnp.finfo(spans.dtype).eps ** 0.5
    spans = jnp.where(known, spans, 1.0)
    cos = jnp.where(known, vec.dot(start, aim) / spans, 1.0)
    sin = jnp.where(known, vec.dot(axis, vec.cross(start, aim)) / spans, 0.0)
    return clip_cosine(cos), sin, known


def clip_cosine(x: Array) -> Array:
    """`x` clipped to -1..1 against rounding; the gradient is zero outside."""
    return jnp.where(x < -1, -1.0, jnp.where(x > 1, 1.0, x))


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
