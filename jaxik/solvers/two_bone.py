"""Solving a two-bone limb: the triangle, the turn of the knee, the swing of the hip."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.struct import struct

LENGTH_BAND = 0.005  # m
DOWN = (0.0, -1.0, 0.0)
LEFT = (1.0, 0.0, 0.0)


def local(rot: Array, turn: Array) -> Array:
    """The correction on the right of `rot` that does what `turn` does on its left."""
    w, x, y, z = quat.components(turn)
    return quat.stack(w, *vec.components(quat.unrotate(rot, vec.stack(x, y, z))))


def third_side(a2: Array, b2: Array, ab: Array, cos: Array) -> Array:
    """Third side of a triangle, by the squares and the product of two sides and their cosine."""
    return vec.safe_sqrt(a2 + b2 - 2.0 * ab * cos)


def soft_limit(x: Array, free: Array, limit: Array) -> Array:
    """`x` up to `free`; beyond, an exponential of slope 1 there that tends to `limit`."""
    room = limit - free
    roomy = room > 0
    over = x - free
    beyond = over > 0
    share = jnp.where(beyond, over, 0.0) / jnp.where(roomy, room, 1.0)
    return jnp.where(beyond, free - jnp.where(roomy, room * jnp.expm1(-share), 0.0), x)


def quartic_limit(x: Array, free: Array, limit: Array) -> Array:
    """`x` up to `free`; beyond, ozz's curve of slope 4/3 there that tends to `limit`.

    At first it overshoots `x`, by 2.8 % of the room at most. Without room `x` passes as it is.
    """
    room = limit - free
    roomy = room > 0
    beyond = roomy & (x > free)
    share = jnp.where(beyond, x - free, 0.0) / jnp.where(roomy, room, 1.0)
    left = (3.0 / (share + 3.0)) ** 4
    return jnp.where(beyond, limit - room * left, x)


def hinge_rotation(
    to_hip: Array, to_ankle: Array, hinge: Array, reach: Array
) -> tuple[Array, Array]:
    """Cosine and sine of half the knee's turn about `hinge` that takes hip and ankle `reach` apart.

    The interior angle is 0..pi after the turn, whatever side the leg was bent to before. Clamped to
    straight or folded where the triangle does not close; no turn where a side lies along the hinge.
    """
    along_thigh, along_shin = vec.dot(to_hip, hinge), vec.dot(to_ankle, hinge)
    thigh, shin = vec.reject(to_hip, hinge), vec.reject(to_ankle, hinge)
    a2, b2 = vec.dot(thigh, thigh), vec.dot(shin, shin)
    across2 = reach * reach - (along_thigh - along_shin) ** 2
    cos_now, sin_now = vec.dot(thigh, shin), vec.dot(hinge, vec.cross(thigh, shin))
    return _opening(*vec.stacked_barrier(a2, b2, across2, cos_now, sin_now))


def _opening(
    a2: Array, b2: Array, apart2: Array, cos_now: Array, sin_now: Array
) -> tuple[Array, Array]:
    """Cosine and sine of half the turn that sets the angle between two sides of a triangle.

    The sides' squares are `a2` and `b2`, that of the third side is to be `apart2`; `cos_now` and
    `sin_now` belong to the present angle and are both times the two sides' lengths.
    """
    return _half_opening(*jnp.broadcast_arrays(a2, b2, apart2, cos_now, sin_now))


@jax.custom_jvp
def _half_opening(
    a2: Array, b2: Array, apart2: Array, cos_now: Array, sin_now: Array
) -> tuple[Array, Array]:
    ab = vec.safe_sqrt(a2 * b2)
    bendable = ab > jnp.finfo(ab.dtype).eps
    inverse = 1.0 / jnp.where(bendable, ab, 1.0)
    open_cos = bounded_cosine(0.5 * (a2 + b2 - apart2) * inverse)
    open_sin = vec.safe_sqrt((1.0 - open_cos) * (1.0 + open_cos))
    cos = open_cos * cos_now + open_sin * sin_now
    sin = open_sin * cos_now - open_cos * sin_now
    norm = vec.safe_sqrt(cos * cos + sin * sin)
    turning = bendable & (norm > 0)
    inverse = 1.0 / jnp.where(turning, norm, 1.0)
    return quat.half_angle(
        jnp.where(turning, cos * inverse, 1.0), jnp.where(turning, sin * inverse, 0.0)
    )


@_half_opening.defjvp
def _half_opening_slope(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    # The turn is the angle wanted less the present one; its slope is told by those of the two.
    a2, b2, apart2, cos_now, sin_now = primals
    a2_slope, b2_slope, apart2_slope, cos_slope, sin_slope = tangents
    half_cos, half_sin = _half_opening(*primals)
    span2 = cos_now * cos_now + sin_now * sin_now
    ab = vec.safe_sqrt(a2 * b2)
    bendable = (ab > jnp.finfo(ab.dtype).eps) & (span2 > 0)
    inverse_a2, inverse_b2, inverse_span2, inverse_ab = (
        1.0 / jnp.where(bendable, x, 1.0) for x in (a2, b2, span2, ab)
    )
    cos = 0.5 * (a2 + b2 - apart2) * inverse_ab
    # Of a leg straight to within rounding no slope is told: it would be rounding, a hundred
    # million times over.
    sin2 = (1.0 - cos) * (1.0 + cos)
    bent = sin2 > 64 * jnp.finfo(sin2.dtype).eps
    sin = jnp.sqrt(jnp.where(bent, sin2, 1.0))
    cos_rise = 0.5 * inverse_ab * (a2_slope + b2_slope - apart2_slope)
    cos_rise -= 0.5 * cos * (inverse_a2 * a2_slope + inverse_b2 * b2_slope)
    wanted = jnp.where(bent, -cos_rise / sin, 0.0)
    present = inverse_span2 * (cos_now * sin_slope - sin_now * cos_slope)
    turn = jnp.where(bendable, 0.5 * (wanted - present), 0.0)
    return (half_cos, half_sin), (-half_sin * turn, half_cos * turn)


def bounded(x: Array) -> Array:
    """`x` kept within 0..1, the cosines a triangle can have."""
    return jnp.where(x < 0, 0.0, jnp.where(x > 1, 1.0, x))


def swing_rotation(bent: Array, to_target: Array, hinge: Array, twist: Array) -> Array:
    """Rotation of the hip that takes the ankle's direction to the target's and keeps the hinge.

    The shortest arc, then a turn about the target's direction that lines the hinge up with where it
    was, seen along that direction; then `twist`, rad, about it.
    """
    start = vec.normalize(bent, vec.constant(DOWN, bent))
    aim = vec.normalize(to_target, start)
    swing = _lined_up(*jnp.broadcast_arrays(start, aim, hinge))
    return quat.multiply(quat.from_axis_angle(aim, twist), swing)


@jax.custom_jvp
def _lined_up(start: Array, aim: Array, hinge: Array) -> Array:
    """Rotation from one unit vector to another that keeps the hinge in line."""
    facing = quat.from_half_angle(aim, *_facing(start, aim, hinge))
    return quat.multiply(facing, arc_beside(start, aim, hinge))


@_lined_up.defjvp
def _lined_up_slope(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # By hand: JAX's own rule goes through all of the arc and its half-angles, and its reverse,
    # computed again in each consumer, took three quarters of a gradient's time.
    (start, aim, hinge), (start_slope, aim_slope, hinge_slope) = primals, tangents
    rot = _lined_up(*primals)
    after = quat.rotate(rot, hinge)
    # What takes the one direction's move to the other's, and then a turn about the aim.
    carried = vec.cross(aim, aim_slope) - quat.rotate(rot, vec.cross(start, start_slope))
    # That turn keeps aim.(after x hinge) at zero.
    moved = vec.cross(carried, after) + quat.rotate(rot, hinge_slope)
    off = vec.dot(aim_slope, vec.cross(after, hinge))
    off += vec.dot(aim, vec.cross(moved, hinge) + vec.cross(after, hinge_slope))
    span = vec.dot(after, hinge) - vec.dot(aim, after) * vec.dot(aim, hinge)
    tiny = jnp.finfo(span.dtype).eps
    known = span > tiny**0.5
    turn = jnp.where(known, off / jnp.where(known, span, 1.0), 0.0)
    x, y, z = vec.components(0.5 * (carried + vec.scale(aim, turn)))
    slope = quat.multiply(quat.stack(jnp.zeros_like(x), x, y, z), rot)
    apart = 1.0 + vec.dot(start, aim) > 4.0 * tiny
    return rot, jnp.where(apart[..., None], slope, 0.0)


def _facing(start: Array, aim: Array, hinge: Array) -> tuple[Array, Array]:
    """Cosine and sine of half the turn about `aim` that lines the hinge up with where it was.

    It comes after the shortest arc from `start` to `aim`, which takes v to
    v - (start + aim) (start + aim).v / (1 + start.aim) + 2 aim (start.v). No turn where they are
    opposed, or where the hinge lies along one of them.
    """
    before, after = vec.reject(hinge, start), vec.reject(hinge, aim)
    spread = 1.0 + vec.dot(start, aim)
    known = spread > 4.0 * jnp.finfo(spread.dtype).eps
    share = vec.dot(before, aim) / jnp.where(known, spread, 1.0)
    cos = vec.dot(before, after) - share * vec.dot(after, start)
    sin = (vec.dot(hinge, start) + share) * vec.dot(hinge, vec.cross(start, aim))
    span = vec.safe_sqrt(cos * cos + sin * sin)
    known = known & (span > jnp.finfo(span.dtype).eps ** 0.5)
    inverse = 1.0 / jnp.where(known, span, 1.0)
    return quat.half_angle(
        jnp.where(known, cos * inverse, 1.0), jnp.where(known, sin * inverse, 0.0)
    )


def arc_beside(start: Array, aim: Array, side: Array) -> Array:
    """Shortest rotation between two unit vectors; half a turn about `side` where they are opposed.

    Of `side` the part at right angles to `start` is taken, or of down where it has none.
    """
    down, left = vec.constant(DOWN, start), vec.constant(LEFT, start)
    beside = vec.reject(side, start)
    beside = jnp.where(vec.has_direction(beside)[..., None], beside, vec.reject(down, start))
    return quat.shortest_arc(start, aim, vec.normalize(beside, left))


def rotation_about(axis: Array, start: Array, aim: Array) -> Array:
    """Turn about the unit `axis` that lines `start` up with `aim`, both unit, seen along the axis.

    The identity where one of them lies along the axis or is zero.
    """
    cos, sin, _ = _angle_about(axis, start, aim)
    return quat.normalize(quat.from_cos_sin(axis, cos, sin))


def _angle_about(axis: Array, start: Array, aim: Array) -> tuple[Array, Array, Array]:
    """Cosine and sine of the angle from `start` to `aim` about `axis`, and whether it is known."""
    start, aim = vec.reject(start, axis), vec.reject(aim, axis)
    spans = vec.safe_sqrt(vec.dot(start, start) * vec.dot(aim, aim))
    known = spans > jnp.finfo(spans.dtype).eps ** 0.5
    spans = jnp.where(known, spans, 1.0)
    cos = jnp.where(known, vec.dot(start, aim) / spans, 1.0)
    sin = jnp.where(known, vec.dot(axis, vec.cross(start, aim)) / spans, 0.0)
    return bounded_cosine(cos), sin, known


def bounded_cosine(x: Array) -> Array:
    """`x` kept within -1..1 against rounding."""
    return jnp.where(x < -1, -1.0, jnp.where(x > 1, 1.0, x))


@struct
class PoleBend:
    """A limb that bends towards a pole."""

    swing: Float[Array, "*b 4"]  # of the hip, on the left of its rotation
    half_cos: Float[Array, "*k"]  # of half the knee's turn about its hinge; comes before the swing
    half_sin: Float[Array, "*k"]
    reached: Float[Array, "*r"]  # 1 where the ankle can be at the target, else 0


def pole_bend(
    to_hip: Float[Array, "*h 3"],
    to_ankle: Float[Array, "*a 3"],
    hinge: Float[Array, "*i 3"],
    to_target: Float[Array, "*t 3"],
    pole: Float[Array, "*p 3"],
    soften: Float[Array, "*s"],
    twist: Float[Array, "*w"],
    gate: AbstractGate,
) -> PoleBend:
    """Bends a limb to its target in the plane that contains the pole, as ozz's two-bone job does.

    From systems.md, 0. The bones' whole lengths make the triangle: unlike with `hinge_rotation`, a
    hinge that is not square to the limb leaves the ankle beside its target, and the plane beside
    the pole. All vectors are in one rigid space and are broadcast.

    A target on the hip folds the knee and leaves the hip as it is. No turn to a pole along the
    target, no arc for an ankle folded onto the hip, no bend with a zero bone. `reached` is told
    from the lengths alone.

    Args:
        to_hip: from the knee, m.
        to_ankle: from the knee, m.
        hinge: unit; a positive turn opens the knee.
        to_target: from the hip, m.
        pole: where the knee points, of any length.
        soften: part of the bones' length up to which the limb follows; counts as 0..1.
        twist: of the limb about the target's direction, in the end, rad.
        gate: how `reached` is decided.
    """
    a2, b2 = vec.dot(to_hip, to_hip), vec.dot(to_ankle, to_ankle)
    thigh, shin = vec.safe_sqrt(a2), vec.safe_sqrt(b2)
    distance = vec.length(to_target)
    free = bounded(soften) * (thigh + shin)
    reach = quartic_limit(distance, free, thigh + shin)
    too_near = gate.below(distance, jnp.abs(thigh - shin), band=LENGTH_BAND)
    reached = (1.0 - too_near) * gate.below(distance, free, band=LENGTH_BAND)

    # A bent limb's normal: one part along the hinge, and one across it if the hinge is tilted.
    normal = vec.dot(hinge, vec.cross(to_hip, to_ankle))
    across = vec.scale(to_ankle, vec.dot(to_hip, hinge)) - vec.scale(
        to_hip, vec.dot(to_ankle, hinge)
    )
    sin_now = _lengthened(normal, vec.dot(across, across), normal, a2 * b2)
    half_cos, half_sin = _opening(a2, b2, reach * reach, vec.dot(to_hip, to_ankle), sin_now)

    bent = quat.rotate(quat.from_half_angle(hinge, half_cos, half_sin), to_ankle) - to_hip
    return PoleBend(_pole_swing(bent, to_target, hinge, pole, twist), half_cos, half_sin, reached)


def _pole_swing(bent: Array, to_target: Array, hinge: Array, pole: Array, twist: Array) -> Array:
    """Rotation of the hip that points the bent limb at its target and its knee at the pole."""
    away = vec.dot(to_target, to_target) > jnp.finfo(to_target.dtype).eps ** 2
    aim = vec.normalize(to_target, vec.constant(DOWN, to_target))
    arc = arc_beside(vec.normalize(bent, aim), aim, hinge)
    normal = quat.rotate(arc, hinge)
    pole = vec.normalize(pole, vec.constant((0.0, 0.0, 0.0), pole))
    cos, sin, known = _angle_about(aim, normal, vec.cross(aim, pole))
    # Ozz takes the angle between the normals, not between their parts across the target. The two
    # are the same unless the hinge is tilted.
    along = vec.dot(normal, aim)
    sin = _lengthened(sin, (along * cos) ** 2, vec.dot(normal, pole), jnp.ones_like(along))
    cos = cos * vec.length(vec.reject(normal, aim))
    facing = quat.from_cos_sin(aim, jnp.where(known, cos, 1.0), jnp.where(known, sin, 0.0))
    swing = quat.multiply(quat.normalize(facing), arc)
    swing = quat.multiply(quat.from_axis_angle(aim, twist), swing)
    return jnp.where(away[..., None], swing, quat.identity(swing.dtype))


def _lengthened(x: Array, across2: Array, sign: Array, scale2: Array) -> Array:
    """Length, with this sign, of what measures `x` one way and the root of `across2` across it.

    `x` itself, with its slope through zero, where `across2` is rounding beside `scale2`.
    """
    tilted = across2 > (8.0 * jnp.finfo(x.dtype).eps) ** 2 * scale2
    length = vec.safe_sqrt(x * x + jnp.where(tilted, across2, 0.0))
    return jnp.where(tilted, jnp.where(sign < 0, -length, length), x)
