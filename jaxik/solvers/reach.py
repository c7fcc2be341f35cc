"""How far a two-bone limb reaches, and how a distance approaches that limit."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import vec
from jaxik.maths.gate import AbstractGate

LENGTH_BAND = 0.005  # m over which a blurred decision about lengths changes
STRETCH_BAND = 0.01


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
