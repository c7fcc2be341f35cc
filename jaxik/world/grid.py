"""A grid over triangles, seen along up: finds the first triangle that a ray along -up hits.

Built once with NumPy, searched in JAX. The plane of the grid is at right angles to up: the point
where a ray crosses it decides the cell, and each cell lists its triangles. There are up to twice as
many cells as triangles. Cells that are still crowded are split four by four, repeatedly as long as
that thins their lists, so that an uneven mesh needs neither long lists nor a fine grid everywhere.

All arrays have one of a few lengths (`padded`): ends that nothing reads let meshes of different
sizes share a compiled program.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt

from jaxik.maths import vec

from . import cells
from .cells import SPLIT

LEAST, STEP = 512, 1 << 16  # lengths of arrays: powers of two between them, then steps
MOST_CELLS, MOST_ENTRIES = 4, 8  # per triangle, of nearly all meshes


def padded(rows: np.ndarray, fill: ArrayLike, least: int = LEAST) -> np.ndarray:
    """Rows and then as many of `fill` as make one of a few lengths, which is `least` or more."""
    length = max(len(rows), least, LEAST)
    length = -(-length // STEP) * STEP if length > STEP else 1 << (length - 1).bit_length()
    end = np.full((length - len(rows), *rows.shape[1:]), fill, rows.dtype)
    return np.concatenate([rows, end])


class Grid(eqx.Module):
    """Lists of triangles per cell, in a frame whose y is up. No gradient passes through it."""

    centre_ws: Float[Array, "*t 3"]
    """m, the frame's origin, in the middle of the mesh for small rounding."""
    axes_ws: Float[Array, "*t 3 3"]
    """Rows: the frame's x, y (up) and z."""
    corners: Float[Array, "*t triangles 9"]
    """m; x z y of each corner in the frame, same winding."""
    visible: UInt[Array, "*t triangles"]
    """One bit per layer; none for walls and lines."""
    corner: Float[Array, "*t 2"]
    """m, x and z of the first cell's corner."""
    pitch: Float[Array, "*t"]
    """m, side of an unsplit cell."""
    first: Int[Array, "*t cells_and_more"]
    """Start of each cell's list in `members`."""
    children: Int[Array, "*t cells"]
    """First part of a split cell, -1 where not split."""
    members: Int[Array, "*t entries"]
    """Triangles, cell by cell."""
    shape: Int[Array, "*t 2"]
    """Unsplit cells along x and z."""
    depth: int = eqx.field(static=True)
    """Levels of split cells."""

    def with_vertices(
        self,
        vertices_ws: Float[Array, "vertices 3"],
        triangles: Int[Array, "triangles 3"],
        layers: UInt[Array, " triangles"],
    ) -> "Grid":
        """The same lists for moved vertices, m."""
        corners, wall = _corners(vertices_ws, triangles, self.centre_ws, self.axes_ws)
        visible = jnp.where(wall, jnp.zeros_like(layers), layers)
        return eqx.tree_at(lambda grid: (grid.corners, grid.visible), self, (corners, visible))

    def look_up(
        self, x: Float[Array, "*b"], z: Float[Array, "*b"]
    ) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
        """Start in `members` and length of the list for a point of the plane, m.

        The length is 0 outside the grid and for NaN.
        """
        across, along = (x - self.corner[0]) / self.pitch, (z - self.corner[1]) / self.pitch
        rows, columns = self.shape.astype(self.corner.dtype)
        inside = (across >= 0) & (across < rows) & (along >= 0) & (along < columns)
        across, along = jnp.where(inside, across, 0.0), jnp.where(inside, along, 0.0)
        row, column = jnp.floor(across), jnp.floor(along)
        cell = row.astype(jnp.int32) * self.shape[1] + column.astype(jnp.int32)
        for _ in range(self.depth):
            across, along = (across - row) * SPLIT, (along - column) * SPLIT
            row, column = jnp.floor(across), jnp.floor(along)
            part = row.astype(jnp.int32) * SPLIT + column.astype(jnp.int32)
            child = self.children.at[cell].get(mode="promise_in_bounds")
            cell = jnp.where(child >= 0, child + part, cell)
        start = self.first.at[cell].get(mode="promise_in_bounds")
        end = self.first.at[cell + 1].get(mode="promise_in_bounds")
        return start, jnp.where(inside, end - start, 0)

    def search(self, offsets: Float[Array, "*b 3"], mask: UInt[Array, "*#b"]) -> Int[Array, "*b"]:
        """The first triangle that each ray hits, -1 for none.

        Rays start at `offsets`, m, from the frame's origin, world axes.

        Watertight, after Woop, Benthin and Wald (Watertight Ray/Triangle Intersection, JCGT 2013).
        Corners are taken relative to the ray, which rounds a shared corner in the same way for all
        its triangles. In that slightly moved mesh, which has no gaps either, the signs of the edge
        functions are tested with a tolerance above their rounding error. A needle whose winding
        the rounding flips is missed, but its neighbours cover the same place.
        """
        grid, offsets = jax.lax.stop_gradient((self, offsets))
        xyz = vec.stacked_barrier(*(vec.dot(offsets, grid.axes_ws[axis]) for axis in range(3)))
        return _first_hit(grid, *xyz, mask)


