"""3-vectors on the last axis, and scalar functions whose gradients stay finite.

Every function broadcasts over the leading axes. All are written component by component: on a CPU,
`jnp.cross`, `jnp.concatenate` and reductions over a last axis of three run three to four times
slower than a handful of fused multiply-adds. The functions called most are jitted, here and in
`quat`: each is traced once per shape and is a single equation from then on, which saves a quarter
of the time it takes to trace the pipeline.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped
from numpy.polynomial import chebyshev

Args = ParamSpec("Args")
Output = TypeVar("Output")


def unstack(v: Shaped[Array, "*b n"]) -> tuple[Array, ...]:
    """The entries of the last axis, each of shape `*b`."""
    # Split, not sliced: the reverse of a slice is a padded array, and all of them are summed.
    parts = jax.lax.split(v, (1,) * v.shape[-1], axis=v.ndim - 1)
    return tuple(jax.lax.squeeze(part, (v.ndim - 1,)) for part in parts)


def components(v: Float[Array, "*b 3"]) -> tuple[Array, Array, Array]:
    """The x, y and z of `v`, each of shape `*b`."""
    x, y, z = unstack(v)
    return x, y, z


def stack(*values: Array) -> Float[Array, "*b n"]:
    """Values broadcast against each other and stacked on a new last axis; undoes `unstack`."""
    # Not `jnp.stack`: under `vmap` over scalars it puts the mapped axis last, so that mapped
    # arrays are laid out one way here and another way elsewhere.
    arrays = jnp.broadcast_arrays(*values)
    last = arrays[0].ndim
    return jax.lax.concatenate([jax.lax.expand_dims(x, (last,)) for x in arrays], last)


def sum_last(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Sum over a short last axis, such as the legs.

    Adds the entries one by one: on a CPU `jnp.sum` is a library call that takes ten times as long.
    """
    return functools.reduce(jnp.add, unstack(x))


def sum_vectors(v: Float[Array, "*b n 3"]) -> Float[Array, "*b 3"]:
    """Sum of a few vectors over the second-to-last axis."""
    return stack(*map(sum_last, components(v)))


def barrier(x: Array) -> Array:
    """`x`, computed only once: an optimization barrier.

    XLA's CPU fusion recomputes a cheap value in each of its consumers. Along a chain of quaternion
    products, where every component depends on all components before it, this grows exponentially.
    A stacked value behind a barrier is not recomputed. Barriers after the products halved the
    compile time of the pipeline; barriers after arcs and rotations halved the run time of its foot
    stage.
    """
    return jax.lax.optimization_barrier(x)


def stacked_barrier(*values: Array) -> tuple[Array, ...]:
    """Scalars (angles, cosines, lengths) broadcast, then stacked behind one `barrier`.

    A stack is differentiated as a whole, so a value whose derivative nobody needs is better alone.
    """
    if len(values) == 1:  # XLA drops a barrier before it fuses; what keeps a value apart is a stack
        return stacked_barrier(*values, jnp.zeros_like(values[0]))[:1]
    return unstack(barrier(stack(*values)))


def remat(function: Callable[Args, Output]) -> Callable[Args, Output]:
    """`function`, whose reverse mode stores only the arguments and recomputes everything else.

    For cheap functions called inside a scan, where each stored number is one more array to write.
    """
    return jax.checkpoint(function, prevent_cse=False)


def repeat(v: Float[Array, "*b n"], count: int) -> Float[Array, "*b count n"]:
    """`count` copies of `v` on a new second-to-last axis."""
    axis = v.ndim - 1
    return barrier(jax.lax.concatenate([jax.lax.expand_dims(v, (axis,))] * count, axis))


