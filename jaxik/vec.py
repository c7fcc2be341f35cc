"""Vectors of three components on the last axis; every function broadcasts over the axes before it.

Written by components: on a CPU `jnp.cross`, `concatenate` and reductions over a last axis of three
run three to four times slower than a handful of fused multiply-adds.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def components(v: Float[Array, "*b 3"]) -> tuple[Array, Array, Array]:
    """The x, y and z of `v`, each of shape `*b`."""
    return v[..., 0], v[..., 1], v[..., 2]


def stack(x: Array, y: Array, z: Array) -> Float[Array, "*b 3"]:
    """The vector with these components, which are broadcast against each other."""
    return jnp.stack(jnp.broadcast_arrays(x, y, z), axis=-1)


def fence(x: Array) -> Array:
    """`x`, computed once.

    XLA's fusion on a CPU computes a cheap value again in each consumer; through a chain of
    quaternion products, where every component depends on every component before, that grows
    exponentially. Fences after the products halved the compile time of the pipeline.
    """
    return jax.lax.optimization_barrier(x)


def dot(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Array:
    """Scalar product."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """Vector product, right-handed."""
    ax, ay, az = components(a)
    bx, by, bz = components(b)
    return stack(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def scale(v: Float[Array, "*b 3"], factor: Array) -> Float[Array, "*c 3"]:
    """`v` times one number per vector."""
    return v * jnp.asarray(factor)[..., None]


def safe_sqrt(x: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Square root; 0 with zero slope where `x` is not above zero."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_divide(
    numerator: Float[Array, "*a"], denominator: Float[Array, "*b"], otherwise: float = 0.0
) -> Array:
    """Quotient; `otherwise` with zero slope where the denominator is zero."""
    known = denominator != 0
    return jnp.where(known, numerator / jnp.where(known, denominator, 1.0), otherwise)


def safe_arctan2(y: Float[Array, "*a"], x: Float[Array, "*b"]) -> Array:
    """Angle of the point (x, y), rad; 0 with zero slope at the origin."""
    known = (x != 0) | (y != 0)
    return jnp.where(known, jnp.arctan2(y, jnp.where(known, x, 1.0)), 0.0)


def length(v: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Euclidean length; at the zero vector 0 with zero slope."""
    return safe_sqrt(dot(v, v))


def unit(v: Float[Array, "*b 3"], fallback: Float[Array, "*f 3"]) -> Float[Array, "*c 3"]:
    """`v` at length one; `fallback`, flat in `v`, where `v` is too short to have a direction."""
    square = dot(v, v)
    known = square > jnp.finfo(v.dtype).eps ** 2
    inverse = 1.0 / jnp.sqrt(jnp.where(known, square, 1.0))
    return jnp.where(known[..., None], scale(v, inverse), fallback)


def reject(v: Float[Array, "*a 3"], direction: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """The part of `v` at right angles to the unit vector `direction`."""
    return v - scale(direction, dot(v, direction))


def constant(v: tuple[float, float, float], like: Array) -> Float[Array, "3"]:
    """A fixed vector in the dtype of `like`."""
    return jnp.asarray(v, like.dtype)
