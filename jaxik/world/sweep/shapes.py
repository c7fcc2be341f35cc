"""Where a sphere or a capsule that comes down rests on an edge, a triangle or a parallelogram.

All points are relative to the centre of the shape, in a frame whose y is up, as (x, y, z) of arrays
of one shape. A capsule is all spheres about `-half` to `half`. It touches an obstacle where a
sphere about its centre would touch the obstacle extruded from `half` to `-half`, so that there are
spheres only: a triangle becomes a prism with parallelograms for sides.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import vec

MISS = -1e9  # m, the height of what is not met

Point = tuple[Array, Array, Array]


class Rest(NamedTuple):
    """A shape at rest."""

    height: Array
    """m, of its centre above where it is; `MISS` where it does not touch."""
    normal: Point
    """Unit, from the contact towards the shape."""
    contact: Point
    """m, on the obstacle, relative to where the centre is before it moves."""


def highest(rests: Rest) -> Rest:
    """The first of several obstacles, along the first axis, that a shape meets on its way down."""
    # Without the barrier each comparison would compute all obstacles again.
    numbers = vec.stacked_barrier(rests.height, *rests.normal, *rests.contact)
    best = [x[0] for x in numbers]
    for index in range(1, len(numbers[0])):
        higher = numbers[0][index] > best[0]
        best = [jnp.where(higher, x[index], y) for x, y in zip(numbers, best, strict=True)]
    height, nx, ny, nz, x, y, z = best
    return Rest(height, (nx, ny, nz), (x, y, z))


def on_edge(start: Point, along: Point, radius: Array) -> tuple[Rest, Array]:
    """A sphere on the line from `start` to `start + along`, and where on it from 0 to 1.

    Over the point at `s` of the line the centre is at `y(s) + sqrt(r² - |w(s)|²)`, with w its
    distance in plan. This is concave: its highest point is where the derivative is zero, or at
    the nearer end.
    """
    (px, py, pz), (dx, dy, dz) = start, along
    run = dx * dx + dz * dz
    middle = -vec.safe_divide(px * dx + pz * dz, run)
    wx, wz = px + middle * dx, pz + middle * dz
    inner = vec.safe_sqrt(radius * radius - wx * wx - wz * wz)
    lean = vec.safe_divide(dy * inner, vec.safe_sqrt(run * (run + dy * dy)))
    place = jnp.where(run > 0, middle + lean, jnp.where(dy > 0, 1.0, 0.0))
    place = jnp.where(place < 0, 0.0, jnp.where(place > 1, 1.0, place))
    wx, wz, y = px + place * dx, pz + place * dz, py + place * dy
    under = radius * radius - wx * wx - wz * wz
    inner = vec.safe_sqrt(under)
    height = jnp.where(under >= 0, y + inner, MISS)
    flat = vec.safe_divide(inner, radius, otherwise=1.0)
    normal = (-vec.safe_divide(wx, radius), flat, -vec.safe_divide(wz, radius))
    return Rest(height, normal, (wx, y, wz)), place


def on_face(
    corner: Point, first: Point, second: Point, radius: Array, whole: bool | Array
) -> tuple[Rest, tuple[Array, Array]]:
    """A sphere on the triangle of two sides from a corner, or on the `whole` parallelogram.

    Also the place of the contact in sides from the corner. A face that contains up is not met.
    """
    (px, py, pz), (ax, ay, az), (bx, by, bz) = corner, first, second
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    size = vec.safe_sqrt(nx * nx + ny * ny + nz * nz)
    size = jnp.where(ny < 0, -size, size)
    determinant = -ny
    nx, ny, nz = (vec.safe_divide(part, size) for part in (nx, ny, nz))
    cx, cz = -radius * nx - px, -radius * nz - pz
    s = vec.safe_divide(cx * bz - cz * bx, determinant)
    t = vec.safe_divide(ax * cz - az * cx, determinant)
    inside = (s >= 0) & (t >= 0) & (ny > 0)
    inside &= jnp.where(whole, (s <= 1) & (t <= 1), s + t <= 1)
    plane = py + vec.safe_divide(nx * px + nz * pz, ny)
    height = jnp.where(inside, plane + vec.safe_divide(radius, ny), MISS)
    contact = (-radius * nx, plane + vec.safe_divide(radius, ny) - radius * ny, -radius * nz)
    return Rest(height, (nx, ny, nz), contact), (s, t)


def on_triangle(corners: tuple[Point, Point, Point], radius: Array, half: Point | None) -> Rest:
    """A sphere, or with `half` a capsule, on a triangle."""
    a, b, c = corners
    if half is None:
        starts, ends = stacked(a, b, c), stacked(b, c, a)
        edges, _ = on_edge(starts, less(ends, starts), radius)
        face, _ = on_face(a, less(b, a), less(c, a), radius, False)
        return highest(_joined(edges, _alone(face)))
    hx, hy, hz = (jnp.broadcast_to(x, a[0].shape) for x in half)
    half = hx, hy, hz
    # The triangle at both ends of the prism, and the sides between them.
    back = tuple(less(corner, half) for corner in corners)
    front = tuple(added(corner, half) for corner in corners)
    starts, ends = stacked(*back, *front), stacked(*back[1:], back[0], *front[1:], front[0])
    sides = less(ends, starts)
    edges, _ = on_edge(starts, sides, radius)
    shift = stacked(*[half] * 3, *[scaled(half, -1.0)] * 3)
    edges = edges._replace(contact=added(edges.contact, shift))
    doubled, lower = stacked(*[scaled(half, 2.0)] * 3), stacked(*back)
    ribs, _ = on_edge(lower, doubled, radius)
    ribs = ribs._replace(contact=stacked(*corners))
    walls, (s, _) = on_face(lower, less(stacked(*back[1:], back[0]), lower), doubled, radius, True)
    side = less(stacked(b, c, a), stacked(a, b, c))
    walls = walls._replace(contact=added(stacked(a, b, c), scaled(side, s)))
    first, second = (stacked(side, side) for side in (less(b, a), less(c, a)))
    faces, _ = on_face(stacked(back[0], front[0]), first, second, radius, False)
    shift = stacked(half, scaled(half, -1.0))
    faces = faces._replace(contact=added(faces.contact, shift))
    return highest(_joined(edges, ribs, walls, faces))


def _joined(*rests: Rest) -> Rest:
    """Obstacles one after the other along the first axis."""
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *rests)


def _alone(rest: Rest) -> Rest:
    """One obstacle with a first axis."""
    return jax.tree.map(lambda x: x[None], rest)


def stacked(*points: Point) -> Point:
    """Points along a new first axis."""
    x, y, z = (jnp.stack(jnp.broadcast_arrays(*parts)) for parts in zip(*points, strict=True))
    return x, y, z


def less(a: Point, b: Point) -> Point:
    """From point `b` to point `a`."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def added(a: Point, b: Point) -> Point:
    """The sum of two points."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def scaled(point: Point, factor: Array | float) -> Point:
    """A point times a number."""
    return point[0] * factor, point[1] * factor, point[2] * factor