@jax.jit
def dot(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Array:
    """Dot product."""
    (ax, ay, az), (bx, by, bz) = components(a), components(b)
    return ax * bx + ay * by + az * bz


@jax.jit
def cross(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """Right-handed cross product."""
    ax, ay, az = components(a)
    bx, by, bz = components(b)
    return stack(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


@jax.jit
def add(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """Sum, computed once (see `barrier`); `+` would recompute it in each consumer."""
    return barrier(stack(*(x + y for x, y in zip(components(a), components(b), strict=True))))


@jax.jit
def subtract(a: Float[Array, "*a 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """Difference, computed once (see `barrier`); `-` would recompute it in each consumer."""
    return barrier(stack(*(x - y for x, y in zip(components(a), components(b), strict=True))))


@jax.jit
def scale(v: Float[Array, "*b 3"], factor: Array) -> Float[Array, "*c 3"]:
    """`v` times one scalar per vector."""
    # By components: the gradient of a broadcast factor would be summed by a library call.
    return barrier(stack(*(x * factor for x in components(v))))


@jax.jit
def safe_sqrt(x: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Square root; 0 with zero gradient where `x` is 0 or negative."""
    positive = x > 0
    # Nearly 0 instead of x: XLA may compute x twice, and round it to either side of 0.
    least = jnp.finfo(x.dtype).eps ** 2
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, least)), 0.0)


@jax.jit
def safe_divide(
    numerator: Float[Array, "*a"], denominator: Float[Array, "*b"], otherwise: float | Array = 0.0
) -> Array:
    """Quotient; `otherwise`, with zero gradient, where the denominator is almost 0."""
    nonzero = jnp.abs(denominator) >= jnp.finfo(denominator.dtype).tiny
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), otherwise)


def safe_arctan2(y: Float[Array, "*a"], x: Float[Array, "*b"]) -> Array:
    """Angle of the point (x, y), -pi..pi rad; 0 with zero gradient at the origin."""
    return _arctan2(*jnp.broadcast_arrays(y, x))


def _arctangent_series(last: int) -> list[float]:
    """Coefficients of the odd powers up to `last` of a polynomial for the arctangent on -1..1.

    Its Chebyshev series, 2 sum (-1)^k q^(2k + 1) / (2k + 1) T_(2k + 1) with q = tan(pi / 8),
    rewritten in powers. Taylor's series hardly converges at 1.
    """
    odd = np.arange(1, last + 1, 2)
    series = np.zeros(last + 1)
    series[odd] = 2.0 * (-1.0) ** (odd // 2) * (np.sqrt(2.0) - 1.0) ** odd / odd
    return chebyshev.cheb2poly(series)[odd].tolist()


# By the size of a float in bytes.
ARCTANGENT = {4: _arctangent_series(17), 8: _arctangent_series(41)}


def _polynomial(x: Array, coefficients: Sequence[float]) -> Array:
    """The polynomial with these coefficients, lowest power first."""
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


@jax.custom_jvp
@jax.jit
def _arctan2(y: Array, x: Array) -> Array:
    # A CPU would call the C library for each arctangent, one number at a time.
    rise, run = jnp.abs(y), jnp.abs(x)
    steep = rise > run
    small, large = jnp.where(steep, run, rise), jnp.where(steep, rise, run)
    tangent = small / jnp.where(large > 0, large, 1.0)
    angle = tangent * _polynomial(tangent * tangent, ARCTANGENT[x.dtype.itemsize])
    angle = jnp.where(steep, 0.5 * jnp.pi - angle, angle)
    return jnp.copysign(jnp.where(x < 0, jnp.pi - angle, angle), y)


@_arctan2.defjvp
def _arctan2_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (y, x), (dy, dx) = primals, tangents
    square = x * x + y * y
    nonzero = square > 0
    inverse = jnp.where(nonzero, 1.0 / jnp.where(nonzero, square, 1.0), 0.0)
    return _arctan2(y, x), x * inverse * dy - y * inverse * dx


@jax.custom_jvp
@jax.jit
def cos_sin(angle: Float[Array, "*b"]) -> tuple[Array, Array]:
    """Cosine and sine of an angle, rad, by Taylor's series.

    Accurate to the rounding error of 1, or of the angle if that is large. A CPU would call the C
    library for each cosine and sine, one number at a time.
    """
    half_turns = jnp.round(angle / jnp.pi)
    remainder = angle - jnp.pi * half_turns  # within -pi/2..pi/2
    sign = 1.0 - 2.0 * jnp.abs(half_turns - 2.0 * jnp.round(0.5 * half_turns))
    count = 14 if remainder.dtype.itemsize < 8 else 24
    terms = [1.0 / math.factorial(power) for power in range(count)]
    square = -remainder * remainder
    cos, sin = _polynomial(square, terms[::2]), remainder * _polynomial(square, terms[1::2])
    return sign * cos, sign * sin


@cos_sin.defjvp
def _cos_sin_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    (cos, sin), (d_angle,) = cos_sin(*primals), tangents
    return (cos, sin), (-sin * d_angle, cos * d_angle)


def length(v: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Euclidean length; 0 with zero gradient at the zero vector."""
    return safe_sqrt(dot(v, v))


def has_direction(v: Float[Array, "*b 3"]) -> Bool[Array, "*b"]:
    """Whether `v` is long enough to be normalized: longer than the machine epsilon."""
    return dot(v, v) > jnp.finfo(v.dtype).eps ** 2


@jax.custom_jvp
@jax.jit
def normalize(v: Float[Array, "*b n"], fallback: Float[Array, "*f n"]) -> Float[Array, "*c n"]:
    """`v` scaled to length 1; `fallback`, with zero gradient in `v`, where `v` has no direction."""
    # XLA computes a root once if it is broadcast; in a scalar, each component would compute it.
    inverse = unstack(barrier(jnp.broadcast_to(_inverse_length(v)[..., None], v.shape)))
    # Without stack and barrier each consumer would compute the components again.
    parts = zip(unstack(v), inverse, unstack(fallback), strict=True)
    return barrier(stack(*(jnp.where(scale > 0, x * scale, other) for x, scale, other in parts)))


@normalize.defjvp
def _normalize_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # Written in terms of the result. JAX's own rule reads v four times and has a long reverse;
    # fused and recomputed in each consumer, it took a third of the time of a gradient.
    (v, fallback), (dv, d_fallback) = primals, tangents
    direction, inverse = normalize(v, fallback), _inverse_length(v)
    pairs = list(zip(unstack(dv), unstack(direction), strict=True))
    along = functools.reduce(jnp.add, (dx * x for dx, x in pairs))
    d_direction = stack(*((dx - along * x) * inverse for dx, x in pairs))
    return direction, jnp.where(inverse[..., None] > 0, d_direction, d_fallback)


def _inverse_length(v: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """1 / length; 0 where `v` is at most as long as the machine epsilon."""
    # XLA computes a root once for all components if it is broadcast to them; what follows a root,
    # such as a choice, it would compute again for each.
    square = functools.reduce(jnp.add, (x * x for x in unstack(v)))
    return jax.lax.rsqrt(jnp.where(square > jnp.finfo(v.dtype).eps ** 2, square, jnp.inf))


def reject(v: Float[Array, "*a 3"], direction: Float[Array, "*b 3"]) -> Float[Array, "*c 3"]:
    """The part of `v` at right angles to the unit vector `direction` (vector rejection)."""
    return v - scale(direction, dot(v, direction))


def across(
    direction: Float[Array, "*a 3"], up: Float[Array, "*b 3"], fallback: Float[Array, "*c 3"]
) -> Float[Array, "*d 3"]:
    """Unit vector at right angles to `up` that is nearest to `direction`; both of length 1.

    `fallback`, with zero gradient in `direction`, where it points along `up` but for rounding.
    """
    part = reject(direction, up)
    known = dot(part, part) > jnp.finfo(part.dtype).eps
    return normalize(scale(part, known.astype(part.dtype)), fallback)


def constant(v: tuple[float, float, float], like: Array) -> Float[Array, "3"]:
    """A fixed vector with the dtype of `like`."""
    return jnp.asarray(v, like.dtype)


def triangle_normal(
    a: Float[Array, "*b 3"], b: Float[Array, "*b 3"], c: Float[Array, "*b 3"], up: Float[Array, "3"]
) -> Float[Array, "*b 3"]:
    """Unit normal of triangles on the side of `up`; `up` itself where they have no area.

    Stays in components to the end, which halves the time of a ray hit.
    """
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (components(corner) for corner in (a, b, c))
    upx, upy, upz = components(up)
    bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    # Sides relative to the longest, so that a tiny triangle has a normal too.
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
