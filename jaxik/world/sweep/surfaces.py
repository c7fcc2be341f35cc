"""Where a shape that comes down rests on each kind of surface."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt

from jaxik.maths import vec
from jaxik.world.grid import Grid
from jaxik.world.heightfield import AbstractHeightfield, Heightfield, HeightFunction
from jaxik.world.surfaces import AbstractSurface, Mesh, MovingSurface, Plane

from .shapes import MISS, Point, Rest, added, highest, less, on_edge, on_triangle, scaled, stacked

ASCENTS = 16  # steps towards the highest rest on a bilinear cell
RINGS = 3  # of first contacts tried on a function, beside the one in the middle
SPHERES = 9  # that stand for a capsule on a function
ROLLS = 4  # steps of a sphere on a function towards the point that faces it


class Shapes(NamedTuple):
    """Shapes that start somewhere and come down along -up."""

    centre_ws: Float[Array, "*b 3"]
    """Metres."""
    radius: Float[Array, "*b"]
    """Metres."""
    half_ws: Float[Array, "*b 3"] | None
    """m, from the centre to the middle of one end of a capsule; None for spheres."""

    def relative(
        self, axes_ws: Float[Array, "3 3"], origin_ws: Float[Array, "3"]
    ) -> tuple[Point, Point | None]:
        """Centre and half in a frame, as points of arrays."""
        half = None if self.half_ws is None else in_frame(self.half_ws, axes_ws)
        return in_frame(self.centre_ws - origin_ws, axes_ws), half


def in_frame(v: Float[Array, "*b 3"], axes_ws: Float[Array, "3 3"]) -> Point:
    """A vector along the axes of a frame."""
    return vec.dot(v, axes_ws[0]), vec.dot(v, axes_ws[1]), vec.dot(v, axes_ws[2])


def rest_on(
    surface: AbstractSurface, shapes: Shapes, up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
    """How far shapes come down until they rest, m, normal and contact there, and whether they do.

    Numbers stay finite for shapes that do not. What overlaps a shape at its start is not met.

    Raises:
        ValueError: a mesh that was not prepared, or a kind of surface that cannot be swept.
    """
    if isinstance(surface, MovingSurface):
        pose = surface.world_from_platform
        inside = pose.inverse()
        half = None if shapes.half_ws is None else inside.turn(shapes.half_ws)
        local = Shapes(inside.apply(shapes.centre_ws), shapes.radius, half)
        drop, normal, contact, met = rest_on(surface.surface, local, inside.turn(up_ws), mask)
        return drop, pose.turn(normal), pose.apply(contact), met
    if isinstance(surface, Plane):
        return _on_plane(surface, shapes, up_ws, mask)
    if isinstance(surface, Mesh):
        wide = surface.wide
        if wide is None:
            raise ValueError(
                "the terrain has a mesh that is not prepared for shapes: sweep them over "
                "jaxik.world.sweep.sweepable(terrain, margin)"
            )
        axes, origin = wide.axes_ws, surface.centre_of(wide)
        centre, half = shapes.relative(axes, origin)
        rest = _on_mesh(surface, wide, (centre, half, shapes.radius), mask)
    elif isinstance(surface, Heightfield | HeightFunction):
        axes, origin = surface.axes_ws, surface.origin_ws
        centre, half = shapes.relative(axes, origin)
        seek = _on_grid if isinstance(surface, Heightfield) else _on_function
        rest = seek(surface, centre, half, shapes.radius)  # type: ignore[arg-type]
        visible = surface.layers & mask != 0
        rest = rest._replace(height=jnp.where(visible, rest.height, MISS))
    else:
        raise ValueError(f"shapes cannot be swept over a {type(surface).__name__}")
    met = rest.height > 0.5 * MISS
    drop, *local = vec.stacked_barrier(
        jnp.where(met, -rest.height, 0.0), *rest.normal, *rest.contact
    )
    normal, contact = (
        vec.stack(*in_frame(vec.stack(x, y, z), axes.T)) for x, y, z in (local[:3], local[3:])
    )
    return drop, normal, shapes.centre_ws + contact, met


def _on_plane(
    plane: Plane, shapes: Shapes, up_ws: Array, mask: Array
) -> tuple[Array, Array, Array, Array]:
    rise = vec.dot(plane.normal_ws, up_ws)
    normal = jnp.where(rise < 0, -plane.normal_ws, plane.normal_ws)
    over = vec.dot(shapes.centre_ws - plane.point_ws, normal) - shapes.radius
    touching = -vec.scale(normal, shapes.radius)
    if shapes.half_ws is not None:
        along = vec.dot(shapes.half_ws, normal)
        over -= jnp.abs(along)
        touching -= vec.scale(shapes.half_ws, jnp.sign(along))
    drop = vec.safe_divide(over, jnp.abs(rise))
    met = (jnp.abs(rise) > 0) & (over >= -_rounding(shapes)) & (plane.layers & mask != 0)
    contact = shapes.centre_ws - vec.scale(up_ws, drop) + touching
    return drop, jnp.broadcast_to(normal, contact.shape), contact, met


def _rounding(shapes: Shapes) -> Array:
    """m, by which a shape that starts at rest may seem to overlap the ground."""
    size = vec.sum_last(jnp.abs(shapes.centre_ws)) + shapes.radius
    return 16 * jnp.finfo(size.dtype).eps * jax.lax.stop_gradient(size)


def _on_mesh(mesh: Mesh, wide: Grid, shape: tuple[Point, Point | None, Array], mask: Array) -> Rest:
    """By the lists of the wide grid; then once more with the triangle that is met first."""
    centre, half, radius = shape
    grid, fixed, stopped = jax.lax.stop_gradient((wide, centre, (radius, half)))
    first, count = grid.look_up(fixed[0], fixed[2])
    rounding = 16 * jnp.finfo(radius.dtype).eps * (1.0 + jnp.abs(fixed[1]))

    def body(step: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        height, winner = best
        triangle = grid.members.at[jnp.where(step < count, first + step, 0)].get(
            mode="promise_in_bounds"
        )
        row = vec.unstack(grid.corners.at[triangle].get(mode="promise_in_bounds"))
        corners = tuple(
            (row[i] - fixed[0], row[i + 2] - fixed[1], row[i + 1] - fixed[2]) for i in (0, 3, 6)
        )
        rest = on_triangle(corners, *stopped).height  # type: ignore[arg-type]
        seen = grid.visible.at[triangle].get(mode="promise_in_bounds") & mask != 0
        better = seen & (step < count) & (rest <= rounding) & (rest > height)
        return jnp.where(better, rest, height), jnp.where(better, triangle, winner)

    start = jnp.full(count.shape, MISS, radius.dtype), jnp.full(count.shape, -1, jnp.int32)
    longest = jnp.max(count, initial=0)
    winner = jax.lax.fori_loop(jnp.zeros_like(longest), longest, body, start)[1]
    indices = mesh.triangles.at[jnp.where(winner >= 0, winner, 0)].get(mode="promise_in_bounds")
    corners = []
    for corner in range(3):
        vertex = mesh.vertices_ws.at[indices[..., corner]].get(mode="promise_in_bounds")
        corners.append(less(in_frame(vertex - wide.centre_ws, wide.axes_ws), centre))
    rest = on_triangle((corners[0], corners[1], corners[2]), radius, half)
    return rest._replace(height=jnp.where(winner >= 0, rest.height, MISS))


def _on_grid(field: Heightfield, centre: Point, half: Point | None, radius: Array) -> Rest:
    """By all cells that the shape is over; then once more with the one that is met first."""
    fixed, shape, stopped = jax.lax.stop_gradient((centre, (half, radius), field))
    rows, columns = field.heights.shape
    size_x, size_z = vec.unstack(stopped.spacing)
    side = [radius + (0.0 if half is None else jnp.abs(half[axis])) for axis in (0, 2)]
    side_x, side_z = jax.lax.stop_gradient(side)

    def span(place: Array, side: Array, size: Array, count: int) -> tuple[Array, Array]:
        low, high = (jnp.floor((place + sign * side) / size) for sign in (-1, 1))
        low, high = (jnp.clip(index, 0, count - 2).astype(jnp.int32) for index in (low, high))
        return low, high - low + 1

    column, wide = span(fixed[0], side_x, size_x, columns)
    row, deep = span(fixed[2], side_z, size_z, rows)
    rounding = 16 * jnp.finfo(radius.dtype).eps * (1.0 + jnp.abs(fixed[1]))

    def body(step: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        height, winner = best
        inside = step < wide * deep
        cell = (row + step // wide) * columns + column + step % wide
        cell = jnp.where(inside, cell, row * columns + column)
        rest = _on_cell(stopped, cell, fixed, *shape).height
        better = inside & (rest <= rounding) & (rest > height)
        return jnp.where(better, rest, height), jnp.where(better, cell, winner)

    start = jnp.full(wide.shape, MISS, radius.dtype), jnp.full(wide.shape, -1, jnp.int32)
    longest = jnp.max(wide * deep, initial=0)
    winner = jax.lax.fori_loop(jnp.zeros_like(longest), longest, body, start)[1]
    rest = _on_cell(field, jnp.where(winner >= 0, winner, 0), centre, half, radius)
    return rest._replace(height=jnp.where(winner >= 0, rest.height, MISS))


def _on_cell(
    field: Heightfield, cell: Array, centre: Point, half: Point | None, radius: Array
) -> Rest:
    """On one cell, given by the index of its first corner; not at all on a hole."""
    columns = field.heights.shape[1]
    size_x, size_z = vec.unstack(field.spacing)
    heights = field.heights.reshape(-1)
    near, near_next, far, far_next = (
        heights.at[cell + step].get(mode="promise_in_bounds")
        for step in (0, 1, columns, columns + 1)
    )
    solid = jnp.isfinite(near + near_next + far + far_next)
    near, near_next, far, far_next = (
        jnp.where(solid, height, 0.0) - centre[1] for height in (near, near_next, far, far_next)
    )
    x, z = (cell % columns) * size_x - centre[0], (cell // columns) * size_z - centre[2]
    a, b = (x, near, z), (x + size_x, near_next, z)
    c, d = (x, far, z + size_z), (x + size_x, far_next, z + size_z)
    if field.interpolation == "bilinear":
        rest = _on_saddle((a, b, c, d), radius, half)
    else:
        corners = (stacked(a, a), stacked(c, b), stacked(d, d))
        rest = highest(on_triangle(corners, radius, half))
    return rest._replace(height=jnp.where(solid, rest.height, MISS))


def _on_saddle(
    corners: tuple[Point, Point, Point, Point], radius: Array, half: Point | None
) -> Rest:
    """On a bilinear cell, by coordinate ascent: on each line of the cell the highest rest is known.

    The height over a contact is concave where the cell's curvature, twist over area, is below that
    of the sphere; there is one highest rest then, and the error falls by the square of their ratio
    with each step.
    """
    if half is None:
        return _ascended(corners, radius, None, jnp.zeros_like(corners[0][0]))
    a, b, c, d = corners
    hx, hy, hz = (jnp.broadcast_to(x, a[0].shape) for x in half)
    # From both ends and the middle: at the wrong end the first steps would be small.
    starts = jnp.stack([end + jnp.zeros_like(a[0]) for end in (-1.0, 0.0, 1.0)])
    return highest(_ascended((a, b, c, d), radius, (hx, hy, hz), starts))


def _ascended(
    corners: tuple[Point, Point, Point, Point], radius: Array, half: Point | None, end: Array
) -> Rest:
    """The rest to which coordinate ascent leads that begins with the sphere at `end`, -1 to 1."""
    a, b, c, d = corners
    across, along = added(b, scaled(a, -1.0)), added(c, scaled(a, -1.0))
    far_across = added(d, scaled(c, -1.0))
    twist = added(far_across, scaled(across, -1.0))

    def line(start: Point, side: Point, cross: Point, place: Array) -> tuple[Point, Point]:
        """The line at a place of the other side."""
        return added(start, scaled(cross, place)), added(side, scaled(twist, place))

    def step(_: Array, places: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        s, t, end = places
        origin = a if half is None else less(a, scaled(half, end))
        s = on_edge(*line(origin, across, along, t), radius)[1]
        t = on_edge(*line(origin, along, across, s), radius)[1]
        if half is not None:
            point = added(*line(a, across, along, t)[:1], scaled(line(a, across, along, t)[1], s))
            end = 2.0 * on_edge(added(point, half), scaled(half, -2.0), radius)[1] - 1.0
        return s, t, end

    middle = jnp.full_like(end, 0.5)
    places = jax.lax.fori_loop(0, ASCENTS, step, (middle, middle, end))
    s, t, end = places
    start, side = line(a, across, along, t)
    contact = added(start, scaled(side, s))
    under = contact if half is None else less(contact, scaled(half, end))
    rest, _ = on_edge(under, scaled(side, 0.0), radius)
    return rest._replace(contact=contact)


def _on_function(
    field: AbstractHeightfield, centre: Point, half: Point | None, radius: Array
) -> Rest:
    """By trying contacts on rings, then rolling to the point of the surface that faces the sphere.

    The contact is on the surface, so that the shape never rests too high. It rests too low where
    the surface rises between the points tried, which lie a quarter of the radius apart.
    """
    turns = jnp.arange(0.0, 2.0 * jnp.pi, jnp.pi / 8.0, radius.dtype)
    rings = jnp.linspace(0.0, 1.0, RINGS + 2, dtype=radius.dtype)[1:-1]
    tried_x, tried_z = (
        jnp.concatenate([jnp.zeros(1, radius.dtype), jnp.outer(rings, part).ravel()])
        for part in (jnp.cos(turns), jnp.sin(turns))
    )
    ends = jnp.zeros(1, radius.dtype)
    if half is not None:
        ends = jnp.linspace(-1.0, 1.0, SPHERES, dtype=radius.dtype)

    def rest_at(wx: Array, wz: Array, end: Array, points: tuple) -> tuple[Rest, Array, Array]:
        """With the contact beside the axis of the sphere at `end`, and the slopes there."""
        (x, y, z), half, radius = points
        hx, hy, hz = (0.0, 0.0, 0.0) if half is None else scaled(half, end)
        sample = field.sample(x + hx + wx, z + hz + wz, jnp.zeros_like(wx))
        inner = vec.safe_sqrt(radius * radius - wx * wx - wz * wz)
        height = jnp.where(sample.solid, sample.height - y - hy + inner, MISS)
        inverse = 1.0 / jnp.sqrt(1.0 + sample.slope_x**2 + sample.slope_z**2)
        normal = (-sample.slope_x * inverse, inverse, -sample.slope_z * inverse)
        contact = (hx + wx, sample.height - y, hz + wz)
        return Rest(height, normal, contact), sample.slope_x, sample.slope_z

    fixed = jax.lax.stop_gradient((centre, half, radius))
    spread = jax.tree.map(lambda x: x[..., None, None], fixed)
    wx, wz = (tried * spread[2] + 0.0 * ends[:, None] for tried in (tried_x, tried_z))
    heights = rest_at(wx, wz, ends[:, None] + 0.0 * wx, spread)[0].height
    rounding = 16 * jnp.finfo(radius.dtype).eps * (1.0 + jnp.abs(fixed[0][1]))
    heights = jnp.where(heights <= rounding[..., None, None], heights, MISS)
    best = jnp.argmax(heights.reshape(*heights.shape[:-2], -1), axis=-1)
    place, ring = best // tried_x.size, best % tried_x.size
    end = ends[place]
    wx, wz = fixed[2] * tried_x[ring], fixed[2] * tried_z[ring]
    rest, slope_x, slope_z = rest_at(wx, wz, end, fixed)
    for _ in range(ROLLS):
        reach = fixed[2] / jnp.sqrt(1.0 + slope_x**2 + slope_z**2)
        moved, *slopes = rest_at(slope_x * reach, slope_z * reach, end, fixed)
        better = (moved.height > rest.height) & (moved.height <= rounding)
        wx, wz = jnp.where(better, slope_x * reach, wx), jnp.where(better, slope_z * reach, wz)
        rest = rest._replace(height=jnp.where(better, moved.height, rest.height))
        slope_x, slope_z = (
            jnp.where(better, new, old) for new, old in zip(slopes, (slope_x, slope_z), strict=True)
        )
    met = (rest.height > 0.5 * MISS) & (rest.height <= rounding)
    rest = rest_at(*jax.lax.stop_gradient((wx, wz, end)), (centre, half, radius))[0]
    return rest._replace(height=jnp.where(met, rest.height, MISS))
