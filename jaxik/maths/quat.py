"""Unit quaternions: wxyz, Hamilton, active; every function broadcasts over the leading axes.

`q` and `-q` are the same rotation. A correction multiplies a local rotation from the right.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import vec


def components(q: Float[Array, "*b 4"]) -> tuple[Array, Array, Array, Array]:
    """The w, x, y and z of `q`, each of shape `*b`."""
    w, x, y, z = vec.unstack(q)
    return w, x, y, z


def stack(w: Array, x: Array, y: Array, z: Array) -> Float[Array, "*b 4"]:
    """The quaternion with these components, broadcast against each other."""
    return vec.stack(w, x, y, z)


def identity(dtype=None) -> Float[Array, "4"]:
    """The rotation by zero."""
    return jnp.array([1.0, 0.0, 0.0, 0.0], dtype)


@jax.jit
def multiply(a: Float[Array, "*a 4"], b: Float[Array, "*b 4"]) -> Float[Array, "*c 4"]:
    """The rotation by `b` followed by the rotation by `a`."""
    aw, ax, ay, az = components(a)
    bw, bx, by, bz = components(b)
    product = stack(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return vec.barrier(product)


def conjugate(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """The inverse rotation."""
    w, x, y, z = components(q)
    return stack(w, -x, -y, -z)


@jax.jit
def rotate(q: Float[Array, "*a 4"], v: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """`v` rotated by `q`."""
    w, x, y, z = components(q)
    vx, vy, vz = vec.components(v)
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    rotated = vec.stack(
        vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx
    )
    return vec.barrier(rotated)


def axes(q: Float[Array, "*b 4"]) -> tuple[Array, Array, Array]:
    """The x, y and z axes rotated by `q`, each `*b 3`: the columns of its matrix."""
    w, x, y, z = components(q)
    return (
        vec.stack(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        vec.stack(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        vec.stack(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def unrotate(q: Float[Array, "*a 4"], v: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """`v` rotated by the inverse of `q`."""
    return rotate(conjugate(q), v)


def dot(a: Float[Array, "*a 4"], b: Float[Array, "*b 4"]) -> Array:
    """Dot product of the four components."""
    aw, ax, ay, az = components(a)
    bw, bx, by, bz = components(b)
    return aw * bw + ax * bx + ay * by + az * bz


def normalize(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """`q` scaled to length 1; the identity, with zero gradient, where `q` is zero."""
    return vec.normalize(q, identity(q.dtype))


def half_angle(cos: Float[Array, "*b"], sin: Float[Array, "*b"]) -> tuple[Array, Array]:
    """Cosine (0 or more) and sine of half of an angle, given the angle's cosine and sine.

    The angle is taken in -pi..pi rad. Uses the half-angle formula that is better conditioned on
    either side of a right angle: exact, with finite gradients everywhere. At an angle of pi, of
    either sign, the half-angle is +pi/2.
    """
    acute = cos >= 0
    larger = jnp.sqrt(jnp.where(acute, 1.0 + cos, 1.0 - cos) * 0.5)
    smaller = sin / (2.0 * larger)
    sign = jnp.where(sin < 0, -1.0, 1.0)
    return jnp.where(acute, larger, sign * smaller), jnp.where(acute, smaller, sign * larger)


def half_cos_sin(angle: Float[Array, "*b"]) -> tuple[Array, Array]:
    """Cosine and sine of half an angle, rad."""
    cos, sin = vec.stacked_barrier(*vec.cos_sin(0.5 * angle))
    return cos, sin


def from_half_angle(
    axis: Float[Array, "*a 3"], half_cos: Float[Array, "*b"], half_sin: Float[Array, "*b"]
) -> Float[Array, "*c 4"]:
    """Rotation about the unit `axis`, given the cosine and sine of half its angle."""
    x, y, z = vec.components(axis)
    return vec.barrier(stack(half_cos, x * half_sin, y * half_sin, z * half_sin))


def from_cos_sin(
    axis: Float[Array, "*a 3"], cos: Float[Array, "*b"], sin: Float[Array, "*b"]
) -> Float[Array, "*c 4"]:
    """Rotation about the unit `axis`, given the cosine and sine of its angle."""
    return from_half_angle(axis, *half_angle(cos, sin))


def from_axis_angle(axis: Float[Array, "*a 3"], angle: Float[Array, "*b"]) -> Float[Array, "*c 4"]:
    """Right-handed rotation about the unit `axis` by `angle`, rad."""
    return from_half_angle(axis, *half_cos_sin(angle))


@vec.remat
def from_rotvec(v: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Rotation about `v` by its length, rad; smooth at zero, where a Taylor series is used."""
    square = vec.dot(v, v)
    large = square > jnp.finfo(v.dtype).eps ** 0.5
    angle = jnp.sqrt(jnp.where(large, square, 1.0))
    cos, sin = vec.cos_sin(0.5 * angle)
    half_sinc = jnp.where(large, sin / angle, 0.5 - square / 48.0)
    cos = jnp.where(large, cos, 1.0 - square / 8.0)
    x, y, z = vec.components(v)
    return stack(cos, x * half_sinc, y * half_sinc, z * half_sinc)


