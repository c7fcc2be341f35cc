"""A two-bone limb: its knee bends about a hinge, then its hip swings, freely or towards a pole.

Half-angle algebra throughout: angles appear only as cosine and sine of half the angle. The
formulas follow ozz-animation's two-bone job, with derivatives written by hand where JAX's own
would be long or not finite.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.struct import struct

from .rotations import DOWN, LENGTH_BAND, PoleTarget, angle_about, clip_cosine, safe_arc

STRETCH_BAND = 0.01


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


def third_side(a2: Array, b2: Array, ab: Array, cos: Array) -> Array:
    """Third side of a triangle by the law of cosines.

    Args:
        a2: square of one side.
        b2: square of another side.
        ab: product of the two.
        cos: cosine of the angle between them.
    """
    return vec.safe_sqrt(a2 + b2 - 2.0 * ab * cos)


def stretch_to(distance: Array, free: Array, most: Array, gate: AbstractGate) -> Array:
    """By how much a limb's bones are longer than they are, so that it reaches a target.

    Args:
        distance: of the target, m.
        free: how far the limb reaches freely, m; one that reaches nowhere is not stretched.
        most: the longest that bones may be, as a multiple of what they are.
        gate: how that is limited.
    """
    ratio = vec.safe_divide(distance, free, otherwise=1.0)
    return gate.clip(ratio, jnp.ones_like(ratio), most, band=STRETCH_BAND)


def soft_limit(x: Array, free: Array, limit: Array) -> Array:
    """`x` up to `free`; beyond that an exponential, of slope 1 at first, that tends to `limit`."""
    room = limit - free
    has_room = room > 0
    excess = x - free
    beyond = excess > 0
    fraction = jnp.where(beyond, excess, 0.0) / jnp.where(has_room, room, 1.0)
    soft = free - jnp.where(has_room, room * jnp.expm1(-fraction), 0.0)
    return jnp.where(beyond, soft, x)


def quartic_limit(x: Array, free: Array, limit: Array) -> Array:
    """`x` up to `free`; beyond that ozz-animation's curve, which tends to `limit`.

    Its slope is 4/3 at first, so that it exceeds `x` by up to 2.8 % of the room between `free` and
    `limit`. Where there is no room, `x` is returned unlimited.
    """
    room = limit - free
    has_room = room > 0
    beyond = has_room & (x > free)
    fraction = jnp.where(beyond, x - free, 0.0) / jnp.where(has_room, room, 1.0)
    left = (3.0 / (fraction + 3.0)) ** 4
    return jnp.where(beyond, limit - room * left, x)


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
