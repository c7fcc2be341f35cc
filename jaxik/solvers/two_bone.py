"""A two-bone limb: its knee bends about a hinge, then its hip swings.

Half-angle algebra throughout: angles appear only as cosine and sine of half the angle. The
formulas follow ozz-animation's two-bone job, with derivatives written by hand where JAX's own
would be long or not finite.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.struct import struct

from .rotations import DOWN, clip_cosine, safe_arc


@struct
class Limb:
    """A limb as seen from its middle joint; all in one space."""

    to_hip: Float[Array, "*h 3"]
    """m, from the knee."""
    to_ankle: Float[Array, "*a 3"]
    """m, from the knee."""
    hinge: Float[Array, "*i 3"]
    """Unit; a positive rotation opens the knee."""


@struct
class LimbBend:
    """The rotations that bend a limb."""

    swing: Float[Array, "*b 4"]
    """Of the hip, on the left of its rotation."""
    half_cos: Float[Array, "*k"]
    """Of half the knee's rotation about its hinge, before the swing."""
    half_sin: Float[Array, "*k"]
    reached: Float[Array, "*r"]
    """1 where the ankle can be at the target, else 0."""
    stretch: Float[Array, "*s"] | None = None
    """Length of both bones as a multiple of what it was; None for 1."""


def hinge_half_angle(limb: Limb, reach: Array) -> tuple[Array, Array]:
    """Cosine and sine of half the hinge rotation that puts hip and ankle `reach`, m, apart.

    Afterwards the interior angle is 0..pi, whichever side the limb was bent to before. Where the
    triangle does not close, the limb becomes straight or folded. It does not rotate where a bone
    lies along the hinge.
    """
    hinge = limb.hinge
    along_thigh, along_shin = vec.dot(limb.to_hip, hinge), vec.dot(limb.to_ankle, hinge)
    thigh, shin = vec.reject(limb.to_hip, hinge), vec.reject(limb.to_ankle, hinge)
    a2, b2 = vec.dot(thigh, thigh), vec.dot(shin, shin)
    across2 = reach * reach - (along_thigh - along_shin) ** 2
    cos_now, sin_now = vec.dot(thigh, shin), vec.dot(hinge, vec.cross(thigh, shin))
    return triangle_half_angle(*vec.stacked_barrier(a2, b2, across2, cos_now, sin_now))


def triangle_half_angle(
    a2: Array, b2: Array, across2: Array, cos_now: Array, sin_now: Array
) -> tuple[Array, Array]:
    """Cosine and sine of half the rotation that sets the angle between two sides of a triangle.

    Args:
        a2: square of one side.
        b2: square of the other side.
        across2: square that the third side is to have.
        cos_now: cosine of the present angle, times both sides.
        sin_now: sine of the present angle, times both sides.
    """
    return _half_angle(*jnp.broadcast_arrays(a2, b2, across2, cos_now, sin_now))


@jax.custom_jvp
def _half_angle(
    a2: Array, b2: Array, across2: Array, cos_now: Array, sin_now: Array
) -> tuple[Array, Array]:
    ab = vec.safe_sqrt(a2 * b2)
    bendable = ab > jnp.finfo(ab.dtype).eps
    inverse = 1.0 / jnp.where(bendable, ab, 1.0)
    open_cos = clip_cosine(0.5 * (a2 + b2 - across2) * inverse)
    open_sin = vec.safe_sqrt((1.0 - open_cos) * (1.0 + open_cos))
    cos = open_cos * cos_now + open_sin * sin_now
    sin = open_sin * cos_now - open_cos * sin_now
    norm = vec.safe_sqrt(cos * cos + sin * sin)
    known = bendable & (norm > 0)
    inverse = 1.0 / jnp.where(known, norm, 1.0)
    return quat.half_angle(
        jnp.where(known, cos * inverse, 1.0), jnp.where(known, sin * inverse, 0.0)
    )


