"""Bending a limb to a target in the plane of a pole, as ozz-animation's two-bone job does."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.struct import struct

from .reach import LENGTH_BAND, quartic_limit, stretch_to
from .rotations import DOWN, angle_about, safe_arc
from .two_bone import Limb, LimbBend, triangle_half_angle


@struct
class PoleTarget:
    """Where a joint is to point, and which way up; all in one space."""

    to_target: Float[Array, "*t 3"]
    """m, from the joint."""
    pole: Float[Array, "*p 3"]
    """Direction, of any length."""
    twist: Float[Array, "*w"]
    """rad, about the target's direction, applied last."""


def bend_to_pole(
    limb: Limb,
    target: PoleTarget,
    soften: Array,
    gate: AbstractGate,
    max_stretch: Array | None = None,
) -> LimbBend:
    """Bends a limb to its target in the plane that contains the pole.

    The triangle is made of the whole lengths of the bones: unlike with `hinge_half_angle`, a hinge
    that is not square to the limb leaves the ankle beside its target, and the plane beside the
    pole. All vectors are in one rigid space and broadcast against each other.

    With the target on the hip, the knee folds and the hip does not rotate. With the pole along the
    target, the hip takes the shortest arc; with the ankle folded onto the hip, not even that. With
    a bone of length zero, the knee does not bend. `reached` follows from the lengths alone.

    Args:
        limb: the limb as it is.
        target: of the ankle, from the hip; the knee points at the pole.
        soften: fraction of the bones' length up to which the ankle reaches its target; beyond, it
            falls short (`quartic_limit`). Clipped to 0..1.
        gate: decides `reached`.
        max_stretch: how long bones may become for a target out of reach, as a multiple of what they
            are; None leaves them.
    """
    to_hip, to_ankle, hinge = limb.to_hip, limb.to_ankle, limb.hinge
    a2, b2 = vec.dot(to_hip, to_hip), vec.dot(to_ankle, to_ankle)
    thigh, shin = vec.safe_sqrt(a2), vec.safe_sqrt(b2)
    distance = vec.length(target.to_target)
    free = jnp.where(soften < 0, 0.0, jnp.where(soften > 1, 1.0, soften)) * (thigh + shin)
    farthest, nearer, stretch = free, distance, None
    if max_stretch is not None:
        stretch = stretch_to(distance, free, max_stretch, gate)
        # The angles of a longer limb are those of the limb as it is with a nearer target.
        farthest, nearer = free * max_stretch, distance / stretch
    reach = quartic_limit(nearer, free, thigh + shin)
    too_near = gate.below(distance, jnp.abs(thigh - shin), band=LENGTH_BAND)
    reached = (1.0 - too_near) * gate.below(distance, farthest, band=LENGTH_BAND)

    # The normal of a bent limb: one part along the hinge, and one across it if the hinge is tilted.
    normal = vec.dot(hinge, vec.cross(to_hip, to_ankle))
    across = vec.scale(to_ankle, vec.dot(to_hip, hinge)) - vec.scale(
        to_hip, vec.dot(to_ankle, hinge)
    )
    sin_now = _signed_length(normal, vec.dot(across, across), normal, a2 * b2)
    half_cos, half_sin = triangle_half_angle(
        a2, b2, reach * reach, vec.dot(to_hip, to_ankle), sin_now
    )

    bent = quat.rotate(quat.from_half_angle(hinge, half_cos, half_sin), to_ankle) - to_hip
    return LimbBend(_pole_swing(bent, hinge, target), half_cos, half_sin, reached, stretch)


def _pole_swing(bent: Array, hinge: Array, target: PoleTarget) -> Array:
    """Rotation of the hip that points the bent limb at its target and its knee at the pole."""
    to_target = target.to_target
    away = vec.dot(to_target, to_target) > jnp.finfo(to_target.dtype).eps ** 2
    aim = vec.normalize(to_target, vec.constant(DOWN, to_target))
    arc = safe_arc(vec.normalize(bent, aim), aim, hinge)
    normal = quat.rotate(arc, hinge)
    pole = vec.normalize(target.pole, vec.constant((0.0, 0.0, 0.0), target.pole))
    cos, sin, known = angle_about(aim, normal, vec.cross(aim, pole))
    # Ozz measures the angle between the normals, not between their parts across the target. The
    # two differ only for a tilted hinge.
    along = vec.dot(normal, aim)
    sin = _signed_length(sin, (along * cos) ** 2, vec.dot(normal, pole), jnp.ones_like(along))
    cos = cos * vec.length(vec.reject(normal, aim))
    facing = quat.from_cos_sin(aim, jnp.where(known, cos, 1.0), jnp.where(known, sin, 0.0))
    swing = quat.multiply(quat.normalize(facing), arc)
    swing = quat.multiply(quat.from_axis_angle(aim, target.twist), swing)
    return jnp.where(away[..., None], swing, quat.identity(swing.dtype))


def _signed_length(x: Array, across2: Array, sign: Array, scale2: Array) -> Array:
    """Length, with the given sign, of a vector with `x` along an axis and root `across2` across it.

    `x` itself, with its gradient through zero, where `across2` is rounding error beside `scale2`.
    """
    tilted = across2 > (8.0 * jnp.finfo(x.dtype).eps) ** 2 * scale2
    length = vec.safe_sqrt(x * x + jnp.where(tilted, across2, 0.0))
    return jnp.where(tilted, jnp.where(sign < 0, -length, length), x)
