"""Rotations of a joint that line one direction up with another."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import quat, vec

DOWN = (0.0, -1.0, 0.0)
LEFT = (1.0, 0.0, 0.0)


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
