"""A plan-view grid over triangles: which of them a ray along -up meets first.

Built once with NumPy, asked in JAX. The plane of the grid is at right angles to up; where a ray
pierces it decides the cell, and the cell lists its triangles. Cells are as many as twice the
triangles; those still crowded are split four by four, again and again while that thins them, so
that an uneven mesh costs neither long lists nor a fine grid everywhere.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxik.maths import vec

from . import cells
from .cells import SPLIT


class Grid(eqx.Module):
    """Lists of triangles by cell, in a frame whose y is up. No slope passes through it."""

    centre_ws: Float[Array, "*t 3"]  # m, the frame's origin, amid the mesh to keep rounding small
    axes_ws: Float[Array, "*t 3 3"]  # rows: the frame's x, y (up) and z
    corners: Float[Array, "*t triangles 9"]  # m; x z y of each corner in the frame, one way round
    visible: UInt[Array, "*t triangles"]  # one bit a layer; none for walls and lines
    corner: Float[Array, "*t 2"]  # m, where the first cell begins
    pitch: Float[Array, "*t"]  # m, side of an unsplit cell
    first: Int[Array, "*t cells_and_end"]  # where the list of each cell begins in `members`
    children: Int[Array, "*t cells"]  # first of a split cell's parts, -1 where it has none
    members: Int[Array, "*t entries"]  # triangles, cell after cell
    shape: tuple[int, int] = eqx.field(static=True)  # unsplit cells along x and z
    depth: int = eqx.field(static=True)  # how often the most crowded cell was split

    def moved(
        self,
        vertices_ws: Float[Array, "vertices 3"],
        triangles: Int[Array, "triangles 3"],
        layers: UInt[Array, " triangles"],
    ) -> "Grid":
        """The same lists over moved vertices."""
        corners, wall = _corners(vertices_ws, triangles, self.centre_ws, self.axes_ws)
        visible = jnp.where(wall, jnp.zeros_like(layers), layers)
        return eqx.tree_at(lambda grid: (grid.corners, grid.visible), self, (corners, visible))

    def _look_up(
        self, x: Float[Array, "*b"], z: Float[Array, "*b"]
    ) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
        """Where the list for a place in the plane, m, begins in `members`, and its length.

        Outside the grid, and for coordinates that are not numbers, the length is 0.
        """
        across, along = (x - self.corner[0]) / self.pitch, (z - self.corner[1]) / self.pitch
        inside = (across >= 0) & (across < self.shape[0]) & (along >= 0) & (along < self.shape[1])
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

    def search(
        self, origins_ws: Float[Array, "*b 3"], mask: UInt[Array, "*#b"]
    ) -> Int[Array, "*b"]:
        """The triangle met first by each ray, -1 where there is none.

        Watertight, after Woop, Benthin and Wald (Watertight Ray/Triangle Intersection, JCGT 2013):
        corners are taken relative to the ray, which rounds a shared corner alike for all its
        triangles; in that slightly moved mesh, which has no gaps either, the signs of the edge
        functions are taken with an allowance above their rounding. A needle that this rounding
        turns over is left out: where it lies, its neighbours lie too.
        """
        grid, origins = jax.lax.stop_gradient((self, origins_ws))
        offset = origins - grid.centre_ws
        place = vec.stacked_barrier(*(vec.dot(offset, grid.axes_ws[axis]) for axis in range(3)))
        return _first_met(grid, *place, mask)


@jax.custom_batching.custom_vmap
def _first_met(
    grid: Grid,
    x: Float[Array, "*#b"],
    y: Float[Array, "*#b"],
    z: Float[Array, "*#b"],
    mask: UInt[Array, "*#b"],
) -> Int[Array, "*b"]:
    """See `Grid.search`; places in the grid's frame, numbers that are treated one by one."""
    shape = jnp.broadcast_shapes(*(number.shape for number in (x, y, z, mask)))
    x, y, z = (jnp.broadcast_to(number, shape) for number in (x, y, z))
    start, count = grid._look_up(x, z)
    slack = 4 * jnp.finfo(x.dtype).eps
    top = y + slack * jnp.abs(y)  # a ray that starts on a triangle meets it

    def within(px: Array, pz: Array, qx: Array, qz: Array) -> tuple[Array, Array]:
        """Twice the area that an edge spans with the ray, and on which side that lies."""
        left, right = px * qz, pz * qx
        area = left - right
        return jnp.abs(area), area >= -slack * (jnp.abs(left) + jnp.abs(right))

    def body(step: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        height, winner = best
        # A ray past the end of its list tests the first entry of all, which costs least: that
        # stays in the cache. It changes nothing, for the test is complete.
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
        # The allowance would lengthen a needle; its box, which needs none, cuts it off.
        inside = by_a & by_b & by_c & (a + b + c > 0)
        inside &= (jnp.minimum(jnp.minimum(ax, bx), cx) <= 0) & (
            jnp.maximum(jnp.maximum(ax, bx), cx) >= 0
        )
        inside &= (jnp.minimum(jnp.minimum(az, bz), cz) <= 0) & (
            jnp.maximum(jnp.maximum(az, bz), cz) >= 0
        )
        inside &= grid.visible.at[triangle].get(mode="promise_in_bounds") & mask != 0
        # The quotient comes last: XLA computes a quotient once, but what ends in a choice again for
        # each that uses it, and both numbers of `best` would take the whole test.
        weighted = jnp.where(inside, a * row[2] + b * row[5] + c * row[8], -jnp.inf)
        here = weighted / jnp.where(inside, a + b + c, 1.0)
        better = (here > height) & (here - slack * jnp.abs(here) <= top)
        return jnp.where(better, here, height), jnp.where(better, triangle, winner)

    nothing = jnp.full(x.shape, -jnp.inf, jnp.result_type(x, grid.corners))
    none = jnp.full(x.shape, -1, jnp.int32)
    longest = jnp.max(count, initial=0)
    return jax.lax.fori_loop(jnp.zeros_like(longest), longest, body, (nothing, none))[1]


@_first_met.def_vmap
def _first_met_by_many(size: int, batched: list, grid: Grid, *numbers: Array) -> tuple[Array, bool]:
    """Rays of one grid are one batch, however many maps they come through.

    They share one loop; a mapped loop would choose anew for each batch, step by step, whether it
    still runs.
    """
    if any(jax.tree.leaves(batched[0])):
        axes = jax.tree.map(lambda mapped: 0 if mapped else None, tuple(batched))
        return jax.vmap(_first_met.fun, in_axes=axes)(grid, *numbers), True
    # What is mapped lies before all other axes; those are counted from the last one.
    rank = max(x.ndim - mapped for x, mapped in zip(numbers, batched[1:], strict=True))
    deep = [
        jnp.expand_dims(x, tuple(range(1, 2 + rank - x.ndim))) if mapped else x
        for x, mapped in zip(numbers, batched[1:], strict=True)
    ]
    return _first_met(grid, *deep), True


_first_met_by_many.one_by_one = _first_met  # for `lanes`, which needs no axis moved


def build(
    vertices_ws: Float[Array, "vertices 3"],
    triangles: Int[Array, "triangles 3"],
    layers: UInt[Array, " triangles"],
    up_ws: Float[Array, "3"],
    slack: float,
) -> Grid:
    """The grid over these triangles; on the host, so outside jit.

    Args:
        vertices_ws: m.
        triangles: rows of vertices; either winding.
        layers: one bit each.
        up_ws: unit.
        slack: m, how far a vertex may later move sideways and its triangles still be found.
    """
    used = np.asarray(vertices_ws)[np.asarray(triangles).reshape(-1)]
    centre_ws = jnp.asarray((used.min(axis=0) + used.max(axis=0)) / 2, used.dtype)
    axes_ws = _axes(up_ws)
    corners, wall = _corners(vertices_ws, triangles, centre_ws, axes_ws)
    plan = np.asarray(corners).reshape(-1, 3, 3)[..., :2]
    # Rays and corners are rounded where they enter the frame: by the size of either.
    size = float(np.abs(used).max()) + float(np.abs(plan).max())
    pad = slack + 16 * float(np.finfo(plan.dtype).eps) * size
    # A wall can only be met once its corners moved sideways.
    listed = np.ones(len(plan), bool) if slack > 0 else ~np.asarray(wall)
    lists = cells.lists(plan.astype(np.float64), listed, pad)
    return Grid(
        centre_ws=centre_ws,
        axes_ws=axes_ws,
        corners=corners,
        visible=_array(np.where(wall, 0, layers), np.uint32),
        corner=_array(lists.corner, plan.dtype),
        pitch=_array(lists.pitch, plan.dtype),
        first=_array(lists.first, np.int32),
        children=_array(lists.children, np.int32),
        members=_array(lists.members, np.int32),
        shape=lists.shape,
        depth=lists.depth,
    )


def _array(numbers: np.ndarray | float, dtype: Any) -> Array:
    """Converted by NumPy: in JAX the conversion would be a program."""
    return jnp.asarray(np.asarray(numbers, dtype), dtype)


@jax.jit  # outside jit one program, not thirty
def _corners(
    vertices: Float[Array, "vertices 3"],
    triangles: Int[Array, "triangles 3"],
    centre: Float[Array, "3"],
    axes: Float[Array, "3 3"],
) -> tuple[Float[Array, "triangles 9"], Bool[Array, " triangles"]]:
    """Rows x z y x z y x z y of the corners in the grid's frame, and which triangles are walls.

    Each vertex is turned once, by components: the same number for all its triangles. All go the
    same way round, so that one sign of an edge function means inside.
    """
    x, y, z = (vec.dot(vertices - centre, axes[axis]) for axis in range(3))
    turned = vec.stack(x, z, y)[triangles]
    sides = turned[:, 1:, :2] - turned[:, :1, :2]
    left, right = sides[:, 0, 0] * sides[:, 1, 1], sides[:, 0, 1] * sides[:, 1, 0]
    noise = 4 * jnp.finfo(turned.dtype).eps * (jnp.abs(left) + jnp.abs(right))
    turned = jnp.where((left < right)[:, None, None], turned[:, ::-1], turned)
    return turned.reshape(-1, 9), jnp.abs(left - right) <= noise


def _axes(up: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Right-handed axes whose second is up; those of the world where up is its y."""
    second = np.asarray(up, np.float64)
    forward = np.eye(3)[2] if abs(second[2]) < 0.9 else np.eye(3)[0]
    side = np.cross(second, forward)
    side /= np.linalg.norm(side)
    return jnp.asarray(np.stack([side, second, np.cross(side, second)]), up.dtype)
