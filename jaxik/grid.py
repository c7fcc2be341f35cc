"""A plan-view grid over triangles: which of them a ray along -up meets first.

Built once with NumPy, asked in JAX. The plane of the grid is at right angles to up; where a ray
pierces it decides the cell, and the cell lists its triangles. Cells are as many as twice the
triangles; those still crowded are split four by four, again and again while that thins them, so
that an uneven mesh costs neither long lists nor a fine grid everywhere.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from . import vec

CELLS = 2.0  # cells per triangle, at most; fewer lengthen the lists, more only fill memory
ENTRIES = 12  # list entries per triangle on average, at most, before cells grow
CROWD = 16  # a cell with more triangles is split
SPLIT = 4  # into this many along each side
DEPTH = 6  # at most this often
CHUNK = 1 << 20  # candidates tested at once; bounds the memory of a build


class Grid(eqx.Module):
    """Lists of triangles by cell, in a frame whose y is up. No slope passes through it."""

    centre_ws: Float[Array, "*t 3"]  # m, the frame's origin, amid the mesh to keep rounding small
    axes_ws: Float[Array, "*t 3 3"]  # rows: the frame's x, y (up) and z
    corners: Float[Array, "*t triangles 9"]  # m; x z y of each corner in the frame
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
        corner, pitch = jax.lax.stop_gradient((self.corner, self.pitch))
        across, along = (x - corner[0]) / pitch, (z - corner[1]) / pitch
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
        functions are taken with an allowance above their rounding.
        """
        origins, corners, centre, axes = jax.lax.stop_gradient(
            (origins_ws, self.corners, self.centre_ws, self.axes_ws)
        )
        x, y, z = (vec.dot(origins - centre, axes[axis]) for axis in range(3))
        start, count = self._look_up(x, z)
        slack = 4 * jnp.finfo(x.dtype).eps

        def edge(px: Array, pz: Array, qx: Array, qz: Array) -> tuple[Array, Array]:
            left, right = px * qz, pz * qx
            return left - right, slack * (jnp.abs(left) + jnp.abs(right))

        def body(step: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
            height, winner = best
            triangle = self.members.at[start + step].get(mode="clip")
            row = corners.at[triangle].get(mode="promise_in_bounds")
            ax, bx, cx = row[..., 0] - x, row[..., 3] - x, row[..., 6] - x
            az, bz, cz = row[..., 1] - z, row[..., 4] - z, row[..., 7] - z
            (a, near_a), (b, near_b), (c, near_c) = (
                edge(bx, bz, cx, cz),
                edge(cx, cz, ax, az),
                edge(ax, az, bx, bz),
            )
            inside = ((a >= -near_a) & (b >= -near_b) & (c >= -near_c)) | (
                (a <= near_a) & (b <= near_b) & (c <= near_c)
            )
            # The allowance would lengthen a needle; its box, which needs none, cuts it off.
            inside &= (jnp.minimum(jnp.minimum(ax, bx), cx) <= 0) & (
                jnp.maximum(jnp.maximum(ax, bx), cx) >= 0
            )
            inside &= (jnp.minimum(jnp.minimum(az, bz), cz) <= 0) & (
                jnp.maximum(jnp.maximum(az, bz), cz) >= 0
            )
            a, b, c = jnp.abs(a), jnp.abs(b), jnp.abs(c)
            here = vec.safe_divide(a * row[..., 2] + b * row[..., 5] + c * row[..., 8], a + b + c)
            inside &= here <= y + slack * (jnp.abs(here) + jnp.abs(y))  # starts on it: meets it
            inside &= self.visible.at[triangle].get(mode="promise_in_bounds") & mask != 0
            better = inside & (step < count) & (here > height)
            return jnp.where(better, here, height), jnp.where(better, triangle, winner)

        nothing = jnp.full(x.shape, -jnp.inf, jnp.result_type(x, corners))
        none = jnp.full(x.shape, -1, jnp.int32)
        longest = jnp.max(count, initial=0)
        return jax.lax.fori_loop(jnp.zeros_like(longest), longest, body, (nothing, none))[1]


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
    centre_ws = jnp.asarray((used.min(axis=0) + used.max(axis=0)) / 2)
    axes_ws = _axes(up_ws)
    corners, wall = _corners(vertices_ws, triangles, centre_ws, axes_ws)
    plan = np.asarray(corners).reshape(-1, 3, 3)[..., :2]
    # Rays and corners are rounded where they enter the frame: by the size of either.
    size = float(np.abs(used).max()) + float(np.abs(plan).max())
    pad = slack + 16 * float(np.finfo(plan.dtype).eps) * size
    # A wall can only be met once its corners moved sideways.
    listed = np.ones(len(plan), bool) if slack > 0 else ~np.asarray(wall)
    lists = _lists(plan.astype(np.float64), listed, pad)
    return Grid(
        centre_ws=centre_ws,
        axes_ws=axes_ws,
        corners=corners,
        visible=jnp.where(wall, jnp.zeros_like(layers), layers),
        corner=jnp.asarray(lists.corner, plan.dtype),
        pitch=jnp.asarray(lists.pitch, plan.dtype),
        first=jnp.asarray(lists.first, jnp.int32),
        children=jnp.asarray(lists.children, jnp.int32),
        members=jnp.asarray(lists.members, jnp.int32),
        shape=lists.shape,
        depth=lists.depth,
    )


def _corners(
    vertices: Float[Array, "vertices 3"],
    triangles: Int[Array, "triangles 3"],
    centre: Float[Array, "3"],
    axes: Float[Array, "3 3"],
) -> tuple[Float[Array, "triangles 9"], Bool[Array, " triangles"]]:
    """Rows x z y x z y x z y of the corners in the grid's frame, and which triangles are walls.

    Each vertex is turned once, by components: the same number for all its triangles.
    """
    x, y, z = (vec.dot(vertices - centre, axes[axis]) for axis in range(3))
    turned = vec.stack(x, z, y)[triangles]
    sides = turned[:, 1:, :2] - turned[:, :1, :2]
    left, right = sides[:, 0, 0] * sides[:, 1, 1], sides[:, 0, 1] * sides[:, 1, 0]
    noise = 4 * jnp.finfo(turned.dtype).eps * (jnp.abs(left) + jnp.abs(right))
    return turned.reshape(-1, 9), jnp.abs(left - right) <= noise


def _axes(up: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Right-handed axes whose second is up; those of the world where up is its y."""
    second = np.asarray(up, np.float64)
    forward = np.eye(3)[2] if abs(second[2]) < 0.9 else np.eye(3)[0]
    side = np.cross(second, forward)
    side /= np.linalg.norm(side)
    return jnp.asarray(np.stack([side, second, np.cross(side, second)]), up.dtype)


class _Lists(NamedTuple):
    """The discrete part of a `Grid`, by the same names."""

    corner: np.ndarray
    pitch: float
    first: np.ndarray
    children: np.ndarray
    members: np.ndarray
    shape: tuple[int, int]
    depth: int


def _lists(
    plan: Float[np.ndarray, "triangles 3 2"], listed: Bool[np.ndarray, " triangles"], pad: float
) -> _Lists:
    """Which cells there are and what is in them, for the triangles that are to be `listed`."""
    numbers = np.flatnonzero(listed)
    corners = plan[numbers]
    shape, corner, pitch = _frame(corners, pad)
    owner, member = _enumerate(corners, shape, corner, pitch, pad)
    mids = corner + pitch * (np.indices(shape).reshape(2, -1).T + 0.5)
    keep = _touching(corners, member, mids[owner], pitch / 2 + pad)
    owner, member = owner[keep], member[keep]

    children, settled, half, base, depth = [], [], pitch / 2, 0, 0
    while True:  # `owner` counts within this level, whose first cell is number `base`
        cells = len(mids)
        parts = np.full(cells, -1)
        crowded = np.bincount(owner, minlength=cells) > CROWD
        if depth < DEPTH and crowded.any():
            split, parents, part_member = _split(corners, owner, member, mids, half, crowded, pad)
        else:
            split, parents, part_member = np.zeros(0, np.int64), owner[:0], member[:0]
        parts[split] = base + cells + SPLIT**2 * np.arange(len(split))
        stays = parts[owner] < 0
        settled.append((base + owner[stays], member[stays]))
        children.append(parts)
        if not len(split):
            break
        mids = (mids[split][:, None] + half * _OFFSETS).reshape(-1, 2)
        owner, member = parents, part_member
        base, half, depth = base + cells, half / SPLIT, depth + 1

    cell = np.concatenate([owners for owners, _ in settled])
    members = np.concatenate([members for _, members in settled])
    order = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=base + cells)
    return _Lists(
        corner=corner,
        pitch=pitch,
        first=np.concatenate([[0], np.cumsum(counts)]),
        children=np.concatenate(children),
        # One entry at least, for the reads of rays that have nothing to meet.
        members=numbers[members[order]] if len(members) else np.zeros(1, np.int64),
        shape=shape,
        depth=depth,
    )


# Middles of a cell's parts, in half sides from its own middle, in the order of `_look_up`.
_OFFSETS = (2 * np.indices((SPLIT, SPLIT)).reshape(2, -1).T + 1) / SPLIT - 1.0


def _frame(
    corners: np.ndarray, pad: float
) -> tuple[tuple[int, int], Float[np.ndarray, "2"], float]:
    """Cells along both sides, the first one's corner and their side, within the budgets."""
    if not len(corners):
        return (1, 1), np.zeros(2), 1.0
    low, high = corners.min(axis=1) - pad, corners.max(axis=1) + pad
    origin, size = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    wanted = CELLS * len(corners)
    pitch = max(np.sqrt(size[0] * size[1] / wanted), size.max() / wanted) or 1.0
    while True:
        spans = np.floor((high - origin) / pitch) - np.floor((low - origin) / pitch) + 1
        if spans.prod(axis=1).sum() <= ENTRIES * len(corners) + 64:
            break
        pitch *= 1.25
    # A shift keeps the lines of the grid off the lines of a mesh that is itself a regular grid.
    across, along = np.floor(size / pitch + 0.37).astype(int) + 1
    return (int(across), int(along)), origin - 0.37 * pitch, float(pitch)


def _enumerate(
    corners: np.ndarray, shape: tuple[int, int], corner: np.ndarray, pitch: float, pad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of cell and triangle whose boxes overlap."""
    last = np.array(shape) - 1
    low = np.clip(np.floor((corners.min(axis=1) - pad - corner) / pitch).astype(int), 0, last)
    high = np.clip(np.floor((corners.max(axis=1) + pad - corner) / pitch).astype(int), 0, last)
    spans = high - low + 1
    counts = spans.prod(axis=1)
    member = np.repeat(np.arange(len(corners)), counts)
    step = np.arange(len(member)) - np.repeat(np.cumsum(counts) - counts, counts)
    row = low[member, 0] + step // spans[member, 1]
    column = low[member, 1] + step % spans[member, 1]
    return row * shape[1] + column, member


def _split(
    corners: np.ndarray,
    owner: np.ndarray,
    member: np.ndarray,
    mids: np.ndarray,
    half: float,
    crowded: np.ndarray,
    pad: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The crowded cells that are worth splitting, and the pairs of part and triangle they give.

    Parts are numbered from 0 over all split cells. Not worth it: triangles on top of each other,
    which fill every part as they filled the whole.
    """
    inside = crowded[owner]
    parts = SPLIT**2
    cell, triangle = np.repeat(owner[inside], parts), np.repeat(member[inside], parts)
    part = np.tile(np.arange(parts), int(inside.sum()))
    keep = _touching(corners, triangle, mids[cell] + half * _OFFSETS[part], half / SPLIT + pad)
    cell, triangle, part = cell[keep], triangle[keep], part[keep]
    before = np.bincount(owner, minlength=len(mids))
    after = np.bincount(cell, minlength=len(mids))
    worth = crowded & (after <= before * parts / 2)
    rank = np.cumsum(worth) - 1
    kept = worth[cell]
    return np.flatnonzero(worth), rank[cell[kept]] * parts + part[kept], triangle[kept]


def _touching(
    corners: np.ndarray, member: np.ndarray, mids: np.ndarray, half: float
) -> Bool[np.ndarray, " pairs"]:
    """Whether the square of half side `half` about each middle touches its triangle.

    Separating axes: the two sides of the square and the normals of the triangle's edges.
    """
    x, z = corners[..., 0].T, corners[..., 1].T
    edges_x, edges_z = np.roll(x, -1, axis=0) - x, np.roll(z, -1, axis=0) - z
    square = np.ones_like(x[:1])
    axes_x = np.concatenate([-edges_z, square, 0 * square])
    axes_z = np.concatenate([edges_x, 0 * square, square])
    touching = np.ones(len(member), bool)
    for axis_x, axis_z in zip(axes_x, axes_z, strict=True):
        places = axis_x * x + axis_z * z
        margin = half * (np.abs(axis_x) + np.abs(axis_z))
        low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
        for begin in range(0, len(member), CHUNK):
            pairs = slice(begin, begin + CHUNK)
            triangle, mid = member[pairs], mids[pairs]
            place = axis_x[triangle] * mid[:, 0] + axis_z[triangle] * mid[:, 1]
            touching[pairs] &= (low[triangle] <= place) & (place <= high[triangle])
    return touching