def shortest_arc(
    a: Float[Array, "*a 3"], b: Float[Array, "*b 3"], fallback: Float[Array, "*f 3"]
) -> Float[Array, "*c 4"]:
    """Shortest rotation that takes the unit vector `a` to the unit vector `b`.

    Where they are opposed every axis is equally short: the answer is a rotation by pi about the
    unit vector `fallback`, which should be at right angles to `a`, with zero gradient.
    """
    w = 1.0 + vec.dot(a, b)
    known = w > 4.0 * jnp.finfo(w.dtype).eps
    axis = jnp.where(known[..., None], vec.cross(a, b), fallback)
    # |(w, a x b)|² = 2 w for unit vectors, but a float32 "unit" vector is not quite one.
    return normalize(stack(jnp.where(known, w, 0.0), *vec.components(axis)))


def nlerp(
    a: Float[Array, "*a 4"], b: Float[Array, "*b 4"], weight: Float[Array, "*w"]
) -> Float[Array, "*c 4"]:
    """Normalized linear interpolation the shorter way: `a` at weight 0, `b` at weight 1."""
    opposed = dot(a, b) < 0
    # By components: the gradient of a broadcast weight would be summed number by number.
    pairs = zip(components(a), components(b), strict=True)
    return normalize(stack(*(x + (jnp.where(opposed, -y, y) - x) * weight for x, y in pairs)))


def nlerp_identity(q: Float[Array, "*a 4"], weight: Float[Array, "*w"]) -> Float[Array, "*c 4"]:
    """`nlerp` from the identity to `q`, for a weight 0..1."""
    w, x, y, z = components(q)
    signed = jnp.where(w < 0, -weight, weight)
    return normalize(stack(1.0 - weight + w * signed, x * signed, y * signed, z * signed))


def nlerp_half(
    half_cos: Float[Array, "*a"], half_sin: Float[Array, "*a"], weight: Float[Array, "*w"]
) -> tuple[Array, Array]:
    """`nlerp_identity` about a fixed axis, on the cosine (0 or more) and sine of half the angle."""
    cos, sin = 1.0 - weight + half_cos * weight, half_sin * weight
    inverse = 1.0 / jnp.sqrt(cos * cos + sin * sin)
    return cos * inverse, sin * inverse


def angle(a: Float[Array, "*a 4"], b: Float[Array, "*b 4"]) -> Array:
    """Angle of the rotation between `a` and `b`, 0..pi rad; zero gradient where they are equal."""
    w, x, y, z = components(multiply(conjugate(a), b))
    sin = vec.safe_sqrt(x * x + y * y + z * z)
    return 2.0 * vec.safe_arctan2(sin, jnp.abs(w))