@jax.custom_batching.custom_vmap
def _first_hit(
    grid: Grid,
    x: Float[Array, "*#b"],
    y: Float[Array, "*#b"],
    z: Float[Array, "*#b"],
    mask: UInt[Array, "*#b"],
) -> Int[Array, "*b"]:
    """`Grid.search` for points in the grid's frame; elementwise in x, y, z and mask."""
    shape = jnp.broadcast_shapes(*(number.shape for number in (x, y, z, mask)))
    x, y, z = (jnp.broadcast_to(number, shape) for number in (x, y, z))
    start, count = grid.look_up(x, z)
    tolerance = 4 * jnp.finfo(x.dtype).eps
    top = y + tolerance * jnp.abs(y)  # a ray that starts on a triangle hits it

    def within(px: Array, pz: Array, qx: Array, qz: Array) -> tuple[Array, Array]:
        """Twice the area that an edge spans with the ray, and whether the ray is inside it."""
        left, right = px * qz, pz * qx
        area = left - right
        return jnp.abs(area), area >= -tolerance * (jnp.abs(left) + jnp.abs(right))

    def body(step: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        height, winner = best
        # A ray past the end of its list tests the very first entry again, which is cheapest since
        # it stays in the cache. The result is the same: the test does not depend on the list.
        entry = jnp.where(step < count, start + step, 0)
        triangle = grid.members.at[entry].get(mode="promise_in_bounds")
        row = vec.unstack(grid.corners.at[triangle].get(mode="promise_in_bounds"))
        ax, bx, cx = row[0] - x, row[3] - x, row[6] - x
        az, bz, cz = row[1] - z, row[4] - z, row[7] - z
        (a, by_a), (b, by_b), (c, by_c) = (
            within(bx, bz, cx, cz),
            within(cx, cz, ax, az),
            within(ax, az, bx, bz),
        )
        # The tolerance would lengthen a needle; its bounding box, which needs none, cuts it off.
        inside = by_a & by_b & by_c & (a + b + c > 0)
        inside &= (jnp.minimum(jnp.minimum(ax, bx), cx) <= 0) & (
            jnp.maximum(jnp.maximum(ax, bx), cx) >= 0
        )
        inside &= (jnp.minimum(jnp.minimum(az, bz), cz) <= 0) & (
            jnp.maximum(jnp.maximum(az, bz), cz) >= 0
        )
        inside &= grid.visible.at[triangle].get(mode="promise_in_bounds") & mask != 0
        # The division comes last: XLA computes a quotient once, but recomputes a select in each
        # consumer, so that both entries of `best` would repeat the whole test.
        weighted = jnp.where(inside, a * row[2] + b * row[5] + c * row[8], -jnp.inf)
        here = weighted / jnp.where(inside, a + b + c, 1.0)
        better = (here > height) & (here - tolerance * jnp.abs(here) <= top)
        return jnp.where(better, here, height), jnp.where(better, triangle, winner)

    lowest = jnp.full(x.shape, -jnp.inf, jnp.result_type(x, grid.corners))
    none = jnp.full(x.shape, -1, jnp.int32)
    longest = jnp.max(count, initial=0)
    return jax.lax.fori_loop(jnp.zeros_like(longest), longest, body, (lowest, none))[1]


@_first_hit.def_vmap
def _first_hit_batched(size: int, batched: list, grid: Grid, *numbers: Array) -> tuple[Array, bool]:
    """The batching rule: rays of one grid form one batch, however many vmaps they come through.

    They share one loop. A batched loop would select for each example, at every step, whether it is
    still running.
    """
    if any(jax.tree.leaves(batched[0])):
        axes = jax.tree.map(lambda mapped: 0 if mapped else None, tuple(batched))
        return jax.vmap(_first_hit.fun, in_axes=axes)(grid, *numbers), True
    # Mapped axes come first; all others broadcast from the last axis.
    rank = max(x.ndim - mapped for x, mapped in zip(numbers, batched[1:], strict=True))
    aligned = [
        jnp.expand_dims(x, tuple(range(1, 2 + rank - x.ndim))) if mapped else x
        for x, mapped in zip(numbers, batched[1:], strict=True)
    ]
    return _first_hit(grid, *aligned), True


_first_hit_batched.elementwise = _first_hit  # for `lanes`


def build(
    vertices_ws: Float[Array, "vertices 3"],
    triangles: Int[Array, "triangles 3"],
    layers: UInt[Array, " triangles"],
    up_ws: Float[Array, "3"],
    slack: float,
) -> Grid:
    """The grid over these triangles; built on the host, so not under jit.

    Args:
        vertices_ws: m.
        triangles: indices of vertices, in either winding.
        layers: one bit each, none for triangles that only fill the arrays.
        up_ws: unit.
        slack: how far a vertex may later move sideways with its triangles still found, m.
    """
    used = np.asarray(vertices_ws)[np.asarray(triangles).reshape(-1)]
    centre_ws = jnp.asarray((used.min(axis=0) + used.max(axis=0)) / 2, used.dtype)
    axes_ws = frame_axes(up_ws)
    corners, wall = _corners(vertices_ws, triangles, centre_ws, axes_ws)
    plan = np.asarray(corners).reshape(-1, 3, 3)[..., :2]
    # Looked up, the place of a ray is rounded in proportion to its size.
    pad = slack + 32 * float(np.finfo(plan.dtype).eps) * float(np.abs(plan).max())
    # A wall can only be hit after its corners have moved sideways.
    listed = np.asarray(layers) > 0 if slack > 0 else ~np.asarray(wall)
    lists = cells.build(plan.astype(np.float64), listed, pad)
    return Grid(
        centre_ws=centre_ws,
        axes_ws=axes_ws,
        corners=corners,
        visible=_as_jax(np.where(wall, 0, layers), np.uint32),
        corner=_as_jax(lists.corner, plan.dtype),
        pitch=_as_jax(lists.pitch, plan.dtype),
        first=_as_jax(padded(lists.first, lists.first[-1], MOST_CELLS * len(plan)), np.int32),
        children=_as_jax(padded(lists.children, -1, MOST_CELLS * len(plan)), np.int32),
        members=_as_jax(padded(lists.members, 0, MOST_ENTRIES * len(plan)), np.int32),
        shape=_as_jax(np.array(lists.shape), np.int32),
        depth=lists.depth,
    )


def _as_jax(numbers: np.ndarray | float, dtype: np.dtype | type) -> Array:
    """A JAX array, cast by NumPy: JAX would compile a program for the cast."""
    return jnp.asarray(np.asarray(numbers, dtype), dtype)


@jax.jit  # outside jit, one program instead of thirty
def _corners(
    vertices: Float[Array, "vertices 3"],
    triangles: Int[Array, "triangles 3"],
    centre: Float[Array, "3"],
    axes: Float[Array, "3 3"],
) -> tuple[Float[Array, "triangles 9"], Bool[Array, " triangles"]]:
    """Corners in the grid's frame, x z y x z y x z y each, and which triangles are walls.

    Each vertex is rotated once, so that it is the same number for all its triangles. All triangles
    get the same winding, so that one sign of an edge function means inside.
    """
    x, y, z = (vec.dot(vertices - centre, axes[axis]) for axis in range(3))
    rotated = vec.stack(x, z, y)[triangles]
    sides = rotated[:, 1:, :2] - rotated[:, :1, :2]
    left, right = sides[:, 0, 0] * sides[:, 1, 1], sides[:, 0, 1] * sides[:, 1, 0]
    noise = 4 * jnp.finfo(rotated.dtype).eps * (jnp.abs(left) + jnp.abs(right))
    rotated = jnp.where((left < right)[:, None, None], rotated[:, ::-1], rotated)
    return rotated.reshape(-1, 9), jnp.abs(left - right) <= noise


def frame_axes(up: ArrayLike) -> Float[Array, "3 3"]:
    """Right-handed axes, the second of which is up; the world's axes where up is its y.

    Args:
        up: unit; not traced.
    """
    second = np.asarray(up, np.float64)
    forward = np.eye(3)[2] if abs(second[2]) < 0.9 else np.eye(3)[0]
    side = np.cross(second, forward)
    side /= np.linalg.norm(side)
    return jnp.asarray(np.stack([side, second, np.cross(side, second)]), np.asarray(up).dtype)
