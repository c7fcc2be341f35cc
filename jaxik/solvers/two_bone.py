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

from .rotations import DOWN, LEFT, half_turn_axis


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
    # Cosines and sines are times both sides, for the wanted angle and the present one each.
    ab = vec.safe_sqrt(a2 * b2)
    open_cos = 0.5 * (a2 + b2 - across2)
    open_cos = jnp.where(open_cos > ab, ab, jnp.where(open_cos < -ab, -ab, open_cos))
    open_sin = vec.safe_sqrt((ab - open_cos) * (ab + open_cos))
    cos, sin = vec.stacked_barrier(
        open_cos * cos_now + open_sin * sin_now, open_sin * cos_now - open_cos * sin_now
    )
    length = jnp.sqrt(cos * cos + sin * sin)
    half_cos, half_sin = vec.stacked_barrier(*quat.half_direction(cos, sin, length))
    # At least the square of the length: zero only where that is.
    square = half_cos * half_cos + half_sin * half_sin
    bendable = (ab > jnp.finfo(ab.dtype).eps) & (square > 0)
    inverse = 1.0 / jnp.sqrt(jnp.where(bendable, square, 1.0))
    return jnp.where(bendable, half_cos * inverse, 1.0), jnp.where(
        bendable, half_sin * inverse, 0.0
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
    """Rotation from one unit vector to another that keeps the hinge in line.

    The shortest arc from s to a is (1 + s.a, s x a), scaled. After it, a rotation about a by half
    an angle of cosine c and sine d makes it (c (1 + s.a), c s x a + d (s + a)), scaled. The arc
    leaves the hinge h at an angle about a from where it was; its cosine and sine are
    (1 + s.a) (h.h + h.s h.a) - (h.(s + a))² and h.(s x a) h.(s + a), scaled alike. No rotation
    about a where the hinge lies along s or a. Where those are opposed, a rotation by pi about the
    part of the hinge at right angles to s.
    """
    middle, normal = vec.add(start, aim), vec.barrier(vec.cross(start, aim))
    spread = 0.5 * vec.dot(middle, middle)
    along, both, beside = vec.dot(hinge, start), vec.dot(hinge, middle), vec.dot(hinge, normal)
    spread, along, both, beside = vec.stacked_barrier(spread, along, both, beside)
    level = vec.dot(hinge, hinge) + along * (both - along)
    cos, sin = vec.stacked_barrier(spread * level - both * both, both * beside)
    length = jnp.sqrt(cos * cos + sin * sin)
    eps = jnp.finfo(spread.dtype).eps
    apart, turns = spread > 4.0 * eps, length > spread * eps**0.5
    half_cos, half_sin = quat.half_direction(cos, sin, length)
    # The factor brings both near to 1, however small the spread is.
    scale = 1.0 / jnp.where(apart, spread, 1.0)
    half_cos, half_sin = vec.stacked_barrier(
        jnp.where(turns, half_cos * scale, 1.0), jnp.where(turns, half_sin * scale, 0.0)
    )
    axis = vec.scale(normal, half_cos) + vec.scale(middle, half_sin)
    axis = jnp.where(apart[..., None], axis, half_turn_axis(start, hinge))
    w = jnp.where(apart, half_cos * spread, 0.0)
    return vec.normalize(quat.stack(w, *vec.components(axis)), jnp.array((0.0, *LEFT), w.dtype))


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
