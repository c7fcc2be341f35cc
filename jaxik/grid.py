"""A plan-view grid over triangles: which of them a ray along -up can meet.

Built once with NumPy, asked in JAX. The plane of the grid is at right angles to up; where a ray
pierces it decides the cell, and the cell lists its triangles. Cells are as many as twice the
triangles; those still crowded are split four by four, again and again while that thins them, so
that an uneven mesh costs neither long lists nor a fine grid everywhere.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

CELLS = 2.0  # cells per triangle, at most; fewer lengthen the lists, more only fill memory
ENTRIES = 12  # list entries per triangle on average, at most, before cells grow
CROWD = 16  # a cell with more triangles is split
SPLIT = 4  # into this many along each side
DEPTH = 6  # at most this often
CHUNK = 1 << 20  # candidates tested at once; bounds the memory of a build


class Grid(eqx.Module):
    """Lists of triangles by cell. Index data: no slope passes through it."""

    corner: Float[Array, "*t 2"]  # m, where the first cell begins
    pitch: Float[Array, "*t"]  # m, side of an unsplit cell
    first: Int[Array, "*t cells_and_end"]  # where the list of each cell begins in `members`
    children: Int[Array, "*t cells"]  # first of a split cell's parts, -1 where it has none
    members: Int[Array, "*t entries"]  # triangles, cell after cell
    shape: tuple[int, int] = eqx.field(static=True)  # unsplit cells along x and z
    depth: int = eqx.field(static=True)  # how often the most crowded cell was split

    def look_up(
        self, x: Float[Array, "*b"], z: Float[Array, "*b"]
    ) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
        """Where the list for a place in the plane, m, begins in `members`, and its length.

        Outside the grid, and for coordinates that are not numbers, the length is 0.
        """
        across = (x - self.corner[0]) / self.pitch
        along = (z - self.corner[1]) / self.pitch
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


def build(
    plan: Float[np.ndarray, "triangles 3 2"], listed: Bool[np.ndarray, " triangles"], pad: float
) -> Grid:
    """The grid over these triangles, on the host.

    Args:
        plan: corners in the plane of the grid, m; the grid's floats take this dtype.
        listed: False leaves a triangle out.
        pad: m, how far a corner may lie from where `plan` has it and still be found; covers the
            rounding of rays and any later move of the vertices.
    """
    numbers = np.flatnonzero(listed)
    corners = plan[numbers].astype(np.float64)
    if not len(numbers):  # nothing to meet: one empty cell
        corners, numbers = np.zeros((0, 3, 2)), np.zeros(0, np.int64)
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
    found = numbers[members[order]] if len(members) else np.zeros(1, np.int64)
    return Grid(
        corner=jnp.asarray(corner, plan.dtype),
        pitch=jnp.asarray(pitch, plan.dtype),
        first=jnp.asarray(np.concatenate([[0], np.cumsum(counts)]), jnp.int32),
        children=jnp.asarray(np.concatenate(children), jnp.int32),
        members=jnp.asarray(found, jnp.int32),
        shape=shape,
        depth=depth,
    )


# Middles of a cell's parts, in half sides from its own middle, in the order of `look_up`.
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
