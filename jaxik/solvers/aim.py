"""Turning a joint until it looks at a target."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate

from .two_bone import LENGTH_BAND, arc_beside, rotation_about


def aim_rotation(
    to_target: Float[Array, "*t 3"],
    forward: Float[Array, "*f 3"],
    offset: Float[Array, "*o 3"],
    up: Float[Array, "*u 3"],
    pole: Float[Array, "*p 3"],
    twist: Float[Array, "*w"],
    gate: AbstractGate,
) -> tuple[Float[Array, "*b 4"], Float[Array, "*r"]]:
    """The joint's turn that lets a ray fixed in it meet the target, and 1 where that can be done.

    Ozz's aim job (systems.md, 0). The ray starts at `offset` and runs along `forward`: the shortest
    arc takes the point where it comes as far from the joint as the target is onto the target; then
    a turn about the target's direction brings `up` as near to the pole as it can; then `twist`.

    Nothing turns, and nothing is reached, where the whole line passes outside that distance. With
    the target on the joint nothing turns. No turn to a pole where it, or the turned `up`, lies
    along the target or is zero. All vectors are in the joint's space and are broadcast.

    To do a part of it, blend from the identity with `quat.nlerp`. That takes the shorter way
    always; ozz takes the longer one in some cases, which is not done here.

    Args:
        to_target: from the joint, m.
        forward: unit, direction of the ray.
        offset: start of the ray, from the joint, m.
        up: axis that the pole attracts, of any length.
        pole: direction, of any length.
        twist: about the target's direction, in the end, rad.
        gate: how it is decided what can be reached.
    """
    along = vec.dot(forward, offset)
    beside = vec.reject(offset, forward)
    distance = vec.length(to_target)
    reached = gate.above(distance, vec.length(beside), band=LENGTH_BAND)
    rest = vec.safe_sqrt(vec.dot(to_target, to_target) - vec.dot(beside, beside))
    meeting = offset + vec.scale(forward, rest - along)

    nowhere = vec.constant((0.0, 0.0, 0.0), to_target)
    away = distance > jnp.finfo(distance.dtype).eps
    target = vec.normalize(to_target, forward)
    up = vec.normalize(up, nowhere)
    arc = arc_beside(vec.normalize(meeting, target), target, up)
    facing = rotation_about(target, quat.rotate(arc, up), vec.normalize(pole, nowhere))
    turn = quat.multiply(facing, arc)
    turn = quat.multiply(quat.from_axis_angle(target, twist), turn)
    weight = jnp.where(away, reached, 0.0)
    return quat.nlerp(quat.identity(turn.dtype), turn, weight), reached
