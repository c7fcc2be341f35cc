"""The cells of a grid over triangles, and which of them touch which cell; NumPy, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

CELLS = 2.0  # cells per triangle, at most; fewer lengthen the lists, more only fill memory
ENTRIES = 12  # list entries per triangle on average, at most, before cells grow
CROWD = 16  # a cell with more triangles is split
SPLIT = 4  # into this many along each side
DEPTH = 6  # at most this often
CHUNK = 1 << 20  # candidates tested at once; bounds the memory of a build


class Lists(NamedTuple):
    """The discrete part of a `Grid`, by the same names."""

    corner: np.ndarray
    pitch: float
    first: np.ndarray
    children: np.ndarray
    members: np.ndarray
    shape: tuple[int, int]
    depth: int


def lists(
    plan: Float[np.ndarray, "triangles 3 2"], listed: Bool[np.ndarray, " triangles"], pad: float
) -> Lists:
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
    return Lists(
        corner=corner,
        pitch=pitch,
        first=np.concatenate([[0], np.cumsum(counts)]),
        children=np.concatenate(children),
        # One entry at least, for the reads of rays that have nothing to meet.
        members=numbers[members[order]] if len(members) else np.zeros(1, np.int64),
        shape=shape,
        depth=depth,
    )


# Middles of a cell's parts, in half sides from its own middle, in the order of `Grid._look_up`.
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