@_half_angle.defjvp
def _half_angle_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    # The rotation is the wanted angle minus the present one; so is its derivative.
    a2, b2, across2, cos_now, sin_now = primals
    d_a2, d_b2, d_across2, d_cos_now, d_sin_now = tangents
    half_cos, half_sin = _half_angle(*primals)
    span2 = cos_now * cos_now + sin_now * sin_now
    ab = vec.safe_sqrt(a2 * b2)
    bendable = (ab > jnp.finfo(ab.dtype).eps) & (span2 > 0)
    inverse_a2, inverse_b2, inverse_span2, inverse_ab = (
        1.0 / jnp.where(bendable, x, 1.0) for x in (a2, b2, span2, ab)
    )
    cos = 0.5 * (a2 + b2 - across2) * inverse_ab
    # The derivative is zero for a limb that is straight to within rounding: it would be rounding
    # error, magnified a hundred million times.
    sin2 = (1.0 - cos) * (1.0 + cos)
    bent = sin2 > 64 * jnp.finfo(sin2.dtype).eps
    sin = jnp.sqrt(jnp.where(bent, sin2, 1.0))
    d_cos = 0.5 * inverse_ab * (d_a2 + d_b2 - d_across2)
    d_cos -= 0.5 * cos * (inverse_a2 * d_a2 + inverse_b2 * d_b2)
    d_wanted = jnp.where(bent, -d_cos / sin, 0.0)
    d_present = inverse_span2 * (cos_now * d_sin_now - sin_now * d_cos_now)
    d_half = jnp.where(bendable, 0.5 * (d_wanted - d_present), 0.0)
    return (half_cos, half_sin), (-half_sin * d_half, half_cos * d_half)


def swing_rotation(bent: Array, to_target: Array, hinge: Array, twist: Array) -> Array:
    """Rotation of the hip that points a bent limb at its target and keeps the hinge in line.

    The shortest arc from `bent` (hip to ankle) to `to_target`, then a rotation about the target's
    direction that lines the hinge up with where it was, seen along that direction; then `twist`,
    rad, about it. All vectors are in one space.
    """
    start = vec.normalize(bent, vec.constant(DOWN, bent))
    aim = vec.normalize(to_target, start)
    swing = _aligned_arc(*jnp.broadcast_arrays(start, aim, hinge))
    return quat.multiply(quat.from_axis_angle(aim, twist), swing)


@jax.custom_jvp
def _aligned_arc(start: Array, aim: Array, hinge: Array) -> Array:
    """Rotation from one unit vector to another that keeps the hinge in line."""
    facing = quat.from_half_angle(aim, *_realignment(start, aim, hinge))
    return quat.multiply(facing, safe_arc(start, aim, hinge))


@_aligned_arc.defjvp
def _aligned_arc_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # By hand: JAX's own rule runs through the whole arc and its half-angles, and its reverse,
    # recomputed in each consumer, took three quarters of the time of a gradient.
    (start, aim, hinge), (d_start, d_aim, d_hinge) = primals, tangents
    rot = _aligned_arc(*primals)
    after = quat.rotate(rot, hinge)
    # Angular velocity that carries the move of one direction into that of the other, to which a
    # rotation about the aim is added.
    carried = vec.cross(aim, d_aim) - quat.rotate(rot, vec.cross(start, d_start))
    # That rotation keeps aim.(after x hinge) at zero.
    d_after = vec.cross(carried, after) + quat.rotate(rot, d_hinge)
    off = vec.dot(d_aim, vec.cross(after, hinge))
    off += vec.dot(aim, vec.cross(d_after, hinge) + vec.cross(after, d_hinge))
    span = vec.dot(after, hinge) - vec.dot(aim, after) * vec.dot(aim, hinge)
    tiny = jnp.finfo(span.dtype).eps
    known = span > tiny**0.5
    spin = jnp.where(known, off / jnp.where(known, span, 1.0), 0.0)
    x, y, z = vec.components(0.5 * (carried + vec.scale(aim, spin)))
    d_rot = quat.multiply(quat.stack(jnp.zeros_like(x), x, y, z), rot)
    apart = 1.0 + vec.dot(start, aim) > 4.0 * tiny
    return rot, jnp.where(apart[..., None], d_rot, 0.0)


def _realignment(start: Array, aim: Array, hinge: Array) -> tuple[Array, Array]:
    """Cosine and sine of half the rotation about `aim` that lines the hinge up with where it was.

    It follows the shortest arc from `start` to `aim`, which takes v to
    v - (start + aim) (start + aim).v / (1 + start.aim) + 2 aim (start.v). No rotation where start
    and aim are opposed, or where the hinge lies along one of them.
    """
    before, after = vec.reject(hinge, start), vec.reject(hinge, aim)
    spread = 1.0 + vec.dot(start, aim)
    known = spread > 4.0 * jnp.finfo(spread.dtype).eps
    ratio = vec.dot(before, aim) / jnp.where(known, spread, 1.0)
    cos = vec.dot(before, after) - ratio * vec.dot(after, start)
    sin = (vec.dot(hinge, start) + ratio) * vec.dot(hinge, vec.cross(start, aim))
    span = vec.safe_sqrt(cos * cos + sin * sin)
    known = known & (span > jnp.finfo(span.dtype).eps ** 0.5)
    inverse = 1.0 / jnp.where(known, span, 1.0)
    return quat.half_angle(
        jnp.where(known, cos * inverse, 1.0), jnp.where(known, sin * inverse, 0.0)
    )
