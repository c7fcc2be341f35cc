"""Vectors of three components on the last axis; every function broadcasts over the axes before it.

Written by components: on a CPU `jnp.cross`, `concatenate` and reductions over a last axis of three
run three to four times slower than a handful of fused multiply-adds. What is called most is jitted,
here and in `quat`: traced once a shape, and from then on one equation, which spares a quarter of
the time that tracing the pipeline takes.
"""

import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.polynomial import chebyshev


def unstack(v: Float[Array, "*b n"]) -> tuple[Array, ...]:
    """What stands on the last axis, one by one, each of shape `*b`."""
    # Split, not sliced: in reverse mode a slice is a padded array, and all of them are summed.
    parts = jax.lax.split(v, (1,) * v.shape[-1], axis=v.ndim - 1)
    return tuple(jnp.squeeze(part, -1) for part in parts)


def components(v: Float[Array, "*b 3"]) -> tuple[Array, Array, Array]:
    """The x, y and z of `v`, each of shape `*b`."""
    x, y, z = unstack(v)
    return x, y, z


def sum_last(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Sum over a short last axis, such as that of the legs.

    Added one by one: a CPU calls a library for `jnp.sum`, which takes ten times as long.
    """
    return functools.reduce(jnp.add, unstack(x))


def sum_vectors(v: Float[Array, "*b n 3"]) -> Float[Array, "*b 3"]:
    """Sum of a few vectors, on the axis before the last."""
    return stack(*map(sum_last, components(v)))


def stack(*values: Array) -> Float[Array, "*b n"]:
    """Numbers on a last axis, broadcast against each other; the inverse of `unstack`."""
    # Not `jnp.stack`: mapped over single numbers it puts the mapped axis last, and what is mapped
    # lies one way here and another there.
    values = jnp.broadcast_arrays(*values)
    last = values[0].ndim
    return jax.lax.concatenate([jax.lax.expand_dims(x, (last,)) for x in values], last)


def barrier(x: Array) -> Array:
    """`x`, computed once.

    XLA's fusion on a CPU computes a cheap value again in each consumer; through a chain of
    quaternion products, where every component depends on every component before, that grows
    exponentially. It does not do so with what was stacked and fenced. Fences after the products
    halved the compile time of the pipeline; after arcs and turns they halved its feet's run time.
    """
    return jax.lax.optimization_barrier(x)


def stacked_barrier(*values: Array) -> tuple[Array, ...]:
    """Numbers, broadcast against each other, stacked behind a barrier: angles, cosines, lengths."""
    return unstack(barrier(stack(*values)))


def remat(function: Callable) -> Callable:
    """The function, of which reverse mode keeps the arguments and computes the rest again.

    For what is cheap and called in a scan, where each number kept is one more array to write.
    """
    return jax.checkpoint(function, prevent_cse=False)


def repeat(v: Float[Array, "*b n"], count: int) -> Float[Array, "*b count n"]:
    """`v` so many times, on an axis before its own."""
    axis = v.ndim - 1
    return barrier(jax.lax.concatenate([jax.lax.expand_dims(v, (axis,))] * count, axis))


@jax.jit
def dot(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Array:
    """Scalar product."""
    (ax, ay, az), (bx, by, bz) = components(a), components(b)
    return ax * bx + ay * by + az * bz


@jax.jit
def cross(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """Vector product, right-handed."""
    ax, ay, az = components(a)
    bx, by, bz = components(b)
    return stack(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


@jax.jit
def add(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """Sum of a place and what was turned, kept: `+` turns anew for each that needs the sum."""
    return barrier(stack(*(x + y for x, y in zip(components(a), components(b), strict=True))))


@jax.jit
def subtract(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """The vector from one place to another, kept: `-` is taken anew for each that needs it."""
    return barrier(stack(*(x - y for x, y in zip(components(a), components(b), strict=True))))


@jax.jit
def scale(v: Float[Array, "*b 3"], factor: Array) -> Float[Array, "*c 3"]:
    """`v` times one number per vector."""
    # By components: a factor that is broadcast is summed by a library in reverse mode.
    return barrier(stack(*(part * factor for part in components(v))))


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
    """Angle of the point (x, y), -pi..pi rad; 0 with zero slope at the origin."""
    return _angle(*jnp.broadcast_arrays(y, x))


def _arctangent_series(last: int) -> list[float]:
    """Coefficients of the odd powers, up to the last, of the arctangent on -1..1.

    Its Chebyshev series, 2 sum (-1)^k q^(2k + 1) / (2k + 1) T_(2k + 1) with q the tangent of an
    eighth of a half-turn, as a polynomial: Taylor's hardly converges at 1.
    """
    odd = np.arange(1, last + 1, 2)
    series = np.zeros(last + 1)
    series[odd] = 2.0 * (-1.0) ** (odd // 2) * (np.sqrt(2.0) - 1.0) ** odd / odd
    return chebyshev.cheb2poly(series)[odd].tolist()


# By the bytes of a float.
ARCTANGENT = {4: _arctangent_series(17), 8: _arctangent_series(41)}


def _polynomial(x: Array, coefficients: Sequence[float]) -> Array:
    """The polynomial with these coefficients, that of the lowest power first."""
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


@jax.custom_jvp
def _angle(y: Array, x: Array) -> Array:
    # A CPU calls the C library for each arctangent, one number at a time.
    rise, run = jnp.abs(y), jnp.abs(x)
    steep = rise > run
    small, large = jnp.where(steep, run, rise), jnp.where(steep, rise, run)
    tangent = small / jnp.where(large > 0, large, 1.0)
    angle = tangent * _polynomial(tangent * tangent, ARCTANGENT[x.dtype.itemsize])
    angle = jnp.where(steep, 0.5 * jnp.pi - angle, angle)
    return jnp.copysign(jnp.where(x < 0, jnp.pi - angle, angle), y)


@_angle.defjvp
def _angle_slope(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (y, x), (y_slope, x_slope) = primals, tangents
    square = x * x + y * y
    known = square > 0
    inverse = jnp.where(known, 1.0 / jnp.where(known, square, 1.0), 0.0)
    return _angle(y, x), x * inverse * y_slope - y * inverse * x_slope


@jax.custom_jvp
def cos_sin(angle: Float[Array, "*b"]) -> tuple[Array, Array]:
    """Cosine and sine of an angle, rad; their error is a rounding of 1, or of a large angle.

    A CPU calls the C library for each, number by number; this is Taylor's series.
    """
    halves = jnp.round(angle / jnp.pi)
    rest = angle - jnp.pi * halves  # within a quarter turn
    sign = 1.0 - 2.0 * jnp.abs(halves - 2.0 * jnp.round(0.5 * halves))
    terms = [1.0 / math.factorial(power) for power in range(14 if rest.dtype.itemsize < 8 else 24)]
    square = -rest * rest
    cos, sin = _polynomial(square, terms[::2]), rest * _polynomial(square, terms[1::2])
    return sign * cos, sign * sin


@cos_sin.defjvp
def _cos_sin_slope(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    (cos, sin), (slope,) = cos_sin(*primals), tangents
    return (cos, sin), (-sin * slope, cos * slope)


def length(v: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Euclidean length; at the zero vector 0 with zero slope."""
    return safe_sqrt(dot(v, v))


def has_direction(v: Float[Array, "*b 3"]) -> Bool[Array, "*b"]:
    """Whether `v` is long enough to be brought to length one."""
    return dot(v, v) > jnp.finfo(v.dtype).eps ** 2


@jax.custom_jvp
@jax.jit
def normalize(v: Float[Array, "*b 3"], fallback: Float[Array, "*f 3"]) -> Float[Array, "*c 3"]:
    """`v` at length one; `fallback`, flat in `v`, where `v` is too short to have a direction."""
    known = has_direction(v)
    inverse = 1.0 / jnp.sqrt(jnp.where(known, dot(v, v), 1.0))
    # Stacked and fenced, or each who needs it would take the length again.
    pairs = zip(components(v), components(fallback), strict=True)
    return barrier(stack(*(jnp.where(known, part * inverse, other) for part, other in pairs)))


@normalize.defjvp
def _unit_slope(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # Told in terms of the answer. JAX's own rule goes through v four times and its reverse is long;
    # fused, and computed again in each consumer, it took a third of a gradient's time.
    (v, fallback), (v_slope, fallback_slope) = primals, tangents
    direction, known = normalize(v, fallback), has_direction(v)
    inverse = 1.0 / jnp.sqrt(jnp.where(known, dot(v, v), 1.0))
    along = dot(direction, v_slope)
    pairs = zip(components(v_slope), components(direction), strict=True)
    turned = stack(*((slope - along * part) * inverse for slope, part in pairs))
    return direction, jnp.where(known[..., None], turned, fallback_slope)


def reject(v: Float[Array, "*a 3"], direction: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """The part of `v` at right angles to the unit vector `direction`."""
    return v - scale(direction, dot(v, direction))


def constant(v: tuple[float, float, float], like: Array) -> Float[Array, "3"]:
    """A fixed vector in the dtype of `like`."""
    return jnp.asarray(v, like.dtype)


def triangle_normal(
    a: Float[Array, "*b 3"], b: Float[Array, "*b 3"], c: Float[Array, "*b 3"], up: Float[Array, "3"]
) -> Float[Array, "*b 3"]:
    """Unit normal of triangles, on the side of up; up where they have no area.

    By components up to the end, which halves the time of a ray's hit.
    """
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (components(corner) for corner in (a, b, c))
    upx, upy, upz = components(up)
    bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    # Sides in units of the longest, so that a tiny triangle has a normal too.
    square = jnp.maximum(bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz)
    inverse = jax.lax.stop_gradient(safe_divide(jnp.ones_like(square), safe_sqrt(square)))
    bx, by, bz, cx, cy, cz = (side * inverse for side in (bx, by, bz, cx, cy, cz))
    x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    square = x * x + y * y + z * z
    known = square > jnp.finfo(square.dtype).eps ** 2
    length = jnp.sqrt(jnp.where(known, square, 1.0))
    inverse = jnp.where(x * upx + y * upy + z * upz < 0, -1.0, 1.0) / length
    return stack(
        jnp.where(known, x * inverse, upx),
        jnp.where(known, y * inverse, upy),
        jnp.where(known, z * inverse, upz),
    )
